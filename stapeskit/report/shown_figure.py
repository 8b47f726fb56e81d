"""A matplotlib figure that a notebook shows although pyplot was never imported."""

from __future__ import annotations

import io

from matplotlib.figure import Figure

_DOTS_PER_INCH = 110  # a figure of 10 inches fills the width of a notebook


class ShownFigure(Figure):
    """A figure without global state that displays itself.

    Notes
    -----
    Notebooks learn to show figures when pyplot is imported: its backend registers a formatter for the class
    `Figure`. A figure made without pyplot is therefore printed as ``<Figure size ...>``, unless its own
    ``_repr_png_`` is there, which every notebook asks for.
    """

    def _repr_png_(self) -> bytes:
        """Return the picture for a notebook."""
        stream = io.BytesIO()
        self.savefig(stream, format="png", dpi=_DOTS_PER_INCH)
        return stream.getvalue()
