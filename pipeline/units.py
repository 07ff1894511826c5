"""rpm, the one unit besides SI that files and configs use throughout."""

from __future__ import annotations

import math

RAD_S_PER_RPM = math.pi / 30.0
"""Multiply a speed in rpm by this for rad/s."""
