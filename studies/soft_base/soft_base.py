"""A machine on a soft base, judged by weights and records that a fit has not seen.

    python studies/soft_base/soft_base.py output=FOLDER [records=FILE] [parts=weights,fifths,halves] [overrides ...]

``weights``: the base is fitted without one weight, which is then predicted at all its speeds. ``fifths``: every fifth
record is predicted. ``halves``: natural frequencies from two disjoint halves of the weights. ``records``: a table of
records of other weights in the same columns is predicted from all records of the machine. ``soft_base.json`` has the
scores of the change against no weight: R^2, median relative error, share of readings in 95 % bands.

*Nothing read* is a prediction from what is written on the weight; *label read* takes one complex factor of the weight
from its other records; the factor of the record itself is read nowhere. Fits of folds start at the answer of all
records. Halves have weights apart, and every other record without a weight.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config.compose import compose_config
from pipeline.config.schema import Config
from pipeline.data.dataset import VibrationDataset
from pipeline.data.sensors import NOMINAL_95
from pipeline.files import write_json
from pipeline.identification.output_error_fit import OutputErrorFit, fit_from, fit_output_error, reweigh
from pipeline.identification.problem import OutputError, output_error
from pipeline.identification.training import FitSetup, setup_of
from pipeline.ingest.records import to_dataset
from pipeline.problem.configured import build_measurement
from pipeline.problem.measurement import Measurement
from pipeline.problem.slopes import invert
from pipeline.rotor.model import translation_dof
from pipeline.rotor.stored import load_modelled_bearings, load_rotor, place_probes
from pipeline.twin.modes import find_modes

TWENTY_GRAMS = 1e-3
"""kg m, at the radius that examples/mafaulda guesses."""
MACHINE = Path(__file__).resolve().parents[2] / "examples" / "mafaulda"


def read(config: Config, records: str | None = None) -> Measurement:
    """The records of the machine, or of another file with the same columns."""
    rotor, section = load_rotor(config.machine.rotor), config.machine.rotor
    data = to_dataset(place_probes(rotor, config.machine.recordings).read_records(records))
    known = load_modelled_bearings(section, config.machine.bearings, data.speeds)
    return build_measurement(config, rotor, data, known)


def keep(data: VibrationDataset, present: np.ndarray) -> VibrationDataset:
    """The records ``present`` (S, R) alone."""
    some = replace(data, present=present).at(np.asarray(present.any(axis=1)))
    return some.of_runs(np.flatnonzero(some.present.any(axis=0)))


def without_weights(data: VibrationDataset) -> VibrationDataset:
    """The same as if nothing were on the disc."""
    return replace(data, excitations=tuple(replace(weight, magnitude=0.0) for weight in data.excitations))


def problem_of(fit: OutputErrorFit, data: VibrationDataset) -> OutputError:
    """What the fit says of other records, whose rotor is solved at its answer."""
    measurement = fit.problem.measurement
    values = np.repeat(measurement.known.values[:, :1], len(data.speeds), axis=1)
    other = replace(measurement, dataset=data, known=replace(measurement.known, speeds=data.speeds, values=values))
    return output_error(other, fit.problem.basis, fit.problem.plane_scale).update(fit.weights)


def fit_again(fit: OutputErrorFit, data: VibrationDataset, setup: FitSetup) -> OutputErrorFit:
    """The same fit of some of the records, from where it is."""
    problem = reweigh(problem_of(fit, data), fit.weights, fit.factor, setup.loss.robust)
    every = np.ones(len(data.speeds), dtype=bool)
    measurement = problem.measurement
    changes: dict[str, Any] = {"measurement": measurement, "keep": every, "problem": problem, "weights": fit.weights}
    return fit_from(replace(fit.start, **changes, held_out={}, from_guess=False), setup, near=True, rounds=3)


@dataclass(frozen=True, eq=False)
class Predicted:
    """Accelerations of n records at P probes, as they were read and as a fit predicts them."""

    weight: np.ndarray  # (n,) which run
    read: np.ndarray  # (n, P) complex, m/s^2
    expected: np.ndarray  # (n, P)
    still: np.ndarray  # (n, P) without a weight
    deviation: np.ndarray  # (n, P, 2) of both parts, bands of the fit and noise of a record together

    def label_read(self) -> Predicted:
        """With one complex factor of each weight that the change of its other records shows."""
        change, seen = self.expected - self.still, self.read - self.still
        share, square = np.empty((2, len(self.read)), dtype=complex)
        for run in np.unique(self.weight):
            rows = self.weight == run
            size = (self.deviation[rows] ** 2).sum(axis=2)
            products = (change[rows].conj() * seen[rows] / size).sum(axis=1)
            squares = (np.abs(change[rows]) ** 2 / size).sum(axis=1)
            share[rows], square[rows] = products.sum() - products, squares.sum() - squares
        return replace(self, expected=self.still + (share / square)[:, None] * change)

    def scores(self, names: Sequence[str]) -> dict[str, Any]:
        """R^2 of the change, median relative error, and share in 95 % bands, by probe."""
        off, change = self.read - self.expected, self.read - self.still
        square = 1 - (np.abs(off) ** 2).sum(axis=0) / (np.abs(change) ** 2).sum(axis=0)
        inside = np.abs(np.stack([off.real, off.imag], axis=-1)) < NOMINAL_95 * self.deviation
        return {
            "r2": dict(zip(names, square.tolist(), strict=True)),
            "median_error": dict(zip(names, np.median(np.abs(off) / np.abs(change), axis=0).tolist(), strict=True)),
            "inside_95": dict(zip(names, inside.mean(axis=(0, 2)).tolist(), strict=True)),
        }


def predict(fit: OutputErrorFit, data: VibrationDataset) -> Predicted:
    """The records of ``data`` with a weight on the disc."""
    heavy = {weight.run for weight in data.excitations if weight.magnitude}
    data = keep(data, data.present & np.isin(data.runs, sorted(heavy)))
    problem, still = problem_of(fit, data), problem_of(fit, without_weights(data))
    speed, run = np.nonzero(data.present)
    factor = -(data.frequencies[speed, run] ** 2)[:, None]
    read, expected, none = (
        factor * every[speed, :, run]
        for every in (data.displacement, problem.displacement(fit.weights), still.displacement(fit.weights))
    )
    plain = replace(problem.readings, precision=tuple(p * 0 + 1 for p in problem.readings.precision), records=())
    (columns,) = replace(problem, readings=plain).columns_of_blocks(fit.weights)
    slopes = columns[0, ..., :-1].numpy()[speed, :, run]
    parts = np.stack([slopes.real, slopes.imag], axis=2)  # (n, P, 2, Z)
    spread = np.einsum("npcz,zy,npcy->npc", parts, fit.covariance(), parts, optimize=True) * factor[..., None] ** 2
    both = np.stack([expected.real, expected.imag], axis=-1)
    other = problem.measurement.deviation_of(problem.displacement(fit.weights), factor=fit.factor, alone=True)
    alone = (factor * other[speed, :, run]) ** 2
    noise = (alone / 2)[..., None] + (problem.measurement.noise.record * both) ** 2
    return Predicted(run, read, expected, none, np.sqrt(spread + noise))


def join(every: Sequence[Predicted]) -> Predicted:
    """The predictions of several folds, whose weights stay apart."""
    weight = np.concatenate([each.weight + 100 * i for i, each in enumerate(every)])
    names = ("read", "expected", "still", "deviation")
    return Predicted(weight, *(np.concatenate([getattr(each, name) for each in every]) for name in names))


def modes_of(fit: OutputErrorFit, below: float = 400.0, step: float = 1e-3) -> list[dict[str, float]]:
    """Natural frequencies of rotor and base in Hz, damping ratios and deviations, at the force of 20 g at each."""
    measurement, covariance = fit.problem.measurement, fit.covariance()
    middle, places = len(measurement.dataset.speeds) // 2, fit.problem.places
    table = fit.identified.table(measurement.known).at(np.array([middle]))
    soft = [(t, p) for t, p in enumerate(measurement.parameters) if p.kind == "base_softening"]

    def at(values: np.ndarray, frequency: float) -> np.ndarray:
        rotor, root = measurement.update(values).updated_rotor, frequency * np.sqrt(TWENTY_GRAMS)
        stiffness = rotor.stiffness.copy()
        for t, p in soft:
            place = translation_dof(p.place, "xy".index(p.detail))
            stiffness[place, place] *= np.exp(-values[t] * p.deviation * root)
        modes = find_modes(replace(rotor, stiffness=stiffness), table)
        return np.stack([modes.frequency[0], modes.logarithmic_decrement[0]])

    values = fit.problem.model_parameters(fit.weights)[0].numpy()
    spread, rows = covariance[places.parameters, places.parameters], []
    for k in np.flatnonzero(at(values, 2 * np.pi * 20)[0] < below):
        frequency = 2 * np.pi * 20
        for _ in range(20):
            frequency = float(at(values, frequency)[0, k])
        best = at(values, frequency)[:, k]
        slopes = np.array([(at(values + step * row, frequency)[0, k] - best[0]) / step for row in np.eye(len(values))])
        deviation, damping = float(np.sqrt(slopes @ spread @ slopes)), best[1] / np.sqrt(4 * np.pi**2 + best[1] ** 2)
        rows.append({"hz": best[0] / (2 * np.pi), "deviation": deviation / (2 * np.pi), "damping_ratio": damping})
    return [{name: float(value) for name, value in row.items()} for row in rows]


def main(arguments: list[str]) -> None:
    """Run what is asked for."""
    ours = {"output", "records", "parts"}
    given = {key: value for key, _, value in (a.partition("=") for a in arguments) if key in ours}
    overrides = [a for a in arguments if a.partition("=")[0] not in ours]
    config = compose_config(["experiment=mafaulda", "tracking=none", *overrides], MACHINE)
    setup, measurement = setup_of(config), read(config)
    names, data = list(config.machine.recordings.probes), measurement.dataset
    fit = fit_output_error(measurement, setup)
    parts = given.get("parts", "weights,fifths,halves").split(",")
    report: dict[str, Any] = {"modes": modes_of(fit), "in_sample": predict(fit, data).scores(names)}

    def say(what: str, scores: Any) -> None:
        report[what] = scores
        write_json(Path(given["output"]) / "soft_base.json", report)
        print(what, scores, flush=True)

    def both(predicted: Predicted) -> dict[str, Any]:
        return {"nothing_read": predicted.scores(names), "label_read": predicted.label_read().scores(names)}

    kinds = ("label_gain", "label_angle", "base_softening")
    say("numbers", {p.name: [v * p.deviation, d * p.deviation] for p, v, d in _numbers(fit) if p.kind in kinds})
    say("bearings", _bearings(fit))
    if "records" in given:
        other = predict(fit, read(config, given["records"]).dataset)
        say("other_weights", both(other))
    if "weights" in parts:
        runs, every = [weight.run for weight in data.excitations if weight.magnitude], []
        for run in runs:
            held = np.array(data.runs) == run
            fold = fit_again(fit, keep(data, data.present & ~held), setup)
            every.append(predict(fold, keep(data, data.present & held)))
            say(f"without {run}", {**both(every[-1]), "modes": modes_of(fold)})
        say("weights", both(join(every)))
        say("weights but the heaviest", both(join(every[:-1])))
    if "fifths" in parts:
        order, every = np.cumsum(data.present.T.ravel()).reshape(data.present.T.shape).T % 5, []
        for i in range(5):
            held = data.present & (order == i)
            every.append(predict(fit_again(fit, keep(data, data.present & ~held), setup), keep(data, held)))
        say("fifths", join(every).scores(names))
    if "halves" in parts:
        order = np.cumsum(data.present, axis=0) % 2
        order[:, 1:] = np.arange(1, len(data.runs)) % 2
        say("halves", [modes_of(fit_again(fit, keep(data, data.present & (order == h)), setup)) for h in range(2)])


def _numbers(fit: OutputErrorFit) -> list[tuple[Any, float, float]]:
    """Each model parameter with its value and deviation, in prior deviations."""
    values = fit.problem.model_parameters(fit.weights)[0].tolist()
    spread = np.sqrt(np.diag(fit.covariance())[fit.problem.places.parameters]).tolist()
    return list(zip(fit.problem.measurement.parameters, values, spread, strict=True))


def _bearings(fit: OutputErrorFit) -> dict[str, float]:
    """How much of its prior deviation the records leave of each coefficient: 1 where they tell nothing."""
    problem = fit.problem
    prior = np.sqrt(np.diag(invert(problem.prior.information[None].numpy())[0]))
    left = np.sqrt(np.diag(fit.covariance()))
    return {
        f"{problem.measurement.unknowns.names[u]} {m}": float(left[i] / prior[i])
        for i, (m, u) in enumerate(problem.active)
    }


if __name__ == "__main__":
    main(sys.argv[1:])
