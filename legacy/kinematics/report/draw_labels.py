"""Names of points in a picture, put where they hide least."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.stapeskit.arrays import Array
from legacy.stapeskit.page.drawings import FAULT, colour, distinct_short_names, plain
from legacy.stapeskit.page.shaded_surface import View

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from legacy.kinematics.measurement import BodyChannels

# More labels cover the picture; and offsets of a label that are tried, points.
_MOST_LABELS = 48
_OFFSETS = (
    (5, 4),
    (-5, 4),
    (5, -4),
    (-5, -4),
    (0, 7),
    (0, -7),
    (9, 0),
    (-9, 0),
    (12, 9),
    (-12, 9),
    (12, -9),
    (-12, -9),
)


def written(
    view: Axes, words: str, across: float, up: float, tint: str, size: float, ha: str, va: str, **more: Any
) -> None:
    """Write words with a white edge, so that they can be read on any ground."""
    from matplotlib.patheffects import withStroke

    view.annotate(
        plain(words), (across, up), color=tint, fontsize=size, ha=ha, va=va, zorder=7,
        path_effects=[withStroke(linewidth=2.0, foreground="white")], **more,
    )  # fmt: skip


def label_points(
    view: Axes,
    sight: View,
    bodies: tuple[BodyChannels, ...],
    bad: set[tuple[str, str, tuple[float, ...]]],
    taken: list[tuple[float, float]],
) -> None:
    """Write the names of points where they hide least; of many points only those with a verdict."""
    total = sum(len(set(body.points)) for body in bodies)
    wrong = {(body, point) for body, point, _ in bad}
    (left, right), (bottom, top) = view.get_xlim(), view.get_ylim()
    # picture coordinates per point of type: axes are about 3.4 inches wide
    scale = (right - left) / (72.0 * 3.4)
    used = list(taken)
    for number, body in enumerate(bodies):
        short = distinct_short_names(body.points)
        for name in dict.fromkeys(body.points):
            if total > _MOST_LABELS and (body.body, name) not in wrong:
                continue
            words = short[name]
            at = sight.flat(body.positions_mm[body.points.index(name)])
            best = max(
                _OFFSETS, key=lambda off: _room(off, words, at, used, scale, (left, right, bottom, top))
            )
            spot = _middle(best, words, at, scale)
            used += [(spot[0] + k * 2.6 * scale * len(words) / 2.0, spot[1]) for k in (-1, 0, 1)]
            tint = FAULT if (body.body, name) in wrong else colour(number)
            ha = "left" if best[0] > 0 else "right" if best[0] < 0 else "center"
            va = "bottom" if best[1] > 0 else "top" if best[1] < 0 else "center"
            written(
                view, words, float(at[0]), float(at[1]), tint, 7.5, ha, va, xytext=best,
                textcoords="offset points", fontweight="bold" if tint == FAULT else "normal",
            )  # fmt: skip


def _middle(offset: tuple[int, int], words: str, at: Array, scale: float) -> tuple[float, float]:
    """Return where the centre of a label would be."""
    width, height = 4.6 * len(words), 7.5
    across = offset[0] + np.sign(offset[0]) * width / 2.0
    return float(at[0] + across * scale), float(
        at[1] + (offset[1] + np.sign(offset[1]) * height / 2.0) * scale
    )


def _room(
    offset: tuple[int, int],
    words: str,
    at: Array,
    used: list[tuple[float, float]],
    scale: float,
    box: tuple[float, ...],
) -> float:
    """Return the distance of a label from the nearest thing, less its overhang over the picture's edge."""
    x, y = _middle(offset, words, at, scale)
    wide = 2.3 * len(words) * scale
    beyond = max(box[0] - (x - wide), x + wide - box[1], box[2] - y, y - box[3], 0.0)
    others = np.array(used) if used else np.empty((0, 2))
    gap = np.hypot(np.maximum(np.abs(others[:, 0] - x) - wide, 0.0), others[:, 1] - y)
    near = float(gap.min()) if len(gap) else 1e3
    return min(near, 9.0 * scale) - 0.05 * float(np.hypot(*offset)) * scale - 20.0 * beyond
