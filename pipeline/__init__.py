"""Identifies the bearing coefficients of rotating machines from their vibration.

``from pipeline import Guess, Measurement, NoiseModel, fit`` is the library's door; ``python -m pipeline`` the command.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

# The systems are small: more threads of numpy's BLAS, or of torch where no stage sets them (`threads`), cost more than
# they give, up to twenty times. This holds for scripts, too: both libraries read it when they are imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

if TYPE_CHECKING:
    from pipeline.data.sensors import NoiseModel as NoiseModel
    from pipeline.identification.fit import default_setup as default_setup
    from pipeline.identification.fit import fit as fit
    from pipeline.problem.measurement import Guess as Guess
    from pipeline.problem.measurement import Measurement as Measurement

__version__ = "0.1.0"

_DOORS = {
    "Guess": "pipeline.problem.measurement",
    "Measurement": "pipeline.problem.measurement",
    "NoiseModel": "pipeline.data.sensors",
    "default_setup": "pipeline.identification.fit",
    "fit": "pipeline.identification.fit",
}
__all__ = ["Guess", "Measurement", "NoiseModel", "__version__", "default_setup", "fit"]


def __getattr__(name: str) -> Any:
    """Imported when it is asked for: the command's help needs none of it."""
    if name not in _DOORS:
        raise AttributeError(f"module 'pipeline' has no attribute '{name}'")
    import importlib

    return getattr(importlib.import_module(_DOORS[name]), name)
