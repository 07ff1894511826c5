"""Sentences for a configuration that breaks a law: the law, what came, the next step."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, get_args

from pipeline.errors import nearest

if TYPE_CHECKING:
    from pydantic import BaseModel, ValidationError

_LAWS = {  # where pydantic speaks of Python's types
    "model_type": "must be a group of keys",
    "model_attributes_type": "must be a group of keys",
    "tuple_type": "must be a list",
}


def explain_schema_errors(error: ValidationError, mapping: Mapping[str, Any], model: type[BaseModel]) -> str:
    """Every error of ``mapping`` against ``model`` as a line of its own, then the next step."""
    errors = error.errors(include_url=False)
    wrong_inside = {item["loc"][:n] for item in errors for n in range(len(item["loc"]))}
    # A list whose items are wrong is "too short", since none of them counts. What is misspelt comes first: for its sake
    # another is missing.
    counted = (item for item in errors if item["type"] != "too_short" or item["loc"] not in wrong_inside)
    errors = sorted(counted, key=lambda item: item["type"] != "extra_forbidden")
    lines = list(dict.fromkeys(_explain(item, mapping, model) for item in errors))
    values = "this value" if len(lines) == 1 else f"these {len(lines)} values"
    machine = mapping.get("machine")
    file = machine.get("file") if isinstance(machine, Mapping) else None
    where = f" (the machine is '{file}')" if file else ""
    return "\n".join(
        [*lines, f"Correct {values}{where}; `python -m pipeline --cfg job` prints the whole configuration."]
    )


def name_first(error: ValidationError) -> str:
    """The first place of a file that is wrong, and how."""
    first = error.errors(include_url=False)[0]
    return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"


def suggest(name: str, candidates: Iterable[str]) -> str:
    """:func:`pipeline.errors.nearest` with the mark that joins it to the sentence before."""
    matches = nearest(name, candidates)
    return f" {matches}" if matches.startswith("(") else f"; {matches}"


def quote_value(value: Any, longest: int = 80) -> str:
    """``value`` as it would be written in a config, shortened."""
    literals = {None: "null", True: "true", False: "false"}
    text = literals[value] if isinstance(value, bool | None) else repr(value)
    return text if len(text) <= longest else text[: longest - 3] + "..."


def _explain(item: Any, mapping: Mapping[str, Any], model: type[BaseModel]) -> str:
    path, value = _locate(item["loc"], mapping)
    context, kind = item.get("ctx", {}), item["type"]
    choices = ""
    if kind.startswith("union_tag"):
        path.append(str(context["discriminator"]).strip("'"))
        value, choices = context.get("tag"), context.get("expected_tags", "")
    elif kind == "literal_error" and isinstance(value, str):
        choices = context["expected"]
    key = ".".join(path)
    if kind == "extra_forbidden":
        near = suggest(path[-1], _list_fields(item["loc"], model))
        return f"{key}: must be a key that the schema knows, but '{path[-1]}' is not{near}"
    if kind in ("missing", "union_tag_not_found"):
        return f"{key}: must be given, but is missing"
    if choices:
        near = suggest(str(value), re.findall(r"'([^']*)'", choices))
        return f"{key}: must be one of these, but got {value!r}{near}"
    # A sentence of the schema itself says what came; a mapping in full would hide the law.
    told = kind == "value_error" or isinstance(value, Mapping)
    came = "" if told else f", but got {quote_value(value)}"
    return f"{key or 'configuration'}: {_state_law(kind, item['msg'])}{came}"


def _state_law(kind: str, message: str) -> str:
    if kind in _LAWS:
        return _LAWS[kind]
    message = re.sub(
        r"^[A-Z]\w*(?: \w+)? should (?=be |have |match |start |end )", "must ", message.removeprefix("Value error, ")
    )
    if kind.endswith(("_parsing", "_from_float", "_short", "_long")):
        # Behind the comma pydantic says what came, in words that the value itself replaces.
        return message.partition(", ")[0]
    return message


def _locate(loc: Sequence[int | str], mapping: Any) -> tuple[list[str], Any]:
    """The path and the value as the user wrote them: pydantic's ``loc`` also names union tags."""
    path: list[str] = []
    node = mapping
    for position, step in enumerate(loc):
        is_key = isinstance(node, Mapping) and step in node
        is_item = isinstance(node, (list, tuple)) and isinstance(step, int) and step < len(node)
        if is_key or is_item:
            node = node[step]
            path.append(str(step))
        elif position == len(loc) - 1:
            path.append(str(step))
    return path, node


def _list_fields(loc: Sequence[int | str], model: type[BaseModel]) -> set[str]:
    """Names of the fields that may stand where ``loc`` ends."""
    models = {model}
    for step in loc[:-1]:
        if isinstance(step, int):
            continue
        fields = [owner.model_fields[step] for owner in models if step in owner.model_fields]
        inner = {inside for field in fields for inside in _list_models(field.annotation)}
        tagged = {m for m in models if any(step in get_args(field.annotation) for field in m.model_fields.values())}
        models = inner or tagged or models
    return {name for owner in models for name in owner.model_fields}


def _list_models(annotation: Any) -> Iterator[type[BaseModel]]:
    """Every model class inside an annotation such as ``tuple[A, ...] | None``."""
    from pydantic import BaseModel

    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _list_models(argument)


# --- overrides ---------------------------------------------------------------------------------


def explain_syntax(text: str, names: Mapping[str, Iterable[str]]) -> str:
    """An override that Hydra can't read; ``names`` may stand in it without their key, such as a stage."""
    key, equals, value = text.partition("=")
    if not equals or not key:
        places = [f"'{group}={key}'" for group, known in names.items() if key in known]
        hint = f"; did you mean {places[0]}?" if places else ", for example stage=train"
        return f"an override must be KEY=VALUE, but got '{text}'{hint}"
    brackets = any(value.count(a) != value.count(b) for a, b in ("[]", "{}", "()"))
    if brackets or any(value.count(quote) % 2 for quote in "'\""):
        return f"an override must close its brackets and quotes, but got '{text}'; write {key}=[1,2] for a list"
    quoted = shlex.quote(f"{key}='{value}'" if '"' in value else f'{key}="{value}"')
    return f"an override must quote a value with special characters, but got '{text}'; write {quoted}"


def quote_override(key: str, value: str) -> str:
    """``key=value`` as a shell and Hydra take it."""
    if re.fullmatch(r"[A-Za-z0-9_./-]+( [A-Za-z0-9_./-]+)*", value) or key.startswith("-"):
        return shlex.quote(f"{key}={value}")
    escaped = value.replace("\\", "\\\\").replace("'", "\\'")
    return shlex.quote(f"{key}='{escaped}'")


def explain_option(group: str, name: Any, known: Sequence[str]) -> str:
    """A name that the config group doesn't have."""
    place = "an installed Hydra plugin" if group.startswith("hydra/") else f"a file in conf/{group}"
    if not known:
        absolute = f"/{group.rpartition('/')[2]}"
        return f"{group} must be {place}, but there is none; a defaults list names conf's groups as '{absolute}'"
    return f"{group} must be {place}, but got {quote_value(name)}{suggest(str(name), known)}"


def explain_key(key: str, tree: Any) -> str:
    """A sentence if ``key`` is not in ``tree``, the composed configuration; otherwise nothing."""
    law = "an override must name a key of the configuration, but "
    path: list[str] = []
    node = tree
    for step in re.findall(r"[^.\[\]]+", key):
        owner = ".".join(path)
        if isinstance(node, dict) and step in node:
            node = node[step]
        elif isinstance(node, list) and step.isdigit() and int(step) < len(node):
            node = node[int(step)]
        elif isinstance(node, dict):
            places = [place for place in list_paths(tree) if place.endswith(f".{key}")]
            if places:
                depth = min(place.count(".") for place in places)
                near = [place for place in places if place.count(".") == depth]
                return f"{law}there is no '{key}'; did you mean {' or '.join(map(repr, near[:3]))}?"
            names = (str(name) for name in node if owner or name != "hydra")
            return f"{law}{owner or 'it'} has no '{step}'{suggest(step, names)}"
        elif isinstance(node, list):
            items = f"the items 0 to {len(node) - 1}" if node else "no items"
            return f"{law}{owner} has {items}, not '{step}'"
        else:
            return f"{law}{owner} is a single value; give {owner}=VALUE instead of '{key}'"
        path.append(step)
    return ""


def list_paths(tree: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """The dotted paths of all mapping keys; Hydra's own left out, and those that are themselves a dotted path."""
    for name, value in tree.items():
        if (prefix or name != "hydra") and "." not in str(name):  # nodes are numbers
            yield f"{prefix}{name}"
            if isinstance(value, Mapping):
                yield from list_paths(value, f"{prefix}{name}.")
