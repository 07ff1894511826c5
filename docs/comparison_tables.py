"""Copy the tables of ``stage=compare`` into a Markdown file: `python docs/comparison_tables.py FOLDER FILE`.

What stands between ``<!-- tables of NAME -->`` and ``<!-- end -->`` is replaced by ``FOLDER/NAME/comparison.md``; a
NAME without that file stays as it is. ``<!-- tables of methods -->`` is the catalogue.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from pipeline.methods.catalogue import METHODS
from pipeline.reporting.blocks import format_markdown

BLOCK = re.compile(r"(<!-- tables of (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def list_methods() -> str:
    """The catalogue as a table."""
    rows = [[f"{m.label} (`{m.name}`)", m.source, m.beforehand] for m in METHODS.values()]
    return format_markdown(["method", "source", "needs beside the measurement"], rows)


def copy_tables(text: str, folder: Path) -> str:
    """The text with the blocks that have a table made anew."""

    def make(block: re.Match[str]) -> str:
        path = folder / block[2] / "comparison.md"
        if block[2] == "methods":
            return f"{block[1]}\n{list_methods()}\n{block[3]}"
        return f"{block[1]}\n{path.read_text(encoding='utf-8')}\n{block[3]}" if path.exists() else block[0]

    return BLOCK.sub(make, text)


if __name__ == "__main__":
    target = Path(sys.argv[2])
    target.write_text(copy_tables(target.read_text(encoding="utf-8"), Path(sys.argv[1])), encoding="utf-8")
