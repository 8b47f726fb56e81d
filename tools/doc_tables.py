"""Make the tables in docs/ that follow from tables of the sources: python -m tools.doc_tables, or make docs.

A block begins with ``<!-- table NAME -->`` and ends with ``<!-- end -->``; the table of that name takes the
place of the lines between.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from legacy.ct_inertia import export_formats as mass_formats
from legacy.ct_inertia.exports import units_of
from legacy.ct_inertia.readers import formats as scan_formats
from legacy.fitting import export_formats as fit_formats
from legacy.kinematics.readers import formats as vibrometer_formats
from legacy.stapeskit.records.motion import ROW_COLUMNS

DOCS = Path(__file__).resolve().parents[1] / "docs"
_BLOCK = re.compile(r"(<!-- table (.+?) -->\n).*?(<!-- end -->)", re.DOTALL)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = ["| " + " | ".join(cells) + " |" for cells in (head, *rows)]
    return "\n".join([lines[0], "|" + "-|" * len(head), *lines[1:], ""])


def code(words: Iterable[str]) -> str:
    return ", ".join(f"`{word}`" for word in words)


def scans() -> str:
    rows = [(entry.title, code(entry.suffixes), entry.reads) for entry in scan_formats.FORMATS]
    return table(("format", "endings", "what is read"), rows)


def vibrometer_files() -> str:
    entries = [entry for entry in reversed(vibrometer_formats.FORMATS) if entry.reads]
    return table(("format", "what is read"), [(entry.words, entry.reads) for entry in entries])


def columns() -> str:
    rows = [(f"`{column.name}`", column.meaning, "yes" if column.stored else "") for column in ROW_COLUMNS]
    return table(("column", "what it holds", "also in `dof.h5`"), rows)


def mass_exports() -> str:
    every = units_of(mass_formats.FORMATS)
    rows = [
        (
            f"`{name}`",
            code(entry.files),
            entry.summary,
            ", ".join(unit for key, unit in every[name].items() if key != "coordinates"),
            every[name]["coordinates"],
        )
        for name, entry in mass_formats.EXPORTS.items()
    ]
    return table(("name", "files", "for", "units", "coordinates"), rows)


def fit_exports() -> str:
    entries = fit_formats.EXPORTS.items()
    rows = [(f"`{name}`", f"`kd{entry.ending}`", entry.content) for name, entry in entries]
    return table(("name", "file", "what it holds"), rows)


TABLES: dict[str, Callable[[], str]] = {
    "scans": scans,
    "vibrometer files": vibrometer_files,
    "columns of dof.csv": columns,
    "exports of a mass": mass_exports,
    "exports of a fit": fit_exports,
}


def fill_tables(text: str) -> str:
    """Return a page with its tables made anew."""
    return _BLOCK.sub(lambda block: f"{block[1]}{TABLES[block[2]]()}{block[3]}", text)


if __name__ == "__main__":
    for page in sorted(DOCS.glob("*.md")):
        before = page.read_text(encoding="utf-8")
        page.write_text(fill_tables(before), encoding="utf-8")
