"""The rim of the footplate: where along it the ligament is stiffest, and how K differs from an even ring.

A ligament of shear modulus G, thickness t (along y) and width g that is thin against the footplate resists
normal displacement of the rim by c = G t / g per length (simple shear), so that an even one has

    K = c R,   R = integral over the rim of r^T r ds,    r = (1, -z, x) for y, alpha, gamma.

Springs k(s) that vary linearly over the footplate, k proportional to 1 + g . (p - p_r) with p_r the centroid
of the rim, follow from K11, K12 and K13 alone: g = S^-1 (p_k - p_r), where p_k = (K13, -K12) / K11 is the
centre of stiffness and S the second moment of the rim about p_r. Sideways springs and second harmonics are
not seen by these entries and are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from fitting.draws import root_of, standard_draws
from fitting.model import principal_axes
from fitting.plane import PISTON_DOF
from stapeskit.arrays import Array

if TYPE_CHECKING:
    from fitting.result import KDFit

_DRAWS = 500  # of K: the sd of a ratio within 3 % of itself
# Simpson's rule along a straight piece of the rim: exact for r^T r.
_SIMPSON = ((0.0, 1.0 / 6.0), (0.5, 2.0 / 3.0), (1.0, 1.0 / 6.0))
# Sectors of 45 degrees by their middle, from anterior over superior; each name covers half a sector to both
# sides.
_SECTORS = (
    "anterior", "anterior-superior", "superior", "posterior-superior",
    "posterior", "posterior-inferior", "inferior", "anterior-inferior",
)  # fmt: skip


def even_ring(outline: ArrayLike) -> Array:
    """Return R (3, 3) in y, alpha, gamma of a rim (points, 2), x and z in order; R11 is its length."""
    first = np.asarray(outline, dtype=float)
    second = np.roll(first, -1, axis=0)
    length = np.linalg.norm(second - first, axis=1)
    total = np.zeros((3, 3))
    for share, weight in _SIMPSON:
        x, z = (first + share * (second - first)).T
        rows = np.column_stack([np.ones_like(x), -z, x])
        total += weight * (rows.T * length) @ rows
    return total


def linear_ratio(points_mm: Array, entries_si: Array) -> Array:
    """Return the stiffness along a rim (n, 2) over its mean, (..., n), from K11, K12, K13 (..., k) in SI."""
    ring = even_ring(points_mm)
    ring = ring / ring[0, 0]
    centroid = np.array([ring[0, 2], -ring[0, 1]])
    second = np.array([[ring[2, 2], -ring[1, 2]], [-ring[1, 2], ring[1, 1]]]) - np.outer(centroid, centroid)
    centre = 1e3 * np.stack([entries_si[..., 2], -entries_si[..., 1]], axis=-1) / entries_si[..., :1]
    return np.asarray(1.0 + (centre - centroid) @ np.linalg.solve(second, (points_mm - centroid).T))


@dataclass(frozen=True)
class Rim:
    """Stiffness along the rim over its mean."""

    points_mm: Array  # (n, 2): x and z of the rim in footplate axes
    ratio: Array  # (n,)
    sd: Array  # (n,)
    side: str = ""  # ``left``, ``right`` or empty: names z

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
        if self.is_even:
            return "Along the rim of the footplate no place is stiffer than another within the uncertainty."
        best = self.stiffest
        ratio = f"{self.ratio[best]:.2f} ± {self.sd[best]:.2f}"
        return f"Stiffest at the {self.name_of(best)} rim: {ratio} times the mean."


def rim_of(fit: KDFit) -> Rim | None:
    """Return the stiffness along the rim of the footplate; None without outline or with other --dof."""
    outline = fit.inertia.outline_mm
    if outline is None or fit.dof != PISTON_DOF:
        return None
    count = len(fit.values) // 2
    drawn = fit.values[:count] + standard_draws(_DRAWS, count, 1) @ root_of(fit.covariance[:count, :count]).T
    ratio, sd = linear_ratio(outline, fit.values), linear_ratio(outline, drawn).std(axis=0)
    return Rim(outline, ratio, sd, fit.inertia.side)


@dataclass(frozen=True)
class Ring:
    """What an even ring of the measured K11 and D11 would be, SI; pairs are values with their sd."""

    length_m: float  # of the rim
    shear_pa: tuple[float, float]  # c = K11 / length = G t / g: the shear modulus times thickness over width
    loss_factor: tuple[float, float]  # im / Re of the piston's dynamic stiffness in the middle of the band
    # measured stiffness over that of the ring about the principal axes near x and z
    rocking_ratio: tuple[float, float]


def ring_of(fit: KDFit) -> Ring | None:
    """Compare K with an even ring around the footplate; None without outline, K11 > 0, or y first."""
    outline = fit.inertia.outline_mm
    if outline is None or fit.dof != PISTON_DOF or not fit.stiffness[0, 0] > 0.0:
        return None
    freq = fit.found.data.freq_hz
    factor = complex(fit.law.factor(2.0 * np.pi * np.sqrt(freq.min() * freq.max())))
    places = [0, len(fit.values) // 2]
    elastic, lossy = fit.values[places]
    dynamic = elastic + factor * lossy
    loss = dynamic.imag / dynamic.real
    slopes = np.array([-loss, factor.imag - loss * factor.real]) / dynamic.real
    covariance = fit.covariance[np.ix_(places, places)]
    ring = even_ring(1e-3 * outline)
    length = float(ring[0, 0])
    ratio = (principal_axes(fit.stiffness) / principal_axes(elastic / length * ring))[4:]
    return Ring(
        length,
        (elastic / length, float(np.sqrt(covariance[0, 0])) / length),
        (float(loss), float(np.sqrt(slopes @ covariance @ slopes))),
        (float(ratio[0]), float(ratio[1])),
    )
