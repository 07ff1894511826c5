"""The operating conditions of one point in a configuration, such as ``{oil_temperature: 70 degC, load: 500 N}``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator

from pipeline.config.operating import to_quantity


def _convert(value: Any) -> Any:
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise ValueError(f"must name conditions with values, such as {{oil_temperature: 70 degC}}, but got {value!r}")
    return {str(name): to_quantity(str(name), level) for name, level in value.items()}


OperatingPoint = Annotated[dict[str, float], BeforeValidator(_convert)]
"""Name -> value, SI; temperatures in K."""
