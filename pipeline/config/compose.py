"""From ``conf/``, a machine file and overrides to a checked :class:`~pipeline.config.schema.Config`.

A command chooses a machine, from ``conf/`` or from a file of the user, and an experiment. A machine without an
experiment is identified as its kind suggests (``conf/experiment/default``), under its own name. Errors, and pydantic's,
leave here as :class:`~pipeline.errors.ConfigError`: the law, what came, the next step.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.config.loader import (
    STAGES,
    compose,
    get_text,
    list_options,
    list_values,
    parse_key,
    parse_overrides,
    refuse_sweeps,
    start_hydra,
)
from pipeline.config.messages import explain_schema_errors, quote_override, quote_value, suggest
from pipeline.config.own_machines import clean_name, make_absolute, store_machine
from pipeline.config.promotion import apply_promoted, is_overridden, look_up
from pipeline.config.quantities import is_number
from pipeline.errors import ConfigError
from pipeline.rotor.bearings import CHANGING

if TYPE_CHECKING:
    from hydra.core.config_loader import ConfigLoader
    from hydra.core.override_parser.types import Override

    from pipeline.config.schema import Config

DEFAULTS = "default/"
"""The folder below ``conf/experiment`` that has the experiments of machines without one."""
_NAMED_OTHERWISE = {"stage", "experiment", "name", "output", "tracking", "hydra"}
"""Keys that the name of a run has no need of: they say which it is, or where it is kept."""


def compose_config(overrides: Sequence[str] = (), folder: Path | None = None) -> Config:
    """The configuration that ``python -m pipeline OVERRIDES`` would run its only stage with."""
    (config,) = compose_stages(overrides, folder)
    return config


def compose_stages(overrides: Sequence[str] = (), folder: Path | None = None) -> list[Config]:
    """The configurations, one a stage, that ``python -m pipeline OVERRIDES`` would run one after the other.

    ``folder`` is that of ``--config-dir``.
    """
    return validate_stages(compose_mapping(overrides, folder), overrides, folder)


def validate_stages(mapping: Mapping[str, Any], overrides: Sequence[str], folder: Path | None = None) -> list[Config]:
    """``mapping`` as a Config for each of its stages, with the values that its study promoted; ``overrides`` win."""
    complete = _insert_runs(mapping)
    configs = [validate(dict(complete) | {"stage": stage}) for stage in list_stages(mapping)]
    changed = tuple(given for given in overrides if parse_key(given).partition(".")[0] not in _NAMED_OTHERWISE)
    return [
        apply_promoted(config, overrides).model_copy(
            update={"chosen_by": name_choice(config, overrides, folder), "overrides": changed}
        )
        for config in configs
    ]


def list_stages(mapping: Mapping[str, Any]) -> list[Any]:
    """The stages of a command, in the order given. Raises ConfigError for one given twice."""
    given = mapping.get("stage")
    stages: list[Any] = given if isinstance(given, list) and given else [given]
    if any(stages.count(stage) > 1 for stage in stages):
        raise ConfigError(f"stage must name each stage once, but got {quote_value(given)}")
    if len(stages) > 1 and "new" in stages:  # before a machine file is written, nothing can read it
        raise ConfigError(f"stage=new must be a command of its own, but got {quote_value(given)}")
    return stages


def _insert_runs(mapping: Mapping[str, Any]) -> Mapping[str, Any]:
    """``mapping`` with the speeds and runs of ``machine.runs_file``, such as ``stage=design`` writes; without such a
    file with those of vibration that was processed elsewhere, where the machine gives none."""
    import yaml

    section, data = mapping.get("machine"), mapping.get("data")
    if not isinstance(section, Mapping) or not (file := section.get("runs_file")):
        known = isinstance(section, Mapping) and isinstance(data, Mapping)
        return dict(mapping) | {"machine": _follow_data(section, data)} if known else mapping
    try:
        read = yaml.safe_load(Path(str(file)).read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError(
            f"machine.runs_file must be speeds and runs such as stage=design writes, but '{file}' can't be read as "
            f"such: {error}"
        ) from None
    if not isinstance(read, dict) or set(read) != {"speeds", "runs"}:
        came = ", ".join(map(str, read)) if isinstance(read, dict) and read else quote_value(read)
        raise ConfigError(f"machine.runs_file must have speeds and runs and nothing else, but '{file}' has {came}")
    return dict(mapping) | {"machine": dict(section) | read}


def _follow_data(machine: Any, data: Any) -> dict[str, Any]:
    """``machine`` with the speeds and runs of vibration that ``data`` names, where it gives none, and the vibration has
    no frequency of its own. Raises DataError for files that can't be read.
    """
    vibration, excitation = (data.get(key) for key in ("vibration", "excitation"))
    asked = [key for key in ("speeds", "runs") if not machine.get(key)]
    if not (vibration and excitation and asked):
        return dict(machine)
    import numpy as np

    from pipeline.data.excitation_files import read_excitations
    from pipeline.data.tables import read_table

    columns = read_table(Path(vibration), {"speed_rpm": "number"}, {"frequency_hz": "number or blank"})
    if "frequency_hz" in columns:
        return dict(machine)
    rpm, runs = np.unique(columns["speed_rpm"]), dict[str, dict[str, Any]]()
    step = float(np.median(np.diff(rpm))) if len(rpm) > 1 else 1.0
    for acting in read_excitations(Path(excitation)):
        what = {"node": acting.node, "magnitude": acting.magnitude, "phase": f"{np.degrees(acting.phase)} deg"}
        what |= {"whirl": acting.whirl} if acting.kind == "force" else {}
        if acting.magnitude:
            runs.setdefault(acting.run, {"name": acting.run}).setdefault(f"{acting.kind}s", []).append(what)
    speeds = {"start_rpm": float(rpm[0]), "stop_rpm": float(rpm[-1]), "step_rpm": step}
    read = {"speeds": speeds, "runs": list(runs.values())}
    return dict(machine) | {key: read[key] for key in asked}


def compose_mapping(overrides: Sequence[str] = (), folder: Path | None = None) -> dict[str, Any]:
    """The composed configuration, interpolations resolved, before the schema has seen it."""
    with start_hydra(folder) as hydra:
        parsed = parse_overrides(overrides, hydra)
        refuse_sweeps(parsed)
        return compose(choose(parsed, hydra), hydra)


def validate(mapping: Mapping[str, Any]) -> Config:
    """``mapping`` as a Config. Raises ConfigError, also for a stage that there is not."""
    from pydantic import ValidationError

    from pipeline.config.schema import Config

    stage = mapping.get("stage")
    if not isinstance(stage, str) or stage not in STAGES:
        known = suggest(str(stage), STAGES)
        raise ConfigError(f"stage must be one of the stages, but got {quote_value(stage)}{known}")
    try:
        return Config.model_validate(mapping)
    except ValidationError as error:
        raise ConfigError(explain_schema_errors(error, mapping, Config)) from None


def expand_sweeps(overrides: Sequence[str]) -> tuple[list[list[str]], frozenset[str]]:
    """The overrides of every job of a multirun, and the keys that are the same in all of them."""
    with start_hydra() as hydra:
        parsed = parse_overrides(overrides, hydra)
        values = [list_values(override) for override in parsed]
    fixed = frozenset(override.key_or_group for override in parsed if not override.is_sweep_override())
    return [list(job) for job in itertools.product(*values)], fixed


@contextmanager
def prepare_for_hydra(overrides: Sequence[str], folder: Path | None) -> Iterator[list[str]]:
    """``overrides`` as Hydra itself takes them, the last of each key; meanwhile its store has the user's own files."""
    with start_hydra(folder) as hydra:
        yield [get_text(override) for override in choose(parse_overrides(overrides, hydra), hydra)]


# --- machine and experiment --------------------------------------------------------------------------


def choose(parsed: Sequence[Override], loader: ConfigLoader) -> list[Override]:
    """``parsed`` with an option of the group ``machine`` in place of ``machine.file``, and with the default experiment
    of a machine that comes without one.

    Raises ConfigError for a machine file that can't be read.
    """
    by_key = {override.key_or_group: override for override in parsed if not override.is_delete()}
    stage, file, machine, experiment = map(by_key.get, ("stage", "machine.file", "machine", "experiment"))
    if stage and "new" in re.findall(r"\w+", get_text(stage)):  # the file is yet to be written
        return [*parsed, *parse_overrides([] if "tracking" in by_key else ["tracking=none"], loader)]
    rest = [override for override in parsed if override is not file]
    path = _locate(file) if file else None
    if file and path:
        if machine:
            raise ConfigError(
                f"a command must have one machine, but got {get_text(machine)} and {get_text(file)}: leave one out"
            )
        (machine,) = parse_overrides([f"machine={store_machine(path)}"], loader)
        rest.insert(0, machine)
    rest = _begin_anew(rest, loader)
    if not machine or not isinstance(machine.value(), str) or machine.is_sweep_override():
        return rest
    name = clean_name(path) if path else str(machine.value())
    if not experiment:
        more = [*_choose_experiment(_compose(rest, loader)), f"name={name}"]
    else:
        has_machine = str(machine.value()) not in list_options("machine") and isinstance(experiment.value(), str)
        given = str(experiment.value())
        more = [f"name={name}_{given}"] if has_machine and not given.startswith(DEFAULTS) else []
    keys = {override.key_or_group for override in parsed}
    more = [text for text in more if not is_overridden(text.partition("=")[0], keys)]
    return [*rest, *parse_overrides(more, loader)]


def _locate(file: Override) -> Path | None:
    """Return the path of the machine file; None for null."""
    if file.is_sweep_override():
        raise ConfigError(f"machine.file must be one file, but got '{get_text(file)}': give a command for each")
    value = file.value()
    if value is None:
        return None
    if not isinstance(value, str) or not value:
        raise ConfigError(f"machine.file must be the path of a machine file, but got '{get_text(file)}'")
    return make_absolute(value)


def _begin_anew(parsed: Sequence[Override], loader: ConfigLoader) -> list[Override]:
    """``parsed`` so that a section that is given anew, with its kind or as known values, has nothing of the former.

    Such are ``machine.bearings.kind=rotor_file`` and ``machine.bearings={kind: linear, kxx: 1e7, kyy: 1e7}``.
    """
    sections = {id(override): _find_kind(override) for override in parsed}
    if not any(sections.values()):
        return list(parsed)
    composed = _compose([o for o in parsed if o.key_or_group in ("machine", "experiment")], loader)
    made: list[Override] = []
    for override in parsed:
        key, tag, value, text = sections[id(override)] or ("", "", None, "")
        former = look_up(composed, key) if key else {}
        if not former or (override.key_or_group != key and former.get(tag) == value):
            made.append(override)
        else:
            made += parse_overrides([f"~{key}", f"+{key}={text}"], loader)
    return made


def _find_kind(override: Override) -> tuple[str, str, Any, str] | None:
    """Return section, name and value of its kind, and the section's text; None where the override gives no kind."""
    key, value = override.key_or_group, override.value()
    section, _, tag = key.rpartition(".")
    if override.is_delete() or override.is_sweep_override() or not key.startswith(("machine.", "data.")):
        return None
    if isinstance(value, dict) and tag == "known":
        return key, "", None, get_text(override).partition("=")[2]
    if isinstance(value, dict) and (tags := [tag for tag in ("kind", "format") if tag in value]):
        return key, tags[0], value[tags[0]], get_text(override).partition("=")[2]
    if tag in ("kind", "format") and isinstance(value, str):
        return section, tag, value, f"{{{tag}: {value}}}"
    return None


def _compose(parsed: Sequence[Override], loader: ConfigLoader) -> Mapping[str, Any]:
    """Compose machine and data alone. A mistake gives an empty mapping: it is told when the whole is composed.

    The section of comparisons is composed of half of all files, and no machine needs it.
    """
    keys = ("machine", "experiment", "data")
    machine_overrides = [o for o in parsed if o.key_or_group.partition(".")[0] in keys and not o.is_sweep_override()]
    try:
        composed = compose([*machine_overrides, *parse_overrides(["~comparison"], loader)], loader)
    except ConfigError:
        return {}
    return composed if isinstance(composed.get("machine"), Mapping) else {}


def _choose_experiment(composed: Mapping[str, Any]) -> list[str]:
    """Return the overrides that say what is identified of a machine of this kind, and at which noise."""
    bearings, recordings, probes = (look_up(composed, f"machine.{key}") for key in ("bearings", "recordings", "probes"))
    each = [bearings, *look_up(composed, "machine.bearings.nodes").values()]
    kinds = {section.get("kind") for section in each if isinstance(section, Mapping)}
    saved = not bearings and bool(look_up(composed, "machine.rotor").get("file"))
    option = "fluid_film" if kinds & CHANGING or saved else "rolling"
    if look_up(composed, "data").get("vibration") or recordings.get("format", "none") != "none":
        baseline = recordings.get("baseline")
        more = [f"data.baseline='{baseline}'"] if isinstance(baseline, str) else []
        more += ["model=constant"] if recordings.get("format") == "exciter" else []  # at a speed or two
        return [f"experiment={DEFAULTS}{option}_measured", *more]
    noise = {key: probes.get(key) for key in ("additive", "multiplicative")}
    listed = [probe.get("floor") for probe in probes.get("at") or () if isinstance(probe, Mapping)]
    numbers = [str(value).partition(" ")[0] for value in [*noise.values(), *listed]]  # of texts such as 0.1 um, too
    stated = noise if any(is_number(number) and float(number) > 0 for number in numbers) else {}
    return [f"experiment={DEFAULTS}{option}", *(f"stated_noise.{key}={value}" for key, value in stated.items())]


def name_choice(config: Config, overrides: Sequence[str], folder: Path | None) -> str:
    """Return the overrides that chose machine and experiment, as a shell takes them in another command."""
    given = dict(override.lstrip("+").partition("=")[::2] for override in overrides)
    parts = []
    if folder:
        parts.append(quote_override("--config-dir", str(folder)))
    if config.machine.file and config.stage != "new":
        path, here = Path(config.machine.file), Path.cwd()
        short = path.relative_to(here) if path.is_relative_to(here) else path
        parts.append(quote_override("machine.file", str(short)))
    elif "machine" in given:
        parts.append(f"machine={given['machine']}")
    if "experiment" in given and not given["experiment"].startswith(DEFAULTS):
        parts.append(f"experiment={given['experiment']}")
    return " ".join(parts)
