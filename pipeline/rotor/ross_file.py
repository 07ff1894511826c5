"""Rotor files that ROSS saved (.toml, .json), read element by element.

ROSS's own loader knows half of its classes only, and solves the oil film of some again, though the file has the
coefficients.
The module ``ross`` comes as an argument: :mod:`pipeline.rotor.ross_adapter` alone imports it.
"""

from __future__ import annotations

import itertools
import warnings
from pathlib import Path
from typing import Any

from pipeline.errors import ConfigError, nearest

_NO_ELEMENTS = ("parameters", "ross_version")


def read_rotor_file(ross: Any, file: Path) -> Any:
    """ROSS's rotor of a file.

    Raises ConfigError: no such file, none that ROSS saved, an element of another class, several shafts.
    """
    if not file.is_file():
        raise ConfigError(
            f"machine.rotor.file must be a rotor saved by ROSS (.toml or .json), but there is no file '{file}'"
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            data = ross.utils.load_data(file)
            elements = [
                _find_class(ross, name, content, file).read_toml_data(content)
                for name, content in data.items()
                if name not in _NO_ELEMENTS and not name.startswith("_")
            ]
            _check_shaft([element.n for element in elements if isinstance(element, ross.ShaftElement)], file)
            kinds = (ross.ShaftElement, ross.DiskElement, ross.BearingElement, ross.PointMass)
            parts = [[element for element in elements if isinstance(element, kind)] for kind in kinds]
            return ross.Rotor(*parts, **data["parameters"])
    except ConfigError:
        raise
    except Exception as error:  # ROSS's elements and its rotor raise many kinds
        raise ConfigError(
            f"machine.rotor.file must be a rotor saved by ROSS (.toml or .json), but '{file}' can't be read as one "
            f"({type(error).__name__}: {error})"
        ) from error


def _find_class(ross: Any, name: str, content: Any, file: Path) -> Any:
    """The class that reads an element that is called CLASS_TAG in the file: the simplest that has its matrices."""
    word = name.partition("_")[0]
    ross_class = getattr(ross, word, None)
    kinds = (ross.ShaftElement, ross.DiskElement, ross.BearingElement, ross.PointMass)
    if not isinstance(ross_class, type) or not issubclass(ross_class, kinds):
        known = sorted(
            name
            for name, candidate in vars(ross).items()
            if isinstance(candidate, type) and issubclass(candidate, kinds)
        )
        raise ConfigError(
            f"machine.rotor.file must have elements that ROSS {ross.__version__} knows, but '{file}' has a '{word}': "
            f"{nearest(word, known)}; put a DiskElement, BearingElement or ShaftElement of its values in its place"
        )
    if issubclass(ross_class, ross.DiskElement) and "m" in content:
        return ross.DiskElement
    count, speeds = len(content.get("kxx") or []), len(content.get("frequency") or [])
    if issubclass(ross_class, ross.BearingElement) and count in (1, speeds):
        return ross.SealElement if issubclass(ross_class, ross.SealElement) else ross.BearingElement
    return ross_class


def _check_shaft(starts: list[Any], file: Path) -> None:
    """Raise ConfigError where the elements, at the nodes ``starts``, are not one shaft from node 0 on."""
    nodes = sorted({int(start) for start in starts})
    if not nodes:
        raise ConfigError(f"machine.rotor.file must have a shaft, but '{file}' has no ShaftElement")
    if nodes[0] != 0:
        raise ConfigError(f"machine.rotor.file must have a shaft from node 0 on, but '{file}' begins at {nodes[0]}")
    for a, b in itertools.pairwise(nodes):
        if b != a + 1:
            raise ConfigError(
                f"machine.rotor.file must have one shaft, but that of '{file}' ends at node {a + 1} and another begins "
                f"at node {b} (rotors on one axis or joined by gears): save the rotor that was measured by itself"
            )
