"""Does the body bend? Patterns that many channels share in the residuals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from legacy.kinematics.calibrated import calibrated
from legacy.kinematics.faults.score_information import State
from legacy.stapeskit.arrays import Array, ComplexArray

_ONE_POINT: float = calibrated("flexible.one_point_share")
# Probability below which a structure of the residuals is reported.
_LIKELY = 1e-3
_TWO_POINTS: float = calibrated("flexible.two_points_share")
# Parts of the lines in which the energy is looked at.
_PARTS = 12


@dataclass(frozen=True)
class Structure:
    """The strongest patterns in the residuals.

    Attributes
    ----------
    p_value : float
        Upper bound on the probability of so large an eigenvalue of the residual covariance under noise.
    concentrated : bool
        One or two points carry nearly all of the pattern.
    gain : float
        Residual energy above the noise edge that the patterns take away.
    pattern : ndarray, (channel,)
        Size of the strongest pattern at each channel, in units of noise.
    begins_hz : float
        From where on the residuals exceed the noise; NaN when from the first lines, or nowhere.
    """

    p_value: float
    concentrated: bool
    gain: float
    pattern: Array
    begins_hz: float = float("nan")

    @property
    def significant(self) -> bool:
        """Whether noise would hardly do that."""
        return self.p_value < _LIKELY


def no_structure(channels: int) -> Structure:
    """Return the structure of residuals that show none."""
    return Structure(1.0, True, 0.0, np.zeros(channels))


def structure_of(state: State, scale: float = 1.0) -> Structure:
    """Search for patterns in whitened residuals; ``scale`` is the least variance of the noise.

    Notes
    -----
    Under noise the eigenvalues of the residual covariance of F lines in p free directions end at
    (1 + sqrt(p / F))^2 times the noise level with Tracy-Widom fluctuations (Johansson 2000,
    doi:10.1007/s002200050027, for complex data); the tail of that law is bounded by exp(-4/3 s^1.5).
    """
    data = state.data
    count = len(data.points)
    live = np.array(data.live)
    both = state.both
    residual = both.transpose(1, 0, 2).reshape(count, -1)[live]
    free, lines = float(np.mean(state.free())), residual.shape[1]
    if free < 2.0 or lines < 8:
        return no_structure(count)
    wide = lines >= free
    product = residual @ residual.conj().T if wide else residual.conj().T @ residual
    values, vectors = np.linalg.eigh(product / lines)
    values, vectors = values[::-1], vectors[:, ::-1]
    if wide:
        values, shape = values[: round(free)], vectors[:, 0]
    else:
        shape = residual @ vectors[:, 0] / np.sqrt(max(lines * float(values[0]), 1e-300))
    level = max(scale, float(np.median(values)) / _median_factor(free, lines) if wide else 0.0)
    edge = (1.0 + np.sqrt(free / lines)) ** 2
    width = (np.sqrt(lines) + np.sqrt(free)) * (lines**-0.5 + free**-0.5) ** (1.0 / 3.0) / lines
    s = (values[0] / level - edge) / width
    p = float(np.exp(-4.0 / 3.0 * s**1.5)) if s > 0.0 else 1.0
    pattern = np.zeros(count, dtype=complex)
    pattern[live] = shape
    above = values[values > level * (edge + 3.0 * width)]
    gain = float(lines * np.sum(above - edge * level))
    begins = _begins(state, both, level) if p < _LIKELY else float("nan")
    size = np.abs(pattern) * np.sqrt(max(float(values[0]), 0.0))
    return Structure(p, _is_concentrated(state, pattern), gain, size, begins)


def _begins(state: State, both: ComplexArray, level: float) -> float:
    """Return the frequency from which on most parts hold more than noise; NaN when that is the first.

    Notes
    -----
    The energy of a part is chi-squared when the body is rigid; each is tested at 1 % of the number of parts.
    """
    from scipy.special import chdtrc

    data = state.data
    pieces = np.array_split(np.arange(len(data.ratio)), min(_PARTS, len(data.ratio)))
    energy = np.sum(np.abs(both) ** 2, axis=(1, 2))
    freedom = state.free() * both.shape[2]
    loud = np.array(
        [
            chdtrc(max(2.0 * np.sum(freedom[own]), 1.0), 2.0 * np.sum(energy[own]) / level)
            < 0.01 / len(pieces)
            for own in pieces
        ]
    )
    at = [float(np.mean(data.ratio[own])) * data.source.middle_hz for own in pieces]
    for k in range(1, len(pieces)):
        if loud[k] and not np.any(loud[:k]) and np.mean(loud[k:]) > 0.6:
            return 0.5 * (at[k] + at[k - 1])
    return float("nan")


def _median_factor(free: float, lines: int) -> float:
    """Return the median eigenvalue of pure noise of unit variance (Marchenko-Pastur, by its quadrature)."""
    ratio = min(free / lines, 1.0)
    low, high = (1.0 - np.sqrt(ratio)) ** 2, (1.0 + np.sqrt(ratio)) ** 2
    grid = np.linspace(low, high, 2001)[1:-1]
    density = np.sqrt((high - grid) * (grid - low)) / grid
    cumulative = np.cumsum(density)
    return float(grid[np.searchsorted(cumulative, 0.5 * cumulative[-1])])


def _is_concentrated(state: State, pattern: ComplexArray) -> bool:
    """Return whether faults at one point, or at two, could make a unit pattern (channel,) alone."""
    alone = replace(state, span=state.span[:1], e=pattern[None, :, None])
    points = state.data.by_point

    def share(*names: str) -> float:
        return float(alone.left_out(np.array([[c for name in names for c in points[name]]]))[0])

    shares = {name: share(name) for name in points}
    if max(shares.values()) > _ONE_POINT:
        return True
    best = sorted(shares, key=lambda name: -shares[name])[:4]
    return len(points) > 4 and max(share(*pair) for pair in combinations(best, 2)) > _TWO_POINTS
