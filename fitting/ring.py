"""The ring test: K of a uniform annular ligament around a footplate's rim, compared with the measured K.

A ligament of shear modulus G, thickness t (along y) and width g (between the rims) that is thin against the
footplate resists normal displacement of the rim by c = G t / g per length (simple shear), so that

    K = c * integral over the rim of r^T r ds,    r = (1, -z, x) for y, alpha, gamma.

The three stiffnesses then have one ratio, whatever G is; how far measured ones are from it says how uneven
the ligament is around the rim, or that the model is wrong. Where width and thickness are known, G follows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fitting.axes import principal_axes
from stapeskit.arrays import Array

# Shear moduli of published models of the human annular ligament that give the measured piston stiffness.
PUBLISHED_SHEAR_PA = (5e3, 70e3)
# Simpson's rule along a straight piece of the rim: exact for r^T r.
_SIMPSON = ((0.0, 1.0 / 6.0), (0.5, 2.0 / 3.0), (1.0, 1.0 / 6.0))


@dataclass(frozen=True)
class Value:
    """A positive number and its standard deviation, NaN where that is not known."""

    value: float
    sd: float

    @property
    def relative(self) -> float:
        """Standard deviation over value."""
        return self.sd / self.value


@dataclass(frozen=True)
class RingTest:
    """A measured K compared with that of a uniform ring of the same piston stiffness.

    Attributes
    ----------
    shear_pa : Value
        c = K11 / rim length = G t / g: the shear modulus times thickness over width.
    measured, expected : ndarray, (6,)
        Of the measured K and of the ring; SI.
    loss_factor : Value
        Im / Re of the piston's dynamic stiffness in the middle of the band.
    gap_m : Value or None
        Width g of the ligament.
    """

    rim_length_m: float
    shear_pa: Value
    measured: Array
    expected: Array
    loss_factor: Value
    gap_m: Value | None = None

    @property
    def shear_times_thickness(self) -> Value | None:
        """G t = K11 g / (rim length + pi g), Pa m; None without the width.

        The middle of a strip of width g around a closed convex curve is longer by pi g (Steiner): with it the
        error is of second order in g over the radius.
        """
        if self.gap_m is None:
            return None
        middle = self.rim_length_m + np.pi * self.gap_m.value
        share = self.rim_length_m / middle
        width = Value(self.gap_m.value * share, self.gap_m.sd * share**2)
        return _product(self.shear_pa, width)

    @property
    def rocking_ratio(self) -> tuple[float, float]:
        """Measured over expected stiffness about the principal axes near x and z."""
        about_x, about_z = (self.measured / self.expected)[4:]
        return float(about_x), float(about_z)

    @property
    def thickness_over_width(self) -> tuple[float, float]:
        """t / g for the largest and the smallest published shear modulus."""
        low, high = PUBLISHED_SHEAR_PA
        return self.shear_pa.value / high, self.shear_pa.value / low


def _product(first: Value, second: Value) -> Value:
    """Return the product of two numbers whose errors are independent."""
    value = first.value * second.value
    return Value(value, value * float(np.hypot(first.relative, second.relative)))


def ring_stiffness(outline_m: ArrayLike) -> tuple[Array, float]:
    """Return K (3, 3) in y, alpha, gamma of a ring with c = 1 N/m2 about the origin, and its length (m).

    Parameters
    ----------
    outline_m : array_like, (points, 2)
        x and z of the rim in order; the last point is joined to the first.
    """
    first = np.asarray(outline_m, dtype=float)
    second = np.roll(first, -1, axis=0)
    length = np.linalg.norm(second - first, axis=1)
    total = np.zeros((3, 3))
    for share, weight in _SIMPSON:
        x, z = (first + share * (second - first)).T
        rows = np.column_stack([np.ones_like(x), -z, x])
        total += weight * (rows.T * length) @ rows
    return total, float(length.sum())


def ring_test(
    stiffness: ArrayLike,
    piston: ArrayLike,
    factor: complex,
    outline_mm: ArrayLike | None,
    covariance: ArrayLike | None = None,
) -> RingTest | None:
    """Compare a measured K with a uniform ring around the footplate; None without outline or K11 > 0.

    Parameters
    ----------
    stiffness : array_like, (3, 3)
        In y, alpha, gamma about the footplate centre; SI.
    piston : array_like, (2,)
        K11 and D11, SI.
    factor : complex
        s of the damping law in the middle of the band: the dynamic stiffness there is K11 + s D11.
    outline_mm : array_like, (points, 2 or 3), or None
        Outline of the footplate in footplate axes: x and z, or x, y and z.
    covariance : array_like, (2, 2), optional
        Of K11 and D11, SI.
    """
    k = np.asarray(stiffness, dtype=float)
    if outline_mm is None or k.shape != (3, 3) or not k[0, 0] > 0.0:
        return None
    ring, length = ring_stiffness(1e-3 * np.asarray(outline_mm, dtype=float)[:, [0, -1]])
    spread = np.full((2, 2), np.nan) if covariance is None else np.asarray(covariance, dtype=float)
    elastic, lossy = (float(value) for value in np.asarray(piston))
    dynamic = elastic + factor * lossy
    loss = dynamic.imag / dynamic.real
    slopes = np.array([-loss, factor.imag - loss * factor.real]) / dynamic.real
    return RingTest(
        length,
        Value(k[0, 0] / length, float(np.sqrt(spread[0, 0])) / length),
        principal_axes(k),
        principal_axes(k[0, 0] / length * ring),
        Value(float(loss), float(np.sqrt(slopes @ spread @ slopes))),
    )
