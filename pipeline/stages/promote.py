"""Let training use what a study found: copy its report over that of the experiment."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from shutil import copyfile

from pipeline.config.promotion import BEST, apply_values, read_promoted
from pipeline.errors import ConfigError
from pipeline.files import read_json, write_beside
from pipeline.reporting.console import say, table
from pipeline.reporting.study_files import AGAIN, SUMMARY
from pipeline.stages.analysis import Analysis
from pipeline.tracking import StageRecord
from pipeline.write_numbers import write_value


def run(analysis: Analysis) -> StageRecord:
    """Say what changes in ``tuning.promoted``, then copy ``tuning.folder`` there.

    :raises ConfigError: where there is no such study, or it is of another experiment
    """
    config = analysis.config
    source, target = Path(config.tuning.folder), Path(config.tuning.promoted)
    promoted = read_promoted(source)
    if promoted is None:
        raise ConfigError(
            f"a study must have ended before it is promoted, but there is no '{source / BEST}': run stage=tune with "
            f"tuning.study={config.tuning.study}, or name another (make promote STUDY=NAME EXPERIMENT=NAME)"
        )
    owner = read_json(source / SUMMARY, AGAIN).get("experiment")
    if owner != config.name:
        raise ConfigError(
            f"a study must be promoted for the experiment that it is of, but '{source}' is of {owner}, not of "
            f"{config.name}: give experiment={owner} (make promote STUDY={config.tuning.study} EXPERIMENT={owner})"
        )
    apply_values(config, promoted.values, f"'{source / BEST}'")
    reports = [path for path in sorted(source.rglob("*")) if path.is_file() and not path.name.startswith(".")]
    files = [path.relative_to(source) for path in reports]
    changes = {name: _compare(source / name, target / name) for name in files}
    if not any(changes.values()):
        origin = f"study '{promoted.study}' (trial {promoted.trial})"
        say(f"{config.name}: '{target}' is what {origin} found: nothing changes")
        return StageRecord()
    old, new = read_promoted(target), promoted.values
    before = old.values if old else {}
    keys = [key for key in dict.fromkeys([*before, *new]) if before.get(key) != new.get(key)]
    values = [[key, *(write_value(each.get(key, "as configured")) for each in (before, new))] for key in keys]
    table(f"{config.name}: values that training uses", ["value", "now", "then"], values)
    rows = [[str(target / name), change] for name, change in changes.items() if change]
    table(f"{config.name}: study '{promoted.study}' (trial {promoted.trial}) is promoted", ["file", ""], rows)
    # What training reads comes last: stopped in between, training still has the values of before.
    last = sorted(files, key=lambda name: name.name == BEST)
    written = [write_beside(target / name, partial(copyfile, source / name)) for name in last]
    say(f"{config.name}: training uses '{target / BEST}' from now on")
    return StageRecord(files=written)


def _compare(new: Path, old: Path) -> str:
    """What becomes of the old file; empty where nothing does."""
    if not old.exists():
        return "new"
    return "" if new.read_bytes() == old.read_bytes() else "changed"
