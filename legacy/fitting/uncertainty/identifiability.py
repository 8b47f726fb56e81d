"""Identifiability: conditioning, the worst combinations of entries, the bound of every entry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legacy.fitting.estimators.base import gram
from legacy.fitting.model.parameter_vector import entry_names, pairs, split
from legacy.fitting.model.scaled_lines import Lines, real_rows, regressor
from legacy.fitting.uncertainty.covariance import chi2, degrees, invert, known_and_spread
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import list_some
from legacy.stapeskit.warnings import Notice

# Relative sd from which on an entry, or a combination of entries, is reported as weak; how many are named.
WEAK_ENTRY = 0.10
WEAK_COMBINATION = 0.25
_NAMED = 3


@dataclass(frozen=True)
class Identifiability:
    """How well the data determine the parameters.

    Relative means relative to sqrt(Xii Xjj) for entry (i, j) of X = K or D, since a coupling may be zero.

    Attributes
    ----------
    condition : float
        Condition number of A with columns of unit length (balanced rows).
    eigenvalues : ndarray, (p,)
        Of the Fisher matrix of the relative parameters, ascending; 1 / sqrt is a relative sd.
    combinations : tuple of (float, tuple of (str, float))
        Relative sd of the worst combinations with their leading entries and coefficients.
    names : tuple of str, (p,)
    bound_si : ndarray, (p,)
        Cramer-Rao bound of the sd of every entry, channel noise only, SI.
    relative : ndarray, (p,)
        The same, relative.
    """

    condition: float
    eigenvalues: Array
    combinations: tuple[tuple[float, tuple[tuple[str, float], ...]], ...]
    names: tuple[str, ...]
    bound_si: Array
    relative: Array

    @property
    def weak(self) -> bool:
        """True when an entry has a relative sd over 10 % or a combination one over 25 %."""
        return bool(
            np.any(self.relative > WEAK_ENTRY) or self.eigenvalues[0] <= 0.0 or self.worst > WEAK_COMBINATION
        )

    @property
    def worst(self) -> float:
        """Relative sd of the worst combination."""
        return self.combinations[0][0]

    def notices(self) -> list[Notice]:
        """Return a warning when the data are weak."""
        if not self.weak:
            return []
        entries = [
            f"{name} {100.0 * value:.0f} %" if value <= 1.0 else f"{name} undetermined"
            for name, value in zip(self.names, self.relative, strict=True)
            if value > WEAK_ENTRY
        ]
        return [
            Notice(
                "weak_identifiability",
                "The data determine some entries weakly"
                + (f" (sd relative to sqrt(Xii Xjj): {list_some(entries, 6)})" if entries else "")
                + f"; the worst combination, {self.describe(0)}, has a relative sd of {self.percent(0)}. "
                "A wider band, another shaker direction or fewer degrees of freedom would help.",
            )
        ]

    def describe(self, place: int) -> str:
        """Return a combination in words, e.g. 0.71 K12 - 0.70 D23."""
        words = ""
        for name, weight in self.combinations[place][1]:
            sign = " - " if weight < 0.0 else " + "
            words += f"{sign if words else sign.strip().replace('+', '')}{abs(weight):.2f} {name}"
        return words

    def percent(self, place: int) -> str:
        """Return the relative sd of a combination in percent."""
        value = 100.0 * self.combinations[place][0]
        return "over 1000 %" if value > 1000.0 else f"{value:.2g} %"


def identifiability(parameters: Array, lines: Lines, units: Array) -> Identifiability:
    """Return how well some lines determine K and D at scaled parameters (p,).

    Parameters
    ----------
    parameters : ndarray, (p,)
        Scaled.
    units : ndarray, (p,)
        SI over scaled.
    """
    n = lines.n
    columns = real_rows(regressor(lines.dq, lines.factor))
    product = gram(columns)
    norms = np.sqrt(np.maximum(np.diag(product), 1e-300))
    spectrum = np.linalg.eigvalsh(product / np.outer(norms, norms))
    determined = spectrum[0] > 1e-15 * spectrum[-1]
    condition = float(np.sqrt(spectrum[-1] / spectrum[0])) if determined else float("inf")
    level = chi2(parameters, lines) / max(degrees(lines), 1)
    known, _ = known_and_spread(parameters, lines, level)
    sizes = relative_sizes(parameters, n)
    fisher = 2.0 * known * np.outer(sizes, sizes)
    values, vectors = np.linalg.eigh(fisher)
    values = np.maximum(values, 1e-300)
    bound = np.sqrt(np.diag(invert(2.0 * known)))
    names = entry_names(n)
    combinations = []
    for place in range(min(_NAMED, len(values))):
        weights = vectors[:, place]
        leading = [index for index in np.argsort(-np.abs(weights))[:4] if abs(weights[index]) > 0.15]
        sign = np.sign(weights[leading[0]])
        parts = tuple((names[index], float(sign * weights[index])) for index in leading)
        combinations.append((float(1.0 / np.sqrt(values[place])), parts))
    return Identifiability(
        condition, values, tuple(combinations), names, bound * np.abs(units), bound / sizes
    )


def relative_sizes(parameters: Array, n: int) -> Array:
    """Return sqrt(Xii Xjj) of every entry (p,)."""
    sizes = []
    for part in split(parameters, n):
        root = np.sqrt(np.abs(np.diag(part)))
        root = np.maximum(root, 1e-6 * max(float(root.max()), 1e-300))
        sizes += [root[row] * root[column] for row, column in pairs(n)]
    return np.array(sizes)
