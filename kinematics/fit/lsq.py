"""Weighted least squares at many lines, plain or robust.

Shapes: c channels, m coefficients, L lines. Data are read in blocks that stay in the cache of the processor;
residuals of all channels and lines are never kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array, ComplexArray

HUBER_TUNING = 2.0
"""Size of a complex residual, in standard deviations of its parts, from which Huber's weight falls: it costs
1.8 % of efficiency on Gaussian noise (by integration)."""
T_FREEDOM = 4.0
"""Degrees of freedom of Student's t of ``t4``, as in dof2kd."""

_BLOCK_VALUES = 60_000  # 1 MB of complex numbers: half of a common L2 cache
_SAME_RATIO = 1e-10  # rounding of a product of two numbers, with room
_SIMULATED = 1000  # lines of noise: the variance of three coefficients is known to 2 %
_SINGULAR = 1e-9  # of a diagonal of R over the largest: not determined
_CONDITION = 1e7  # of a Gram matrix: one step of refinement mends up to here


@dataclass
class Solution:
    """Coefficients of every line, and sums over lines of every channel.

    Attributes
    ----------
    z : ndarray, (m, L), complex
        NaN at lines that the channels do not determine.
    covariance : ndarray, (L, m, m)
        E[dz dz^H] of the complex coefficients for the stated noise.
    chi2 : ndarray, (L,)
        Sum of |residual / sd|^2 over channels.
    count : ndarray, (L,), int
        Channels used.
    good : ndarray, (L,), bool
        Whether the line is determined.
    explained : ndarray, (L,)
        Sum of |fitted / sd|^2 over channels.
    freedom : ndarray, (c,)
        Sum over lines of the expectation of |residual / sd|^2, 2 (1 - leverage).
    weight : ndarray, (c,)
        Mean over lines of 1 / sd^2, times the robust weight, relative to the largest of the line.
    square : ndarray, (c,)
        Sum of |residual|^2 times ``line_scale``.
    used : ndarray, (c,), int
        Lines in use.
    """

    z: ComplexArray
    covariance: Array
    chi2: Array
    count: NDArray[np.int64]
    good: NDArray[np.bool_]
    explained: Array
    freedom: Array
    weight: Array
    square: Array
    used: NDArray[np.int64]

    @classmethod
    def empty(cls, channels: int, size: int, lines: int) -> Solution:
        """Return a solution to be filled."""
        return cls(
            z=np.full((size, lines), np.nan, dtype=complex),
            covariance=np.full((lines, size, size), np.nan),
            chi2=np.full(lines, np.nan),
            count=np.zeros(lines, dtype=np.int64),
            good=np.zeros(lines, dtype=bool),
            explained=np.zeros(lines),
            freedom=np.zeros(channels),
            weight=np.zeros(channels),
            square=np.zeros(channels),
            used=np.zeros(channels, dtype=np.int64),
        )

    def is_rounding(self, share: float = 1e-8) -> bool:
        """Return whether residuals are rounding errors only, so that they are no measure of noise."""
        left = float(np.nansum(self.chi2))
        return left <= share**2 * (left + float(self.explained.sum()))


def blocks(channels: int, lines: int) -> Iterator[slice]:
    """Yield slices of lines whose values stay in the cache."""
    width = max(64, _BLOCK_VALUES // max(channels, 1))
    return (slice(start, min(start + width, lines)) for start in range(0, lines, width))


def solve(
    basis: Array, value: ComplexArray, sd: Array, robust: str = "none", line_scale: Array | None = None
) -> Solution:
    """Fit the coefficients of every line.

    Parameters
    ----------
    basis : ndarray, (c, m)
        Well-conditioned columns.
    value : ndarray, (c, L), complex
        NaN where missing.
    sd : ndarray, broadcastable to (c, L)
        Standard deviation of the real (= imaginary) part; positive, NaN or infinite where not to be used.
    robust : str
        ``none``, ``huber`` or ``t4``; see `robust_weight`.
    line_scale : ndarray, (L,), optional
        Weights of ``Solution.square``.
    """
    channels, lines = value.shape
    sd = np.broadcast_to(sd, value.shape)
    scale = np.ones(lines) if line_scale is None else line_scale
    out = Solution.empty(channels, basis.shape[1], lines)
    for part in blocks(channels, lines):
        _fit_block(basis, value[:, part], sd[:, part], robust, part, scale, out)
    out.weight /= max(int(np.sum(out.good)), 1)
    if robust != "none":
        out.covariance *= _variance_factor(basis, value, sd, robust, out)
    return out


def _fit_block(
    basis: Array, y: ComplexArray, sd: Array, robust: str, part: slice, scale: Array, out: Solution
) -> None:
    """Fit some lines and enter them; noise that is the same at all lines has one column."""
    sd = sd[:, :1] if robust == "none" and sd.strides[1] == 0 else sd
    used = np.isfinite(y) & np.isfinite(sd) & (sd > 0.0)
    whole = bool(used.all())
    y = np.ascontiguousarray(y if whole else np.where(used, y, 0.0))
    noise = 1.0 / sd**2 if whole else np.where(used, 1.0 / np.where(used, sd, 1.0) ** 2, 0.0)
    z, inverse, good = _weighted(basis, y, noise)
    weight, plain = noise, inverse
    if robust != "none":
        start = np.flatnonzero(good)
        if robust == "t4":  # several optima: start from the only one of Huber's function
            _reweight(basis, y, noise, z, start, "huber", tolerance=1e-2)
        weight = _reweight(basis, y, noise, z, start, robust, tolerance=1e-3)
        inverse = _weighted(basis, y, weight)[1]
    z[:, ~good] = 0.0
    left = y - _times(basis, z)
    chosen = used & good
    residual = np.where(chosen, left.real**2 + left.imag**2, 0.0)
    leverage = weight * (_pairs(basis) @ inverse.reshape(len(inverse), -1).T)
    largest = np.max(weight, axis=0)
    gram = (noise.T @ _pairs(basis)).reshape(-1, *inverse.shape[1:])
    out.z[:, part] = np.where(good, z, np.nan)
    out.covariance[part] = np.where(good[:, None, None], 2.0 * plain, np.nan)
    out.chi2[part] = np.where(good, np.einsum("cl,cl->l", noise, residual), np.nan)
    out.count[part], out.good[part] = used.sum(axis=0), good
    out.freedom += 2.0 * np.einsum("cl,cl->c", chosen.astype(float), 1.0 - leverage)
    out.weight += np.einsum("cl,l->c", weight, good / np.where(largest > 0.0, largest, 1.0))
    out.square += residual @ scale[part]
    out.used += np.count_nonzero(chosen, axis=1)
    out.explained[part] = np.einsum("il,lij,jl->l", z.conj(), gram, z).real


def _times(matrix: Array, y: ComplexArray) -> ComplexArray:
    """Return the product of a real matrix and complex columns."""
    return np.asarray((matrix @ np.ascontiguousarray(y).view(float)).view(complex))


def _pairs(basis: Array) -> Array:
    """Return the products of the columns (c, m), (c, m * m)."""
    return np.asarray((basis[:, :, None] * basis[:, None, :]).reshape(len(basis), -1))


def _weighted(basis: Array, y: ComplexArray, noise: Array) -> tuple[ComplexArray, Array, NDArray[np.bool_]]:
    """Return coefficients (m, n), inverse Gram matrices (n or 1, m, m) and which lines are determined.

    Notes
    -----
    Lines whose channels keep the ratios of their weights share one QR factorisation; Gram matrices of the
    others are made by one matrix product, and refined once; where the condition passes 1e7, the rows are
    factorised instead (Golub and Van Loan 2013, Matrix Computations, 5.3).
    """
    size, lines = basis.shape[1], y.shape[1]
    top = noise.max(axis=0)
    top = np.where(top > 0.0, top, 1.0)  # lines without values
    w = noise / top
    if noise.shape[1] == 1 or np.all(np.abs(w - w[:, :1]) <= _SAME_RATIO * w[:, :1]):
        found = _factorised(basis, w[:, 0])
        if found is None:
            return np.zeros((size, lines), dtype=complex), np.zeros((1, size, size)), np.zeros(lines, bool)
        return _times(found[0], y), found[1] / top[:, None, None], np.ones(lines, bool)
    gram = (w.T @ _pairs(basis)).reshape(-1, size, size)
    trace = np.trace(gram, axis1=1, axis2=2)
    ridge = 1e-14 * np.where(trace > 0.0, trace, 1.0)
    inverse = np.linalg.inv(gram + ridge[:, None, None] * np.eye(size))
    condition = np.linalg.norm(inverse, axis=(1, 2)) * trace
    good = (condition < _CONDITION) & (trace > 0.0)  # lines without values determine nothing
    z, left = np.zeros((size, lines), dtype=complex), y
    for _ in range(2):
        z = z + np.einsum("lij,jl->il", inverse, _times(basis.T, w * left))
        left = y - _times(basis, z)
    for k in np.flatnonzero(~good):
        found = _factorised(basis, w[:, k])
        if found is not None:
            z[:, k], inverse[k], good[k] = found[0] @ y[:, k], found[1], True
    return z, inverse / top[:, None, None], good


def _factorised(basis: Array, weight: Array) -> tuple[Array, Array] | None:
    """Return the solution (m, c) of values with these weights (c,), and the inverse Gram matrix, by QR.

    None where they do not determine the coefficients.
    """
    root = np.sqrt(weight)
    q, r = np.linalg.qr(basis * root[:, None])
    diagonal = np.abs(np.diag(r))
    if len(diagonal) < basis.shape[1] or not diagonal.min() > _SINGULAR * diagonal.max():
        return None
    turn = np.linalg.inv(r)
    return turn @ q.T * root, turn @ turn.T


def robust_weight(size: Array, kind: str) -> Array:
    """Return the weight of a complex residual of a size (in sd of its parts) relative to least squares.

    ``huber``: min(1, k / size), k = 2. ``t4``: Student's t with 4 degrees of freedom in the plane,
    6 / (4 + size^2) (Lange, Little and Taylor 1989, doi:10.1080/01621459.1989.10478852).
    """
    if kind == "huber":
        return np.asarray(np.minimum(1.0, HUBER_TUNING / np.maximum(size, 1e-300)))
    return np.asarray((T_FREEDOM + 2.0) / (T_FREEDOM + size**2))


def _reweight(
    basis: Array,
    y: ComplexArray,
    noise: Array,
    z: ComplexArray,
    lines: NDArray[np.intp],
    kind: str,
    tolerance: float,
    rounds: int = 200,
) -> Array:
    """Iterate the robust weights until no line moves by more than ``tolerance`` of its sd; return them."""
    live = lines
    for _ in range(rounds):
        if len(live) == 0:
            break
        size = np.sqrt(noise[:, live]) * np.abs(y[:, live] - basis @ z[:, live])
        weight = noise[:, live] * robust_weight(size, kind)
        new, inverse, good = _weighted(basis, y[:, live], weight)
        step = np.where(good, new - z[:, live], 0.0)
        z[:, live] += step
        sd = np.sqrt(np.diagonal(inverse, axis1=1, axis2=2).T)
        live = live[np.max(np.abs(step) / np.maximum(sd, 1e-300), axis=0) > tolerance]
    size = np.sqrt(noise) * np.abs(y - basis @ np.where(np.isfinite(z), z, 0.0))
    return noise * robust_weight(size, kind)


def _variance_factor(basis: Array, value: ComplexArray, sd: Array, kind: str, out: Solution) -> float:
    """Return the variance of the robust estimate over that of least squares.

    Notes
    -----
    An M-estimate has the variance E psi^2 / (E psi')^2 (Huber and Ronchetti 2009, Robust Statistics, 3.2)
    where values are many. Where coefficients are nearly as many as values, residuals are smaller than errors
    and this no longer holds: Gaussian noise of the same beams, gaps and sd is fitted in the same way, its
    variance is found by counting, and only the ratio to it is taken from the residuals.
    """
    good = np.flatnonzero(out.good)
    if len(good) == 0:
        return 1.0
    most = int(np.clip(_BLOCK_VALUES // (2 * len(value)), 200, _SIMULATED))
    lines = good[np.linspace(0, len(good) - 1, min(most, len(good))).astype(int)]
    y, s = value[:, lines], sd[:, lines]
    used = np.isfinite(y) & np.isfinite(s) & (s > 0.0)
    s = np.where(used, s, 1.0)
    repeat = max(1, _SIMULATED // len(lines))
    s, used = np.tile(s, repeat), np.tile(used, repeat)
    noise = s * np.random.default_rng(0).normal(size=(*s.shape, 2)).view(complex)[..., 0]
    trial = Solution.empty(len(value), basis.shape[1], s.shape[1])
    _fit_block(basis, noise, np.where(used, s, np.nan), kind, slice(None), np.ones(s.shape[1]), trial)
    whole = np.einsum("il,lij,jl->l", trial.z.conj(), np.linalg.inv(trial.covariance), trial.z).real
    counted = float(np.nanmean(whole)) / basis.shape[1]
    seen = [
        _influence(np.abs(values - basis @ z)[mask] / spread[mask], kind)
        for values, z, spread, mask in (
            (y, out.z[:, lines], s[:, : len(lines)], used[:, : len(lines)]),
            (noise, np.nan_to_num(trial.z), s, used),
        )
    ]
    return counted * seen[0] / seen[1]


def _influence(size: Array, kind: str) -> float:
    """Return E psi^2 / (E psi')^2 of residuals, psi' averaged along and across the residual."""
    u = robust_weight(size, kind)
    if kind == "huber":
        along = np.where(size <= HUBER_TUNING, 1.0, 0.0)
    else:
        along = u * (T_FREEDOM - size**2) / (T_FREEDOM + size**2)
    return float(np.mean((u * size) ** 2) / np.mean(0.5 * (u + along)) ** 2)
