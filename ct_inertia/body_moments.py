"""Geometric moments of a body with their covariance by source, and its ten inertial parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError

VOLUME_PARAMETERS = ("V", "Vx", "Vy", "Vz", "Jxx", "Jyy", "Jzz", "Jxy", "Jyz", "Jxz")
"""The inertial parameters of a body of density 1 kg/m3, in the order of `stapeskit.records.mass_file`."""

_UPPER = (np.array([0, 1, 2, 0, 1, 0]), np.array([0, 1, 2, 1, 2, 2]))
"""Row and column of the six second moments xx, yy, zz, xy, yz, xz."""


@dataclass(frozen=True)
class Moments:
    """Geometric moments of a body in scan axes, with their covariance by source.

    Attributes
    ----------
    centroid_mm : ndarray, (3,)
        Scan coordinates.
    second_mm5 : ndarray, (3, 3)
        Integral of (r - c)(r - c)^T dV about the centroid.
    contributions : mapping of str to ndarray, (10, 10)
        Covariance of (V, cx, cy, cz, Sxx, Syy, Szz, Sxy, Syz, Sxz) in powers of mm, by independent source:
        noise, levels, psf, separation, border, slices, surroundings, coat, voids, grey_scale, misfit,
        voxels.

    Raises
    ------
    StapeskitError
        A volume that is not positive, or second moments that no body has.
    """

    volume_mm3: float
    centroid_mm: Array
    second_mm5: Array
    contributions: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.volume_mm3 > 0.0 or np.linalg.eigvalsh(self.second_mm5)[0] <= 0.0:
            raise StapeskitError.of(
                "the measured body",
                "one of positive volume and extent",
                f"{self.volume_mm3:.3g} mm3",
                next_step="Check its labels, and that grey values were read as they were written (signed or "
                "unsigned, order of bytes)",
            )

    @property
    def volume_m3(self) -> float:
        """Volume, m3."""
        return 1e-9 * self.volume_mm3

    @property
    def covariance(self) -> Array:
        """Sum of all contributions, (10, 10), in powers of mm."""
        return np.asarray(sum(self.contributions.values(), np.zeros((10, 10))))

    @property
    def volume_sd_mm3(self) -> float:
        """Standard deviation of the volume, mm3."""
        return float(np.sqrt(max(self.covariance[0, 0], 0.0)))

    @property
    def inertia_mm5(self) -> Array:
        """Inertia tensor about the centroid per unit density, (3, 3): trace(S) 1 - S."""
        return np.asarray(np.trace(self.second_mm5) * np.eye(3) - self.second_mm5)

    def sensitivity(self, points_mm: Array, sigma_mm: float = 0.0) -> Array:
        """Return d(V, c, S) per mm3 added at points (n, 3), as a blur of some width shows it, (n, 10)."""
        away = points_mm - self.centroid_mm
        square = away[:, _UPPER[0]] * away[:, _UPPER[1]]
        square[:, :3] -= sigma_mm**2
        return np.column_stack([np.ones(len(away)), away / self.volume_mm3, square])

    def with_lump(self, name: str, point_mm: Array, volume_mm3: float) -> Moments:
        """Return the moments with one more source: a volume that may be missing about a point (3,)."""
        step = volume_mm3 * self.sensitivity(point_mm[None])[0]
        return self.with_source(name, np.outer(step, step))

    def vector(self) -> Array:
        """Return (V, cx, cy, cz, Sxx, Syy, Szz, Sxy, Syz, Sxz), (10,), in powers of mm."""
        return np.array([self.volume_mm3, *self.centroid_mm, *self.second_mm5[_UPPER]])

    def with_source(self, name: str, covariance: Array) -> Moments:
        """Return the moments with one more independent source of uncertainty, (10, 10), added by its name."""
        known = self.contributions.get(name, 0.0)
        return replace(self, contributions={**self.contributions, name: known + covariance})

    def volume_parameters(self, about_mm: Array) -> tuple[Array, dict[str, Array]]:
        """Return the ten parameters at density 1 about a point (3,) in scan axes, SI, and their covariances.

        Returns
        -------
        values : ndarray, (10,)
            In the order of `VOLUME_PARAMETERS`: m3, m4, m5. Times a density they are inertial parameters.
        covariances : dict of str to ndarray, (10, 10)
            By source.

        Notes
        -----
        With r = c - p: first moments V r; inertia (trace(S) 1 - S) + V (|r|^2 1 - r r^T), the parallel axis
        theorem; Jxy = -Sxy - V rx ry.
        """
        x, y, z = (self.centroid_mm - about_mm) * 1e-3
        volume, second = 1e-9 * self.volume_mm3, 1e-15 * self.second_mm5
        moment_xx, moment_yy, moment_zz, moment_xy, moment_yz, moment_xz = second[_UPPER]
        values = np.array(
            [
                volume,
                *(volume * np.array([x, y, z])),
                moment_yy + moment_zz + volume * (y * y + z * z),
                moment_xx + moment_zz + volume * (x * x + z * z),
                moment_xx + moment_yy + volume * (x * x + y * y),
                -moment_xy - volume * x * y,
                -moment_yz - volume * y * z,
                -moment_xz - volume * x * z,
            ]
        )
        jacobian = np.zeros((10, 10))
        jacobian[:, 0] = [1, x, y, z, y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -y * z, -x * z]
        jacobian[1:4, 1:4] = volume * np.eye(3)
        jacobian[4:, 1:4] = volume * np.array(
            [[0, 2 * y, 2 * z], [2 * x, 0, 2 * z], [2 * x, 2 * y, 0], [-y, -x, 0], [0, -z, -y], [-z, 0, -x]]
        )
        jacobian[4:7, 4:7] = 1.0 - np.eye(3)
        jacobian[7:, 7:] = -np.eye(3)
        jacobian = jacobian * np.array([1e-9, *[1e-3] * 3, *[1e-15] * 6])
        return values, {name: jacobian @ part @ jacobian.T for name, part in self.contributions.items()}
