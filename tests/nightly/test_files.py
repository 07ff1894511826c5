"""Two thousand damaged files of every format."""

from __future__ import annotations

import test_hostile_files as by_day
from running import at_night

test_damaged_files = at_night(by_day.test_damaged_files, "seeds", [range(24, 2024)], ids=str)
