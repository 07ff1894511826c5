"""From a record's nested values to the flat names and texts that MLflow accepts; MLflow is not needed."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pipeline.errors import without_password

NAME_LENGTH = 250
PARAMETER_LENGTH = 6000
TAG_LENGTH = 8000

_FORBIDDEN_IN_NAME = re.compile(r"[^\w .:/-]")


MetricValue = tuple[str, float, int, int]
"""Name, finite value, time (ms since 1970) and step: what :class:`mlflow.entities.Metric` takes, in its order."""


def clean_name(text: str) -> str:
    """``text`` as a name MLflow accepts: other characters become ``_``, at most 250 are kept."""
    # "/" makes folders of names, which must not be empty, "." or "..", nor start at the root.
    parts = [word for word in _FORBIDDEN_IN_NAME.sub("_", text).split("/") if word not in ("", ".", "..")]
    return "/".join(parts)[:NAME_LENGTH] or "_"


def shorten(text: str, length: int) -> str:
    """``text``, cut to ``length`` characters with an ellipsis where it is longer."""
    return text if len(text) <= length else text[: length - 3] + "..."


def simplify(value: object) -> Any:
    """``value`` as what JSON and YAML know: dict, list, str, int, float, bool and None."""
    from pydantic_core import to_jsonable_python

    return to_jsonable_python(value, fallback=lambda other: other.tolist() if hasattr(other, "tolist") else str(other))


def flatten_parameters(parameters: Mapping[str, object]) -> dict[str, str]:
    """``parameters`` by dotted name, as texts that can be pasted back as overrides (``null``, ``[1, 2]``).

    Passwords are masked.
    """

    def leaves(prefix: str, value: object) -> Iterator[tuple[str, object]]:
        if isinstance(value, dict) and value:
            for key, item in value.items():
                yield from leaves(f"{prefix}.{key}" if prefix else key, item)
        elif prefix:
            yield prefix, value

    return {
        clean_name(name): shorten(
            without_password(value if isinstance(value, str) else json.dumps(value)), PARAMETER_LENGTH
        )
        for name, value in leaves("", simplify(parameters))
    }


def flatten_tags(tags: Mapping[str, object]) -> dict[str, str]:
    """``tags`` with names and lengths that MLflow accepts."""
    return {clean_name(name): shorten(without_password(str(text)), TAG_LENGTH) for name, text in tags.items()}


def collect_final(metrics: Mapping[str, float], time: float) -> tuple[list[MetricValue], list[str]]:
    """The finite metrics at ``time`` (s since 1970), step 0; and the names of those that are not finite."""
    finite = {name: value for name, value in metrics.items() if _is_finite(value)}
    values = [(clean_name(name), float(value), _to_ms(time), 0) for name, value in finite.items()]
    return values, [name for name in metrics if name not in finite]


def collect_history(
    history: Sequence[Mapping[str, float | str]], started: float, ended: float
) -> tuple[list[MetricValue], list[str]]:
    """The finite numbers of all rows; and the names of which some value is not finite.

    A row has no time of its own: the rows are spread evenly over the stage (``started`` to ``ended``, s).

    :raises KeyError: if a row has no ``step``
    """
    values: list[MetricValue] = []
    skipped: dict[str, None] = {}
    for number, row in enumerate(history, start=1):
        time = _to_ms(started + (ended - started) * number / len(history))
        for name, value in row.items():
            if name == "step" or isinstance(value, str):
                continue
            if _is_finite(value):
                values.append((clean_name(name), float(value), time, int(row["step"])))
            else:
                skipped[name] = None
    return values, list(skipped)


def _is_finite(value: float | None) -> bool:
    return value is not None and math.isfinite(value)


def _to_ms(seconds: float) -> int:
    return round(1000 * seconds)
