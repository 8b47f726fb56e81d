"""Logarithms of a predictor and a response over many ears, with the covariance of their errors."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array


@dataclass(frozen=True)
class LogPairs:
    """Natural logarithms of a predictor x and a response y of n ears.

    Attributes
    ----------
    x, y : ndarray, (n,)
    own : ndarray, (n, 2, 2)
        Covariance of the measurement errors of (x, y) that belong to each ear alone, with the covariance of x
        and y: without it the exponent is pulled towards their ratio.
    shared : ndarray, (n, 2, s), optional
        Effect of each of s independent errors of unit variance on (x, y) of every ear. An error that all
        ears have in common, with the same effect, changes no exponent; one of some ears only (a scanner)
        does.
    subject : ndarray of int, (n,), optional
        Which ears belong to one person; every ear is its own subject when left out.
    covariates : ndarray, (n, c), optional
        Further predictors of both x and y (age, sex, ...), as numbers.

    Raises
    ------
    ValueError
        Shapes differ, numbers are not finite, or a covariance is not positive semidefinite.
    """

    x: Array
    y: Array
    own: Array
    shared: Array = field(default_factory=lambda: np.zeros((0, 2, 0)))
    subject: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    covariates: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        n = len(self.x)
        set_value = object.__setattr__
        if not len(self.subject):
            set_value(self, "subject", np.arange(n))
        if not len(self.shared):
            set_value(self, "shared", np.zeros((n, 2, 0)))
        if not len(self.covariates):
            set_value(self, "covariates", np.zeros((n, 0)))
        shapes = (self.y.shape, self.own.shape, self.shared.shape[:2], self.subject.shape)
        if shapes != ((n,), (n, 2, 2), (n, 2), (n,)) or len(self.covariates) != n:
            raise ValueError(f"arrays of {n} ears must agree in length; got {shapes}")
        if not all(np.all(np.isfinite(a)) for a in (self.x, self.y, self.own, self.shared, self.covariates)):
            raise ValueError("logarithms and their covariances must be finite")
        if np.any(
            np.linalg.eigvalsh(self.own) < -1e-9 * np.trace(self.own, axis1=1, axis2=2)[:, None] - 1e-300
        ):
            raise ValueError("covariances of measurement errors must be positive semidefinite")

    @property
    def n(self) -> int:
        """Number of ears."""
        return len(self.x)

    @property
    def degrees(self) -> int:
        """Degrees of freedom of the scatter about the law."""
        return self.n - 2 - self.covariates.shape[1]

    @property
    def values(self) -> Array:
        """Return x and y together, (n, 2)."""
        return np.stack([self.x, self.y], axis=1)

    def has_pairs(self) -> bool:
        """Return whether any subject has more than one ear."""
        return len(np.unique(self.subject)) < self.n

    def covariates_are_independent(self) -> bool:
        """Return whether no covariate follows from the others or is the same in all ears."""
        design = np.column_stack([np.ones(self.n), self.covariates])
        return int(np.linalg.matrix_rank(design, tol=1e-9)) == design.shape[1]

    def without_common_errors(self) -> LogPairs:
        """Return the same ears without shared errors whose effect is the same on all.

        Such an error moves the means only: no exponent, scatter or test depends on it.
        """
        common = np.all(np.abs(self.shared - self.shared[:1]) < 1e-12, axis=(0, 1))
        return replace(self, shared=self.shared[:, :, ~common])

    def select(self, keep: NDArray[np.bool_]) -> LogPairs:
        """Return some of the ears; ``keep`` is (n,)."""
        return LogPairs(
            self.x[keep],
            self.y[keep],
            self.own[keep],
            self.shared[keep],
            self.subject[keep],
            self.covariates[keep],
        )

    def centred(self) -> LogPairs:
        """Return the same ears with x and y about their means, which no exponent depends on."""
        return replace(self, x=self.x - self.x.mean(), y=self.y - self.y.mean())
