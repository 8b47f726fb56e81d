"""The layout of a figure, made once and from one measurement of labels and ticks around its axes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.transforms import BboxBase


def lay_out(drawing: Figure) -> None:
    """Place the axes of a figure as its layout engine does, then remove the engine.

    With the engine, matplotlib would draw all of the figure twice to save it. The engine itself measures
    labels and ticks a second time when it has placed the axes; that is done only where other ticks may have
    made them wider.
    """
    engine = drawing.get_layout_engine()
    if engine is None:
        return
    for axes in drawing.axes:
        vars(axes)["get_tightbbox"] = _MeasuredOnce(axes)
    engine.execute(drawing)
    for axes in drawing.axes:
        del vars(axes)["get_tightbbox"]
    drawing.set_layout_engine(None)


class _MeasuredOnce:
    """The box around axes with their labels and ticks, pixels: it moves with the axes.

    It is measured again where other ticks may have made it wider: those along x, whose last label
    reaches beyond the axes, or longer labels along y.
    """

    def __init__(self, axes: Axes) -> None:
        self._axes, self._measure = axes, axes.get_tightbbox
        self._beyond: NDArray[np.float64] | None = None
        self._ticks, self._longest = np.zeros(0), 0
        for spine in axes.spines.values():
            spine.set_in_layout(False)  # lines and ticks, for which the space between axes is wide enough

    def __call__(self, *arguments: Any, **options: Any) -> BboxBase | None:
        """Return what ``get_tightbbox`` of the axes does."""
        from matplotlib.transforms import Bbox

        axes = self._axes
        axes.apply_aspect()
        ticks, longest = np.asarray(axes.xaxis.get_majorticklocs()), _longest_label(axes.yaxis)
        if self._beyond is None or longest > self._longest or not np.array_equal(ticks, self._ticks):
            box = self._measure(*arguments, **options)
            if box is None:
                return None
            self._beyond = np.subtract(box.extents, axes.bbox.extents)
            self._ticks, self._longest = ticks, longest
        return Bbox.from_extents(*np.add(axes.bbox.extents, self._beyond))


def _longest_label(axis: Axis) -> int:
    """Return the letters of the longest label at the ticks of an axis."""
    labels = [
        *axis.get_major_formatter().format_ticks(list(axis.get_majorticklocs())),
        *axis.get_minor_formatter().format_ticks(list(axis.get_minorticklocs())),
    ]
    return max(map(len, labels), default=0)
