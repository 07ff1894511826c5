"""What a command can name, and Hydra on ``conf/``: overrides parsed and composed, and its errors in our words."""

from __future__ import annotations

import contextlib
import copy
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from pipeline.config.messages import explain_key, explain_option, explain_syntax, list_paths
from pipeline.errors import ConfigError
from pipeline.files import hash_parts, keep, look_up

if TYPE_CHECKING:
    from hydra.core.config_loader import ConfigLoader
    from hydra.core.override_parser.types import Override
    from omegaconf import DictConfig

CONF = Path(__file__).parents[2] / "conf"
ROOT_CONFIG = "config"
VERSION_BASE = "1.3"
FILE_KEY = "machine.file="

STAGES: dict[str, str] = {
    "new": "write a machine file of your own, with comments, to machine.file",
    "configure": "write the experiment's composed configuration to config.yaml",
    "identify": "from a machine's data to its results: all of the stages that belong to it, in one command",
    "generate": "model the machine with ROSS and write its vibration",
    "ingest": "turn measured data into the two files that training reads, and draw them",
    "runup": "fit natural frequencies and damping ratios to a run-up, its ramp modelled",
    "diagnose": "tell which coefficients the data determine: rank, condition number, predicted deviation",
    "senses": "fit the data in every sense of phases and angles, and say which one they choose",
    "design": "choose the runs that would identify best, from what an experimenter can do",
    "choose": "say which model the data ask for: bearing laws, laws with a correction, or a network",
    "tune": "search hyperparameters on held-out speeds, and say which values are the best",
    "promote": "let training use what a study found (tuning.study); what changes is said first",
    "train": "identify the unknown bearing coefficients from the vibration",
    "evaluate": "compare identified with modelled coefficients, and with per-speed least squares",
    "robustness": "train from many initial guesses or seeds at once",
    "compare": "identify the modelled machine by every method, over noise, sensors and number of speeds",
    "predict": "predict vibration never seen, critical speeds and stability with the digital twin",
    "balance": "tell the unbalance behind a vibration, and the correction weights: hole, mass, what remains",
    "verdict": "say whether each coefficient can be trusted, why, and what to do next",
    "export": "write the identified bearings for ROSS, ANSYS, DyRoBeS, XLTRC2, Excel, CSV and JSON",
    "summary": "put the results on one screen and in one picture",
    "report": "write one page (HTML, PDF) with all that was measured, identified and predicted, to send on",
    "check": "hold the metrics of all experiments against conf/thresholds; exit code 1 where one is passed",
}

RESULTS: dict[str, str] = {
    "verdict": "verdicts.json",
    "evaluate": "metrics.json",
    "predict": "prediction.json",
    "summary": "summary.txt",
    "report": "report.html",
}
"""What stage=identify makes of a fit, in this order, and the file that shows that it was made."""


def list_options(group: str) -> list[str]:
    """The names that ``group=NAME`` takes."""
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def parse_key(override: str) -> str:
    """The key or the group that an override is of, without the cost of Hydra's parser."""
    return override.lstrip("+~").partition("=")[0].partition("@")[0]


@contextmanager
def start_hydra(folder: Path | None = None) -> Iterator[ConfigLoader]:
    """Hydra's loader of ``conf/`` and of the user's files in ``folder``; its global state is afterwards as it was, also
    inside a running job."""
    from hydra import version
    from hydra._internal.config_loader_impl import ConfigLoaderImpl
    from hydra._internal.utils import create_config_search_path
    from hydra.core.plugins import Plugins
    from hydra.core.singleton import Singleton
    from hydra.core.utils import setup_globals

    from pipeline.config.own_machines import store_folder

    if not CONF.is_dir():
        raise ConfigError(f"conf/ must lie beside the package, but {CONF} is not there; run from a checkout")
    plugins = Plugins.instance()  # what plugins register, once a process, is to stay
    state = Singleton.get_state()
    state["instances"][Plugins] = plugins  # else Hydra looks for all of them again
    try:
        version.setbase(VERSION_BASE)
        setup_globals()
        if folder:
            store_folder(folder)
        yield ConfigLoaderImpl(create_config_search_path(str(CONF)))
    finally:
        Singleton.set_state(state)


def _load(chosen: Sequence[Override], loader: Any) -> DictConfig:
    """The composed configuration of these overrides."""
    from hydra.core.config_store import ConfigStore
    from omegaconf import OmegaConf

    values = [o for o in chosen if isinstance(o.value(), dict) or not loader.repository.group_exists(o.key_or_group)]
    groups = [get_text(override) for override in chosen if override not in values]
    stored = [(group, inside) for group, inside in ConfigStore.instance().repo.items() if (CONF / group).is_dir()]
    config = _insert_machine(groups, stored, loader) or copy.deepcopy(_compose_groups(groups, stored, loader))
    OmegaConf.set_struct(config, True)
    loader._apply_overrides_to_config(values, config)
    return config


def _insert_machine(groups: Sequence[str], stored: Sequence[Any], loader: Any) -> DictConfig | None:
    """The file of ``machine.file`` put into what the other groups compose to, which is kept.

    None where there is none, where the machine or the data are changed by an experiment too, or where it does not fit:
    Hydra puts them together then, and says what is wrong.
    """
    from omegaconf.errors import OmegaConfBaseException

    files = stored[0][1].items() if [group for group, _ in stored] == ["machine"] else ()
    whole = {f"machine={name.removesuffix('.yaml')}": file.node for name, file in files if file.package == "_global_"}
    chosen = [group for group in groups if set(whole.get(group, {"": None})) <= {"machine", "data"}]
    if not chosen:
        return None
    config = copy.deepcopy(_compose_groups([NO_MACHINE if group in chosen else group for group in groups], [], loader))
    bare = _compose_groups([NO_MACHINE, "~experiment", "~comparison"], [], loader)
    with contextlib.suppress(OmegaConfBaseException):
        if all(config[key] == bare[key] for key in ("machine", "data")):
            config.merge_with(whole[chosen[0]])
            return config
    return None


NO_MACHINE = "machine=base/none"


def _compose_groups(groups: Sequence[str], stored: Sequence[Any], loader: Any) -> DictConfig:
    """What groups of files compose to. It is kept for those of ``conf/``: reading it is a tenth of the work.

    Values of a command and files of a user are not kept beyond this process, since they may be secret.
    """
    import yaml
    from hydra import __version__
    from hydra.types import RunMode
    from omegaconf import OmegaConf

    # The identity of the chosen groups, and of all that they can be composed of.
    files = [(str(path), path.read_bytes()) for path in sorted(CONF.rglob("*.yaml")) if path.is_file()]
    key = hash_parts(repr([__version__, groups, files, stored]))
    if key not in _COMPOSED:
        content = look_up("configurations", key)
        if not content:
            composed = loader.load_configuration(ROOT_CONFIG, list(groups), RunMode.RUN, from_shell=False)
            content = yaml.dump(OmegaConf.to_container(composed), Dumper=yaml.CSafeDumper, sort_keys=False).encode()
            if not stored:
                keep("configurations", key, content)
        _COMPOSED[key] = OmegaConf.create(yaml.CSafeLoader(content).get_single_data())
    return _COMPOSED[key]


_COMPOSED: dict[str, DictConfig] = {}
"""What groups of files compose to, in this process, by the identity of both."""


def compose(parsed: Sequence[Override], loader: ConfigLoader) -> dict[str, Any]:
    """The configuration of these overrides, interpolations resolved, before the schema has seen it."""
    import yaml
    from hydra.errors import HydraException, MissingConfigException
    from omegaconf import OmegaConf, open_dict
    from omegaconf.errors import OmegaConfBaseException

    _check_group_values(parsed, loader)
    try:
        config = _load(parsed, loader)
        with open_dict(config):
            del config["hydra"]
        mapping = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except MissingConfigException as error:
        raise ConfigError(_explain_missing(error)) from None
    except HydraException as error:
        raise ConfigError("\n".join(_explain_keys(parsed, loader)) or _quote_hydra(error)) from None
    except OmegaConfBaseException as error:
        raise ConfigError(_explain_unresolved(error)) from None
    except (AssertionError, AttributeError, TypeError, ValueError) as error:
        # Hydra has no error of its own for some overrides, such as ~experiment=[a].
        raise ConfigError(_quote_hydra(error)) from None
    except yaml.YAMLError as error:
        raise ConfigError(f"a file in conf/ must be YAML, but {error}") from None
    return cast("dict[str, Any]", mapping)


def _is_group(override: Override, loader: ConfigLoader) -> bool:
    return bool(loader.get_group_options(override.key_or_group))


def get_text(override: Override) -> str:
    """The override as it was written."""
    return override.input_line or ""


# --- overrides ---------------------------------------------------------------------------------


def parse_overrides(overrides: Sequence[str], loader: ConfigLoader) -> list[Override]:
    """The last override of each key. Raises ConfigError for what Hydra can't read, and for a key of old."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    names = {"stage": STAGES, "experiment": list_options("experiment")}
    parser = OverridesParser.create(config_loader=loader)
    parsed = []
    for text in overrides:
        try:
            parsed += parser.parse_overrides([text])
        except HydraException:
            path = text.lstrip("+").removeprefix(FILE_KEY)
            if path in (text, "") or "'" in path or '"' in path:
                raise ConfigError(explain_syntax(text, names)) from None
            parsed += parser.parse_overrides([f"{FILE_KEY}'{path}'"])  # a path as it is, such as ~/rig (1)/ü.yaml
        if not parsed[-1].key_or_group:  # "=3"
            raise ConfigError(explain_syntax(text, names))
    # The last override of each key wins, as a shell user expects; Hydra itself refuses a group given twice.
    last = {(override.get_key_element(), override.is_delete()): override for override in parsed}
    return [override for override in parsed if last[override.get_key_element(), override.is_delete()] is override]


def refuse_sweeps(parsed: Sequence[Override]) -> None:
    """Raise ConfigError for an override of several values."""
    for override in parsed:
        if override.is_sweep_override():
            key, _, values = get_text(override).partition("=")
            raise ConfigError(
                f"a single run must have one value for {key}, but got '{values}'; "
                f"add -m to run all of them, or write {key}=[...] for a list and \"{key}='...'\" for a text"
            )


def list_values(override: Override) -> list[str]:
    """The override as each job of a multirun has it."""
    if not override.is_sweep_override():
        return [get_text(override)]
    key = override.get_key_element()
    if override.is_hydra_override():
        raise ConfigError(
            f"a multirun must sweep over keys of the pipeline, but got '{get_text(override)}'; give one value"
        )
    if not override.is_discrete_sweep():
        raise ConfigError(f"a multirun must list its values, but got '{get_text(override)}'; write such as {key}=1,2,3")
    every = [f"{key}={value}" for value in override.sweep_string_iterator()]
    if not every:
        raise ConfigError(f"a multirun must have a value for each key, but '{get_text(override)}' stands for none")
    return every


# --- Hydra's errors in our words -----------------------------------------------------------------


def _check_group_values(parsed: Sequence[Override], loader: ConfigLoader) -> None:
    """Refuse ``machine=5`` and ``experiment=null`` by name, for which Hydra raises a bare ValueError."""
    for override in parsed:
        value = override.value()
        names = value if isinstance(value, list) else [value]
        fits = isinstance(value, dict) or all(isinstance(name, str) for name in names)
        if not fits and not (override.is_delete() and value is None) and _is_group(override, loader):
            group = override.key_or_group
            raise ConfigError(explain_option(group, value, loader.get_group_options(group)))


def _explain_missing(error: Any) -> str:
    group, _, name = (error.missing_cfg_file or "").rpartition("/")
    place = re.match(r"In '([^']+)'", str(error))
    inside = place and place[1] not in (ROOT_CONFIG, "hydra/config")
    return (f"in conf/{place[1]}.yaml, " if place and inside else "") + explain_option(
        group, name, error.options or list_options(group)
    )


def _quote_hydra(error: Exception) -> str:
    """Hydra's own words, for the rare cases that have no sentence of ours."""
    phrases = [line.strip() for line in f"{error}\n{error.__cause__ or ''}".splitlines()]
    return f"the overrides must fit conf/, but Hydra says: {' '.join(word for word in phrases if word)}"


def _explain_unresolved(error: Any) -> str:
    from omegaconf.errors import MissingMandatoryValue

    key = error.full_key or "a value"
    if isinstance(error, MissingMandatoryValue):
        step = "" if "[" in key else f", or add {key}=VALUE"
        return f"{key} must be given, but is ???: write it in place of the ??? in the machine file{step}"
    return f"{key} must refer to what exists, but got: {str(error).splitlines()[0]}"


def _explain_keys(parsed: Sequence[Override], loader: ConfigLoader) -> list[str]:
    """A sentence for every override of a key that the chosen groups don't have."""
    from hydra.errors import HydraException
    from omegaconf import OmegaConf

    groups = [o for o in parsed if isinstance(o.value(), (str, list)) and _is_group(o, loader)]
    try:
        config = _load([o for o in groups if not o.is_add()], loader)
    except HydraException:
        return []  # the groups themselves don't compose: Hydra's words tell more
    tree: Any = OmegaConf.to_container(config, resolve=False)
    present = {*tree["hydra"]["runtime"]["choices"], *list_paths(tree)}
    added = [
        f"only a new key must have a +, but {o.key_or_group} is there and got '{get_text(o)}'; write "
        f"'{get_text(o).lstrip('+')}'"
        for o in parsed
        if o.is_add() and o.key_or_group in present
    ]
    changed = [
        explain_key(o.key_or_group, tree)
        for o in parsed
        if not (o.is_add() or o.is_force_add() or o.package or o in groups)
    ]
    return [sentence for sentence in [*added, *changed] if sentence]
