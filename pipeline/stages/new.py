"""Write a machine file: everything of a machine in one file, with comments, ready to run or to be filled in."""

from __future__ import annotations

import os
from pathlib import Path

from pipeline.config.messages import written
from pipeline.config.own_machines import absolute, plain_name
from pipeline.config.schema import Config
from pipeline.errors import ConfigError, DataError
from pipeline.files import write_text
from pipeline.reporting.console import say
from pipeline.stages.execution import StageOutput


def run(config: Config) -> StageOutput:
    """The machine file, and the next command. Raises ConfigError without ``machine.file``, DataError where it is."""
    if config.machine.file is None:
        raise ConfigError("stage=new must know the file to write, but has none: add machine.file=my_machine.yaml")
    path = absolute(config.machine.file)
    if path.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"machine.file must end in .yaml, but got '{path.name}': add the ending")
    if os.path.lexists(path):
        raise DataError(f"stage=new must not replace a file, but '{path}' is there: choose another name, or move it")
    command = f"python -m pipeline {{}} {written('machine.file', config.machine.file)}"
    write_text(path, template(path, config.new.bearings, config.new.data))
    say(f"machine file in '{path}'")
    if config.new.data == "simulated":
        say(f"it runs as it is; next: {command.format('stage=train')}")
    else:
        say(
            "fill in rotor, probes and the paths of your recordings (what you leave as it is belongs to an example), "
            f"next: {command.format('stage=ingest')}"
        )
    return StageOutput(files=[path])


def template(path: Path, bearings: str, data: str) -> str:
    """The text of a machine file for this kind of bearings and source of data."""
    simulated = data == "simulated"
    parts = [
        _HEAD.format(
            name=plain_name(path), command=f"python -m pipeline stage=train {written('machine.file', path.name)}"
        ),
        _IDENTIFIED[bearings],
        _ROTOR,
        (_SIMULATED_BEARINGS if simulated else _EXPECTED_BEARINGS) + _BEARINGS[bearings],
        _SIMULATED.format(more=_BACKWARD if bearings == "fluid_film" else "") if simulated else _RECORDINGS[data],
    ]
    known = _KNOWN[bearings] if not simulated else ""
    return "\n".join([*parts[:-1], parts[-1] + known, _REST])


_HEAD = """\
# Everything of a machine in one file. In the folder of this file:
#
#     {command}
#
# Anything here can be changed for one command, such as machine.rotor.discs.0.width='40 mm'. Results go to
# artifacts/{name} of the folder that the command is given in (name=NAME, output=FOLDER for others).
#
# Quantities carry their unit; a number alone is SI. Relative paths start in the folder of this file. Nodes of the shaft
# are counted from 0; x, y and all angles: from x towards y, the sense in which the shaft turns.
#
"""
_IDENTIFIED = {
    "rolling": """\
# What is identified: kxx, kyy, cxx and cyy of each bearing, the same at every speed. Others for a command:
# identify.unknowns=[kxx,kyy]; by another method: experiment=NAME (python -m pipeline --help lists them).
""",
    "fluid_film": """\
# What is identified: all eight coefficients of each bearing, as functions of the speed. Fewer for a command:
# identify.unknowns=[kxx,kyy,cxx,cyy]; by another method: experiment=NAME (python -m pipeline --help lists them).
""",
}
_ROTOR = """\
rotor:
  shaft:  # from the left; each piece is divided into `elements` finite elements, and a node is at each end of one
    - {length: 900 mm, outer_diameter: 50 mm, inner_diameter: 0 mm, elements: 6}
  material: {density: 7810 kg/m^3, youngs_modulus: 211 GPa, shear_modulus: 81.2 GPa}
  discs:  # by width and diameters; or by mass, diametral_inertia and polar_inertia (kg m^2)
    - {node: 2, width: 50 mm, inner_diameter: 50 mm, outer_diameter: 220 mm}
    - {node: 4, width: 50 mm, inner_diameter: 50 mm, outer_diameter: 260 mm}
  bearing_nodes: [1, 5]
  shear_effects: true
  file: null  # a rotor saved by ROSS (.toml, .json) takes the place of all the above
"""
_SIMULATED_BEARINGS = "# The bearings that data are simulated with. Training does not see what it identifies.\n"
_EXPECTED_BEARINGS = """\
# The bearings as they are expected: stage=design plans runs with them. Training does not see what it identifies.
"""
_BEARINGS = {
    "rolling": """\
bearings:  # or kind: ball (n_balls, ball_diameter, static_load, contact_angle); kind: per_node where they differ
  kind: linear
  kxx: 4.0e7  # N/m
  kyy: 6.0e7
  cxx: 4.0e3  # N s/m
  cyy: 5.0e3
""",
    "fluid_film": """\
bearings:  # or kind: journal_table (a published table); kind: per_node where they differ: nodes: {1: {...}, 5: {...}}
  kind: cylindrical
  journal_diameter: 60 mm
  length: 30 mm
  radial_clearance: 0.08 mm
  oil_viscosity: 0.05 Pa s
  static_load: null  # each bearing carries an equal share of the rotor's weight
""",
}
_SIMULATED = """\
speeds: {{start_rpm: 500, stop_rpm: 6000, step_rpm: 50}}
runs:  # trial unbalances; a shaker or magnetic bearing: forces: [{{node: 2, magnitude: 10 N, whirl: backward}}]
  - {{name: first_disc, unbalances: [{{node: 2, magnitude: 100 g mm, phase: 0 deg}}]}}
  - {{name: second_disc, unbalances: [{{node: 4, magnitude: 100 g mm, phase: 90 deg}}]}}
{more}residual_unbalance: []  # in every run, and nobody knows: [{{node: 2, magnitude: 40 g mm, phase: 50 deg}}]

probes:
  at: bearings  # x and y there; all: at every node; or a list, two a node: [{{node: 1, angle: 45 deg}}, ...]
  additive: 0 um        # noise of each reading: root mean square,
  multiplicative: 0.01  # and as a share of the reading
  runout: 0 um
  quantisation: 0 um
  seed: 0

recordings:
  format: none  # of simulated data; stage=new new.data=recordings (or tables) shows what a measured machine has here
"""
_BACKWARD = """\
  - {name: backward, forces: [{node: 2, magnitude: 10 N, whirl: backward}]}  # for the cross-coupling
"""
_RECORDINGS = {
    "recordings": """\
# Time signals of run-ups and a tacho: HDF5, TDMS, CSV or Excel. All options: docs/ingest.md.
recordings:
  format: waveform
  records: run_up       # or constant_speed: one file a speed (`files: [...]` of a run)
  signal_unit: V        # of the stored numbers: V, mV, or um ... (then without scale)
  sample_rate: 10 kHz   # or time: CHANNEL with time_unit, or sample_rate_attribute; a TDMS channel may say it itself

  # At least two probes at a node. channel: HDF5 path, TDMS group/channel, or column. scale: negative where the voltage
  # falls as the shaft comes nearer.
  probes:
    DE_left: {node: 1, angle: 45 deg, channel: signals/DE_left, scale: 7.87 V/mm}
    DE_right: {node: 1, angle: 135 deg, channel: signals/DE_right, scale: 7.87 V/mm}
    NDE_left: {node: 5, angle: 45 deg, channel: signals/NDE_left, scale: 7.87 V/mm}
    NDE_right: {node: 5, angle: 135 deg, channel: signals/NDE_right, scale: 7.87 V/mm}
  tacho: {angle: 0 deg, channel: signals/tacho, edge: rising, pulses_per_revolution: 1}

  # Phases of trial weights: angles on the shaft from the tacho's mark, with_rotation or against_rotation; or from_x.
  shaft_angle: with_rotation
  runs:
    - {name: as_found, file: recordings/as_found.h5}
    - {name: first_disc, file: recordings/first_disc.h5, unbalances: [{node: 2, magnitude: 100 g mm, phase: 0 deg}]}
    - {name: second_disc, file: recordings/second_disc.h5, unbalances: [{node: 4, magnitude: 100 g mm, phase: 90 deg}]}
  baseline: as_found    # the run without weights: it is subtracted, and with it residual unbalance and runout
  speeds: {start_rpm: 1500, stop_rpm: 5800, step_rpm: 25}  # vectors are fitted at these, inside every run-up
  slow_roll: null       # runout, where there is no baseline: {below_rpm: 300}
""",
    "tables": """\
# Amplitudes and phases over the speed, CSV or Excel: one file a run, one row a speed, two columns a probe. All options:
# docs/ingest.md.
recordings:
  format: table
  layout: wide               # or long: one row a run, speed and probe
  conventions:               # what the numbers mean; none of these has a default
    length: um               # of the amplitudes: um, mm, m, mil, in ...
    amplitude: peak_to_peak  # zero_to_peak, peak_to_peak or rms
    phase: lag               # lag: degrees from the tacho pulse to the next positive peak; lead: its opposite
    phase_unit: deg          # deg or rad
    speed: rpm               # rpm, Hz or rad/s
  columns: {speed: speed_rpm}

  # At least two probes at a node, each with its two columns.
  probes:
    DE_left: {node: 1, angle: 45 deg, columns: {amplitude: DE_left um pp, phase: DE_left deg}}
    DE_right: {node: 1, angle: 135 deg, columns: {amplitude: DE_right um pp, phase: DE_right deg}}
    NDE_left: {node: 5, angle: 45 deg, columns: {amplitude: NDE_left um pp, phase: NDE_left deg}}
    NDE_right: {node: 5, angle: 135 deg, columns: {amplitude: NDE_right um pp, phase: NDE_right deg}}
  tacho: {angle: 0 deg}

  # Phases of trial weights: angles on the shaft from the tacho's mark, with_rotation or against_rotation; or from_x.
  shaft_angle: with_rotation
  runs:
    - {name: as_found, file: recordings/as_found.csv}
    - {name: first_disc, file: recordings/first_disc.csv, unbalances: [{node: 2, magnitude: 100 g mm, phase: 0 deg}]}
    - {name: second_disc, file: recordings/second_disc.csv, unbalances: [{node: 4, magnitude: 100 g mm, phase: 90 deg}]}
  baseline: as_found         # the run without weights: it is subtracted, and with it residual unbalance and runout
  speeds: {start_rpm: 1500, stop_rpm: 5800, step_rpm: 25}  # the runs are brought to these; they must cover them
  slow_roll: null            # runout, where there is no baseline: {below_rpm: 300}
""",
}
_KNOWN = {
    "rolling": """\
  known: bearings  # what is not identified is as `bearings` says above (no cross-coupling); or a table of your own
""",
    "fluid_film": """\
  known: null  # a table of what is not identified (docs/ingest.md), or bearings: as `bearings` says above
""",
}
_REST = """\
# What stage=predict looks at: an unbalance that no run has, at a speed of the data.
prediction:
  node: 4
  speed_rpm: 3000
  unbalances:
    - {node: 2, magnitude: 60 g mm, phase: 30 deg}
    - {node: 4, magnitude: 150 g mm, phase: 200 deg}

# What stage=design may choose runs from: trial unbalances, singly and in pairs, and a shaker's rotating force.
candidates:
  unbalance_nodes: [2, 4]
  unbalance: 100 g mm
  force_nodes: [2, 4]  # [] without a shaker
  force: 10 N
  whirls: [forward, backward]
  phases_deg: [0, 90, 180, 270]
"""
