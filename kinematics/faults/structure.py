"""Is what a rigid motion leaves noise, or a pattern that many channels share?"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.fault_model import State

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
_ONE_POINT = 0.85
_LIKELY = 1e-3
_TWO_POINTS = 0.93


@dataclass(frozen=True)
class Structure:
    """The strongest patterns in the residuals.

    Attributes
    ----------
    ratio : float
        Largest eigenvalue of the residual covariance relative to the edge expected for noise.
    p_value : float
        Upper bound on the probability of that under noise.
    concentrated : bool
        One or two points carry nearly all of the pattern.
    gain : float
        Residual energy above the noise edge that the patterns take away.
    pattern : ndarray, (channel,)
        Size of the strongest pattern at each channel, in units of noise.
    begins_hz : float
        From where on the residuals exceed the noise; NaN when from the first lines, or nowhere.
    """

    ratio: float
    p_value: float
    concentrated: bool
    gain: float
    pattern: Array
    begins_hz: float = float("nan")

    @property
    def significant(self) -> bool:
        """Whether noise would hardly do that."""
        return self.p_value < _LIKELY


def structure_of(state: State, rest: ComplexArray, scale: float = 1.0) -> Structure:
    """Look for patterns in whitened residuals.

    Parameters
    ----------
    state : State
    rest : ndarray, (channel, sample), complex
        Whitened residuals of lines without motion.
    scale : float
        Variance of the noise, at least that of which patterns are judged.

    Notes
    -----
    Under noise the eigenvalues of the residual covariance of F lines in p free directions end at
    (1 + sqrt(p / F))^2 times the noise level with Tracy-Widom fluctuations (Johansson 2000,
    doi:10.1007/s002200050027, for complex data); the tail of that law is bounded by exp(-4/3 s^1.5).
    """
    data = state.data
    count, size = state.span.shape
    live = np.flatnonzero(data.a > 0.0)
    nothing = Structure(0.0, 1.0, True, 0.0, np.zeros(count))
    residual = np.hstack([state.e, rest])[live]
    free, lines = len(live) - size, residual.shape[1]
    if free < 2 or lines < 8:
        return nothing
    if lines >= free:
        values, vectors = np.linalg.eigh(residual @ residual.conj().T / lines)
        values, vectors = values[::-1][:free], vectors[:, ::-1]
        shape = vectors[:, 0]
    else:
        values, vectors = np.linalg.eigh(residual.conj().T @ residual / lines)
        values, vectors = values[::-1], vectors[:, ::-1]
        shape = residual @ vectors[:, 0] / np.sqrt(max(lines * values[0], 1e-300))
    level = max(scale, float(np.median(values)) / _median_factor(free, lines) if lines >= free else 0.0)
    edge = (1.0 + np.sqrt(free / lines)) ** 2
    width = (np.sqrt(lines) + np.sqrt(free)) * (lines**-0.5 + free**-0.5) ** (1.0 / 3.0) / lines
    s = (values[0] / level - edge) / width
    p = float(np.exp(-4.0 / 3.0 * s**1.5)) if s > 0.0 else 1.0
    pattern = np.zeros(count)
    pattern[live] = np.abs(shape) * np.sqrt(values[0])
    above = values[values > level * (edge + 3.0 * width)]
    gain = float(lines * np.sum(above - edge * level))
    begins = _begins(state, rest, level) if p < _LIKELY else float("nan")
    near = _concentrated(state, live, shape)
    return Structure(values[0] / level / edge, p, near, gain, pattern, begins)


def _begins(state: State, rest: ComplexArray, level: float) -> float:
    """Return the frequency from which on most segments hold more than noise; NaN when that is the first.

    Notes
    -----
    The energy of a segment is chi-squared when the body is rigid; each is tested at 1 % of the number of
    segments.
    """
    from scipy.special import chdtrc

    data = state.data
    free = int(np.sum(data.a > 0.0)) - state.span.shape[1]
    parts = data.divisor.shape[1]
    loud = np.zeros(parts, dtype=bool)
    for k in range(parts):
        held = np.hstack([state.e[:, data.part == k], rest[:, data.rest_part == k]])
        energy = 2.0 * float(np.sum(np.abs(held) ** 2)) / level
        loud[k] = chdtrc(2.0 * free * max(held.shape[1], 1), energy) < 0.01 / parts
    for k in range(1, parts):
        if not np.any(loud[:k]) and np.mean(loud[k:]) > 0.6 and loud[k]:
            here = np.mean(data.freq_hz[data.part == k])
            return float(0.5 * (here + np.mean(data.freq_hz[data.part == k - 1])))
    return float("nan")


def _median_factor(free: int, lines: int) -> float:
    """Return the median eigenvalue of pure noise of unit variance (Marchenko-Pastur, by its quadrature)."""
    ratio = min(free / lines, 1.0)
    low, high = (1.0 - np.sqrt(ratio)) ** 2, (1.0 + np.sqrt(ratio)) ** 2
    grid = np.linspace(low, high, 2001)[1:-1]
    density = np.sqrt((high - grid) * (grid - low)) / grid
    cumulative = np.cumsum(density)
    return float(grid[np.searchsorted(cumulative, 0.5 * cumulative[-1])])


def _concentrated(state: State, live: NDArray[np.intp], pattern: ComplexArray) -> bool:
    """Tell whether faults at one point, or at two, could make the pattern alone."""
    groups: dict[str, list[int]] = {}
    for place, channel in enumerate(live):
        groups.setdefault(state.data.points[channel], []).append(place)
    span = state.span[live]
    shares: dict[str, float] = {}
    for size in {len(own) for own in groups.values()}:
        same = {name: own for name, own in groups.items() if len(own) == size}
        shares |= dict(zip(same, _shares(span, np.array(list(same.values())), pattern).tolist(), strict=True))
    if max(shares.values()) > _ONE_POINT:
        return True
    best = sorted(shares, key=lambda name: -shares[name])[:4]
    pairs = [
        float(_shares(span, np.array([groups[a] + groups[b]]), pattern)[0]) for a, b in combinations(best, 2)
    ]
    return len(groups) > 4 and max(pairs, default=0.0) > _TWO_POINTS


def _shares(span: Array, channels: NDArray[np.intp], pattern: ComplexArray) -> Array:
    """Return the part of a unit pattern in the residual directions of sets of channels (set, n), (set,)."""
    rows = span[channels]
    values, vectors = np.linalg.eigh(np.eye(channels.shape[1]) - rows @ rows.swapaxes(1, 2))
    along = np.abs(np.einsum("bnk,bn->bk", vectors, pattern[channels])) ** 2
    return np.asarray(np.sum(np.where(values > 1e-9, along / np.maximum(values, 1e-9), 0.0), axis=1))
