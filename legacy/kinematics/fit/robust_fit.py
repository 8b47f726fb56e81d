"""Huber and Student-t fits at many lines: Newton steps until every line has settled."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.fit import symmetric_batches
from legacy.kinematics.fit.line_gram import Piece, Weighted, add, pieces, predicted, weighted
from legacy.kinematics.fit.line_noise import LineNoise, blocks
from legacy.kinematics.fit.line_sums import Solution
from legacy.stapeskit.arrays import Array, ComplexArray

# For complex residuals; loses 1.8 % of efficiency on Gaussian noise (by integration).
HUBER_TUNING = 2.0
# As --robust t4 of dof2kd.
T_FREEDOM = 4.0
# Relative change of the solution at the end, and of the first round.
TOLERANCE = 1e-6
_ROUGH = 1e-2
# Limit of iterations.
_MOST = 300
# Relative rounding of a sum of some hundred values, 1e4 times that of one, and the least share of the trace
# on the diagonal of second derivatives, so that they can be inverted.
_ROUNDING = 1e-12
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


def robust_cost(size: Array, kind: str) -> Array:
    """Return rho(|e|), whose derivative is u |e|, see `robust_weight`; in sum it is minimal at the fit."""
    if kind == "huber":
        inner = np.minimum(size, HUBER_TUNING)
        return inner * (size - 0.5 * inner)
    return 0.5 * (T_FREEDOM + 2.0) * np.log1p(size**2 / T_FREEDOM)


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
    """Minimize the sum of rho(|e|) at each line, ``z`` (m, 2, n) in place.

    Returns
    -------
    int
        Number of turns.
    int
        Lines not settled.

    Notes
    -----
    Newton's method. A step that does not lower the sum is replaced by one of reweighting, which always does
    (Huber and Ronchetti 2009, Robust Statistics, 7.8); the second derivatives of the next step are then
    mixed with those of reweighting, which are never smaller: half, three quarters and so on of these.
    """
    live = np.flatnonzero(good)
    now = _Lines.of(basis, piece.y[:, :, live], piece.noise[:, live], top[live], z[:, :, live], kind)
    mixed = np.zeros(len(live))
    for turn in range(1, _MOST + 1):
        if len(live) == 0:
            return turn - 1, 0
        step, moved = now.newton_step(basis, mixed, kind)
        new = now.at(basis, now.z + step, kind)
        worse = ~((moved >= 0.0) & (new.cost <= now.cost * (1.0 + _ROUNDING)))
        mixed = np.where(worse, 0.5 * (1.0 + mixed), 0.25 * mixed)
        if np.any(worse):
            step[:, :, worse], moved[worse] = now.part(worse).reweighting_step(basis, kind)
            new = now.at(basis, now.z + step, kind)
        z[:, :, live], now = new.z, new
        going = moved > tolerance**2
        if np.sum(going) < 0.8 * len(live):
            live, mixed, now = live[going], mixed[going], now.part(going)
    return _MOST, len(live)


@dataclass(frozen=True)
class _Lines:
    """Lines on their way.

    Attributes
    ----------
    y : ndarray, (2, channel, n)
    noise : ndarray, (channel, n)
        Relative weights.
    peak : ndarray, (n,)
        1 / sd of the best channel.
    z : ndarray, (m, 2, n)
    residual : ndarray, (2, channel, n)
    size : ndarray, (channel, n)
        |residual| / sd.
    cost : ndarray, (n,)
    """

    y: Array
    noise: Array
    peak: Array
    z: Array
    residual: Array
    size: Array
    cost: Array

    @classmethod
    def of(cls, basis: Array, y: Array, noise: Array, peak: Array, z: Array, kind: str) -> _Lines:
        residual = y - predicted(basis, z)
        size = np.sqrt((residual[0] ** 2 + residual[1] ** 2) * noise) * peak
        return cls(y, noise, peak, z, residual, size, np.sum(robust_cost(size, kind), axis=0))

    def at(self, basis: Array, z: Array, kind: str) -> _Lines:
        return _Lines.of(basis, self.y, self.noise, self.peak, z, kind)

    def part(self, chosen: NDArray[np.bool_]) -> _Lines:
        return _Lines(**{field.name: getattr(self, field.name)[..., chosen] for field in fields(self)})

    def newton_step(self, basis: Array, mixed: Array, kind: str) -> tuple[Array, Array]:
        """Return the step (m, 2, n) and its square in units of sd, (n,).

        Along its residual e a value has the weight ``along`` of `robust_weight`, across it u:
        u I + (along - u) e e^T / |e|^2 is a symmetric matrix of the real and the imaginary part.
        """
        m, count = len(self.z), len(self.peak)
        u, along = robust_weight(self.size, kind)
        weight = self.noise * u
        square = self.residual[0] ** 2 + self.residual[1] ** 2
        bent = self.noise * (along - u) * (1.0 - mixed) / np.where(square > 0.0, square, 1.0)
        rows = np.ascontiguousarray(symmetric_batches.products(basis).T)
        second = np.empty((count, 2, m, 2, m))
        for (i, j), straight in zip(((0, 0), (0, 1), (1, 1)), (weight, 0.0, weight), strict=True):
            gram = rows @ (straight + bent * self.residual[i] * self.residual[j])
            second[:, i, :, j] = second[:, j, :, i] = symmetric_batches.unpack(gram, m)
        matrix = second.reshape(count, 2 * m, 2 * m)
        trace = np.trace(matrix, axis1=1, axis2=2)
        matrix += (_ROUNDING * np.where(trace > 0.0, trace, 1.0))[:, None, None] * np.eye(2 * m)
        slope = np.stack([basis.T @ (weight * part) for part in self.residual]).transpose(2, 0, 1)
        step = np.linalg.solve(matrix, slope.reshape(count, 2 * m, 1)).reshape(slope.shape)
        return step.transpose(2, 1, 0), np.sum(step * slope, axis=(1, 2)) * self.peak**2

    def reweighting_step(self, basis: Array, kind: str) -> tuple[Array, Array]:
        """Return the step (m, 2, n) of one reweighting and its square in units of sd; 0 without solution."""
        weight = self.noise * robust_weight(self.size, kind)[0]
        count = len(self.peak)
        fit = weighted(basis, [_make_piece(slice(0, count), self.y, weight)], count)
        step = np.where(fit.good, fit.z - self.z, 0.0)
        square = np.sum(step * symmetric_batches.times(fit.gram, step), axis=(0, 1))
        return step, square * self.peak**2


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
