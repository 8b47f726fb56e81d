"""What is known of the parameters of a joint fit before the data are seen: a normal distribution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legacy.fitting.calibrated import calibrated
from legacy.stapeskit.arrays import Array

# In metres; the prior is stated in mm.
MILLIMETRE = 1e-3


@dataclass(frozen=True)
class Prior:
    """A normal distribution of parameters, flat along those that nothing is known of.

    Attributes
    ----------
    mean : ndarray, (p,)
    root : ndarray, (r, p)
        R, where R^T R is the inverse covariance: zero columns are parameters without a prior.
    """

    mean: Array
    root: Array

    @classmethod
    def independent(cls, mean: Array, precision_root: Array) -> Prior:
        """Return the prior of independent parameters with 1 / sd (p,), 0 for none."""
        return cls(np.asarray(mean), np.diag(precision_root))

    @property
    def free(self) -> int:
        """Number of parameters without a prior."""
        return int(np.sum(~np.any(self.root, axis=0)))

    def extended(self, precision_root: Array) -> Prior:
        """Return the prior with further independent parameters of mean 0 and 1 / sd ``precision_root``."""
        size, more = self.root.shape, len(precision_root)
        root = np.zeros((size[0] + more, size[1] + more))
        root[: size[0], : size[1]] = self.root
        root[size[0] :, size[1] :] = np.diag(precision_root)
        return Prior(np.concatenate([self.mean, np.zeros(more)]), root)

    def draw(self, around: Array, rng: np.random.Generator) -> Prior:
        """Return the prior with its mean drawn around ``around`` (p,) where it knows a parameter."""
        known = np.any(self.root, axis=0)
        covariance = np.linalg.inv(self.root[:, known].T @ self.root[:, known])
        mean = self.mean.copy()
        mean[known] = around[known] + np.linalg.cholesky(covariance) @ rng.standard_normal(int(known.sum()))
        return Prior(mean, self.root)


def coupling_prior() -> tuple[Array, Array]:
    """Return mean (3, 3) and covariance (9, 9) of Y before the data are seen, SI.

    Notes
    -----
    Rows y, alpha, gamma, columns x, z, beta. A ring at the height h has Y[alpha, z] = h = -Y[gamma, x]; both
    heights of uneven rings differ little, so that they are correlated (benchmarks/ligament_prior.py).
    """
    height, spread = calibrated("ligament.height_mm"), calibrated("ligament.height_sd_mm")
    apart = calibrated("ligament.height_difference_sd_mm")
    tilt, turned = calibrated("ligament.tilt_sd"), calibrated("ligament.torsion_sd")
    second = calibrated("ligament.second_order_sd")
    mean = np.array([[0.0, 0.0, 0.0], [0.0, height, 0.0], [-height, 0.0, 0.0]])
    sd = np.array([[tilt, tilt, second], [second, spread, turned], [spread, second, turned]])
    covariance = np.diag(sd.ravel() ** 2)
    places = [4, 6]
    covariance[places, places] = spread**2 + 0.25 * apart**2
    covariance[4, 6] = covariance[6, 4] = -(spread**2 - 0.25 * apart**2)
    unit = np.array([[1.0, 1.0, 1.0 / MILLIMETRE], *[[MILLIMETRE, MILLIMETRE, 1.0]] * 2])
    return mean * unit, covariance * np.outer(unit.ravel(), unit.ravel())
