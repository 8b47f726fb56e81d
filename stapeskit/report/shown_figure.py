"""A matplotlib figure that a notebook shows although pyplot was never imported."""

from __future__ import annotations

import io

from matplotlib.figure import Figure

_DOTS_PER_INCH = 110  # a figure of 10 inches fills the width of a notebook


class ShownFigure(Figure):
    """A figure without global state that displays itself.

    Notebooks learn to show a `Figure` when pyplot is imported; any object may show itself by ``_repr_png_``.
    """

    def _repr_png_(self) -> bytes:
        """Return the picture for a notebook."""
        stream = io.BytesIO()
        self.savefig(stream, format="png", dpi=_DOTS_PER_INCH)
        return stream.getvalue()
