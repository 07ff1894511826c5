"""Thirty prepared cases with known coefficients: is a verdict right?

    python studies/verdicts/judge.py output=FOLDER          # all cases of cases.yaml, into FOLDER/verdicts.json
    python studies/verdicts/judge.py output=FOLDER noise=estimated      # the same where nobody states the noise

What is counted was laid down before the first case was run. A coefficient that is called good is *outside* where the
median over the speed of its error over the half width of the 95 % band that the verdict states is above 1, and
*outside the fit's band* where the same holds for the fit's own 95 % interval. Good ones and those with care are *low*
where the band holds at less than 85 % of the speeds, point by point. A coefficient is *accurate* where the median over
the speed of its error is below 5 % of its size; a cross term counts as a tenth of the direct ones at least, since what
is nearly nothing has no percent. Verdicts never see the modelled coefficients: they are read here alone.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.compose import compose_config
from pipeline.config.schema import Config
from pipeline.data.dataset import VibrationDataset
from pipeline.data.sensors import NOMINAL_95
from pipeline.errors import PipelineError
from pipeline.files import write_json
from pipeline.identification.fit import fit
from pipeline.identification.identified import answer_of
from pipeline.identification.training import setup_of
from pipeline.parameters.as_built import stand_on_pedestals
from pipeline.problem.configured import build_measurement, model_machine, read_probes
from pipeline.problem.determination import measure_sizes
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.trust.judgement import assess

CASES = Path(__file__).with_name("cases.yaml")
ACCURATE = 0.05


def prepare(
    case: Mapping[str, Any], machines: Mapping[str, Any], noise: str = "stated"
) -> tuple[Config, Measurement, BearingTable]:
    """The configuration, the measurement as it is stated, and the modelled coefficients."""
    name = case["machine"]
    own = [*machines["machines"][name], *case.get("overrides", []), "tracking=none"]
    own += machines["coverage_noise"] if own[0].startswith("machine.file") else []
    own += [f"loss.noise={noise}"] if noise != "stated" else []
    config = compose_config([*own, f"output={tempfile.gettempdir()}/verdicts"])
    rotor, bearings, complete = model_machine(config)
    data = read_probes(config, rotor, complete)
    for what, given in case.get("wrong", {}).items():
        data = WRONG[what](data, given)
    keep = np.isin(bearings.speeds, data.speeds)
    truth = bearings.at(keep)
    if config.machine.as_built is not None:
        truth = stand_on_pedestals(truth, config.machine.as_built)
    known = replace(truth, values=np.where(_unknown(config, truth), 0.0, bearings.at(keep).values))
    return config, build_measurement(config, rotor, data, known), truth


def _unknown(config: Config, table: BearingTable) -> np.ndarray:
    return config.identify.unknowns_of(table.nodes).identified[:, None]


def judge(config: Config, measurement: Measurement, truth: BearingTable) -> dict[str, Any]:
    """Verdicts beside errors, a row a coefficient; or that the data were refused."""
    try:
        found = fit(measurement, setup_of(config))
    except PipelineError as error:
        return {"refused": str(error), "coefficients": []}
    assert found.uncertainty is not None
    about = {"fit": found.quality.summary["fit"], "outcome": found.outcome.label}
    verdicts, evidence = assess(config, answer_of(measurement, found.model, found.uncertainty), about)
    truth = truth.at(np.isin(truth.speeds, evidence.answer.speeds))  # of a fit that ran off, only some can be judged
    own = found.deviation(truth.speeds)
    assert own is not None
    rows = []
    for one in verdicts["verdicts"]:
        b, c = one["bearing"] - 1, COEFFICIENTS.index(one["coefficient"])
        error = np.abs(evidence.answer.values[b, :, c] - truth.values[b, :, c])
        rows.append(
            {
                "coefficient": f"node {one['node']} {one['coefficient']}",
                "verdict": one["verdict"],
                "error_percent": 100 * _compare(error, measure_sizes(truth.values)[b, :, c]),
                "band_percent": one["checks"]["band"]["percent"],
                "within_percent": 100 * float(np.mean(error <= evidence.band[b, :, c])),
                "error_over_band": _compare(error, evidence.band[b, :, c]),
                "error_over_fit_band": _compare(error, NOMINAL_95 * own[b, :, c]),
                "reason": one["reasons"][0],
            }
        )
    return {"machine": verdicts["machine"], "misfit": evidence.misfit.of_stated, "coefficients": rows}


def _compare(error: np.ndarray, size: np.ndarray) -> float:
    """Median over the speed of a ratio; very large where an error is compared with nothing."""
    return float(np.median(error / np.maximum(np.nan_to_num(size, nan=np.inf), 1e-9 * error + 1e-300)))


def count(results: Mapping[str, Mapping[str, Any]]) -> dict[str, int]:
    """What is counted, over all coefficients of the cases."""
    rows = [row for result in results.values() for row in result["coefficients"]]
    good, careful = ([row for row in rows if row["verdict"] == verdict] for verdict in ("good", "with care"))
    accurate = [row for row in rows if row["error_percent"] < 100 * ACCURATE]
    return {
        "cases": len(results),
        "coefficients": len(rows),
        "good": len(good),
        "good_outside": sum(row["error_over_band"] > 1 for row in good),
        "good_outside_the_fits_band": sum(row["error_over_fit_band"] > 1 for row in good),
        "good_with_20_percent_error": sum(row["error_percent"] > 20 for row in good),
        "good_low": sum(row["within_percent"] < 85 for row in good),
        "with_care": len(careful),
        "with_care_low": sum(row["within_percent"] < 85 for row in careful),
        "no": sum(row["verdict"] == "no" for row in rows),
        "outside_the_fits_band": sum(row["error_over_fit_band"] > 1 for row in rows),
        "accurate": len(accurate),
        "accurate_not_good": sum(row["verdict"] != "good" for row in accurate),
        "wrong_by_20_percent": sum(row["error_percent"] > 20 for row in rows),
        "refused": sum("refused" in result for result in results.values()),
    }


# --- what is wrong ---------------------------------------------------------------------------------------


def _gain_of_run(data: VibrationDataset, given: list[float]) -> VibrationDataset:
    run, size, degrees = given
    gain = np.ones(len(data.runs), dtype=complex)
    gain[int(run)] = size * np.exp(1j * np.radians(degrees))
    return replace(data, displacement=data.displacement * gain)


def _gain_of_probe(data: VibrationDataset, given: list[float]) -> VibrationDataset:
    gain = np.ones((len(data.channels), 1))
    gain[int(given[0])] = given[1]
    return replace(data, displacement=data.displacement * gain)


def _gain_of_all(data: VibrationDataset, given: list[float]) -> VibrationDataset:
    return replace(data, displacement=data.displacement * given[0] * np.exp(1j * np.radians(given[1])))


def _angle_of_probe(data: VibrationDataset, given: list[float]) -> VibrationDataset:
    channels = list(data.channels)
    node, angle = channels[int(given[0])]
    channels[int(given[0])] = (node, angle + given[1])
    return replace(data, channels=tuple(channels))


def _node_of_weight(data: VibrationDataset, given: list[int]) -> VibrationDataset:
    acting = list(data.excitations)
    acting[given[0]] = replace(acting[given[0]], node=given[1])
    return replace(data, excitations=tuple(acting))


def _exchange_runs(data: VibrationDataset, given: list[int]) -> VibrationDataset:
    order = list(range(len(data.runs)))
    order[given[0]], order[given[1]] = order[given[1]], order[given[0]]
    return replace(data, displacement=data.displacement[..., order])


def _keep_speeds(data: VibrationDataset, given: int) -> VibrationDataset:
    return data.at(np.unique(np.linspace(0, len(data.speeds) - 1, given).round().astype(int)))


def _correlated_noise(data: VibrationDataset, given: list[float]) -> VibrationDataset:
    """A share of the reading that wanders over the speed, of this correlation between neighbours."""
    share, correlation = given
    draw = np.random.default_rng(3).standard_normal((2, *data.displacement.shape))
    steps = (draw[0] + 1j * draw[1]) / np.sqrt(2)
    for s in range(1, len(steps)):
        steps[s] = correlation * steps[s - 1] + np.sqrt(1 - correlation**2) * steps[s]
    return replace(data, displacement=data.displacement * (1 + share * steps))


WRONG: dict[str, Callable[[VibrationDataset, Any], VibrationDataset]] = {
    "gain_of_run": _gain_of_run,
    "gain_of_probe": _gain_of_probe,
    "gain_of_all": _gain_of_all,
    "angle_of_probe": _angle_of_probe,
    "node_of_weight": _node_of_weight,
    "exchange_runs": _exchange_runs,
    "keep_runs": lambda data, given: data.of_runs(np.array(given)),
    "keep_speeds": _keep_speeds,
    "conjugate": lambda data, given: replace(data, displacement=data.displacement.conj()),
    "correlated_noise": _correlated_noise,
}


def main(arguments: list[str]) -> None:
    """Judge the cases of ``group=chosen`` or ``judged`` (both) and write them with their counts."""
    given = dict(argument.split("=", 1) for argument in arguments)
    machines = yaml.safe_load(CASES.read_text(encoding="utf-8"))
    summary: dict[str, Any] = {}
    for group in [given["group"]] if "group" in given else ["chosen", "judged"]:
        results = {}
        for name, case in machines[group].items():
            if given.get("case") not in (None, name):
                continue
            results[name] = judge(*prepare(case, machines, given.get("noise", "stated")))
            print(f"{group}: {name}: {json.dumps(count({name: results[name]}))}", flush=True)
        summary[group] = count(results) | {"of": results}
    both = [summary[group].pop("of") for group in summary]
    summary["all"] = count({name: one for of in both for name, one in of.items()})
    folder = Path(given["output"])
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "verdicts.json", summary)
    write_json(folder / "cases.json", {name: one for of in both for name, one in of.items()})
    print(json.dumps(summary, indent=2))


if __name__ == "__main__":
    main(sys.argv[1:])
