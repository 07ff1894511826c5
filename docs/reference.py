"""Writes docs/configuration.md from the schema, from conf/ and from docs/meanings.yaml: `make reference`.

Each section of the schema is a table: key, unit or values, default, meaning. A default is that of the schema, or what
the default experiment composes; `machine` has those of conf/config.yaml alone, since a machine is the user's own.
"""

from __future__ import annotations

import textwrap
import types
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import yaml
from pydantic_core import PydanticUndefined

from pipeline.config.compose import compose_mapping
from pipeline.config.identification import LossConfig
from pipeline.config.machine import MachineConfig
from pipeline.config.schema import Config
from pipeline.config.section import Section

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "configuration.md"
MEANINGS: dict[str, dict[str, str]] = yaml.safe_load((ROOT / "docs" / "meanings.yaml").read_text(encoding="utf-8"))
HEAD = """# Configuration

<!-- made by docs/reference.py (make reference): change docs/meanings.yaml or pipeline/config in its place -->

A key is given on the command line (`model.width=24`), in a machine file (those of `machine`), or in
a file of `conf/experiment`. A quantity is a text with its unit (`150 mm`), or a number in the unit
of the table. Anything else than these keys is refused, with the nearest one that there is.
`python -m pipeline stage=train --cfg job` prints the whole configuration of a command.

Defaults are those of the experiment `hydrostatic_stiffness`, which is the default one; other
experiments, and `conf/experiment/default` for a machine file of your own, have others. A dash marks
a key that has none and must be given where its section is.
"""
_ALTERNATIVES = {
    "ConstantModelConfig": "model=constant",
    "FunctionsModelConfig": "model=b_spline",
    "BearingsModelConfig": "model=bearings",
    "BearingsNetworkModelConfig": "model=bearings_network",
}
_SUFFIXES = {"_rpm": "rpm", "_deg": "deg", "_seconds": "s", "_hz": "Hz"}
_NAMES: dict[Any, str] = {bool: "true, false", int: "whole number", float: "number", str: "text"}


def sections() -> dict[type[Section], list[str]]:
    """Every section of the schema, with the paths at which it stands.

    ``[]`` marks a list, ``NAME`` a key of the user's own, and ``(table)`` a format of recordings.
    """
    found: dict[type[Section], list[str]] = {}

    def visit(section: type[Section], path: str) -> None:
        first = section not in found
        if path not in found.setdefault(section, []):
            found[section].append(path)
        for name, field in section.model_fields.items() if first else ():
            for inner, mark in _inner(field.annotation):
                form = inner.model_fields.get("format")
                of = f"({get_args(form.annotation)[0]})" if form else ""
                visit(inner, f"{path}.{name}{mark}{of}".lstrip("."))

    visit(Config, "")
    return found


def _inner(annotation: Any, mark: str = "") -> Iterator[tuple[type[Section], str]]:
    if isinstance(annotation, type) and issubclass(annotation, Section):
        yield annotation, mark
    mark += {tuple: "[]", dict: ".NAME"}.get(get_origin(annotation), "")
    for part in get_args(annotation):
        yield from _inner(part, mark)


def meaning_of(section: type[Section], name: str) -> str:
    """What a key means. Raises KeyError with the class and the key where nobody has written it down."""
    if said := section.model_fields[name].description:
        return said
    for one in section.__mro__:
        for key in (f"{one.__module__}.{one.__name__}", one.__name__):
            if name in MEANINGS.get(key, {}):
                return MEANINGS[key][name]
    if name in MEANINGS["anywhere"]:
        return MEANINGS["anywhere"][name]
    raise KeyError(f"docs/meanings.yaml must say what '{name}' of {section.__name__} means")


def unit_of(section: type[Section], name: str) -> str:
    """The unit of a key in SI, or the values that it takes."""
    field = section.model_fields[name]
    extra = field.json_schema_extra
    if isinstance(extra, dict) and "unit" in extra:
        return _unit(str(extra["unit"]))
    said = " or ".join(dict.fromkeys(_say(field.annotation)))
    if said.startswith("number"):
        unit = next((unit for suffix, unit in _SUFFIXES.items() if name.endswith(suffix)), None)
        unit = unit or {"k": "N/m", "c": "N s/m"}.get(name[0] if name[1:] in ("xx", "xy", "yx", "yy") else "")
        said = said.replace("number", unit) if unit else said
    return said


def _say(annotation: Any) -> Iterator[str]:
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        extra = next((e for m in parts[1:] if isinstance(e := getattr(m, "json_schema_extra", None), dict)), {})
        yield from [_unit(str(extra["unit"]))] if "unit" in extra else _say(parts[0])
    elif origin is Literal:
        yield ", ".join(f"`{part}`" for part in parts)
    elif origin in (Union, types.UnionType):
        for part in parts:
            yield from _say(part)
    elif origin is tuple:
        yield f"list of {' or '.join(dict.fromkeys(_say(parts[0])))}"
    elif origin is dict:
        yield f"{' or '.join(dict.fromkeys(_say(parts[1])))}, by name"
    elif isinstance(annotation, type) and issubclass(annotation, Section):
        yield "section"
    else:
        yield "`null`" if annotation is type(None) else _NAMES.get(annotation, "text")


def _unit(unit: str) -> str:
    return unit.replace("**", "^").replace(" * ", " ").replace(" / ", "/")


def default_of(section: type[Section], name: str, path: str) -> str:
    """The default of a key at a path as a person writes it; empty for a section, a dash where it must be given."""
    field = section.model_fields[name]
    if name in ("kind", "format") or (any(True for _ in _inner(field.annotation)) and field.is_required()):
        return ""
    value = _look_up([*filter(None, path.split(".")), name], _ALTERNATIVES.get(section.__name__))
    if value is PydanticUndefined:
        value = field.get_default(call_default_factory=True)
    if value is PydanticUndefined:
        return "-"
    recorded = section is MachineConfig and name in ("speeds", "runs")
    if isinstance(value, Section | dict) or recorded:
        return ""
    text = yaml.safe_dump(list(value) if isinstance(value, tuple) else value, default_flow_style=True, width=999)
    return f"`{text.strip().removesuffix('...').strip()}`"


@cache
def _read_defaults() -> Any:
    return yaml.safe_load((ROOT / "conf" / "config.yaml").read_text(encoding="utf-8"))


@cache
def _compose(override: str | None) -> Any:
    return compose_mapping([override] if override else [])


def _look_up(path: list[str], override: str | None) -> Any:
    value = _read_defaults() if path[0] == "machine" else _compose(override)
    for key in path:
        if not isinstance(value, dict) or key not in value:
            return PydanticUndefined
        value = value[key]
    return value


def write() -> str:
    """The page."""
    parts = [HEAD]
    for section, paths in sections().items():
        kind = section.model_fields.get("kind")
        which = f", {' or '.join(_say(kind.annotation))}" if kind and section is not LossConfig else ""
        parts.append(f"\n## {paths[0] or 'Top level'}{which}\n")
        if others := paths[1:]:
            shown = ", ".join(f"`{one}`" for one in others[:4])
            same = f"The same at {shown}{' and others' if len(others) > 4 else ''}."
            parts.append("\n" + textwrap.fill(same, 100, break_long_words=False, break_on_hyphens=False) + "\n")
        parts.append("\n| key | unit or values | default | meaning |\n|---|---|---|---|\n")
        for name in section.model_fields:
            told = unit_of(section, name), default_of(section, name, paths[0]), meaning_of(section, name)
            parts.append(f"| `{section.model_fields[name].alias or name}` | {' | '.join(told)} |\n")
    return "".join(parts)


if __name__ == "__main__":
    PAGE.write_text(write(), encoding="utf-8")
