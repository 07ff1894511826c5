"""What ``python -m pipeline --help`` prints."""

from __future__ import annotations

import re
import textwrap


def format_usage() -> str:
    """The whole help."""
    from pipeline.config.loader import STAGES, list_options

    experiments = {name: _description(name) for name in list_options("experiment")}
    machines = textwrap.fill(", ".join(list_options("machine")), 100, initial_indent="  ", subsequent_indent="  ")
    return f"""\
usage: python -m pipeline stage=STAGE experiment=NAME|machine.file=FILE [KEY=VALUE ...] [-m]

{textwrap.fill(_SUMMARY, 100)}

stages (default: train; a stage whose input is missing makes it first):
{_table(STAGES)}

experiments:
{_table(experiments)}

machines (of an experiment, or alone: machine=NAME; one of your own: machine.file=FILE):
{machines}

examples:
{_EXAMPLES}

options:
  -m, --multirun   one job for every combination of values such as seed=1,2,3
  --cfg job        print the whole configuration and run nothing
  --info           print how Hydra composed it
  -h, --help       this help
  --config-dir DIR machines and experiments of your own, in DIR/machine and DIR/experiment
  --version        the version

Results of an experiment go to artifacts/NAME/ (output=FOLDER for another place); the jobs of a
multirun to a folder of their own each, named by what was swept, such as
artifacts/NAME/optimizer.adam.steps-500/.
Exit codes: 0 done, 1 a threshold passed (stage=check) or a result skipped (stage=identify), 2 a
mistake in what was given, 70 a bug, 130 interrupted."""


_SUMMARY = (
    "Identifies the bearing coefficients of rotating machines from their measured vibration and a model of "
    "shaft and discs. The bearings' stiffness and damping are trained so that the equation of motion holds "
    "at the bearings (FEM-NN)."
)
_EXAMPLES = """\
  python -m pipeline                                         train the default experiment
  python -m pipeline stage=new machine.file=mine.yaml        write a file for a machine of your own
  python -m pipeline stage=train machine.file=mine.yaml      and use it
  python -m pipeline stage=evaluate experiment=NAME          compare with the modelled coefficients
  python -m pipeline stage=[train,evaluate,predict]          several stages, one after the other
  python -m pipeline optimizer.adam.steps=500 seed=3         change values
  python -m pipeline 'machine.rotor.shaft.0.length=150 mm'           quantities carry their unit
  python -m pipeline -m seed=1,2,3                           one job for each value
  python -m pipeline --cfg job experiment=NAME               see the whole configuration"""


def _table(rows: dict[str, str]) -> str:
    width = max(map(len, rows), default=0) + 2
    indent = " " * (width + 2)
    return "\n".join(
        textwrap.fill(row or "-", 100, initial_indent=f"  {name:<{width}}", subsequent_indent=indent)
        for name, row in rows.items()
    )


def _description(experiment: str) -> str:
    """The experiment's ``description``, read without the cost of a YAML parser."""
    from pipeline.config.loader import CONF

    text = (CONF / "experiment" / f"{experiment}.yaml").read_text(encoding="utf-8")
    match = re.search(r"^description: *[>|]?-?\s*(.+)$", text, re.MULTILINE)
    return match[1].strip().strip("'\"") if match else ""
