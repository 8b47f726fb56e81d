"""Weighted least squares at lines with different weights: one Gram matrix per line, solved together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.fit import symmetric_batches
from legacy.kinematics.fit.line_noise import LineNoise, blocks
from legacy.kinematics.fit.line_sums import Solution
from legacy.stapeskit.arrays import Array, ComplexArray

# Ratio of the smallest to the largest eigenvalue below which a line has no solution.
SINGULAR = 1e-9
# Condition numbers of the Gram matrix above which a line is solved by singular values, is refined by one
# step, and is given up.
DOUBTFUL = 1e7
REFINE = 1e2
_HOPELESS = 1e15
# Largest ratio of weights that rounding allows.
_EXACT = 1e6
# Sizes from which on lines are solved together by their normal equations.
_LINES = 1024
_VALUES = 1_000_000


@dataclass
class Piece:
    """Some lines of the data, as large as stays in the processor's cache.

    Attributes
    ----------
    lines : slice
        Within the lines solved together.
    y : ndarray, (2, channel, n)
        Real and imaginary parts; zero where not used.
    weight : ndarray, (channel, n)
        Relative weights of the fit; zero where not used.
    used : ndarray, (channel, n), bool, or None
        Where a value is used; None: everywhere.
    noise : ndarray, (channel, n)
        Relative weights by the noise alone.
    """

    lines: slice
    y: Array
    weight: Array
    used: NDArray[np.bool_] | None
    noise: Array


@dataclass(frozen=True)
class Weighted:
    """Coefficients z (m, 2, n), packed Gram matrices and their inverses (p, n), and determined lines (n,)."""

    z: Array
    gram: Array
    inverse: Array
    good: NDArray[np.bool_]


def spans(channels: int, lines: int) -> Iterator[slice]:
    """Yield runs of whole blocks that are solved together."""
    together: list[slice] = []
    for part in blocks(channels, lines):
        together.append(part)
        count = part.stop - together[0].start
        if count >= _LINES or count * channels >= _VALUES:
            yield slice(together[0].start, part.stop)
            together = []
    if together:
        yield slice(together[0].start, together[-1].stop)


def pieces(
    value: ComplexArray, noise: LineNoise, part: slice, room: Array | None = None
) -> tuple[list[Piece], Array]:
    """Cut lines into pieces; return them with 1 / sd of the best channel of each line, (n,).

    The weights are relative to that channel. ``room`` of 3 numbers per value is used for the pieces.
    """
    parts, best = [], np.ones(part.stop - part.start)
    room = np.empty(3 * len(value) * len(best)) if room is None else room
    for lines in blocks(len(value), part.stop - part.start):
        block = value[:, part][:, lines]
        mine = room[3 * len(value) * lines.start : 3 * len(value) * lines.stop].reshape(3, *block.shape)
        y, root = mine[:2], mine[2]
        y[0], y[1] = block.real, block.imag
        np.divide(1.0, noise.at(slice(part.start + lines.start, part.start + lines.stop)), out=root)
        top, used = np.max(root, axis=0), None
        flat = y.reshape(-1)
        if not (np.isfinite(flat @ flat) and np.isfinite(np.sum(top)) and np.min(root) > 0.0):
            used = np.isfinite(y[0]) & np.isfinite(y[1]) & np.isfinite(root) & (root > 0.0)
            missing = ~used
            for part_of in mine:
                np.copyto(part_of, 0.0, where=missing)
            top = np.max(root, axis=0)
            top[top <= 0.0] = 1.0
        root *= 1.0 / top
        np.multiply(root, root, out=root)
        best[lines] = top
        parts.append(Piece(lines, y, root, used, root))
    return parts, best


def each_line(
    basis: Array,
    value: ComplexArray,
    noise: LineNoise,
    part: slice,
    out: Solution,
    room: Array | None = None,
) -> None:
    """Fit a run of lines with different weights and add its sums."""
    cut, top = pieces(value, noise, part, room)
    add(basis, cut, top, weighted(basis, cut, len(top)), part, out)


def weighted(basis: Array, cut: Sequence[Piece], count: int) -> Weighted:
    """Solve the ``count`` lines of some pieces.

    Notes
    -----
    The basis (channel, m) has orthonormal columns, so that the Gram matrices are as well conditioned as the
    weights allow. One step of refinement restores the digits of a condition number above 1e2; lines above
    1e7 are solved again by singular values, and are not determined when those of the Gram matrix differ by
    more than 1e9.
    """
    size = basis.shape[1]
    gram, right = np.empty((size * (size + 1) // 2, count)), np.empty((size, 2, count))
    rows = np.ascontiguousarray(symmetric_batches.products(basis).T)
    room = np.empty(max(piece.y.size for piece in cut))
    for piece in cut:
        gram[:, piece.lines] = rows @ piece.weight
        weighed = room[: piece.y.size].reshape(piece.y.shape)
        right[:, :, piece.lines] = _right_sides(basis, np.multiply(piece.y, piece.weight, out=weighed))
    inverse = symmetric_batches.inverse(gram, size)
    condition = symmetric_batches.condition(gram, inverse, size)
    inverse[:, ~(condition < _HOPELESS)] = 0.0
    z = symmetric_batches.times(inverse, right)
    good = condition < DOUBTFUL
    if np.any((condition > REFINE) & good):
        for piece in cut:
            left = (piece.y - predicted(basis, z[:, :, piece.lines])) * piece.weight
            right[:, :, piece.lines] = _right_sides(basis, left)
        z += symmetric_batches.times(inverse, right)
    if not np.all(good):
        for piece in cut:
            for line in np.flatnonzero(~good[piece.lines]):
                at = piece.lines.start + int(line)
                good[at] = _one_line(basis, piece, int(line), z[:, :, at], inverse[:, at])
        z[:, :, ~good] = 0.0
        inverse[:, ~good] = 0.0
    return Weighted(z, gram, inverse, good)


def _right_sides(basis: Array, weighed: Array) -> Array:
    """Return the right sides (m, 2, n) of weighed readings (2, channel, n)."""
    return np.stack([basis.T @ weighed[0], basis.T @ weighed[1]], axis=1)


def predicted(basis: Array, z: Array) -> Array:
    """Return the fitted readings (2, channel, n) of coefficients (m, 2, n)."""
    return np.stack([basis @ np.ascontiguousarray(z[:, 0]), basis @ np.ascontiguousarray(z[:, 1])])


def determining(basis: Array, root: Array) -> Array | None:
    """Return roots of weights (channel,) whose range can be solved; None when the channels lack rank.

    Parameters
    ----------
    basis : ndarray, (channel, m)
    root : ndarray, (channel,)
        One over the standard deviations; zero at channels that are not used.

    Notes
    -----
    The most precise channels that together determine the motion are chosen first. A channel that is a million
    times as precise as the least precise of these constrains the motion as an exact one would: its weight is
    limited to that ratio, which rounding allows.
    """
    size = basis.shape[1]
    order = np.argsort(-root, kind="stable")
    order = order[root[order] > 0.0]
    low, high = size, len(order)
    if high < size or not _spans(basis[order]):
        return None
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if _spans(basis[order[:middle]]) else (middle + 1, high)
    return np.minimum(root, _EXACT * root[order[low - 1]])


def _spans(rows: Array) -> bool:
    s = np.linalg.svd(rows, compute_uv=False)
    return bool(s[-1] ** 2 > SINGULAR * s[0] ** 2)


def _one_line(basis: Array, piece: Piece, line: int, z: Array, inverse: Array) -> bool:
    """Solve one line by singular values, in place; return whether it is determined."""
    factor = determining(basis, np.sqrt(piece.weight[:, line]))
    if factor is None:
        return False
    root = factor[:, None]
    u, s, vt = np.linalg.svd(root * basis, full_matrices=False)
    turn = vt.T / s
    z[:] = turn @ (u.T @ (root * piece.y[:, :, line].T))
    inverse[:] = symmetric_batches.pack(turn @ turn.T)
    return True


def add(basis: Array, cut: Sequence[Piece], top: Array, fit: Weighted, part: slice, out: Solution) -> None:
    """Store the fit of a run of lines and add its residual sums, counted with the weights of the noise."""
    size, channels = basis.shape[1], len(basis)
    out.good[part] = fit.good
    out.z[:, part] = fit.z[:, 0] + 1j * fit.z[:, 1]
    out.inverse[:, part] = fit.inverse * (2.0 / top**2)
    out.explained[part] = np.sum(fit.z * symmetric_batches.times(fit.gram, fit.z), axis=(0, 1)) * top**2
    misfit, count = np.empty(len(top)), np.full(len(top), channels)
    lever = np.zeros((channels, len(fit.inverse)))
    room = np.empty((2, max(piece.noise.size for piece in cut)))
    for piece in cut:
        at, plain = piece.lines, piece.noise
        live = fit.good[at].astype(float)
        square, other = room[:, : plain.size].reshape(2, *plain.shape)
        for half, r in enumerate((square, other)):
            np.matmul(basis, np.ascontiguousarray(fit.z[:, half, at]), out=r)
            np.subtract(piece.y[half], r, out=r)
            np.multiply(r, r, out=r)
        square += other
        number: Array = np.full(channels, live.sum())
        if piece.used is not None:
            np.copyto(square, 0.0, where=~piece.used)
            number = piece.used @ live
            count[at] = piece.used.sum(axis=0)
        if not np.all(fit.good[at]):
            square *= live
        out.energy += square @ np.ones(len(live))
        square *= plain
        misfit[at] = np.ones(channels) @ square
        out.scaled += square @ top[at] ** 2
        lever += piece.weight @ fit.inverse[:, at].T
        if piece.weight is not plain:
            peak = np.max(piece.weight, axis=0)
            live = live / np.where(peak > 0.0, peak, 1.0)
        out.weight += piece.weight @ live
        out.used += number.astype(np.int64)
        out.freedom += 2.0 * number
    out.freedom -= 2.0 * np.sum(
        symmetric_batches.products(basis) * symmetric_batches.doubled(size) * lever, axis=1
    )
    out.misfit[part] = misfit * top**2
    out.count[part] = count
