"""Model the machine and write its vibration: what a measurement would have given."""

from __future__ import annotations

import numpy as np

from pipeline.data.operating import describe_points
from pipeline.data.tables import read_marks
from pipeline.errors import DataError
from pipeline.problem.configured import find_idle, model_machine, read_probes
from pipeline.reporting.console import say, warn
from pipeline.stages.analysis import Analysis, require_own, write_data
from pipeline.tracking import StageRecord
from pipeline.twin.modes import StabilityMargin, find_modes, measure_stability
from pipeline.units import RAD_S_PER_RPM
from pipeline.write_numbers import write_number


def run(analysis: Analysis) -> StageRecord:
    """Vibration, excitation, and the modelled and the known coefficients."""
    config = analysis.config
    require_own(analysis, "generate")
    marks = read_marks(analysis.vibration)
    if marks is not None and "origin" not in marks:
        raise DataError(
            f"generate must not replace what it did not write, but '{analysis.vibration}' was made elsewhere: move it "
            "and give it as data.vibration=..., or choose another folder with output=FOLDER"
        )
    rotor, bearings, complete = model_machine(config)
    dataset = read_probes(config, rotor, complete)
    *written, _ = write_data(analysis, dataset, bearings, bearings, rotor.fingerprint)
    # A tenth of the speeds shows the trend; the eigenvalues of all would take longer than the vibration.
    margin = measure_stability(find_modes(rotor, bearings.at(np.arange(0, len(dataset.speeds), 10))))
    say(
        f"{config.name}: {len(dataset.runs)} runs, {describe_points(dataset)}, {len(dataset.channels)} channels in "
        f"'{analysis.vibration}'\n" + _describe_margin(margin)
    )
    for name in find_idle(bearings):
        warn(
            f"no bearing depends on {name}: the data are the same at all its values (a film depends on the oil's "
            "temperature where oil_viscosity is a law, and on the load where static_load is 'condition')"
        )
    if not margin.stable:
        warn(
            f"the modelled rotor is unstable somewhere (growth {write_number(margin.largest_growth, digits=3)} 1/s): "
            "its steady vibration can't be measured"
        )
    return StageRecord(
        metrics={
            "stability": {
                "largest_growth": margin.largest_growth,
                "smallest_logarithmic_decrement": margin.smallest_logarithmic_decrement,
            }
        },
        tags={"data_fingerprint": dataset.fingerprint, "rotor_fingerprint": rotor.fingerprint},
        files=written,
    )


def _describe_margin(margin: StabilityMargin) -> str:
    if margin.smallest_logarithmic_decrement is None or margin.at_speed is None:
        return "no whirling mode below twice the top speed"
    at = margin.at_speed / RAD_S_PER_RPM
    return f"smallest logarithmic decrement {margin.smallest_logarithmic_decrement:.3f} at {at:.0f} rpm"
