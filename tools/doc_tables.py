"""Fill the tables of docs/ that follow from tables of the sources: python -m tools.doc_tables, or make docs.

A block begins with ``<!-- table NAME -->`` and ends with ``<!-- end -->``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from ct_inertia.scan.formats import FORMATS as SCANS
from kinematics.readers.formats import FORMATS as VIBROMETER_FILES

DOCS = Path(__file__).resolve().parents[1] / "docs"
BLOCK = re.compile(r"(<!-- table (.+?) -->\n).*?(<!-- end -->)", re.DOTALL)
TABLES: dict[str, list[Sequence[str]]] = {
    "scans": [
        ("format", "endings", "what is read"),
        *((one.title, ", ".join(f"`{end}`" for end in one.suffixes), one.reads) for one in SCANS),
    ],
    "vibrometer files": [
        ("format", "what is read"),
        *((one.words, one.reads) for one in VIBROMETER_FILES if one.reads),
    ],
}


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown; the first row is its head."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|" + "-|" * len(rows[0]), *lines[1:], ""])


if __name__ == "__main__":
    for page in sorted(DOCS.glob("*.md")):
        text = page.read_text(encoding="utf-8")
        page.write_text(
            BLOCK.sub(lambda match: f"{match[1]}{markdown(TABLES[match[2]])}{match[3]}", text),
            encoding="utf-8",
        )
