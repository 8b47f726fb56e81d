"""Geometric moments of a body: volume, centroid and second moments, with covariance by source."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from legacy.ct_inertia.errors import CtInertiaError
from legacy.stapeskit.arrays import Array


@dataclass(frozen=True)
class Moments:
    """Moments of a body of uniform weight in scan axes.

    Attributes
    ----------
    volume_mm3 : float
    centroid_mm : ndarray, (3,)
        In scan coordinates.
    second_mm5 : ndarray, (3, 3)
        Integral of (r - c)(r - c)^T dV about the centroid.
    contributions : mapping of str to ndarray, (10, 10)
        Covariance of (V, cx, cy, cz, Sxx, Syy, Szz, Sxy, Syz, Sxz) in powers of mm, by independent source.

    Raises
    ------
    CtInertiaError
        A volume that is not positive, or second moments that no body has.
    """

    volume_mm3: float
    centroid_mm: Array
    second_mm5: Array
    contributions: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.volume_mm3 > 0.0:
            raise CtInertiaError.of(
                "the volume of the body",
                "positive",
                f"{self.volume_mm3:g} mm3",
                next_step="Check labels and grey values of the body",
            )
        if np.linalg.eigvalsh(self.second_mm5)[0] <= 0.0:
            raise CtInertiaError.of(
                "the second moments of the body",
                "positive definite",
                "others",
                next_step="Check labels and grey values of the body",
            )

    @property
    def inertia_mm5(self) -> Array:
        """Inertia tensor about the centroid per unit density, (3, 3): trace(S) 1 - S."""
        return np.trace(self.second_mm5) * np.eye(3) - self.second_mm5
