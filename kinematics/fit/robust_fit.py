"""Huber and Student-t fits at many lines: reweighting until every line has settled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinematics.fit import symmetric_batches
from kinematics.fit.line_gram import Piece, Weighted, add, pieces, predicted, weighted
from kinematics.fit.line_noise import LineNoise, blocks
from kinematics.fit.line_sums import Solution
from stapeskit.arrays import Array, ComplexArray

# For complex residuals; loses 1.8 % of efficiency on Gaussian noise (by integration).
HUBER_TUNING = 2.0
# As --robust t4 of dof2kd.
T_FREEDOM = 4.0
# Relative change of the solution at the end, and of the first round.
TOLERANCE = 1e-6
_ROUGH = 1e-2
# Limit of iterations.
_MOST = 300
# Values of the sample on which the noise level is found.
_LOSS_VALUES = 400_000


def robust_weight(size: Array, kind: str) -> tuple[Array, Array]:
    """Return u(|e|) and d(|e| u)/d|e| for two-dimensional residuals e in units of sd.

    ``huber``: u = min(1, k / |e|), k = 2. ``t4``: Student's t with 4 degrees of freedom,
    u = 6 / (4 + |e|^2) (Lange, Little and Taylor 1989, doi:10.1080/01621459.1989.10478852).
    """
    if kind == "huber":
        with np.errstate(divide="ignore"):
            u = np.minimum(1.0, HUBER_TUNING / size)
        return u, np.where(size <= HUBER_TUNING, 1.0, 0.0)
    u = (T_FREEDOM + 2.0) / (T_FREEDOM + size**2)
    return u, u * (T_FREEDOM - size**2) / (T_FREEDOM + size**2)


def robust_solve(
    basis: Array, value: ComplexArray, noise: LineNoise, kind: str
) -> tuple[Solution, Array, float, int, int]:
    """Fit all lines robustly.

    Returns
    -------
    Solution
        With the weights at the end; misfit and channel sums with the stated noise.
    ndarray, (p, freq)
        Packed inverse Gram matrices of plain least squares.
    float
        Factor of the variance, see loss.
    int
        Most reweightings of a line.
    int
        Lines that had not settled after 300.
    """
    channels, lines = value.shape
    out = Solution(channels, lines, basis.shape[1])
    plain = np.zeros_like(out.inverse)
    most, unsettled = 0, 0
    sizes: list[Array] = []
    kept = max(1, int(np.ceil(channels * lines / _LOSS_VALUES)))
    taken = 0
    for part in blocks(channels, lines):
        (piece,), top = pieces(value, noise, part)
        start = weighted(basis, [piece], len(top))
        plain[:, part] = start.inverse * (2.0 / top**2)
        fit, weight, turns, left = _reweight(basis, piece, top, start, kind)
        most, unsettled = max(most, turns), unsettled + left
        chosen = np.flatnonzero(fit.good)[::kept]
        size = _sizes(basis, piece.y[:, :, chosen], piece.noise[:, chosen], fit.z[:, :, chosen])
        sizes.append((size * top[chosen])[piece.noise[:, chosen] > 0.0])
        taken += len(chosen)
        add(basis, [Piece(piece.lines, piece.y, weight, piece.used, piece.noise)], top, fit, part, out)
    size = np.concatenate(sizes) if sizes else np.empty(0)
    share = basis.shape[1] * taken / max(size.size, 1)
    factor = loss(size, share, kind) if 0.0 < share < 0.95 else 1.0
    return out, plain, factor, most, unsettled


def _sizes(basis: Array, y: Array, noise: Array, z: Array) -> Array:
    """Return |residual| relative to the noise of the best channel of each line, (channel, n)."""
    r = y - predicted(basis, z)
    return np.asarray(np.sqrt((r[0] ** 2 + r[1] ** 2) * noise))


def _reweight(
    basis: Array, piece: Piece, top: Array, start: Weighted, kind: str
) -> tuple[Weighted, Array, int, int]:
    """Reweight a piece; a line that has settled is left alone.

    Student's t has several optima: it starts from the only one of Huber's function.
    """
    z = start.z.copy()
    if kind == "t4":
        _iterate(basis, piece, top, z, start.good, "huber", _ROUGH)
    turns, left = _iterate(basis, piece, top, z, start.good, kind, TOLERANCE)
    weight = piece.noise * robust_weight(_sizes(basis, piece.y, piece.noise, z) * top, kind)[0]
    end = weighted(basis, [_make_piece(piece.lines, piece.y, weight)], len(top))
    good = end.good & start.good
    inverse = np.where(good, end.inverse, 0.0)
    return Weighted(np.where(good, z, 0.0), end.gram, inverse, good), weight, turns, left


def _make_piece(lines: slice, y: Array, weight: Array) -> Piece:
    return Piece(lines, y, weight, None, weight)


def _iterate(
    basis: Array, piece: Piece, top: Array, z: Array, good: NDArray[np.bool_], kind: str, tolerance: float
) -> tuple[int, int]:
    """Reweight ``z`` (m, 2, n) in place; return the number of turns and the lines not settled."""
    live = np.flatnonzero(good)
    y, noise, peak = piece.y[:, :, live], piece.noise[:, live], top[live]
    for turn in range(1, _MOST + 1):
        if len(live) == 0:
            return turn - 1, 0
        old = z[:, :, live]
        weight = noise * robust_weight(_sizes(basis, y, noise, old) * peak, kind)[0]
        fit = weighted(basis, [_make_piece(slice(0, len(live)), y, weight)], len(live))
        step = fit.z - old
        moved = np.sum(step * symmetric_batches.times(fit.gram, step), axis=(0, 1)) * peak**2
        z[:, :, live] = np.where(fit.good, fit.z, old)
        going = (moved > tolerance**2) & fit.good
        if np.sum(going) < 0.8 * len(live):
            live, y, noise, peak = live[going], y[:, :, going], noise[:, going], peak[going]
    return _MOST, len(live)


def loss(size: Array, share: float, kind: str) -> float:
    """Return the variance of a robust estimate over that of weighted least squares without outliers.

    Parameters
    ----------
    size : ndarray, (n,)
        |residual| / sd of the robust fit.
    share : float
        Coefficients per complex value.

    Notes
    -----
    El Karoui et al. 2013, doi:10.1073/pnas.1307842110: with many coefficients per value the residuals are
    proximal images of the errors; c is the size of that contraction, found from mean(c psi' / (1 + c psi'))
    = share. Here for residuals in the plane, whose psi' differs along and across the residual.
    """
    u, along = robust_weight(size, kind)
    low, high = 0.0, 1e3
    for _ in range(80):
        c = 0.5 * (low + high)
        taken = 0.5 * np.mean(c * along / (1.0 + c * along) + c * u / (1.0 + c * u))
        low, high = (c, high) if taken < share else (low, c)
    return float(c**2 * np.mean((u * size) ** 2) / 2.0 * (1.0 - share) / share**2)
