"""The figures of a page as files and its tables as CSV and LaTeX: ``stapeskit figures PAGE.html DIR``.

The files are those that the buttons of the page save (stapeskit/page/parts/page.js), and each figure as PDF.
"""

from __future__ import annotations

import base64
import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from legacy.pipeline.figure_pdf import figure_pdf
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.own_files import OutputSet
from legacy.stapeskit.tables.latex_tables import PACKAGE, tabular
from legacy.stapeskit.tables.text_cells import as_text_cell

_PICTURE = re.compile(r"data:image/(svg|png)(?:\+xml)?;base64,(.*)", re.DOTALL)
_STEP = "Give report.html, dof.html or kd.html"
_LONGEST_NAME = 100  # characters; with number and ending less than the 255 bytes that file systems allow
_LEAST_ROWS = 3  # a header and two rows
_NUMBER = re.compile(r"[+-]?[\d.][^|!(=@]*")  # without what calls something from a formula


@dataclass
class _Parts(HTMLParser):
    """What a page holds: figures (name, kind, bytes) and tables (name, rows of cells)."""

    figures: list[tuple[str, str, bytes]] = field(default_factory=list)
    tables: list[tuple[str, list[list[str]]]] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()
        self._heading = ""
        self._titles: dict[str, list[str]] = {"h2": [], "title": []}
        self._reading = ""
        self._rows: list[list[str]] | None = None

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Begin a heading, table, row or cell, or keep a picture."""
        values = dict(attrs)
        if tag in self._titles:
            self._reading, self._titles[tag] = tag, []
        elif tag == "table":
            self._rows = []
        elif tag == "tr" and self._rows is not None:
            self._rows.append([])
        elif tag in ("td", "th") and self._rows:
            self._rows[-1].append("")
        elif tag == "br" and self._rows and self._rows[-1]:
            self._rows[-1][-1] += " "
        elif tag == "img" and (picture := _PICTURE.fullmatch(values.get("src") or "")):
            content = base64.b64decode(picture[2])
            self.figures.append((self._number(self.figures), picture[1], content))

    def handle_endtag(self, tag: str) -> None:
        """End a heading or a table."""
        if tag in self._titles:
            self._reading = ""
        if tag == "table" and self._rows is not None:
            rows = [[" ".join(cell.split()) for cell in row] for row in self._rows if row]
            if len(rows) >= _LEAST_ROWS:
                self.tables.append((self._number(self.tables), rows))
            self._rows = None

    def handle_data(self, data: str) -> None:
        """Add text to the open heading or cell."""
        if self._reading:
            self._titles[self._reading].append(data)
        elif self._rows and self._rows[-1]:
            self._rows[-1][-1] += data

    def _number(self, others: Sequence[tuple[Any, ...]]) -> str:
        """Return the heading of the section as a name, with a number that counts within it."""
        words = "".join(self._titles["h2"] or self._titles["title"]).lower()
        name = re.sub(r"[^a-z0-9]+", "_", words).strip("_")[:_LONGEST_NAME] or "page"
        return f"{name}_{1 + sum(str(other[0]).rpartition('_')[0] == name for other in others)}"


def write_figures(page: Path, folder: Path, *, force: bool = False) -> tuple[Path, ...]:
    """Write every figure of a page (PDF, and SVG, or PNG where it is pixels) and every table (CSV, LaTeX).

    Parameters
    ----------
    page : Path
        report.html, dof.html, kd.html or another page of these commands.
    folder : Path
        Made when missing.
    force : bool
        Replace files of the same names that this function did not write.

    Raises
    ------
    StapeskitError
        No such page, neither figure nor table in it, or the name of an output is taken by another file.
    """
    parts = _parts(page)
    files = {f"{name}.{kind}": content for name, kind, content in parts.figures}
    files |= {f"{name}.pdf": _pdf(page, kind, content) for name, kind, content in parts.figures}
    for name, rows in parts.tables:
        files[f"table_{name}.csv"] = _csv(rows)
        files[f"table_{name}.tex"] = ("\n".join([PACKAGE, *tabular(rows)]) + "\n").encode()
    if not files:
        raise StapeskitError.of("the page", "one with figures or tables", "none", page.name, _STEP)
    outputs = OutputSet("stapeskit figures", folder, tuple(files), (page,), force)
    outputs.check()
    with outputs.staged() as stage:
        for name, content in files.items():
            (stage / name).write_bytes(content)
    return tuple(outputs.folder / name for name in files)


def _parts(page: Path) -> _Parts:
    """Read a page."""
    parts = _Parts()
    try:
        if page.exists() and not page.is_file():
            raise ValueError("a folder, a pipe or a device")
        parts.feed(page.read_text(encoding="utf-8"))
    except (OSError, ValueError, AssertionError) as fault:  # the parser asserts what declarations hold
        got = f"{page}: {fault.strerror}" if isinstance(fault, OSError) else page
        raise StapeskitError.of("the page", "a page that a command wrote", got, "", _STEP) from fault
    return parts


def _pdf(page: Path, kind: str, content: bytes) -> bytes:
    try:
        return figure_pdf(kind, content)
    except MemoryError:
        raise
    except Exception as fault:  # whatever XML, numbers of paths and packed pixels can hold
        step = f"{_STEP} as the command wrote it"
        raise StapeskitError.of("a figure", "one that a command drew", kind, page.name, step) from fault


def _csv(rows: Sequence[Sequence[str]]) -> bytes:
    stream = io.StringIO(newline="")
    csv.writer(stream).writerows(
        [[cell if _NUMBER.fullmatch(cell) else as_text_cell(cell) for cell in row] for row in rows]
    )
    return ("\ufeff" + stream.getvalue()).encode()
