"""Make the blocks of a page: text, tables, matrices, figures, warnings, verdicts, the three-dimensional view.

Each block is a piece of HTML made from the macro of the same name in ``page.html.j2``; every text is escaped.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

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

# Tables of so few rows are not broken between two printed pages.
_FEW_ROWS = 14
# Matrices up to this size show the interval of each entry; larger ones have it in their CSV file.
_MOST_WITH_INTERVALS = 3


@cache
def _blocks() -> TemplateModule:
    """Return the macros of the template, compiled once."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
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
    return render(
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
    return render("matrix", title, list(names), cells, caption, link, f"{file}.csv")


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
        return render("vector", Markup(data.decode()), caption, alt, file)
    return image(data, caption, alt, kind, file=file)


def image(data: bytes, caption: str, alt: str, kind: str = "png", *, file: str = "image") -> Markup:
    """Embed the bytes of a picture (``png``, ``jpeg``) with a caption."""
    return render("image", f"data:image/{kind};base64,{to_base64(data)}", caption, alt, file, kind)


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


def to_base64(data: bytes) -> str:
    """Return bytes as text."""
    return base64.b64encode(data).decode()
