"""A few SVG elements for the drawings of the docs."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

INK, SOFT, BONE, EDGE, PLASTIC, STEEL = "#1d2733", "#52606d", "#e6d3ad", "#9b8458", "#c3d7e3", "#b4bcc6"
RED, GREEN, BLUE, BEAM = "#b3301c", "#1b7340", "#1f4fb0", "#d7263d"


class Drawing:
    """Elements in the order in which they cover each other."""

    def __init__(self, width: int, height: int, title: str) -> None:
        self.parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" '
            f'font-family="Helvetica, Arial, sans-serif" font-size="15"><title>{escape(title)}</title>'
            f'<rect width="{width}" height="{height}" rx="10" fill="#ffffff"/>'
        ]

    def path(self, d: str, fill: str = "none", stroke: str = INK, width: float = 1.5, more: str = "") -> None:
        """Add a path."""
        self.parts.append(f'<path d="{d}" fill="{fill}" stroke="{stroke}" stroke-width="{width}" {more}/>')

    def line(
        self, ends: Sequence[float], stroke: str = INK, width: float = 1.5, head: bool = False, more: str = ""
    ) -> None:
        """Add a line x0, y0, x1, y1, with an arrow head at its end where asked for."""
        x0, y0, x1, y1 = ends
        self.path(f"M{x0} {y0}L{x1} {y1}", "none", stroke, width, more)
        if head:
            length = ((x1 - x0) ** 2 + (y1 - y0) ** 2) ** 0.5
            along, across = (x1 - x0) / length, (y1 - y0) / length
            size = 3.5 + 2.0 * width
            left = (x1 - size * along - 0.5 * size * across, y1 - size * across + 0.5 * size * along)
            right = (x1 - size * along + 0.5 * size * across, y1 - size * across - 0.5 * size * along)
            tip = (x1 + 0.4 * size * along, y1 + 0.4 * size * across)
            points = " ".join(f"{x:.1f},{y:.1f}" for x, y in (tip, left, right))
            self.parts.append(f'<polygon points="{points}" fill="{stroke}"/>')

    def dot(self, x: float, y: float, fill: str, radius: float = 4.0) -> None:
        """Add a filled circle."""
        self.parts.append(
            f'<circle cx="{x}" cy="{y}" r="{radius}" fill="{fill}" stroke="#fff" stroke-width="1"/>'
        )

    def text(
        self, x: float, y: float, lines: str, fill: str = INK, anchor: str = "start", bold: bool = False
    ) -> None:
        """Add text, one line a row."""
        weight = ' font-weight="bold"' if bold else ""
        for row, words in enumerate(lines.splitlines()):
            self.parts.append(
                f'<text x="{x}" y="{y + 19 * row}" fill="{fill}" text-anchor="{anchor}"{weight}>'
                f"{escape(words)}</text>"
            )

    def svg(self) -> str:
        """Return the file."""
        return "\n".join([*self.parts, "</svg>"]) + "\n"


def stapes(drawing: Drawing, x: float, y: float, size: float) -> None:
    """Draw a stapes seen from the front: the footplate centred at x, y, the head above it."""

    def at(*places: tuple[float, float]) -> str:
        return " ".join(f"{x + size * a:.1f} {y - size * b:.1f}" for a, b in places)

    outer = (
        f"M{at((-1.35, -0.02))} C{at((-1.45, 0.3), (-1.35, 0.32), (-1.28, 0.5))} "
        f"C{at((-1.3, 1.4), (-1.0, 2.1), (-0.45, 2.55))} C{at((-0.62, 2.8), (-0.6, 3.3), (-0.05, 3.3))} "
        f"C{at((0.55, 3.3), (0.55, 2.8), (0.4, 2.55))} C{at((1.0, 2.0), (1.25, 1.3), (1.25, 0.5))} "
        f"C{at((1.35, 0.32), (1.45, 0.3), (1.35, -0.02))} "
        f"C{at((0.6, -0.14), (-0.6, -0.14), (-1.35, -0.02))} Z "
        f"M{at((-0.95, 0.42))} C{at((-1.0, 1.2), (-0.8, 1.9), (-0.2, 2.25))} "
        f"C{at((-0.05, 2.32), (0.1, 2.32), (0.2, 2.25))} C{at((0.75, 1.8), (0.92, 1.2), (0.92, 0.42))} "
        f"C{at((0.5, 0.22), (-0.5, 0.22), (-0.95, 0.42))} Z"
    )
    drawing.path(outer, BONE, EDGE, 2, 'fill-rule="evenodd"')
