"""Composed configurations in the cache: what was composed before needs neither Hydra nor pint, which take a second."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.cache import identity, keep, look_up

if TYPE_CHECKING:
    from pipeline.config.schema import Config

_KIND = "configurations"
_PACKAGE = Path(__file__).parents[1]
_PACKAGES = ("hydra-core", "pydantic", "pint")


def made_from(conf: Path, overrides: Sequence[str], outside: Sequence[str | bytes] = ()) -> str:
    """Identity of all that a configuration is composed from: ``conf``, the schema, the packages, the overrides, and
    the files ``outside``."""
    schema = [*sorted(Path(__file__).parent.glob("*.py")), _PACKAGE / "coefficients.py", _PACKAGE / "unknowns.py"]
    try:
        contents = [
            part for path in (*sorted(conf.rglob("*.yaml")), *schema) for part in (str(path), path.read_bytes())
        ]
    except OSError:
        contents = []  # Hydra says what is wrong with conf/
    return identity(*contents, *map(importlib.metadata.version, _PACKAGES), json.dumps(list(overrides)), *outside)


def kept(key: str) -> list[Config] | None:
    """The configurations of a command, one a stage; None where there are none, or a damaged entry."""
    content = look_up(_KIND, key)
    return None if content is None else _read(content)


def keep_configurations(key: str, configs: Sequence[Config]) -> None:
    """Keep what reads back to the very same values."""
    content = json.dumps([config.model_dump(mode="json") for config in configs]).encode()
    if _read(content) == configs:
        keep(_KIND, key, content)


def _read(content: bytes) -> list[Config] | None:
    from pipeline.config.schema import Config

    try:
        return [Config.model_validate(mapping) for mapping in json.loads(content)]
    except (ValueError, TypeError):  # pydantic's errors are ValueErrors
        return None
