"""Figures of a page as PDF: the paths and pictures of their SVG, drawn anew by matplotlib's PDF writer.

It reads what matplotlib writes as SVG: paths of absolute M, L, C, Q and z, ``use`` of such paths, pictures,
groups with ``transform``, and rectangles and paths that clip. Text is drawn as paths there.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.page.page import settle_style

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.path import Path
    from matplotlib.transforms import Transform

_LINK = "{http://www.w3.org/1999/xlink}href"
_STEP = re.compile(r"([MLCQz])([^MLCQz]*)")
_TURN = re.compile(r"(\w+)\(([^)]*)\)")
_POINTS_PER_INCH = 72.0  # of PDF and of matplotlib's SVG
# Dots per inch of a figure that is a picture, as pages draw them.
_PICTURE_DPI = 130.0
# Our figures have some thousand; elements that use one another in turn can be drawn without end.
_MOST_ELEMENTS = 200_000


def figure_pdf(kind: str, content: bytes) -> bytes:
    """Return a figure of a page as PDF.

    Parameters
    ----------
    kind : {"svg", "png"}
    """
    from matplotlib.figure import Figure

    settle_style()
    if kind == "svg":
        drawing = replayed(ElementTree.fromstring(content))
    else:
        pixels = _pixels(content)
        drawing = Figure(figsize=(pixels.shape[1] / _PICTURE_DPI, pixels.shape[0] / _PICTURE_DPI))
        drawing.figimage(pixels, resize=False)
        drawing.set_dpi(_PICTURE_DPI)
    stream = io.BytesIO()
    # A document holds no date: the same page gives the same bytes.
    drawing.savefig(stream, format="pdf", dpi=drawing.dpi, metadata={"CreationDate": None})
    return stream.getvalue()


def replayed(root: ElementTree.Element) -> Figure:
    """Return a figure that draws what an SVG of matplotlib holds."""
    from matplotlib.figure import Figure

    width, height = (float(number) for number in root.attrib["viewBox"].split()[2:])
    drawing = Figure(figsize=(width / _POINTS_PER_INCH, height / _POINTS_PER_INCH))
    drawing.add_artist(_Replay(root, height).artist)
    return drawing


def _pixels(png: bytes) -> NDArray[np.uint8]:
    """Return the pixels of a picture, (height, width, 4)."""
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(png)).convert("RGBA"))


class _Replay:
    """The elements of one SVG, drawn in their order.

    Attributes
    ----------
    artist : Artist
        What draws them on a figure.
    """

    def __init__(self, root: ElementTree.Element, height: float) -> None:
        from matplotlib.artist import Artist
        from matplotlib.transforms import Affine2D

        # SVG counts downwards, PDF upwards.
        self._page = Affine2D().scale(1.0, -1.0).translate(0.0, height)
        self._left = _MOST_ELEMENTS
        self._named = {element.get("id"): element for element in root.iter() if element.get("id")}
        replay = self._element

        class Drawn(Artist):
            def draw(self, renderer: Any) -> None:
                replay(renderer, root, Affine2D(), {}, None)

        self.artist = Drawn()

    def _element(
        self,
        renderer: Any,
        element: ElementTree.Element,
        outer: Transform,
        style: Mapping[str, str],
        clip: tuple[Path, Transform] | None,
    ) -> None:
        """Draw an element and its children with the transform, style and clip of its parent."""
        self._left -= 1
        if self._left < 0:
            raise ValueError(f"more than {_MOST_ELEMENTS} elements")
        tag = element.tag.rpartition("}")[2]
        if tag in ("defs", "metadata", "style", "clipPath"):
            return
        here = _transform(turns) + outer if (turns := element.get("transform")) else outer
        style = {**style, **_style(own)} if (own := element.get("style")) else style
        if name := element.get("clip-path"):
            clip = self._clip(name[5:-1], here)
        if tag == "use":
            target = self._named[(element.get(_LINK) or "")[1:]]
            if "x" in element.attrib or "y" in element.attrib:
                here = _transform(f"translate({element.get('x', '0')} {element.get('y', '0')})") + here
            self._element(renderer, target, here, style, clip)
        elif tag == "path" and element.get("d"):  # a blank has none
            self._path(renderer, element.get("d", ""), here, style, clip)
        elif tag == "image":
            self._image(renderer, element, here, clip)
        for part in element:
            self._element(renderer, part, here, style, clip)

    def _clip(self, name: str, here: Transform) -> tuple[Path, Transform]:
        from matplotlib.path import Path

        shape = self._named[name][0]
        if shape.get("d"):
            return _outline(shape.get("d", "")), here
        x, y, width, height = (float(shape.get(key, "0")) for key in ("x", "y", "width", "height"))
        return Path(np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])), here

    def _context(self, renderer: Any, clip: tuple[Path, Transform] | None) -> Any:
        from matplotlib.transforms import TransformedPath

        context = renderer.new_gc()
        if clip is not None:
            context.set_clip_path(TransformedPath(clip[0], clip[1] + self._page))
        return context

    def _path(
        self,
        renderer: Any,
        steps: str,
        here: Transform,
        style: Mapping[str, str],
        clip: tuple[Path, Transform] | None,
    ) -> None:
        from matplotlib.colors import to_rgba

        context, opacity = self._context(renderer, clip), float(style.get("opacity", "1"))
        fill, stroke = style.get("fill", "#000000"), style.get("stroke", "none")
        face = None if fill == "none" else to_rgba(fill, opacity * float(style.get("fill-opacity", "1")))
        if stroke == "none":
            context.set_linewidth(0.0)
        else:
            context.set_foreground(to_rgba(stroke, opacity * float(style.get("stroke-opacity", "1"))), True)
            context.set_linewidth(float(style.get("stroke-width", "1")))
        if face is not None and stroke == "none":
            context.set_foreground(face, True)
        context.set_capstyle({"square": "projecting"}.get(style.get("stroke-linecap", ""), "butt"))
        context.set_joinstyle(style.get("stroke-linejoin", "round"))
        if dashes := style.get("stroke-dasharray"):
            lengths = [float(length) for length in dashes.split(",")]
            context.set_dashes(float(style.get("stroke-dashoffset", "0")), lengths)
        renderer.draw_path(context, _outline(steps), here + self._page, face)

    def _image(
        self,
        renderer: Any,
        element: ElementTree.Element,
        here: Transform,
        clip: tuple[Path, Transform] | None,
    ) -> None:
        from matplotlib.transforms import Affine2D

        pixels = _pixels(base64.b64decode((element.get(_LINK) or "").partition(",")[2]))
        x, y, width, height = (float(element.get(key, "0")) for key in ("x", "y", "width", "height"))
        square = Affine2D().scale(1.0, -1.0).translate(0.0, 1.0).scale(width, height).translate(x, y)
        place = square + here + self._page
        renderer.draw_image(self._context(renderer, clip), 0.0, 0.0, pixels[::-1], place)


def _style(text: str) -> dict[str, str]:
    pairs = (part.partition(":") for part in text.split(";") if ":" in part)
    return {name.strip(): value.strip() for name, _, value in pairs}


def _transform(text: str) -> Transform:
    """Return the transform of an attribute: the last operation is applied first."""
    from matplotlib.transforms import Affine2D

    whole: Transform = Affine2D()
    for kind, listed in _TURN.findall(text):
        numbers = [float(number) for number in re.split(r"[\s,]+", listed.strip())]
        if kind == "translate":
            step = Affine2D().translate(numbers[0], numbers[1] if len(numbers) > 1 else 0.0)
        elif kind == "scale":
            step = Affine2D().scale(*numbers)
        elif kind == "rotate":
            step = Affine2D().rotate_deg(numbers[0])
        else:
            step = Affine2D.from_values(*numbers)
        whole = step + whole
    return whole


def _outline(steps: str) -> Path:
    """Return a path from the steps of its attribute ``d``."""
    from matplotlib.path import Path

    codes = {"M": Path.MOVETO, "L": Path.LINETO, "C": Path.CURVE4, "Q": Path.CURVE3, "z": Path.CLOSEPOLY}
    places: list[tuple[float, float]] = []
    kinds: list[int] = []
    for letter, listed in _STEP.findall(steps):
        numbers = [float(number) for number in listed.replace(",", " ").split()] or [0.0, 0.0]
        pairs = list(zip(numbers[::2], numbers[1::2], strict=True))
        places += pairs
        kinds += [int(codes[letter])] * len(pairs)
    return Path(np.array(places), kinds)
