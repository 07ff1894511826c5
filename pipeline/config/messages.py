"""Sentences for a configuration that breaks its schema: one line a value, with its path and what came."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from pipeline.errors import nearest

_LONGEST_SHOWN = 80
_SUBJECT = re.compile(r"^[A-Z]\w*(?: \w+)? should (?=be |have |match |start |end )")


def schema_errors(error: ValidationError, mapping: Mapping[str, Any], model: type[BaseModel]) -> str:
    """Every error of ``mapping`` against ``model`` as a line of its own, then the next step."""
    lines = [_line(item, mapping, model) for item in error.errors(include_url=False)]
    lines = list(dict.fromkeys(lines))
    values = "this value" if len(lines) == 1 else f"these {len(lines)} values"
    return "\n".join([*lines, f"Correct {values}; `python -m pipeline --cfg job` prints the whole configuration."])


def suggestion(name: str, candidates: Iterable[str]) -> str:
    """:func:`pipeline.errors.nearest` with the mark that joins it to the sentence before."""
    words = nearest(name, candidates)
    return f" {words}" if words.startswith("(") else f"; {words}"


def shown(value: Any) -> str:
    """``value`` as it would be written in a config, shortened."""
    words = {None: "null", True: "true", False: "false"}
    text = words[value] if value is None or isinstance(value, bool) else repr(value)
    return text if len(text) <= _LONGEST_SHOWN else text[: _LONGEST_SHOWN - 3] + "..."


def _line(item: Any, mapping: Mapping[str, Any], model: type[BaseModel]) -> str:
    path, value = _located(item["loc"], mapping)
    context, kind = item.get("ctx", {}), item["type"]
    if kind == "extra_forbidden":
        return f"{'.'.join(path)}: must be a key that the schema knows, but '{path[-1]}' is not" + suggestion(
            path[-1], _fields_beside(item["loc"], model)
        )
    if kind == "missing":
        return f"{'.'.join(path)}: must be given, but is missing"
    if kind == "union_tag_not_found":
        return f"{'.'.join([*path, _tag_key(context)])}: must be given, but is missing"
    if kind == "union_tag_invalid":
        return _choice([*path, _tag_key(context)], context["tag"], context["expected_tags"])
    if kind == "literal_error" and isinstance(value, str):
        return _choice(path, value, context["expected"])
    return f"{'.'.join(path) or 'configuration'}: {_law(kind, item['msg'])}{_came(kind, value)}"


def _choice(path: Sequence[str], value: str, expected: str) -> str:
    choices = re.findall(r"'([^']*)'", expected)
    return f"{'.'.join(path)}: must be one of these, but got {value!r}" + suggestion(value, choices)


def _tag_key(context: Mapping[str, Any]) -> str:
    return str(context["discriminator"]).strip("'")


def _law(kind: str, message: str) -> str:
    message = _SUBJECT.sub("must ", message.removeprefix("Value error, "))
    # Behind the comma pydantic says what came, in words that _came replaces by the value itself.
    return message.partition(", ")[0] if kind.endswith(("_parsing", "_from_float", "_short", "_long")) else message


def _came(kind: str, value: Any) -> str:
    # A sentence of the schema itself says what came; a mapping in full would hide the law.
    return "" if kind == "value_error" or isinstance(value, Mapping) else f", but got {shown(value)}"


def _located(loc: Sequence[int | str], mapping: Any) -> tuple[list[str], Any]:
    """The path and the value as the user wrote them: pydantic's ``loc`` also names union tags."""
    path: list[str] = []
    node = mapping
    for position, part in enumerate(loc):
        is_key = isinstance(node, Mapping) and part in node
        is_item = isinstance(node, (list, tuple)) and isinstance(part, int) and part < len(node)
        if is_key or is_item:
            node = node[part]
            path.append(str(part))
        elif position == len(loc) - 1:
            path.append(str(part))
    return path, node


def _fields_beside(loc: Sequence[int | str], model: type[BaseModel]) -> set[str]:
    """Names of the fields that may stand where ``loc`` ends."""
    models = {model}
    for part in loc[:-1]:
        if isinstance(part, int):
            continue
        inner = {m for owner in models if part in owner.model_fields for m in _models(owner.model_fields[part].annotation)}
        models = inner or _tagged(models, part) or models
    return {name for owner in models for name in owner.model_fields}


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """Every model class inside an annotation such as ``tuple[A, ...] | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models(argument)


def _tagged(models: set[type[BaseModel]], tag: str) -> set[type[BaseModel]]:
    """The members of a union that carry ``tag`` as a literal."""
    return {m for m in models if any(tag in get_args(field.annotation) for field in m.model_fields.values())}
