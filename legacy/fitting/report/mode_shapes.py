"""Mode shapes over the footplate: piston and rocking at two phases, with the nodal line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from legacy.fitting.model.annular_ligament import ellipse_mm
from legacy.fitting.model.model import Modes
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.page.page import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Length and width of a usual footplate, mm: an ellipse to draw on where there is no outline.
_USUAL_MM = (2.7, 1.24)
_INK = "#1d2733"


def shape_figure(mode_list: Modes, outline_mm: Array | None = None) -> Figure:
    """Draw y of the footplate in every mode: where it is largest, and a quarter of a period later.

    Parameters
    ----------
    mode_list : Modes
        In y, alpha, gamma.
    outline_mm : ndarray, (points, 2 or 3), optional
        Of the footplate in footplate axes, x and z (or x, y, z), mm; else an ellipse.

    Notes
    -----
    y(x, z) = Re[(y - z alpha + x gamma) e^(i phase)]. Where a mode is complex the nodal line moves.
    """
    from matplotlib.path import Path

    rim = ellipse_mm(*_USUAL_MM) if outline_mm is None else np.asarray(outline_mm, dtype=float)[:, [0, -1]]
    low, high = rim.min(axis=0), rim.max(axis=0)
    x, z = np.meshgrid(*(np.linspace(start, end, 121) for start, end in zip(low, high, strict=True)))
    inside = Path(rim).contains_points(np.column_stack([x.ravel(), z.ravel()])).reshape(x.shape)
    figure = new_figure(10.8, 4.0)
    axes = figure.subplots(2, len(mode_list.pairs), squeeze=False, sharex=True, sharey=True)
    for place, mode in enumerate(mode_list.pairs):
        y, alpha, gamma = mode.shape
        motion = np.where(inside, y - z * 1e-3 * alpha + x * 1e-3 * gamma, np.nan)
        phases = np.exp(1j * np.linspace(0.0, np.pi, 181))
        motion = motion * phases[int(np.argmax([np.nanmax(np.abs((motion * turn).real)) for turn in phases]))]
        size = float(np.nanmax(np.abs(motion.real)))
        for axis, shown in zip(axes[:, place], (motion.real, -motion.imag), strict=True):
            drawn = axis.pcolormesh(x, z, shown / size, cmap="RdBu_r", vmin=-1.0, vmax=1.0, rasterized=True)
            if np.nanmin(shown) < 0.0 < np.nanmax(shown):
                axis.contour(x, z, shown, levels=[0.0], colors=_INK, linewidths=1.2)
            _frame(axis, rim)
        axes[0, place].set_title(f"mode {place + 1}, {mode.frequency_hz:.0f} Hz", fontsize=10)
        axes[1, place].set_xlabel("x (mm)")
    axes[0, 0].invert_yaxis()
    for axis, words in zip(axes[:, 0], ("z (mm)", "90° later, z (mm)"), strict=True):
        axis.set_ylabel(words)
    figure.colorbar(drawn, ax=list(axes.ravel()), shrink=0.8, label="y, scaled")
    return figure


def _frame(axis: Axes, rim: Array) -> None:
    """Draw the outline in equal axes."""
    closed = np.vstack([rim, rim[:1]])
    axis.plot(closed[:, 0], closed[:, 1], color=_INK, lw=0.7)
    axis.set_aspect("equal")
    axis.tick_params(labelsize=8)
