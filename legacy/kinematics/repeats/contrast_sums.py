"""Energies of contrasts between takes and of what they leave, gathered over runs of lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from legacy.stapeskit.arrays import Array, ComplexArray

# Lines apart up to which noise is taken for correlated: a Hann window reaches two.
_CORRELATED_LINES = 3


def energy_of(values: ComplexArray) -> float:
    """Return the sum of squared sizes."""
    return float(np.vdot(values, values).real)


def contrasts(gain: ComplexArray, columns: Sequence[Array]) -> ComplexArray:
    """Return orthonormal contrasts over the takes, (n, take, k), orthogonal to the gains (n, take)."""
    design = np.stack([gain, *(gain * (column - column.mean()) for column in columns)], axis=2)
    return np.asarray(np.linalg.qr(design)[0][:, :, 1:])


@dataclass
class ContrastSums:
    """Sums over lines of one contrast and of the residual from it.

    Attributes
    ----------
    energy, remainder : float
        Of the contrast, and of what remains.
    cells : int
        Channels and lines with any remainder.
    squares : float
        Sum of the squared energies of the cells.
    products, chances, pairs : ndarray, (lag,)
        Products of neighbouring lines, what chance makes of their squares, and how many pairs went in.
    """

    energy: float = 0.0
    remainder: float = 0.0
    cells: int = 0
    squares: float = 0.0
    products: ComplexArray = field(default_factory=lambda: np.zeros(_CORRELATED_LINES, dtype=complex))
    chances: Array = field(default_factory=lambda: np.zeros(_CORRELATED_LINES))
    pairs: Array = field(default_factory=lambda: np.zeros(_CORRELATED_LINES))
    lines: int = 0

    def add(self, z: ComplexArray, remainder: ComplexArray) -> None:
        """Add a run of lines.

        Parameters
        ----------
        z : ndarray, (n, channel), complex
        remainder : ndarray, (n, take, channel), complex
            The residual after the contrast.
        """
        remainder = np.ascontiguousarray(remainder)
        size = remainder.real**2 + remainder.imag**2
        cells = np.sum(size, axis=1)
        self.energy += energy_of(z)
        self.remainder += float(np.sum(cells))
        self.cells += int(np.count_nonzero(cells))
        self.squares += float(np.vdot(cells, cells))
        self.lines += len(remainder)
        for lag in range(1, min(_CORRELATED_LINES, len(remainder) - 1) + 1):
            self.products[lag - 1] += complex(np.vdot(remainder[:-lag], remainder[lag:]))
            self.chances[lag - 1] += float(np.vdot(size[lag:], size[:-lag]))
            self.pairs[lag - 1] += len(remainder) - lag

    def compared(
        self, own: float, rest: float, stated: bool, doubt: float = 0.0
    ) -> tuple[float | None, float]:
        """Return the p-value of the energy of the contrast, and the noise per complex value in that test.

        Parameters
        ----------
        own, rest : float
            Complex degrees of freedom of the contrast and of what remains.
        stated : bool
            The noise is known: 2 per complex value.
        doubt : float
            Relative variance of the noise power that is stated for one take at one channel and line. The
            mean of n of them, with which an energy of n values is compared, adds its share to that of chance.
        """
        from scipy import special

        if rest < 1.0:
            if not stated:
                return None, 0.0
            widen = 1.0 + doubt
            return float(special.chdtrc(2.0 * own / widen, self.energy / widen)), 2.0
        noise = self.remainder / rest
        if noise <= 0.0:
            return (1.0 if self.energy <= 0.0 else 0.0), 0.0
        widen = self._correlation() * self._freedom_loss(rest) * (1.0 + doubt)
        ratio = self.energy / own / noise
        return float(special.fdtrc(2.0 * own / widen, 2.0 * rest / widen, ratio)), noise

    def _freedom_loss(self, rest: float) -> float:
        """Return by what factor unequal noise lowers the degrees of freedom.

        Energies per channel and line are sums of exponentials over the takes; with e = sum |r|^2 over m takes
        of equal noise s, E[e^2] = s^2 m (m + 1), so sum s^2 is estimated without knowing any s.
        """
        cells = max(self.cells, 1)
        m = max(rest / cells, 0.25)
        squares = self.squares / (m * (m + 1.0)) * m**2
        return max(1.0, squares * cells / max(self.remainder**2, 1e-300))

    def _correlation(self) -> float:
        """Return by what factor correlation between neighbouring lines lowers the degrees of freedom."""
        factor = 1.0
        for lag, pairs in enumerate(self.pairs, start=1):
            if pairs > 0.0:
                whole = (self.lines - lag) / pairs
                product = abs(self.products[lag - 1]) ** 2
                factor += 2.0 * whole**2 * max(product - self.chances[lag - 1], 0.0) / self.remainder**2
        return float(factor)


class Outliers:
    """Sums over lines of every take against the others.

    Parameters
    ----------
    count : int
        Takes.
    columns : sequence of ndarray (take,)
        The level, which is subtracted first.
    """

    def __init__(self, count: int, columns: Sequence[Array]) -> None:
        self._columns = list(columns)
        self._taken = 1 + len(self._columns)
        tested = count if count - self._taken >= 2 else 0
        self._sums = [ContrastSums() for _ in range(tested)]
        self._lever = np.zeros(tested)
        self._lines = np.zeros(tested)
        self._spent = np.zeros(tested, dtype=bool)

    def add(self, data: ComplexArray, gain: ComplexArray, residual: ComplexArray) -> None:
        """Add a run of lines: values and residual (n, take, channel), and gains (n, take)."""
        if not self._sums:
            return
        span, own = gain[:, :, None], residual
        if self._columns:
            basis = contrasts(gain, self._columns)
            own = residual - np.einsum("ftk,fkc->ftc", basis, np.einsum("ftk,ftc->fkc", basis.conj(), data))
            span = np.concatenate([span, basis], axis=2)
        for take, sums in enumerate(self._sums):
            way = -np.einsum("ftk,fk->ft", span, span[:, take].conj())
            way[:, take] += 1.0
            length = np.linalg.norm(way, axis=1)
            if self._spent[take] or np.min(length) < 1e-6:
                self._spent[take] = True
                continue
            way /= length[:, None]
            z = np.einsum("ft,ftc->fc", way.conj(), data, optimize=True)
            remainder = way[:, :, None] * z[:, None, :]
            sums.add(z, np.subtract(own, remainder, out=remainder))
            self._lever[take] += float(np.sum(length * np.abs(gain[:, take])))
            self._lines[take] += len(length)

    def worst(self, freedom: float, doubt: float = 0.0) -> tuple[float, int, float, float, float] | None:
        """Return the most certain outlier: p-value, take, lever, energy and noise; None without any.

        Parameters
        ----------
        freedom : float
            Complex degrees of freedom of one take.
        doubt : float
            As of ``ContrastSums.compared``.
        """
        count = len(self._sums)
        extremes = []
        for take, sums in enumerate(self._sums):
            if self._spent[take] or not self._lines[take]:
                continue
            p, noise = sums.compared(freedom, freedom * (count - self._taken - 1), False, doubt)
            if p is not None:
                lever = float(self._lever[take] / self._lines[take])
                extremes.append((p, -sums.energy, take, lever, noise))
        if not extremes:
            return None
        p, energy, take, lever, noise = min(extremes)
        return min(1.0, count * p), take, lever, -energy, noise
