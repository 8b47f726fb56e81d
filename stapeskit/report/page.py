"""Put together one self-contained HTML page: a title, a first screen, sections, a folded appendix.

A block is a piece of HTML made by a function of this file from the macro of the same name in
``page.html.j2``; every text is escaped. A page loads nothing, needs no network, and can be read without its
scripts.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from stapeskit.report.colours import PAGE_COLOURS
from stapeskit.report.figures import draw
from stapeskit.report.quantities import PLAIN, Quantity, ShownUnit, plus_minus
from stapeskit.report.saved_table import csv_link, numeric_columns
from stapeskit.warnings import Notice
from stapeskit.warnings import table as warning_table

if TYPE_CHECKING:
    from jinja2.environment import TemplateModule
    from markupsafe import Markup
    from matplotlib.figure import Figure

    from stapeskit.report.scene3d import Scene

_HERE = Path(__file__).parent
# Tables of so few rows are not broken between two printed pages.
_FEW_ROWS = 14
# Matrices up to this size show the interval of each entry; larger ones have it in their CSV file.
_MOST_WITH_INTERVALS = 3
# Nothing is loaded from anywhere and nothing is sent; only the scripts of this project run.
_POLICY = (
    "default-src 'none'; base-uri 'none'; form-action 'none'; style-src 'unsafe-inline'; img-src data:; "
    "script-src {hashes}"
)


@cache
def _blocks() -> TemplateModule:
    """Return the macros of the template, compiled once."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(_HERE), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    return environment.get_template("page.html.j2").module


def _render(macro: str, *values: Any) -> Markup:
    block: Markup = getattr(_blocks(), macro)(*values)
    return block


@dataclass
class Section:
    """A heading with its blocks.

    Attributes
    ----------
    name : str
        The heading.
    id : str
        What links refer to.
    folded : bool
        Whether the reader opens it.
    """

    name: str
    blocks: list[Markup]
    id: str
    folded: bool = False

    def add(self, *blocks: Markup) -> Section:
        """Append blocks and return the section."""
        self.blocks.extend(blocks)
        return self


@dataclass
class Page:
    """A page under construction.

    Attributes
    ----------
    title, lead : str
        Heading, and a sentence below it.
    first : list of Markup
        The first screen: verdict, summary, key matrices, a figure.
    sections, appendix : list of Section
        What follows, and what few readers open.
    """

    title: str
    lead: str = ""
    first: list[Markup] = field(default_factory=list)
    sections: list[Section] = field(default_factory=list)
    appendix: list[Section] = field(default_factory=list)

    def add(self, *blocks: Markup) -> Page:
        """Append blocks to the first screen and return the page."""
        self.first.extend(blocks)
        return self

    def section(self, name: str, *blocks: Markup, folded: bool = False) -> Section:
        """Append a section and return it."""
        return self._append(self.sections, name, blocks, folded)

    def appendix_section(self, name: str, *blocks: Markup) -> Section:
        """Append a folded section to the appendix and return it."""
        return self._append(self.appendix, name, blocks, True)

    def _append(self, part: list[Section], name: str, blocks: Iterable[Markup], folded: bool) -> Section:
        key = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_") or "section"
        same = sum(re.sub(r"_\d+$", "", other.id) == key for other in (*self.sections, *self.appendix))
        section = Section(name, list(blocks), f"{key}_{same + 1}" if same else key, folded)
        part.append(section)
        return section

    def add_listed(self, listed: Path, makers: Mapping[str, Callable[[], Markup | None]]) -> None:
        """Append the sections that a TOML file lists, in its order.

        Parameters
        ----------
        listed : Path
            ``[[section]]`` tables with ``name``, ``blocks`` (names of makers or of PNG files beside the
            list), and optionally ``caption``, ``folded`` and ``appendix``.
        makers : mapping of str to callable
            A function that makes each block, or returns None where this result has nothing to show; a section
            without blocks is left out.

        Raises
        ------
        KeyError
            A block is neither in ``makers`` nor a PNG file: a mistake of the program, not of its user.
        """
        import tomllib

        for entry in tomllib.loads(listed.read_text(encoding="utf-8"))["section"]:
            caption = entry.get("caption", "")
            blocks = []
            for name in entry["blocks"]:
                file = listed.with_name(name)
                if name not in makers and file.suffix == ".png":
                    blocks.append(image(file.read_bytes(), caption, entry["name"]))
                elif (block := makers[name]()) is not None:
                    blocks.append(block)
            if blocks:
                part = self.appendix if entry.get("appendix") else self.sections
                folded = bool(entry.get("folded") or entry.get("appendix"))
                self._append(part, entry["name"], blocks, folded)

    def html(self) -> str:
        """Return the whole page."""
        from markupsafe import Markup

        blocks = [*self.first, *(block for part in (*self.sections, *self.appendix) for block in part.blocks)]
        scripts = [str(_render("script"))]
        if any("data-scene" in block for block in blocks):
            scripts.append((_HERE / "viewer.js").read_text(encoding="utf-8"))
        hashes = " ".join(f"'sha256-{_base64(hashlib.sha256(one.encode()).digest())}'" for one in scripts)
        return str(
            _render(
                "page",
                self.title,
                self.lead,
                self.first,
                self.sections,
                self.appendix,
                PAGE_COLOURS,
                _POLICY.format(hashes=hashes),
                [Markup(script) for script in scripts],
            )
        )

    def write(self, path: Path) -> None:
        """Write the page as UTF-8."""
        # Names of files may hold bytes that are no UTF-8.
        Path(path).write_text(self.html(), encoding="utf-8", errors="replace")


def text(sentence: str) -> Markup:
    """Return a paragraph."""
    return _render("text", sentence)


def code(words: str) -> Markup:
    """Return lines to copy."""
    return _render("code", words)


def subheading(words: str) -> Markup:
    """Return a small heading within a section."""
    return _render("subheading", words)


def beside(*blocks: Markup) -> Markup:
    """Return blocks next to each other where the window is wide enough."""
    return _render("beside", blocks)


def folded(summary: str, *blocks: Markup) -> Markup:
    """Return blocks below one line that opens them."""
    return _render("folded", summary, blocks)


def table(
    head: Sequence[str],
    rows: Iterable[Sequence[object]],
    caption: str = "",
    *,
    words: bool = False,
    names: int = 1,
    file: str = "table",
) -> Markup:
    """Return a table with a button that saves its numbers as CSV.

    Parameters
    ----------
    rows : iterable of sequence
        Cells: `Quantity`, numbers, text, or other blocks. In the file a `Quantity` has five columns: value,
        sd, lower, upper, unit.
    words : bool
        Align all columns to the left and let text wrap.
    names : int
        Columns of names, aligned to the left.
    file : str
        Name of the saved file without ending.
    """
    listed = [["" if cell is None else _cell(cell) for cell in row] for row in rows]
    numeric = any(isinstance(cell, Quantity | float | int) for row in listed for cell in row)
    link = csv_link(numeric_columns(head, listed)) if numeric else ""
    shown = [[_number(cell) if isinstance(cell, float) else cell for cell in row] for row in listed]
    return _render(
        "table", list(head), shown, words, names, len(listed) <= _FEW_ROWS, caption, link, f"{file}.csv"
    )


def _cell(cell: object) -> object:
    """Return numbers of numpy as numbers of Python."""
    return cell.item() if isinstance(cell, np.generic) else cell


def _number(value: float) -> str:
    return f"{value:.5g}" if np.isfinite(value) else ""


def matrix(
    names: Sequence[str],
    values_si: ArrayLike,
    sd_si: ArrayLike | None = None,
    units: Sequence[Sequence[ShownUnit]] | None = None,
    caption: str = "",
    *,
    title: str = "",
    interval_95_si: ArrayLike | None = None,
    file: str = "matrix",
) -> Markup:
    """Return a square matrix with ±, 95 % intervals, and a button that saves its numbers as CSV.

    Parameters
    ----------
    names : sequence of str, (n,)
        Degrees of freedom.
    values_si, sd_si : array_like, (n, n)
        Entries and standard deviations, SI; NaN or None where one is not known.
    units : nested sequence of ShownUnit, (n, n), optional
        Unit in which each entry is shown, of `quantities.matrix_units`.
    caption : str
        What it is, about which point, in which axes.
    interval_95_si : array_like, (n, n, 2), optional
        Limits of the 95 % intervals, SI, where they are not the value ± 1.96 standard deviations.

    Notes
    -----
    Entries whose interval holds zero are grey.
    """
    values = np.asarray(values_si, dtype=float)
    places = range(len(names))
    sds = np.full(values.shape, np.nan) if sd_si is None else np.asarray(sd_si, dtype=float)
    limits = None if interval_95_si is None else np.asarray(interval_95_si, dtype=float)
    quantities = [
        [
            Quantity(
                float(values[i, j]),
                None if np.isnan(sds[i, j]) else float(sds[i, j]),
                PLAIN if units is None else units[i][j],
                None if limits is None else (float(limits[i, j, 0]), float(limits[i, j, 1])),
            )
            for j in places
        ]
        for i in places
    ]
    rows = [(names[i], names[j], quantities[i][j]) for i in places for j in places]
    link = csv_link(numeric_columns(("row", "column", ""), rows))
    cells = [[_entry(quantities[i][j], i == j, len(names)) for j in places] for i in places]
    return _render("matrix", title, list(names), cells, caption, link, f"{file}.csv")


def _entry(entry: Quantity, diagonal: bool, size: int) -> dict[str, str]:
    """Return what a cell of a matrix shows."""
    shown = entry.unit.of(entry.value) + 0.0
    if entry.sd is None or not entry.known_sd or entry.sd == 0.0:
        value, rest = f"{shown:.4g}", entry.unit.symbol
    else:
        value, _, spread = plus_minus(shown, entry.unit.of(entry.sd)).partition(" ± ")
        if value.startswith("("):
            value, spread = f"{shown:.4g}", f"{entry.unit.of(entry.sd):.2g}"
        rest = f"± {spread} {entry.unit.symbol}"
    limits = entry.limits
    holds_zero = limits is not None and limits[0] <= 0.0 <= limits[1]
    return {
        "value": value,
        "rest": rest,
        "interval": entry.interval if size <= _MOST_WITH_INTERVALS and entry.sd != 0.0 else "",
        "kind": "diagonal" if diagonal else "open" if holds_zero else "",
    }


def figure(
    drawing: Figure, caption: str, alt: str, *, vector: bool | None = None, file: str = "figure"
) -> Markup:
    """Embed a matplotlib figure.

    Parameters
    ----------
    alt : str
        What it shows, for who cannot see it.
    vector : bool, optional
        SVG or PNG; by default SVG unless it has many points.
    """
    from markupsafe import Markup

    data, kind = draw(drawing, vector)
    if kind == "svg":
        return _render("vector", Markup(data.decode()), caption, alt, file)
    return image(data, caption, alt, kind, file=file)


def image(data: bytes, caption: str, alt: str, kind: str = "png", *, file: str = "image") -> Markup:
    """Embed the bytes of a picture (``png``, ``jpeg``) with a caption."""
    return _render("image", f"data:image/{kind};base64,{_base64(data)}", caption, alt, file, kind)


def notices(found: Iterable[Notice]) -> Markup:
    """Return every warning in the colour of its verdict, or one line that says that there is none."""
    known = warning_table()
    listed = [
        {
            "code": notice.code,
            "text": notice.text,
            "css": _css(known[notice.code].verdict) if notice.code in known else "",
        }
        for notice in found
    ]
    return _render("notices", listed)


def verdict(level: str, sentence: str, reasons: Iterable[Notice] = ()) -> Markup:
    """Return the verdict on a result.

    Parameters
    ----------
    level : {"believe", "check", "do not use"}
    reasons : iterable of Notice
        By weight; of each the first sentence is shown, and the rest when the reader opens it.
    """
    listed = []
    for reason in reasons:
        first, stop, rest = reason.text.partition(". ")
        listed.append({"code": reason.code, "first": first + stop.strip(), "rest": rest})
    return _render("verdict", level, _css(level), sentence, listed)


def cards(*groups: tuple[str, Sequence[Sequence[object]]]) -> Markup:
    """Return the summary: groups of a title and rows of name and text or `Quantity`."""
    return _render("cards", groups)


def inputs(provenance: Mapping[str, Any]) -> Markup:
    """Return the inputs of a result with size, date and content hash."""
    rows = [
        (
            role,
            entry["file"],
            f"{entry['size_bytes']:,}",
            entry["modified"][:16].replace("T", " "),
            entry["hash"],
        )
        for role, entry in provenance.get("inputs", {}).items()
    ]
    return table(("role", "file", "bytes", "modified (UTC)", "content hash"), rows, words=True)


def viewer(scene: Scene) -> Markup:
    """Return the three-dimensional view of a scene."""
    from markupsafe import Markup

    content = scene.content()
    motions = [motion.name for motion in scene.motions]
    return _render("viewer", scene.title, Markup(content), motions, scene.groups, scene.caption)


def _css(level: str) -> str:
    return level.replace(" ", "-")


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()
