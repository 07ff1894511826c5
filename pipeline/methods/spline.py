"""Output error with B-splines of the speed in place of the network: the fair competitor of the output error.

As many spline functions as the data determine, by the same criterion as the network's features; and a value for each
speed, which is the end of that growth, where Akaike's criterion likes it better (Akaike 1974).

Legend: S speeds, M members, U unknowns, A those of them that members have.
"""

from __future__ import annotations

import numpy as np

from pipeline.identification.losses import loss_of
from pipeline.identification.optimizers import levenberg_marquardt, until_still
from pipeline.identification.output_error_fit import OutputErrorFit, fit_output_error, invert
from pipeline.identification.quality import output_error_quality
from pipeline.identification.selection import AKAIKE
from pipeline.identification.sensor_deviations import SpeedwiseProblem
from pipeline.identification.training import FitSetup
from pipeline.identification.uncertainty import uncertainty_of
from pipeline.methods.method import Estimate, MethodOptions, doubt_of, drop_unbalance, estimate, refuse_undetermined
from pipeline.problem.measurement import Measurement


def spline(measurement: Measurement, options: MethodOptions) -> Estimate:
    """The spline that Akaike's criterion chooses, and its Cramer-Rao deviations."""
    data, own = drop_unbalance(measurement), options.settings.spline
    setup = FitSetup(own.model, own.loss, own.optimizer, own.training, options.seed)
    refuse_undetermined(loss_of(own.loss).diagnose(data, setup).reports)
    smooth = fit_output_error(data, setup)
    answer = None if setup.constant else _each_speed(smooth, setup)
    if answer is not None:
        return answer
    quality = output_error_quality(smooth)
    words = f"{smooth.problem.n_fitted} numbers, {smooth.minimum.outcomes[0].label} after {smooth.minimum.steps} steps"
    identified, speeds = smooth.identified, data.dataset.speeds
    deviation = uncertainty_of(smooth).deviation(identified, speeds)
    return Estimate(identified.table(data.known), deviation, words, doubt_of(quality.misfit))


def _each_speed(smooth: OutputErrorFit, setup: FitSetup) -> Estimate | None:
    """A value for each speed, from the smooth answer on; None where the smooth one has the better criterion."""
    import torch

    data, sensors = smooth.start.measurement, smooth.problem.sensors
    problem = SpeedwiseProblem(sensors)
    outputs = smooth.problem.outputs(smooth.weights)
    start = torch.stack([outputs[:, m, :, u] for m, u in sensors.active], dim=-1)
    found = levenberg_marquardt(problem, start, setup.optimizer.levenberg_marquardt, until_still(), by_diagonal=True)
    smooth_square = float(smooth.problem.rows(smooth.weights).square().sum())
    square, count = float(problem.rows(found).square().sum()), found.numel()
    if not square + AKAIKE * count < smooth_square + AKAIKE * smooth.problem.n_fitted:
        return None
    values, slope = sensors.unknowns(problem.outputs(found))
    spread = invert(problem.normal(found)[1][0])
    deviation = np.sqrt(np.einsum("saa->sa", spread)) * np.abs(slope[0].numpy())
    unknowns, expected = data.unknowns, sensors.n_rows - count
    words = f"{count} numbers, a value for each speed"
    doubt = doubt_of(square / expected) if expected > 0 else ""
    from_active = unknowns.from_active
    return estimate(data, from_active(values[0].numpy()), from_active(deviation), words, doubt)
