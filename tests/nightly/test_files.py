"""Thousands of damaged files of every format."""

from __future__ import annotations

import ingest.test_hostile_files as by_day
import test_any_bytes as own
from running import at_night

test_damaged_files = at_night(by_day.test_damaged_files, "seeds", [range(24, 2024)], ids=str)
small = own.small  # the fixture of it
test_own_files = at_night(own.test_a_file_with_any_bytes_wrong_is_read_or_refused, "seeds", [range(150, 1500)], ids=str)
