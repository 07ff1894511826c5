"""From ``conf/`` and overrides to a checked :class:`~pipeline.config.schema.Config`.

Besides ``pipeline.__main__`` the only module that knows Hydra. Its errors, and pydantic's, leave
here as :class:`~pipeline.errors.ConfigError`: the law, what came, the next step.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from pipeline.config.kept import keep_configurations, kept, made_from
from pipeline.config.messages import (
    bad_syntax,
    no_option,
    paths,
    schema_errors,
    shown,
    suggestion,
    unknown_key,
)
from pipeline.errors import ConfigError

if TYPE_CHECKING:
    from hydra.core.config_loader import ConfigLoader
    from hydra.core.override_parser.types import Override

    from pipeline.config.schema import Config

CONF = Path(__file__).parents[2] / "conf"
ROOT_CONFIG = "config"
VERSION_BASE = "1.3"


def compose_config(overrides: Sequence[str] = ()) -> Config:
    """The configuration that ``python -m pipeline OVERRIDES`` would run its only stage with."""
    (config,) = compose_stages(overrides)
    return config


def compose_stages(overrides: Sequence[str] = ()) -> list[Config]:
    """The configurations, one a stage, that ``python -m pipeline OVERRIDES`` would run one after the other.

    What was composed before comes from the cache, without Hydra and pint, which take a second.
    """
    from pipeline.config.promotion import with_promoted

    key = made_from(CONF, overrides)
    configs = kept(key)
    if configs is None:
        mapping = composed_mapping(overrides)
        configs = _validated_stages(mapping)
        if _is_all_in_the_key(mapping, overrides):
            keep_configurations(key, configs)
    return [with_promoted(config, overrides) for config in configs]


def effective(mapping: Mapping[str, Any], overrides: Sequence[str]) -> list[Config]:
    """``mapping`` as a Config for each of its stages, with the promoted values of its study; ``overrides`` win over
    them."""
    from pipeline.config.promotion import with_promoted

    return [with_promoted(config, overrides) for config in _validated_stages(mapping)]


def _validated_stages(mapping: Mapping[str, Any]) -> list[Config]:
    complete = _with_excitation_file(mapping)
    return [validated(dict(complete) | {"stage": stage}) for stage in stages_of(mapping)]


def stages_of(mapping: Mapping[str, Any]) -> list[str]:
    """The stages of a command, in the order given. Raises ConfigError for an unknown one, and one given twice."""
    given = mapping.get("stage")
    stages: list[Any] = given if isinstance(given, list) and given else [given]
    for stage in stages:
        _require_stage(stage)
    if len(set(stages)) < len(stages):
        raise ConfigError(f"stage must name each stage once, but got {shown(given)}")
    return stages


def _require_stage(stage: object) -> None:
    from pipeline.config.stage_names import STAGES

    if not isinstance(stage, str) or stage not in STAGES:
        raise ConfigError(f"stage must be one of the stages, but got {shown(stage)}{suggestion(str(stage), STAGES)}")


def _is_all_in_the_key(mapping: Mapping[str, Any], overrides: Sequence[str]) -> bool:
    """Whether nothing comes from an excitation of another file, or from what the environment resolves."""
    section = mapping.get("excitation")
    from_file = isinstance(section, Mapping) and bool(section.get("file"))
    return not from_file and not any("$" in override for override in overrides)


def _with_excitation_file(mapping: Mapping[str, Any]) -> Mapping[str, Any]:
    """``mapping`` with the speeds and runs of ``excitation.file``, such as ``stage=design`` writes."""
    import yaml

    section = mapping.get("excitation")
    file = section.get("file") if isinstance(section, Mapping) else None
    if not file:
        return mapping
    try:
        read = yaml.safe_load(Path(str(file)).read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError(
            f"excitation.file must be an excitation such as stage=design writes, but '{file}' can't be read as one: "
            f"{error}"
        ) from None
    if not isinstance(read, dict):
        raise ConfigError(f"excitation.file must have speeds and runs, but '{file}' has {shown(read)}")
    return dict(mapping) | {"excitation": read | {"file": str(file)}}


def composed_mapping(overrides: Sequence[str] = ()) -> dict[str, Any]:
    """The composed configuration, interpolations resolved, before the schema has seen it."""
    with _hydra() as loader:
        parsed = last_of_each(_parsed(overrides, loader))
        _refuse_sweeps(parsed)
        return _composed(parsed, loader)


def validated(mapping: Mapping[str, Any]) -> Config:
    """``mapping`` as a Config."""
    from pydantic import ValidationError

    from pipeline.config.schema import Config

    _require_stage(mapping.get("stage"))
    try:
        return Config.model_validate(mapping)
    except ValidationError as error:
        raise ConfigError(schema_errors(error, mapping, Config)) from None


def expanded(overrides: Sequence[str]) -> tuple[list[list[str]], frozenset[str]]:
    """The overrides of every job of a multirun, and the keys that are the same in all of them."""
    with _hydra() as loader:
        parsed = last_of_each(_parsed(overrides, loader))
        choices = [_choices(override) for override in parsed]
    fixed = frozenset(override.key_or_group for override in parsed if not override.is_sweep_override())
    return [list(job) for job in itertools.product(*choices)], fixed


def options(group: str) -> list[str]:
    """The names that ``group=NAME`` takes."""
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def deduplicated(overrides: Sequence[str]) -> list[str]:
    """``overrides`` with the last of those that set the same key."""
    with _hydra() as loader:
        return [_text(override) for override in last_of_each(_parsed(overrides, loader))]


def last_of_each(parsed: Sequence[Override]) -> list[Override]:
    """The last override of each key, as a shell user expects; Hydra itself refuses a group given twice."""
    last = {override.get_key_element(): override for override in parsed}
    return [override for override in parsed if last[override.get_key_element()] is override]


@contextmanager
def _hydra() -> Iterator[ConfigLoader]:
    """Hydra set up on ``conf/``; its global state is afterwards as it was, also inside a running job."""
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.singleton import Singleton

    if not CONF.is_dir():
        raise ConfigError(f"conf/ must lie beside the package, but {CONF} is not there; run from a checkout")
    state = Singleton.get_state()
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(CONF), job_name="pipeline", version_base=VERSION_BASE):
            yield GlobalHydra.instance().config_loader()
    finally:
        Singleton.set_state(state)


def _composed(parsed: Sequence[Override], loader: ConfigLoader) -> dict[str, Any]:
    import yaml
    from hydra import compose
    from hydra.errors import HydraException, MissingConfigException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    _check_group_values(parsed, loader)
    try:
        config = compose(ROOT_CONFIG, overrides=[_text(override) for override in parsed])
        mapping = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except MissingConfigException as error:
        raise ConfigError(_missing_option(error)) from None
    except HydraException as error:
        raise ConfigError("\n".join(_unknown_keys(parsed, loader)) or _said(error)) from None
    except OmegaConfBaseException as error:
        raise ConfigError(_unresolved(error)) from None
    except (AssertionError, AttributeError, TypeError, ValueError) as error:
        # Hydra has no error of its own for some overrides, such as ~experiment=[a].
        raise ConfigError(_said(error)) from None
    except yaml.YAMLError as error:
        raise ConfigError(f"a file in conf/ must be YAML, but {error}") from None
    return cast("dict[str, Any]", mapping)


def _is_group(override: Override, loader: ConfigLoader) -> bool:
    return bool(loader.get_group_options(override.key_or_group))


def _text(override: Override) -> str:
    assert override.input_line is not None
    return override.input_line


# --- overrides ---------------------------------------------------------------------------------


def _parsed(overrides: Sequence[str], loader: ConfigLoader) -> list[Override]:
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    parser = OverridesParser.create(config_loader=loader)
    parsed = []
    for text in overrides:
        try:
            parsed += parser.parse_overrides([text])
        except HydraException:
            raise ConfigError(_bad_syntax(text)) from None
        if not parsed[-1].key_or_group:  # "=3"
            raise ConfigError(_bad_syntax(text))
    return parsed


def _bad_syntax(text: str) -> str:
    from pipeline.config.stage_names import STAGES

    return bad_syntax(text, {"stage": STAGES, "experiment": options("experiment")})


def _refuse_sweeps(parsed: Sequence[Override]) -> None:
    for override in parsed:
        if override.is_sweep_override():
            key, _, values = _text(override).partition("=")
            raise ConfigError(
                f"a single run must have one value for {key}, but got '{values}'; "
                f"add -m to run all of them, or write {key}=[...] for a list and \"{key}='...'\" for a text"
            )


def _choices(override: Override) -> list[str]:
    if not override.is_sweep_override():
        return [_text(override)]
    key = override.get_key_element()
    if override.is_hydra_override():
        raise ConfigError(
            f"a multirun must sweep over keys of the pipeline, but got '{_text(override)}'; give one value"
        )
    if not override.is_discrete_sweep():
        raise ConfigError(f"a multirun must list its values, but got '{_text(override)}'; write such as {key}=1,2,3")
    choices = [f"{key}={value}" for value in override.sweep_string_iterator()]
    if not choices:
        raise ConfigError(f"a multirun must have a value for each key, but '{_text(override)}' stands for none")
    return choices


# --- Hydra's errors in our words -----------------------------------------------------------------


def _check_group_values(parsed: Sequence[Override], loader: ConfigLoader) -> None:
    """Refuse ``rotor=5`` and ``experiment=null`` by name, for which Hydra raises a bare ValueError."""
    for override in parsed:
        value = override.value()
        names = value if isinstance(value, list) else [value]
        fits = isinstance(value, dict) or all(isinstance(name, str) for name in names)
        if not fits and not (override.is_delete() and value is None) and _is_group(override, loader):
            group = override.key_or_group
            raise ConfigError(no_option(group, value, loader.get_group_options(group)))


def _missing_option(error: Any) -> str:
    group, _, name = (error.missing_cfg_file or "").rpartition("/")
    place = re.match(r"In '([^']+)'", str(error))
    inside = place is not None and place[1] not in (ROOT_CONFIG, "hydra/config")
    return (f"in conf/{place[1]}.yaml, " if place and inside else "") + no_option(
        group, name, error.options or options(group)
    )


def _said(error: Exception) -> str:
    """Hydra's own words, for the rare cases that have no sentence of ours."""
    words = [line.strip() for line in f"{error}\n{error.__cause__ or ''}".splitlines()]
    return f"the overrides must fit conf/, but Hydra says: {' '.join(word for word in words if word)}"


def _unresolved(error: Any) -> str:
    from omegaconf.errors import MissingMandatoryValue

    key = error.full_key or "a value"
    if isinstance(error, MissingMandatoryValue):
        return f"{key} must be given, but is ???; add {key}=VALUE"
    return f"{key} must refer to what exists, but got: {str(error).splitlines()[0]}"


def _unknown_keys(parsed: Sequence[Override], loader: ConfigLoader) -> list[str]:
    """A sentence for every override of a key that the chosen groups don't have."""
    from hydra import compose
    from hydra.errors import HydraException
    from omegaconf import OmegaConf

    groups = [o for o in parsed if isinstance(o.value(), (str, list)) and _is_group(o, loader)]
    plain = [_text(o) for o in groups if not o.is_add()]
    try:
        config = compose(ROOT_CONFIG, overrides=plain, return_hydra_config=True)
    except HydraException:
        return []  # the groups themselves don't compose: Hydra's words tell more
    tree = OmegaConf.to_container(config, resolve=False)
    added = [_already_there(o, tree) for o in parsed if o.is_add()]
    changed = [unknown_key(o.key_or_group, tree) for o in parsed if not (_adds(o) or o.package or o in groups)]
    return [sentence for sentence in [*added, *changed] if sentence]


def _adds(override: Override) -> bool:
    return override.is_add() or override.is_force_add()


def _already_there(override: Override, tree: Any) -> str:
    key, text = override.key_or_group, _text(override)
    if key not in tree["hydra"]["runtime"]["choices"] and key not in paths(tree):
        return ""
    return f"only a new key must have a +, but {key} is there and got '{text}'; write '{text.lstrip('+')}'"
