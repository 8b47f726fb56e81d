"""One self-contained HTML page: headings, tables, matrices, figures, warnings; no network, no scripts needed.

Every text goes through Jinja2 with autoescape; figures are embedded as data. It prints on A4.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from stapeskit.page.numbers import printed
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from markupsafe import Markup
    from matplotlib.figure import Figure

_STYLE = """
:root { --ink: #1d2733; --soft: #5d6b7a; --line: #d9dfe6; --tint: #f4f6f9; --accent: #0b6e99; --warn: #8a5a00; }
* { box-sizing: border-box; }
body { font: 15px/1.5 system-ui, "DejaVu Sans", sans-serif; color: var(--ink); margin: 0 auto; max-width: 1120px;
       padding: 24px 28px 64px; background: #fff; }
h1 { font-size: 26px; margin: 0 0 4px; } h2 { font-size: 19px; margin: 36px 0 8px; padding-top: 10px;
       border-top: 1px solid var(--line); } h3 { font-size: 15px; margin: 18px 0 4px; }
p.lead { color: var(--soft); margin: 0 0 12px; } p { margin: 8px 0; max-width: 85ch; }
nav a { margin-right: 14px; color: var(--accent); text-decoration: none; font-size: 14px; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: 10px 0; font-size: 14px; font-variant-numeric: tabular-nums; }
th, td { padding: 4px 11px; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
th { background: var(--tint); font-weight: 600; } th:first-child, td:first-child { text-align: left; }
table.text td, table.text th { text-align: left; white-space: normal; vertical-align: top; overflow-wrap: break-word; }
table.two th:nth-child(2), table.two td:nth-child(2) { text-align: left; }
td small { color: var(--soft); }
figure { margin: 14px 0; } figure img { max-width: 100%; height: auto; display: block; }
figcaption { color: var(--soft); font-size: 13px; max-width: 95ch; margin-top: 4px; }
.notice { border-left: 4px solid #e0a526; background: #fdf7e8; padding: 6px 12px; margin: 6px 0; max-width: 100ch; }
.notice code { color: var(--warn); } .good { border-left-color: #2c8a57; background: #eef7f1; }
details > summary { cursor: pointer; color: var(--accent); margin: 10px 0; }
pre { background: var(--tint); padding: 10px; overflow-x: auto; font-size: 13px; }
@media (max-width: 600px) {
  body { padding: 16px 14px 48px; } th, td { padding: 3px 6px; white-space: normal; } table { font-size: 13px; }
  figure { overflow-x: auto; } figure img { max-width: max(100%, 640px); }
}
@page { size: A4; margin: 14mm 12mm; }
@media print {
  body { font-size: 10pt; max-width: none; padding: 0; } nav { display: none; } h1 { font-size: 17pt; }
  h2 { font-size: 13pt; margin-top: 14pt; break-after: avoid; } h3 { break-after: avoid; }
  figure, tr, .notice { break-inside: avoid; } thead { display: table-header-group; }
  figure img { max-height: 250mm; } .scroll { overflow: visible; } table { font-size: 8.5pt; max-width: 100%; }
  th, td { padding: 2px 5px; white-space: normal; } .notice { print-color-adjust: exact; }
}
"""

_TEMPLATE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{{ policy }}"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title><style>{{ style }}</style></head><body>
<h1>{{ title }}</h1>{% if lead %}<p class="lead">{{ lead }}</p>{% endif %}
{% if sections|length > 2 %}<nav>{% for s in sections %}<a href="#{{ s.key or 's%d' % loop.index }}">{{ s.heading }}</a>{% endfor %}</nav>{% endif %}
{% for s in sections %}<section id="{{ s.key or 's%d' % loop.index }}"><h2>{{ s.heading }}</h2>
{% for block in s.blocks %}{{ block }}
{% endfor %}</section>
{% endfor %}</body></html>
"""


# A page loads nothing from anywhere and sends nothing: styles, scripts and pictures are in it.
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"


def _render(template: str, **values: Any) -> Markup:
    from jinja2 import Environment
    from markupsafe import Markup

    return Markup(Environment(autoescape=True).from_string(template).render(**values))


@dataclass
class Section:
    """One heading with its blocks, each made by a function of this file.

    Attributes
    ----------
    heading : str
    blocks : list of Markup
    key : str
        Stable name, by which pages order and link sections; empty where nothing refers to it.
    """

    heading: str
    blocks: list[Markup] = field(default_factory=list)
    key: str = ""

    def add(self, *blocks: Markup) -> Section:
        """Append blocks and return the section."""
        self.blocks.extend(blocks)
        return self


@dataclass
class Page:
    """A page under construction: a title, a lead sentence, sections."""

    title: str
    lead: str = ""
    sections: list[Section] = field(default_factory=list)

    def section(self, heading: str, *blocks: Markup) -> Section:
        """Append a section."""
        made = Section(heading, list(blocks))
        self.sections.append(made)
        return made

    def html(self) -> str:
        """Return the whole page."""
        from markupsafe import Markup

        style = Markup(_STYLE)
        return str(
            _render(
                _TEMPLATE,
                title=self.title,
                lead=self.lead,
                sections=self.sections,
                style=style,
                policy=_POLICY,
            )
        )

    def write(self, path: Path) -> None:
        """Write the page as UTF-8."""
        Path(path).write_text(self.html(), encoding="utf-8")


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


def subheading(words: str) -> Markup:
    """Return a small heading within a section."""
    return _render("<h3>{{ t }}</h3>", t=words)


def table(
    header: Sequence[str], rows: Iterable[Sequence[object]], words: bool = False, named_by: int = 1
) -> Markup:
    """Return a table; ``words`` aligns text to the left and lets it wrap.

    Of a table of numbers the first ``named_by`` columns, 1 or 2, are names and stand to the left.
    """
    return _render(
        '<div class="scroll"><table{% if words %} class="text"{% elif two %} class="two"{% endif %}><thead><tr>{% for h in header %}'
        '<th scope="col">{{ h }}</th>{% endfor %}</tr></thead><tbody>{% for row in rows %}<tr>{% for cell in row %}'
        "<td>{{ cell }}</td>{% endfor %}</tr>{% endfor %}</tbody></table></div>",
        header=header,
        rows=[list(row) for row in rows],
        words=words,
        two=named_by == 2,
    )


def notices(found: Iterable[Notice]) -> Markup:
    """Return every warning as a block, or one line that says that there is none."""
    return _render(
        "{% for n in found %}<div class='notice'><code>{{ n.code }}</code> {{ n.text }}</div>{% else %}"
        "<div class='notice good'>No warnings.</div>{% endfor %}",
        found=[replace(one, text=printed(one.text)) for one in found],
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
    cells = [
        [
            {
                "value": f"{numbers[i, j]:.4g}",
                "sd": "" if sds is None or sds[i, j] == numbers[i, j] == 0.0 else f"± {sds[i, j]:.2g}",
                "unit": "" if units is None else units[i][j],
            }
            for j in range(len(names))
        ]
        for i in range(len(names))
    ]
    return _render(
        '<div class="scroll"><table><tr><th></th>{% for n in names %}<th>{{ n }}</th>{% endfor %}</tr>'
        "{% for row in cells %}<tr><th>{{ names[loop.index0] }}</th>{% for c in row %}<td>{{ c.value }}"
        "{% if c.unit %} <small>{{ c.unit }}</small>{% endif %}{% if c.sd %}<br><small>{{ c.sd }}</small>{% endif %}"
        "</td>{% endfor %}</tr>{% endfor %}</table></div><figcaption>{{ caption }}</figcaption>",
        names=list(names),
        cells=cells,
        caption=caption,
    )


def figure(
    drawing: Figure, caption: str, alt: str, dpi: int = 130, vector: bool = True, palette: bool = False
) -> Markup:
    """Embed a matplotlib figure and release it.

    Parameters
    ----------
    drawing : Figure
    caption, alt : str
    dpi : int
        Dots per inch of pixels.
    vector : bool
        SVG; PNG otherwise.
    palette : bool
        Keep 256 colours of a PNG, which makes coloured maps several times smaller.
    """
    stream = io.BytesIO()
    if vector:
        drawing.savefig(stream, format="svg", dpi=dpi)
        data, kind = _shortened(stream.getvalue()), "svg"
    else:
        drawing.savefig(stream, format="png", dpi=dpi)
        data, kind = _few_colours(stream.getvalue()) if palette else stream.getvalue(), "png"
    drawing.clear()
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


def _shortened(svg: bytes) -> bytes:
    """Round the coordinates of paths to hundredths of a point, which no eye and no printer tells apart."""
    path = re.compile(rb' d="[^"]*"')
    number = re.compile(rb"(\d+\.\d\d)\d+")
    return path.sub(lambda found: number.sub(rb"\1", found.group()), svg)


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
    """Return blocks that stand behind one line until the reader opens it."""
    return _render(
        "<details><summary>{{ s }}</summary>{% for b in blocks %}{{ b }}{% endfor %}</details>",
        s=summary,
        blocks=blocks,
    )


def inputs_table(provenance: dict[str, Any]) -> Markup:
    """Return the inputs of a result with size, date and hash."""
    rows = [
        (role, entry["file"], f"{entry['size_bytes']:,}", entry["modified"], entry["hash"])
        for role, entry in provenance.get("inputs", {}).items()
    ]
    return table(("role", "file", "bytes", "modified", "content hash"), rows, words=True)


def new_figure(width: float, height: float) -> Figure:
    """Return an empty matplotlib figure in inches that no global state knows of."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")
