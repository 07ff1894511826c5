"""The physical model and its blend with influence coefficients, as methods that learn from conditions.

Legend: C conditions, S speeds, P channels, N planes, D = S P.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from peers import Peer

from pipeline.balance.fitted import Blend, blend_with_influence, find_contradictions
from pipeline.balance.physical import Physical, read_levels
from pipeline.data.conditions import Conditions
from pipeline.errors import DataError, IdentifiabilityError
from pipeline.identification.output_error_fit import OutputErrorFit, fit_output_error
from pipeline.identification.quality import output_error_quality
from pipeline.identification.training import FitSetup
from pipeline.identification.uncertainty import measure_uncertainty
from pipeline.problem.condition_noise import NO_LEVELS, condition_noise, suffices, to_dataset
from pipeline.problem.measurement import Measurement
from pipeline.problem.noise_levels import NoiseLevels, spread_blocks
from pipeline.rotor.bearing_table import BearingTable


def physical_peers(template: Measurement, setup: FitSetup, rate: float) -> dict[str, Peer]:
    """``physical``: the rotor of the ``template``, fitted to what the influence coefficients find consistent.

    ``blend`` corrects it by influence coefficients. Both leave out conditions that contradict their labels, at the
    false alarms ``rate``. One fit serves both.
    """
    fitted: dict[tuple[object, ...], tuple[Physical, Conditions]] = {}

    def fit(train: Conditions) -> tuple[Physical, Conditions]:
        key = (train.names, train.speeds.tobytes())
        if key not in fitted:
            sound = leave_out(train, rate)
            fitted[key] = fit_physical(template, setup, sound), sound
        return fitted[key]

    def physical(train: Conditions, speeds: np.ndarray) -> Physical:
        model, _ = fit(train)
        return model if np.array_equal(speeds, train.speeds) else carry(model, speeds)

    def blended(train: Conditions, speeds: np.ndarray) -> Blend:
        if not np.array_equal(train.speeds, speeds):
            raise IdentifiabilityError(
                "a blend with influence coefficients must be measured at the speeds that it predicts, but these were "
                "not: the physical model alone tells them"
            )
        return blend_with_influence(*fit(train))

    return {"physical": physical, "blend": blended}


def leave_out(train: Conditions, rate: float) -> Conditions:
    """The conditions that do not contradict their labels; all where they are too few to judge one by the others."""
    try:
        return train.without(find_contradictions(train, rate)[0])
    except IdentifiabilityError:
        return train


def fit_physical(template: Measurement, setup: FitSetup, conditions: Conditions) -> Physical:
    """Fit the rotor of the ``template`` to conditions, at their speeds.

    With too few conditions to estimate the levels of their noise, the noise is as it was stated. Raises as
    :func:`pipeline.identification.output_error_fit.fit_output_error`.
    """
    known = template.known.at(np.abs(template.known.speeds[:, None] - conditions.speeds).argmin(axis=0))
    enough = suffices(conditions)
    measurement = replace(
        template,
        noise=template.noise if enough else template.noise.with_drift(),
        dataset=to_dataset(conditions),
        known=replace(known, speeds=conditions.speeds),
        drift=condition_noise(conditions, template.noise) if enough else NO_LEVELS,
    )
    return physical_of(fit_output_error(measurement, setup), conditions)


def physical_of(fit: OutputErrorFit, conditions: Conditions) -> Physical:
    """The predictor of a fit to these conditions, with the noise that its residuals show, or the stated one where there
    are no levels."""
    measurement = fit.problem.measurement
    if measurement.drift:
        noise = read_levels(fit.problem, fit.weights)
    else:
        variance = (measurement.deviation**2).mean(axis=2)  # (S, P)
        level = spread_blocks(np.stack([np.diag(speed_variance).astype(complex) for speed_variance in variance]))
        noise = NoiseLevels(conditions.record_covariance, level, np.inf)
    return Physical(
        speeds=conditions.speeds,
        channels=conditions.channels,
        planes=conditions.planes,
        noise=noise,
        measurement=measurement,
        problem=fit.problem,
        weights=fit.weights,
        covariance=measure_uncertainty(fit, output_error_quality(fit)).covariance,
    )


def carry(model: Physical, speeds: np.ndarray) -> Physical:
    """The physical model at other ``speeds`` (S,) rad/s.

    The noise there is that of the nearest fitted speed, as much larger as the machine is more lively. Raises
    DataError for known coefficients that depend on the speed.
    """
    values = model.measurement.known.values
    if np.ptp(values, axis=1).any():
        raise DataError(
            "the physical model must have known coefficients that do not depend on the speed to predict at other "
            "speeds, but they do: give them as values"
        )
    table = BearingTable(model.measurement.known.nodes, speeds, np.repeat(values[:, :1], len(speeds), axis=1))
    interpolated = replace(model, speeds=speeds, measurement=replace(model.measurement, known=table))
    here, asked = (np.abs(known.influence_at(np.zeros(len(model.planes)))[0]) for known in (model, interpolated))
    return replace(interpolated, noise=_carry(model.noise, model.speeds, speeds, here, asked))


def _carry(
    noise: NoiseLevels, fitted: np.ndarray, speeds: np.ndarray, here: np.ndarray, asked: np.ndarray
) -> NoiseLevels:
    """The noise at ``speeds``, of that at the ``fitted`` ones; ``here`` and ``there`` (D, N) are the influences."""
    nearest = np.abs(speeds[:, None] - fitted).argmin(axis=1)
    n_channels = noise.record.shape[1]
    power = [(influence.reshape(len(s), -1) ** 2).sum(1) for influence, s in ((here, fitted), (asked, speeds))]
    blocks = [noise.condition[s * n_channels :, s * n_channels :][:n_channels, :n_channels] for s in nearest]
    ratio = power[1] / power[0][nearest]
    condition = spread_blocks(np.stack([r * block for r, block in zip(ratio, blocks, strict=True)]))
    return replace(noise, record=noise.record[nearest] * ratio[:, None, None], condition=condition)
