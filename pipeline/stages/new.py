"""Write a machine file: everything of a machine in one file, with comments, ready to run or to be filled in."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path

from pipeline.config.messages import quote_override
from pipeline.config.own_machines import clean_name, make_absolute
from pipeline.data.csv_format import CsvConfig, describe_format
from pipeline.errors import ConfigError, DataError
from pipeline.files import render, write_text
from pipeline.ingest.recognition import recognize_recordings
from pipeline.reporting.console import say
from pipeline.rotor.stored import load_rotor
from pipeline.stages.analysis import Analysis
from pipeline.tracking import StageRecord


def run(analysis: Analysis) -> StageRecord:
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
    new, guesses, rotor = config.new, dict[str, str](), config.machine.rotor
    data = new.data
    if new.source:
        source, nodes = make_absolute(new.source), load_rotor(rotor).bearing_nodes if rotor.file else (1, 5)
        data, guesses = recognize_recordings(source, path.parent, nodes)
        for sentence in describe_format(source, (), CsvConfig()) if source.suffix in (".csv", ".txt") else ():
            say(sentence)
    text = insert_guesses(fill_template(path, new.bearings, data, new.supports, new.probes), guesses)
    if rotor.file:
        file = json.dumps(os.path.relpath(make_absolute(rotor.file), path.parent), ensure_ascii=False)
        text = text.replace("\n  file: null ", f"\n  file: {file} ", 1)
    write_text(path, text)
    say(f"machine file in '{path}'")
    if data == "simulated":
        say(f"it runs as it is; next: {command.format('stage=identify')}")
    else:
        asked = f"places of the probes and every ??? ({text.count('???')})" if guesses else "probes, runs and paths"
        say(
            f"fill in {'' if rotor.file else 'the rotor, '}{asked} (what you leave as it is belongs to an example), "
            f"next: {command.format('stage=identify')}"
        )
    return StageRecord(files=[path])


def insert_guesses(text: str, guesses: Mapping[str, str]) -> str:
    """A machine file with what was recognised in place of the example's: the values, or lines, of keys of
    ``recordings``; a key without any becomes a comment."""
    before, mark, recordings = text.partition("\nrecordings:\n")
    for key, guess in guesses.items():
        value = guess if guess.startswith("  #") else f" {guess}"  # lines, with what to confirm of them
        pattern = rf"(?m)^( +{key}:)(?: [^#\n]+?(?= *(?:#|$))|.*\n(?:    .*\n)+)"
        found = re.search(pattern, recordings)
        if found:
            told = found[1] + value if guess else found[0].replace(key, f"# {key}", 1)
            recordings = recordings[: found.start()] + told + recordings[found.end() :]
    return before + mark + recordings


def fill_template(path: Path, bearings: str, data: str, supports: str = "none", probes: str = "shaft") -> str:
    """The text of a machine file for this kind of bearings, source of data, supports, and motion that probes measure.

    In ``machine_file.yaml``, ``{% if simulated and fluid_film %}`` begins a part of files that are all of that.
    """
    sections = {
        "simulated": {"simulated"},
        "processed": {"processed", "measured"},
        "recordings": {"recordings", "recorded", "measured"},
        "tables": {"tables", "recorded", "measured"},
        "exciter": {"exciter", "recorded", "measured"},
    }
    seen = {"shaft": {"shaft"}, "both": {"relative", "casing", "ground"}}.get(probes, {probes, "ground"})
    tags = {bearings, supports} | sections[data] | seen
    command = f"python -m pipeline stage=identify {quote_override('machine.file', path.name)}"
    return render(
        Path(__file__).with_name("machine_file.yaml"),
        command=command,
        name=clean_name(path),
        **dict.fromkeys(tags, True),
    )
