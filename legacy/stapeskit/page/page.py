"""One self-contained HTML page: headings, tables, matrices, figures, warnings; no network, no scripts needed.

Every text goes through Jinja2 with autoescape; figures are embedded as data. It prints on A4. A small script of
its own (parts/page.js) saves tables and figures; without scripts everything can still be read.
"""

from __future__ import annotations

import base64
import hashlib
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from legacy.stapeskit.page.foreign_markup import own_scripts
from legacy.stapeskit.page.layout import lay_out
from legacy.stapeskit.page.numbers import plus_minus, printed
from legacy.stapeskit.page.quantities import MASS, ShownUnit
from legacy.stapeskit.process import is_command
from legacy.stapeskit.warnings import Notice

if TYPE_CHECKING:
    from jinja2 import Template
    from markupsafe import Markup
    from matplotlib.figure import Figure

# A page loads nothing from anywhere and sends nothing: styles, scripts and pictures are in it. Of scripts only
# those of this program run, whatever the page contains.
_POLICY = (
    "default-src 'none'; base-uri 'none'; form-action 'none'; style-src 'unsafe-inline'; img-src data:; "
    "script-src {scripts}"
)

_PARTS = Path(__file__).with_name("parts")
# Tables of so few rows are not broken between two printed pages.
_FEW_ROWS = 14
# Numbers within words, which no line may break: 3.1e-09, 1734 ± 17 N/m, (1.38 ± 0.03)·10⁻³, 0.11 %
_UNIT = rf" (?:%|°|[µm]?m|Hz|{MASS.symbol}|N/m)(?!\w)"
_NUMBER = re.compile(
    r"(?<![\w.])(\([-+]?\d[\d.]* ± \d[\d.]*\)·10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+|[-+]?\d[\d.]*e[-+]\d+"
    rf"|[-+]?\d[\d.]* ± \d[\d.]*(?:{_UNIT})?|[-+]?\d[\d.]*{_UNIT})"
)


def _part(name: str) -> str:
    return (_PARTS / name).read_text(encoding="utf-8")


def _keep_on_one_line(cell: object) -> Markup:
    """Return the text of a cell whose numbers stay in one line."""
    from markupsafe import Markup, escape

    return Markup(_NUMBER.sub(r'<span class="n">\1</span>', str(escape(_print_cell(cell)))))


def _print_cell(cell: object) -> object:
    """Return a cell with the letters that a page has; marked-up cells and numbers as they are."""
    return printed(cell) if type(cell) is str else cell


@cache
def _policy() -> str:
    """Return what a browser may do with a page."""
    hashes = (hashlib.sha256(script.encode()).digest() for script in own_scripts())
    return _POLICY.format(
        scripts=" ".join(f"'sha256-{base64.b64encode(value).decode()}'" for value in hashes)
    )


@cache
def _compile(template: str) -> Template:
    """Return a template of this program, compiled once: a page of a study has a hundred blocks of ten kinds."""
    from jinja2 import Environment

    return Environment(autoescape=True).from_string(template)


def _render(template: str, **values: Any) -> Markup:
    from markupsafe import Markup

    return Markup(_compile(template).render(**values))


@dataclass
class Section:
    """One heading with its blocks, each made by a function of this file.

    Attributes
    ----------
    key : str
        Stable name, by which pages order and link sections; empty where nothing refers to it.
    group : str
        Part of the page that the section belongs to; pages with groups have a navigation at their side.
    """

    heading: str
    blocks: list[Markup] = field(default_factory=list)
    key: str = ""
    group: str = ""

    def add(self, *blocks: Markup) -> Section:
        """Append blocks and return the section."""
        self.blocks.extend(blocks)
        return self


@dataclass
class Page:
    """A page under construction: a title, a lead sentence, a summary, sections."""

    title: str
    lead: str = ""
    sections: list[Section] = field(default_factory=list)
    summary: list[Markup] = field(default_factory=list)

    def section(self, heading: str, *blocks: Markup) -> Section:
        """Append a section."""
        part = Section(heading, list(blocks))
        self.sections.append(part)
        return part

    def html(self) -> str:
        """Return the whole page."""
        from markupsafe import Markup

        listed = [(section.key or f"s{place + 1}", section) for place, section in enumerate(self.sections)]
        grouped = [(name, list(entries)) for name, entries in groupby(listed, lambda pair: pair[1].group)]
        return str(
            _render(
                _part("page.html"),
                title=self.title,
                lead=self.lead,
                sections=listed,
                groups=grouped if any(section.group for section in self.sections) else [],
                summary=self.summary,
                style=Markup(_part("page.css")),
                script=Markup(_part("page.js")),
                policy=_policy(),
            )
        )

    def write(self, path: Path) -> None:
        """Write the page as UTF-8."""
        # Names of files may hold bytes that are no UTF-8.
        Path(path).write_text(self.html(), encoding="utf-8", errors="replace")


def template(source: str, **values: Any) -> Markup:
    """Return a block made from a Jinja2 template; every value is escaped."""
    return _render(source, **values)


def with_script(block: Markup, style: str, data_id: str, data: str, code: str) -> Markup:
    """Return a block followed by its style, its data as JSON and the script that moves it.

    Parameters
    ----------
    block : Markup
        Usable, or hidden, where scripts do not run.
    style, code : str
        Text of this project: it is not escaped.
    data_id : str
        Id of the element that holds the data.
    data : str
        JSON; characters that could end the element are written as escapes of JSON.
    """
    from markupsafe import Markup

    safe = data.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
    return _render(
        '<style>{{ style }}</style>{{ block }}<script type="application/json" id="{{ id }}">{{ data }}</script>'
        "<script>{{ code }}</script>",
        style=Markup(style),
        block=block,
        id=data_id,
        data=Markup(safe),
        code=Markup(code),
    )


def text(sentence: str) -> Markup:
    """Return a paragraph."""
    return _render("<p>{{ t }}</p>", t=sentence)


def code(words: str) -> Markup:
    """Return a line to copy."""
    return _render("<pre>{{ t }}</pre>", t=words)


def subheading(words: str) -> Markup:
    """Return a small heading within a section."""
    return _render("<h3>{{ t }}</h3>", t=words)


def table(
    header: Sequence[str], rows: Iterable[Sequence[object]], words: bool = False, named_by: int = 1
) -> Markup:
    """Return a table; ``words`` aligns text to the left and lets it wrap.

    Of a table of numbers the first ``named_by`` columns, 1 or 2, are names, aligned to the left.
    """
    listed = list(rows)
    return _render(
        '<div class="scroll{% if few %} few{% endif %}"><table{% if words %} class="text"{% elif two %} class="two"{% endif %}><thead><tr>{% for h in header %}'
        '{% if h %}<th scope="col">{{ h }}</th>{% else %}<td></td>{% endif %}{% endfor %}</tr></thead><tbody>{% for row in rows %}<tr>{% for cell in row %}'
        "<td>{{ cell }}</td>{% endfor %}</tr>{% endfor %}</tbody></table></div>",
        header=[printed(name) for name in header],
        rows=[[_keep_on_one_line(cell) if words else _print_cell(cell) for cell in row] for row in listed],
        words=words,
        two=named_by == 2,
        few=len(listed) <= _FEW_ROWS,
    )


def notices(shown: Iterable[Notice]) -> Markup:
    """Return every warning as a block, or one line that says that there is none."""
    return _render(
        "{% for n in found %}<div class='notice'><code>{{ n.code }}</code> {{ n.text }}</div>{% else %}"
        "<div class='notice good'>No warnings.</div>{% endfor %}",
        found=[replace(notice, text=printed(notice.text)) for notice in shown],
    )


def matrix(
    values: ArrayLike,
    names: Sequence[str],
    caption: str,
    deviations: ArrayLike | None = None,
    units: Sequence[Sequence[str]] | None = None,
) -> Markup:
    """Return a square matrix with the names of its rows and columns, units and standard deviations.

    Parameters
    ----------
    values : array_like, (n, n)
    names : sequence of str, (n,)
        Degrees of freedom.
    caption : str
        What it is, about which point, in which axes, in which unit.
    deviations : array_like, (n, n), optional
        Standard deviations, printed under the values.
    units : nested sequence of str, (n, n), optional
        Unit of each entry.
    """
    numbers = np.asarray(values, dtype=float)
    sds = None if deviations is None else np.asarray(deviations, dtype=float)
    cells = []
    for i, row in enumerate(numbers):
        shown = [_value_and_sd(value, None if sds is None else sds[i, j]) for j, value in enumerate(row)]
        marks = [""] * len(names) if units is None else units[i]
        cells.append(
            [{"value": value, "sd": sd, "unit": unit} for (value, sd), unit in zip(shown, marks, strict=True)]
        )
    return _render(
        '<figure class="matrix"><div class="scroll"><table><tr><td></td>{% for n in names %}<th scope="col">{{ n }}</th>{% endfor %}</tr>'
        '{% for row in cells %}<tr><th scope="row">{{ names[loop.index0] }}</th>{% for c in row %}<td>{{ c.value }}'
        "{% if c.unit %} <small>{{ c.unit }}</small>{% endif %}{% if c.sd %}<br><small>{{ c.sd }}</small>{% endif %}"
        "</td>{% endfor %}</tr>{% endfor %}</table></div><figcaption>{{ caption }}</figcaption></figure>",
        names=list(names),
        cells=cells,
        caption=caption,
    )


def _value_and_sd(value: float, sd: float | None) -> tuple[str, str]:
    """Return a number to the digits of its standard deviation, and that with ±; four digits without one."""
    if sd is None or sd == value == 0.0:
        return f"{value:.4g}", ""
    shown, _, spread = plus_minus(value, sd).partition(" ± ")
    return (shown, f"± {spread}") if "(" not in shown else (f"{value:.4g}", f"± {sd:.2g}")


def quantity_matrix(
    values_si: ArrayLike,
    units: Sequence[Sequence[ShownUnit]],
    names: Sequence[str],
    caption: str,
    deviations_si: ArrayLike | None = None,
) -> Markup:
    """Return a square matrix in SI units, shown in units for people; see ``matrix``."""
    per_si = np.array([[unit.per_si for unit in row] for row in units])
    sds = None if deviations_si is None else np.asarray(deviations_si, dtype=float) * per_si
    # A zero has no sign.
    shown = np.asarray(values_si, dtype=float) * per_si + 0.0
    return matrix(shown, names, caption, sds, [[unit.symbol for unit in row] for row in units])


def figure(
    drawing: Figure, caption: str, alt: str, dpi: int = 130, vector: bool = True, palette: bool = False
) -> Markup:
    """Embed a matplotlib figure.

    Parameters
    ----------
    dpi : int
        Dots per inch of pixels.
    vector : bool
        SVG; PNG otherwise.
    palette : bool
        Keep 256 colours of a PNG, which makes coloured maps several times smaller.
    """
    lay_out(drawing)
    stream = io.BytesIO()
    if vector:
        drawing.savefig(stream, format="svg", dpi=dpi)
        data, kind = _shorten(stream.getvalue()), "svg"
    else:
        drawing.savefig(stream, format="png", dpi=dpi)
        data, kind = _few_colours(stream.getvalue()) if palette else stream.getvalue(), "png"
    return image(data, caption, alt, kind)


def _few_colours(png: bytes) -> bytes:
    """Return the same picture with the 256 colours that suit it best."""
    from PIL import Image

    stream = io.BytesIO()
    picture = Image.open(io.BytesIO(png)).convert("RGB")
    few = picture.quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    colours, corner = few.getpalette() or [], few.getpixel((0, 0))
    if isinstance(corner, int) and picture.getpixel((0, 0)) == (255, 255, 255):
        colours[3 * corner : 3 * corner + 3] = [255, 255, 255]
        few.putpalette(colours)
    few.save(stream, format="png")
    return stream.getvalue()


def _shorten(svg: bytes) -> bytes:
    """Round the coordinates of paths to hundredths of a point, finer than any screen or printer shows."""
    path = re.compile(rb' d="[^"]*"')
    number = re.compile(rb"(\d+\.\d\d)\d+")
    return path.sub(lambda match: number.sub(rb"\1", match.group()), svg)


def image(data: bytes, caption: str, alt: str, kind: str = "png") -> Markup:
    """Embed picture bytes (``png`` or ``svg``) with a caption."""
    mime = "image/svg+xml" if kind == "svg" else f"image/{kind}"
    source = f"data:{mime};base64,{base64.b64encode(data).decode()}"
    return _render(
        '<figure><img src="{{ source }}" alt="{{ alt }}"><figcaption>{{ caption }}</figcaption></figure>',
        source=source,
        caption=caption,
        alt=alt,
    )


def folded(summary: str, *blocks: Markup) -> Markup:
    """Return blocks hidden below one line until the reader opens it."""
    return _render(
        "<details><summary>{{ s }}</summary>{% for b in blocks %}{{ b }}{% endfor %}</details>",
        s=summary,
        blocks=blocks,
    )


def inputs_table(provenance: dict[str, Any]) -> Markup:
    """Return the inputs of a result with size, date and hash."""
    rows = [
        (role, entry["file"], f"{entry['size_bytes']:,}", _date(entry["modified"]), entry["hash"])
        for role, entry in provenance.get("inputs", {}).items()
    ]
    return table(("role", "file", "bytes", "modified", "content hash"), rows, words=True)


def _date(moment: str) -> str:
    """Return a date of ISO 8601 as people write it: to the minute."""
    return re.sub(r"^(\d{4}-\d\d-\d\d)T(\d\d:\d\d):\d\d(\.\d+)?\+00:00$", r"\1 \2 UTC", moment)


def new_figure(width: float, height: float) -> Figure:
    """Return an empty matplotlib figure in inches that no global state knows of."""
    from matplotlib.figure import Figure

    settle_style()
    return Figure(figsize=(width, height), layout="constrained")


@cache
def settle_style() -> None:
    """Draw by the settings that matplotlib comes with, where this is the process of a command.

    A file matplotlibrc in the working folder, which matplotlib reads, could have LaTeX run what it says.
    """
    if is_command():
        import matplotlib

        matplotlib.rcdefaults()
