"""The result of least squares at many lines: coefficients, variances and sums of residuals."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array, ComplexArray


@dataclass
class Solution:
    """Coefficients and residual sums, filled block by block.

    Attributes
    ----------
    z : ndarray, (m, freq), complex
        Coefficients in the orthonormal basis; zero where not determined.
    inverse : ndarray, (p, freq)
        Packed inverse of the Gram matrix with weights 1 / (2 sd^2).
    good : ndarray, (freq,), bool
        Lines whose channels determine the motion; only they enter the sums.
    count : ndarray, (freq,), int
        Channels used.
    misfit, explained : ndarray, (freq,)
        Sum of |residual / sd|^2 and of |fitted / sd|^2.
    energy : ndarray, (channel,)
        Sum of |residual|^2 over the lines, m^2.
    scaled : ndarray, (channel,)
        Sum of |residual / sd|^2.
    freedom : ndarray, (channel,)
        Sum of 2 (1 - leverage): what ``scaled`` is on average under the stated noise.
    weight : ndarray, (channel,)
        Sum of weights relative to the strongest channel of each line.
    used : ndarray, (channel,), int
        Lines used.
    """

    channels: int
    lines: int
    size: int
    z: ComplexArray = field(init=False)
    inverse: Array = field(init=False)
    good: NDArray[np.bool_] = field(init=False)
    count: NDArray[np.int64] = field(init=False)
    misfit: Array = field(init=False)
    explained: Array = field(init=False)
    energy: Array = field(init=False)
    scaled: Array = field(init=False)
    freedom: Array = field(init=False)
    weight: Array = field(init=False)
    used: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        packed_size = self.size * (self.size + 1) // 2
        self.z = np.zeros((self.size, self.lines), dtype=complex)
        self.inverse = np.zeros((packed_size, self.lines))
        self.good = np.zeros(self.lines, dtype=bool)
        self.count = np.zeros(self.lines, dtype=np.int64)
        self.misfit, self.explained = np.zeros(self.lines), np.zeros(self.lines)
        self.energy, self.scaled = np.zeros(self.channels), np.zeros(self.channels)
        self.freedom, self.weight = np.zeros(self.channels), np.zeros(self.channels)
        self.used = np.zeros(self.channels, dtype=np.int64)

    def take(self, lines: NDArray[np.intp], few: Solution) -> None:
        """Add the solution of a few lines (n,) that no sum contains yet."""
        for name in ("z", "inverse"):
            getattr(self, name)[:, lines] = getattr(few, name)
        for name in ("good", "count", "misfit", "explained"):
            getattr(self, name)[lines] = getattr(few, name)
        for name in ("energy", "scaled", "freedom", "weight", "used"):
            getattr(self, name)[:] += getattr(few, name)

    def rescaled(self, change: Array) -> Solution:
        """Return the solution for variances that are ``change`` (freq,) times as large."""
        solution = Solution(self.channels, 0, self.size)
        for name in ("lines", "z", "good", "count", "energy", "freedom", "weight", "used"):
            setattr(solution, name, getattr(self, name))
        solution.inverse = self.inverse * change
        solution.misfit, solution.explained = self.misfit / change, self.explained / change
        total = float(np.sum(self.misfit))
        solution.scaled = self.scaled * (float(np.sum(solution.misfit)) / total if total > 0.0 else 1.0)
        return solution
