"""Where along the rim of the footplate the ligament is stiffest, from K alone.

Springs normal to the footplate along its rim, k(s) per length, have K11 = sum k, K12 = -sum k z, K13 = sum
k x. These three moments determine a stiffness that varies linearly over the footplate, k proportional to 1
+ g . (p - c) with c the centroid of the rim: g = S^-1 (p_k - c), where p_k = (K13, -K12) / K11 is the
centre of stiffness and S the second moment of the rim about c. Sideways springs and second harmonics are
not seen by these entries and are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fitting.draws import root_of, standard_draws
from stapeskit.arrays import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fitting.result import KDFit

DOF = ("y", "alpha", "gamma")
_DRAWS = 500  # of K: the sd of a ratio within 3 % of itself
# Sectors of 45 degrees by their middle, from anterior over superior; each name covers half a sector to both
# sides.
_SECTORS = (
    "anterior", "anterior-superior", "superior", "posterior-superior",
    "posterior", "posterior-inferior", "inferior", "anterior-inferior",
)  # fmt: skip


@dataclass(frozen=True)
class RimStiffness:
    """Stiffness along the rim over its mean.

    Attributes
    ----------
    points_mm : ndarray, (n, 2)
        x and z of the rim in footplate axes.
    ratio, sd : ndarray, (n,)
        Stiffness over its mean along the rim, and its standard deviation.
    side : str
        ``left``, ``right`` or empty: names z.
    """

    points_mm: Array
    ratio: Array
    sd: Array
    side: str = ""

    @property
    def stiffest(self) -> int:
        """Place of the stiffest point."""
        return int(np.argmax(self.ratio))

    @property
    def is_even(self) -> bool:
        """Whether the data do not show that any place is stiffer than another (95 %)."""
        return bool(self.ratio[self.stiffest] - 1.0 < 1.96 * self.sd[self.stiffest])

    def name_of(self, place: int) -> str:
        """Return the anatomical name of a point of the rim; by axes where the side is not known."""
        x, z = self.points_mm[place] - self.points_mm.mean(axis=0)
        if not self.side:
            return f"{'anterior' if x > 0 else 'posterior'}, {'+z' if z > 0 else '-z'}"
        superior = z if self.side == "left" else -z
        return _SECTORS[round(np.degrees(np.arctan2(superior, x)) / 45.0) % 8]

    def sentence(self) -> str:
        """Return what the rim shows, with its uncertainty."""
        best = self.stiffest
        if self.is_even:
            return "Along the rim of the footplate no place is stiffer than another within the uncertainty."
        ratio = f"{self.ratio[best]:.2f} ± {self.sd[best]:.2f}"
        return f"Stiffest at the {self.name_of(best)} rim: {ratio} times the mean."


def rim_stiffness(fit: KDFit, side: str = "", seed: int = 1) -> RimStiffness | None:
    """Return the stiffness along the rim of the footplate; None without outline or with other --dof.

    Parameters
    ----------
    side : str
        ``left`` or ``right``: whether z is superior or inferior.
    """
    outline = fit.footplate_outline_mm
    if outline is None or fit.dof != DOF:
        return None
    points = np.asarray(outline, dtype=float)[:, [0, -1]]
    count = len(fit.values) // 2
    normal = standard_draws(_DRAWS, count, seed)
    drawn = fit.values[:count] + normal @ root_of(fit.covariance[:count, :count]).T
    ratios = np.array([linear_ratio(points, entries) for entries in drawn])
    return RimStiffness(points, linear_ratio(points, fit.values[:count]), ratios.std(axis=0), side)


def linear_ratio(points_mm: Array, entries_si: Array) -> Array:
    """Return the stiffness along a rim (n, 2) over its mean, (n,), from K11, K12, K13, ... in SI."""
    ahead = np.roll(points_mm, -1, axis=0) - points_mm
    behind = points_mm - np.roll(points_mm, 1, axis=0)
    length = 0.5 * (np.hypot(*ahead.T) + np.hypot(*behind.T))
    weight = length / length.sum()
    centroid = weight @ points_mm
    arms = points_mm - centroid
    second = np.einsum("n,ni,nj->ij", weight, arms, arms)
    centre = 1e3 * np.array([entries_si[2], -entries_si[1]]) / entries_si[0]
    return np.asarray(1.0 + arms @ np.linalg.solve(second, centre - centroid))


def rim_figure(rim: RimStiffness) -> Figure:
    """Draw the rim with its stiffness as colour and width, and the names of its sides."""
    from matplotlib import colormaps

    from stapeskit.report.figures import panels, style

    with style():
        drawing, grid = panels(1, 1, width=6.4, height=3.8)
        axes = grid.ravel()[0]
        closed = np.vstack([rim.points_mm, rim.points_mm[:1]])
        lowest, highest = float(rim.ratio.min()), float(rim.ratio.max())
        shade = (rim.ratio - lowest) / max(highest - lowest, 1e-9)
        colours = colormaps["viridis"](shade)
        for place in range(len(rim.points_mm)):
            pair = closed[place : place + 2]
            axes.plot(pair[:, 0], pair[:, 1], color=colours[place], lw=3.0 + 7.0 * shade[place])
        best = rim.points_mm[rim.stiffest]
        axes.annotate(f"{rim.ratio[rim.stiffest]:.2f}", best, ha="center", va="center", fontsize=9)
        low, high = rim.points_mm.min(axis=0), rim.points_mm.max(axis=0)
        middle = 0.5 * (low + high)
        up = {"left": ("superior", "inferior"), "right": ("inferior", "superior")}.get(rim.side, ("+z", "-z"))
        for text, x, z in (
            ("anterior", high[0] + 0.25, middle[1]),
            ("posterior", low[0] - 0.25, middle[1]),
            (up[0], middle[0], high[1] + 0.2),
            (up[1], middle[0], low[1] - 0.2),
        ):
            axes.text(x, z, text, ha="center", va="center", fontsize=9, color="#52606d")
        axes.set_aspect("equal")
        axes.set(xlabel="x (mm)", ylabel="z (mm)", xlim=(low[0] - 0.7, high[0] + 0.7))
        axes.set_ylim(low[1] - 0.45, high[1] + 0.45)
    return drawing
