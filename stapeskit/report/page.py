"""Put together one self-contained HTML page of blocks: text, tables, matrices, figures, warnings, verdicts.

A `Page` has a title, a first screen, sections and a folded appendix; it loads nothing, needs no network, and
can be read without its scripts. Each block is made by the macro of the same name in ``page.html.j2``; every
text is escaped.

Examples
--------
>>> from stapeskit.report import page
>>> shown = page.Page("An ear").add(page.verdict("believe", "No warning calls for a check."))
>>> section = shown.section("Stiffness K", page.matrix(("y",), [[1735.0]], [[19.0]]))
>>> shown.appendix_section("Inputs", page.text("scan.tif")).folded
True
>>> "1735" in shown.html()
True
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from stapeskit.report.colours import PAGE_COLOURS
from stapeskit.report.figures import draw
from stapeskit.report.quantities import PLAIN, Quantity, ShownUnit, plus_minus
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
# Matrices up to this size show the interval of each entry.
_MOST_WITH_INTERVALS = 3


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
        taken = {other.id for other in (*self.sections, *self.appendix)}
        own = next(one for one in chain([key], (f"{key}_{k}" for k in count(2))) if one not in taken)
        section = Section(name, list(blocks), own, folded)
        part.append(section)
        return section

    def html(self) -> str:
        """Return the whole page."""
        from markupsafe import Markup

        blocks = [*self.first, *(block for part in (*self.sections, *self.appendix) for block in part.blocks)]
        scripts = [str(render("script"))]
        if any("data-scene" in block for block in blocks):
            scripts.append((_HERE / "viewer.js").read_text(encoding="utf-8"))
        parts = (self.title, self.lead, self.first, self.sections, self.appendix)
        return str(render("page", *parts, PAGE_COLOURS, [Markup(script) for script in scripts]))

    def write(self, path: Path) -> None:
        """Write the page as UTF-8."""
        # Names of files may hold bytes that are no UTF-8.
        Path(path).write_text(self.html(), encoding="utf-8", errors="replace")


@cache
def _blocks() -> TemplateModule:
    """Return the macros of the template, compiled once."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(_HERE),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    return environment.get_template("page.html.j2").module


def render(macro: str, *values: Any) -> Markup:
    """Render values by a macro of the template; every text is escaped."""
    block: Markup = getattr(_blocks(), macro)(*values)
    return block


def text(sentence: str) -> Markup:
    """Return a paragraph."""
    return render("text", sentence)


def code(words: str) -> Markup:
    """Return lines to copy."""
    return render("code", words)


def subheading(words: str) -> Markup:
    """Return a small heading within a section."""
    return render("subheading", words)


def beside(*blocks: Markup) -> Markup:
    """Return blocks next to each other where the window is wide enough."""
    return render("beside", blocks)


def folded(summary: str, *blocks: Markup) -> Markup:
    """Return blocks below one line that opens them."""
    return render("folded", summary, blocks)


def table(
    head: Sequence[str],
    rows: Iterable[Sequence[object]],
    caption: str = "",
    *,
    words: bool = False,
    names: int = 1,
) -> Markup:
    """Return a table.

    Parameters
    ----------
    rows : iterable of sequence
        Cells: `Quantity`, numbers, text, or other blocks.
    words : bool
        Align all columns to the left and let text wrap.
    names : int
        Columns of names, aligned to the left.
    """
    shown = [[_cell(cell) for cell in row] for row in rows]
    return render("table", list(head), shown, words, names, len(shown) <= _FEW_ROWS, caption)


def _cell(cell: object) -> object:
    """Return what is shown of a cell: numbers to five digits, nothing for what is unknown."""
    value = cell.item() if isinstance(cell, np.generic) else cell
    if isinstance(value, float):
        return f"{value:.5g}" if np.isfinite(value) else ""
    return "" if value is None else value


def matrix(
    names: Sequence[str],
    values_si: ArrayLike,
    sd_si: ArrayLike | None = None,
    units: Sequence[Sequence[ShownUnit]] | None = None,
    caption: str = "",
    *,
    title: str = "",
    interval_95_si: ArrayLike | None = None,
) -> Markup:
    """Return a square matrix with ± and 95 % intervals.

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
    cells = [
        [
            _entry(
                Quantity(
                    float(values[i, j]),
                    None if np.isnan(sds[i, j]) else float(sds[i, j]),
                    PLAIN if units is None else units[i][j],
                    None if limits is None else (float(limits[i, j, 0]), float(limits[i, j, 1])),
                ),
                i == j,
                len(names),
            )
            for j in places
        ]
        for i in places
    ]
    return render("matrix", title, list(names), cells, caption)


def _entry(entry: Quantity, diagonal: bool, size: int) -> dict[str, str]:
    """Return what a cell of a matrix shows."""
    shown = entry.unit.of(entry.value) + 0.0
    if shown == 0.0 and not entry.sd:
        return {"value": "0", "rest": "", "interval": "", "kind": "open"}
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


def figure(drawing: Figure, caption: str, alt: str, *, file: str = "figure") -> Markup:
    """Embed a matplotlib figure with a button that saves it.

    Parameters
    ----------
    alt : str
        What it shows, for who cannot see it.
    file : str
        Name of the saved file without ending.
    """
    from markupsafe import Markup

    return render("figure", Markup(draw(drawing)), caption, alt, file)


def notices(found: Iterable[Notice], confirmed: Sequence[str] = ()) -> Markup:
    """Return every warning in the colour of its verdict, or one line that says that there is none.

    Those whose code the user has confirmed are said to be checked, and are no more than information.
    """
    listed = [
        {
            "code": notice.code,
            "text": notice.text,
            "css": "information" if notice.code in confirmed else _colour_of(notice.code),
            "confirmed": notice.code in confirmed,
        }
        for notice in found
    ]
    return render("notices", listed)


def _colour_of(code: str) -> str:
    known = warning_table()
    return _css(known[code].verdict) if code in known else ""


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
    return render("verdict", level, _css(level), sentence, listed)


def cards(*groups: tuple[str, Sequence[Sequence[object]]]) -> Markup:
    """Return the summary: groups of a title and rows of name and text or `Quantity`."""
    return render("cards", groups)


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
    return render("viewer", scene.title, Markup(content), motions, scene.groups, scene.caption)


def _css(level: str) -> str:
    return level.replace(" ", "-")
