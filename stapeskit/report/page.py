"""Put together one self-contained HTML page of blocks: text, tables, matrices, figures, warnings, verdicts.

A `Page` has a title, a first screen, sections and a folded appendix; it loads nothing, needs no network, and
can be read without its scripts. Each block is made by the macro of the same name in ``page.html.j2``; every
text is escaped.

>>> from stapeskit.report import page
>>> shown = page.Page("An ear").add(page.verdict("believe", "no warning speaks against it"))
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
from functools import cache, partial
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from stapeskit.report.colours import PAGE_COLOURS
from stapeskit.report.figures import draw
from stapeskit.report.quantities import PLAIN, Quantity, ShownUnit, plus_minus
from stapeskit.warnings import Notice, is_among
from stapeskit.warnings import table as warning_table

if TYPE_CHECKING:
    from jinja2.environment import TemplateModule
    from markupsafe import Markup
    from matplotlib.figure import Figure

    from stapeskit.report.scene3d import Scene

_HERE = Path(__file__).parent
_FEW_ROWS = 14  # tables up to it are not broken between two printed pages
_MOST_WITH_INTERVALS = 3  # matrices up to this size show the interval of each entry
PLUS_MINUS = (
    "± is one standard deviation, the line below it the 95 % interval, by all known sources of error; grey "
    "where it holds zero."
)
"""What the numbers of `matrix` and `entries` are, for the place where the first of them stands."""


@dataclass
class Section:
    """A heading with its blocks; links refer to its id, and the reader opens it when it is folded."""

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

    A ``lead`` is a sentence below the title; ``first`` the first screen: verdict, summary, key matrices, a
    figure; ``sections`` follow, and the ``appendix``, which few readers open.
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
        key = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_") or "section"
        taken = {other.id for other in (*self.sections, *self.appendix)}
        own = next(one for one in chain([key], (f"{key}_{k}" for k in count(2))) if one not in taken)
        self.sections.append(Section(name, list(blocks), own, folded))
        return self.sections[-1]

    def appendix_section(self, name: str, *blocks: Markup) -> Section:
        """Append a folded section to the appendix and return it."""
        section = self.section(name, *blocks, folded=True)
        self.appendix.append(self.sections.pop())
        return section

    def html(self) -> str:
        """Return the whole page."""
        from markupsafe import Markup

        body = render("body", self.title, self.lead, self.first, self.sections, self.appendix)
        scripts = [render("script")]
        if "data-scene" in body:
            scripts.append(Markup((_HERE / "viewer.js").read_text(encoding="utf-8")))
        return str(render("page", self.title, body, PAGE_COLOURS, scripts))

    def write(self, path: Path) -> None:
        """Write the page as UTF-8; names of files may hold bytes that are none."""
        Path(path).write_text(self.html(), encoding="utf-8", errors="replace")


@cache
def _blocks() -> TemplateModule:
    """Return the macros of the template, compiled once."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    loader = FileSystemLoader(_HERE)
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    return environment.get_template("page.html.j2").module


def render(macro: str, *values: Any) -> Markup:
    """Render values by a macro of the template; every text is escaped."""
    block: Markup = getattr(_blocks(), macro)(*values)
    return block


text = partial(render, "text")
"""A paragraph."""
code = partial(render, "code")
"""Lines to copy."""
note = partial(render, "note")
"""A paragraph in small print: what the numbers below it mean."""
subheading = partial(render, "subheading")
"""A small heading within a section."""
beside = partial(render, "beside")
"""Blocks next to each other where the window is wide enough."""
folded = partial(render, "folded")
"""One line, and the blocks that it opens."""


def table(
    head: Sequence[str],
    rows: Iterable[Sequence[object]],
    caption: str = "",
    *,
    title: str = "",
    words: bool = False,
    names: int = 1,
) -> Markup:
    """Return a table of cells: `Quantity`, numbers, text, or other blocks.

    The first ``names`` columns are aligned to the left; with ``words`` all are, and their text wraps.
    """
    shown = [[_cell(cell) for cell in row] for row in rows]
    return render("table", title, list(head), shown, words, names, len(shown) <= _FEW_ROWS, caption)


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
) -> Markup:
    """Return a symmetric matrix with ± and, where it is small, 95 % intervals; grey where these hold zero.

    Parameters
    ----------
    values_si, sd_si : array_like, (n, n)
        Entries and standard deviations, SI; NaN or None where one is not known.
    units : nested sequence of ShownUnit, (n, n), optional
        Unit in which each entry is shown, of `quantities.matrix_units`.
    """
    size = len(names)
    values = np.asarray(values_si, dtype=float).tolist()
    sds = np.full((size, size), np.nan) if sd_si is None else np.asarray(sd_si, dtype=float)

    def entry(i: int, j: int) -> Quantity:
        sd = None if np.isnan(sds[i, j]) else float(sds[i, j])
        return Quantity(values[i][j], sd, PLAIN if units is None else units[i][j])

    small = size <= _MOST_WITH_INTERVALS
    cells = [[_entry(entry(i, j), small, signed=i != j) for j in range(size)] for i in range(size)]
    for i in range(size):
        cells[i][i]["kind"] = "diagonal"
        for j in range(i):
            cells[i][j] |= {"kind": f"below {cells[i][j]['kind']}", "rest": "", "interval": ""}
    return render("entries", title, names, names, cells, caption)


def entries(
    rows: Sequence[str], columns: Sequence[str], cells: Sequence[Sequence[Quantity]], *, title: str = ""
) -> Markup:
    """Return quantities (rows, columns), each with ± and its 95 % interval below it, as `matrix` has them."""
    return render("entries", title, rows, columns, [[_entry(cell) for cell in row] for row in cells], "")


def _entry(entry: Quantity, with_interval: bool = True, *, signed: bool = False) -> dict[str, str]:
    """Return number, the line with sd and unit below it, and interval; ``open`` where that holds zero.

    A value that has no sign and is below its standard deviation is undetermined.
    """
    unit, value, sd = entry.unit, entry.unit.of(entry.value) + 0.0, entry.sd
    if value == 0.0 and not sd:
        return {"value": "0", "rest": "", "interval": "", "kind": ""}
    if sd is None or not entry.known_sd or sd == 0.0:
        return {"value": f"{value:.4g}", "rest": unit.symbol, "interval": "", "kind": ""}
    text, _, spread = plus_minus(value, unit.of(sd)).partition(" ± ")
    if text.startswith("("):
        text, spread = f"{value:.4g}", f"{unit.of(sd):.2g}"
    low, high = entry.limits or (np.nan, np.nan)
    undetermined = not signed and sd > abs(entry.value)
    return {
        "value": "undetermined" if undetermined else text,
        "rest": f"{text} ± {spread} {unit.symbol}" if undetermined else f"± {spread} {unit.symbol}",
        "interval": entry.interval if with_interval else "",
        "kind": "open" if low <= 0.0 <= high else "",
    }


def figure(drawing: Figure, caption: str, alt: str, *, file: str = "figure", title: str = "") -> Markup:
    """Embed a matplotlib figure with a button that saves it.

    ``alt`` says what it shows, for who cannot see it; ``file`` is the name of the saved file without ending.
    """
    from markupsafe import Markup

    return render("figure", title, Markup(draw(drawing)), caption, alt, file)


def notices(found: Iterable[Notice], confirmed: Sequence[str] = ()) -> Markup:
    """Return every warning in the colour of its verdict, or one line that says that there is none.

    Those whose code the user has confirmed are said to be checked, and are no more than information.
    """
    known, listed = warning_table(), []
    for notice in found:
        checked = is_among(notice.code, confirmed)
        level = "information" if checked else known[notice.code].verdict if notice.code in known else ""
        listed.append({"code": notice.code, "text": notice.text, "css": _css(level), "confirmed": checked})
    return render("notices", listed)


def verdict(level: str, sentence: str, reasons: Iterable[Notice] = ()) -> Markup:
    """Return the verdict on a result, with its reasons by weight.

    Of each reason the first sentence is shown, and the rest when the reader opens it.
    """
    listed = []
    for reason in reasons:
        first, stop, rest = reason.text.partition(". ")
        listed.append({"code": reason.code, "first": first + stop.strip(), "rest": rest})
    return render("verdict", level, _css(level), sentence, listed)


def inputs(provenance: Mapping[str, Any]) -> Markup:
    """Return the inputs of a result with size, date and content hash."""
    rows = [
        (role, one["file"], f"{one['size_bytes']:,}", one["modified"][:16].replace("T", " "), one["hash"])
        for role, one in provenance.get("inputs", {}).items()
    ]
    return table(("role", "file", "bytes", "modified (UTC)", "content hash"), rows, words=True)


def viewer(scene: Scene) -> Markup:
    """Return the three-dimensional view of a scene."""
    from markupsafe import Markup

    motions = [motion.name for motion in scene.motions]
    return render("viewer", scene.title, Markup(scene.content()), motions, scene.groups, scene.caption)


def _css(level: str) -> str:
    return level.replace(" ", "-")
