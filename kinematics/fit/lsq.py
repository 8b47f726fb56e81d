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
    energy, freedom : ndarray, (c,)
        Sums over lines of |residual / sd|^2 and of its expectation, 2 (1 - leverage).
    weight : ndarray, (c,)
        Mean over lines of 1 / sd^2, times the robust weight, relative to the largest of the line.
    square : ndarray, (c,)
        Sum of |residual|^2 times ``line_scale``.
    used : ndarray, (c,), int
        Lines in use.
    explained : float
        Sum of |fitted / sd|^2.
    variance_factor : float
        Variance of the robust estimate over that of least squares, for noise as the residuals show it.
    """

    z: ComplexArray
    covariance: Array
    chi2: Array
    count: NDArray[np.int64]
    good: NDArray[np.bool_]
    energy: Array
    freedom: Array
    weight: Array
    square: Array
    used: NDArray[np.int64]
    explained: float = 0.0
    variance_factor: float = 1.0

    @classmethod
    def empty(cls, channels: int, size: int, lines: int) -> Solution:
        """Return a solution to be filled."""
        return cls(
            z=np.full((size, lines), np.nan, dtype=complex),
            covariance=np.full((lines, size, size), np.nan),
            chi2=np.full(lines, np.nan),
            count=np.zeros(lines, dtype=np.int64),
            good=np.zeros(lines, dtype=bool),
            energy=np.zeros(channels),
            freedom=np.zeros(channels),
            weight=np.zeros(channels),
            square=np.zeros(channels),
            used=np.zeros(channels, dtype=np.int64),
        )

    @property
    def level(self) -> Array:
        """Residual energy of each channel over that of its noise, (c,); NaN without redundancy."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(
                self.freedom > 1e-9 * np.maximum(self.used, 1), self.energy / self.freedom, np.nan
            )

    def is_rounding(self, share: float = 1e-8) -> bool:
        """Return whether residuals are rounding errors only, so that they are no measure of noise."""
        left = float(np.nansum(self.chi2))
        return left <= share**2 * (left + self.explained)


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

    Notes
    -----
    Lines whose channels keep the ratios of their noise share one QR factorisation. The others have Gram
    matrices, made by one matrix product for all lines and refined once; where their condition passes 1e7,
    each line has its own QR factorisation (Golub and Van Loan 2013, Matrix Computations, 5.3).
    """
    channels, lines = value.shape
    sd = np.broadcast_to(sd, value.shape)
    scale = np.ones(lines) if line_scale is None else line_scale
    out = Solution.empty(channels, basis.shape[1], lines)
    for part in blocks(channels, lines):
        _fit_block(basis, value[:, part], sd[:, part], robust, part, scale[part], out)
    out.weight /= max(int(np.sum(out.good)), 1)
    if robust != "none":
        out.variance_factor = _variance_factor(basis, value, sd, robust, out)
        out.covariance *= out.variance_factor
    return out


def _fit_block(
    basis: Array, y: ComplexArray, sd: Array, robust: str, part: slice, scale: Array, out: Solution
) -> None:
    """Fit some lines and enter them into the solution."""
    with np.errstate(divide="ignore", invalid="ignore"):
        noise = 1.0 / np.square(sd)
    used = np.isfinite(y) & np.isfinite(noise) & (noise > 0.0)
    if not used.all():
        y, noise = np.where(used, y, 0.0), np.where(used, noise, 0.0)
    weight = noise
    found = _shared(basis, y, noise) if robust == "none" else None
    if found is not None:
        z, inverse, leverage = found
        good = np.ones(y.shape[1], dtype=bool)
    else:
        z, inverse, good = _weighted(basis, y, noise)
        if robust != "none":
            start = np.flatnonzero(good)
            if robust == "t4":  # several optima: start from the only one of Huber's function
                _reweight(basis, y, noise, z, start, "huber", tolerance=1e-2)
            weight = _reweight(basis, y, noise, z, start, robust, tolerance=1e-3)
        final = inverse if weight is noise else _weighted(basis, y, weight)[1]
        z[:, ~good] = 0.0
        pairs = basis[:, :, None] * basis[:, None, :]
        leverage = weight * np.einsum("cij,lij->cl", pairs, final, optimize=True)
    left = y - _product(basis, z)
    residual = left.real**2 + left.imag**2
    normal = residual * noise
    chi2 = normal.sum(axis=0)
    chosen, largest = used & good, np.max(weight, axis=0)
    out.z[:, part] = np.where(good, z, np.nan)
    out.covariance[part] = np.where(good[:, None, None], 2.0 * inverse, np.nan)
    out.chi2[part] = np.where(good, chi2, np.nan)
    out.count[part], out.good[part] = used.sum(axis=0), good
    out.energy += normal @ good
    out.freedom += 2.0 * np.sum(chosen * (1.0 - leverage), axis=1)
    out.weight += weight @ np.where(good & (largest > 0.0), 1.0 / np.where(largest > 0.0, largest, 1.0), 0.0)
    out.square += (residual * chosen) @ scale
    out.used += chosen.sum(axis=1)
    whole = np.sum((y.real**2 + y.imag**2) * noise, axis=0)
    out.explained += float(np.sum(np.maximum(whole - chi2, 0.0) * good))


def _product(matrix: Array, values: ComplexArray) -> ComplexArray:
    """Return the product of a real matrix with complex columns, in half the time."""
    return np.asarray((matrix @ np.ascontiguousarray(values).view(float)).view(complex))


def _shared(basis: Array, y: ComplexArray, noise: Array) -> tuple[ComplexArray, Array, Array] | None:
    """Return coefficients, inverse Gram matrices and leverage (c, 1) by one QR factorisation for all lines.

    None where the weights are not a product of channel and line, or do not determine the coefficients.
    """
    first = int(np.argmax(noise[:, 0]))
    product = noise[:, :1] / max(noise[first, 0], 1e-300) * noise[first]
    if noise[first, 0] == 0.0 or np.any(np.abs(noise - product) > _SAME_RATIO * product):
        return None
    root = np.sqrt(noise[:, :1])
    factors = _factorised(basis, root)
    if factors is None:
        return None
    q, turn = factors
    inverse = (noise[first, 0] / noise[first])[:, None, None] * (turn @ turn.T)
    return _product(turn @ q.T, root * y), inverse, np.sum(q**2, axis=1, keepdims=True)


def _factorised(basis: Array, root: Array) -> tuple[Array, Array] | None:
    """Return Q and the inverse of R of weighted columns; None where these are dependent."""
    q, r = np.linalg.qr(basis * root)
    diagonal = np.abs(np.diag(r))
    if np.count_nonzero(root) < basis.shape[1] or diagonal.min() <= 1e-9 * diagonal.max():
        return None
    return q, np.linalg.inv(r)


def _weighted(basis: Array, y: ComplexArray, noise: Array) -> tuple[ComplexArray, Array, NDArray[np.bool_]]:
    """Return coefficients (m, n), inverse Gram matrices (n, m, m) and which lines are determined."""
    size = basis.shape[1]
    top = np.maximum(noise.max(axis=0), 1e-300)
    w = noise / top
    products = (basis[:, :, None] * basis[:, None, :]).reshape(len(basis), -1)
    gram = (products.T @ w).T.reshape(-1, size, size)
    trace = np.trace(gram, axis1=1, axis2=2)
    ridge = 1e-14 * np.where(trace > 0.0, trace, 1.0)
    inverse = np.linalg.inv(gram + ridge[:, None, None] * np.eye(size))
    condition = np.linalg.norm(inverse, axis=(1, 2)) * trace
    good = (condition < _CONDITION) & (np.count_nonzero(noise, axis=0) >= size)
    z = np.zeros((size, y.shape[1]), dtype=complex)
    for _ in range(2):
        right = _product(basis.T, w * (y - _product(basis, z)))
        z = z + np.einsum("lij,jl->il", inverse, right)
    for line in np.flatnonzero(~good):
        factors = _factorised(basis, np.sqrt(w[:, line, None]))
        if factors is not None:
            q, turn = factors
            z[:, line], inverse[line] = turn @ (q.T @ (np.sqrt(w[:, line]) * y[:, line])), turn @ turn.T
            good[line] = True
    return z, inverse / top[:, None, None], good


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
    """Reweight lines until each moves by less than ``tolerance`` of its sd; change z, return weights."""
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
