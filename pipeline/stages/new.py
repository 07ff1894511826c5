"""Write a machine file: everything of a machine in one file, with comments, ready to run or to be filled in."""

from __future__ import annotations

import os
from pathlib import Path

from pipeline.config.messages import quote_override
from pipeline.config.own_machines import clean_name, make_absolute
from pipeline.errors import ConfigError, DataError
from pipeline.files import write_text
from pipeline.reporting.console import say
from pipeline.stages.analysis import Analysis
from pipeline.stages.execution import StageOutput

TEMPLATE = Path(__file__).with_name("machine_file.yaml")


def run(analysis: Analysis) -> StageOutput:
    """The machine file, and the next command. Raises ConfigError without ``machine.file``, DataError where it is."""
    config = analysis.config
    if config.machine.file is None:
        raise ConfigError("stage=new must know the file to write, but has none: add machine.file=my_machine.yaml")
    path = make_absolute(config.machine.file)
    if path.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"machine.file must end in .yaml, but got '{path.name}': add the ending")
    if os.path.lexists(path):
        raise DataError(f"stage=new must not replace a file, but '{path}' is there: choose another name, or move it")
    command = f"python -m pipeline {{}} {quote_override('machine.file', config.machine.file)}"
    write_text(path, fill_template(path, config.new.bearings, config.new.data))
    say(f"machine file in '{path}'")
    if config.new.data == "simulated":
        say(f"it runs as it is; next: {command.format('stage=identify')}")
    else:
        say(
            "fill in rotor, probes, runs and the paths of your data (what you leave as it is belongs to an example), "
            f"next: {command.format('stage=identify')}"
        )
    return StageOutput(files=[path])


def fill_template(path: Path, bearings: str, data: str) -> str:
    """The text of a machine file for this kind of bearings and source of data.

    In ``machine_file.yaml``, a line such as ``#: simulated fluid_film`` begins a part of files that are all of that.
    """
    sections = {
        "simulated": {"simulated"},
        "processed": {"processed", "measured"},
        "recordings": {"recordings", "recorded", "measured"},
        "tables": {"tables", "recorded", "measured"},
    }
    tags = {bearings} | sections[data]
    lines, wanted = [], True
    for line in TEMPLATE.read_text(encoding="utf-8").splitlines(keepends=True):
        if line.startswith("#:"):
            wanted = set(line.split()[1:]) <= tags
        elif wanted:
            lines.append(line)
    command = f"python -m pipeline stage=identify {quote_override('machine.file', path.name)}"
    return "".join(lines).replace("{command}", command).replace("{name}", clean_name(path))
