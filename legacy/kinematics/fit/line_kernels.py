"""One pass of compiled code over the lines; each function returns None where numpy has to do it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.fit import symmetric_batches
from legacy.kinematics.fit.line_noise import LineNoise
from legacy.kinematics.fit.line_sums import Solution
from legacy.kinematics.native import compiled
from legacy.stapeskit.arrays import Array, ComplexArray

# As in the sources: SIZE, WIDE of kernels.h; TILE of shared.c; BLOCK of lines.c.
_SIZE, _WIDE, _TILE, _BLOCK = 6, 8, 16, 32


def _stride(rows: NDArray[Any], itemsize: int) -> int | None:
    """Return the doubles from row to row of an array whose rows are without gaps; None of any other."""
    fits = rows.ndim == 2 and rows.dtype.isnative and rows.flags.aligned and rows.itemsize == itemsize
    if not fits or rows.strides[0] % 8 or (rows.shape[1] > 1 and rows.strides[1] != itemsize):
        return None
    return rows.strides[0] // 8


def _pad_rows(rows: Array) -> Array:
    """Return rows (n, m) with zeros up to what the kernels take."""
    rows_of_six = np.zeros((len(rows), _SIZE))
    rows_of_six[:, : rows.shape[1]] = rows
    return rows_of_six


@dataclass(frozen=True)
class SharedPass:
    """The compiled fit of lines that share a factorisation.

    Attributes
    ----------
    value : ndarray, (channel, freq), complex
    even : ndarray, (freq,)
        line^-2 by line.
    z : ndarray, (6, 2 freq)
        Coefficients by part; filled.
    misfit : ndarray, (2 freq,)
        Filled.
    """

    value: ComplexArray
    even: Array
    z: Array
    misfit: Array

    @classmethod
    def of(cls, value: ComplexArray, line: Array, size: int) -> SharedPass | None:
        """Prepare it for values (channel, freq) and ``line`` (freq,); None where numpy has to do it."""
        if compiled() is None or _stride(value, 16) is None or not 0 < size <= _SIZE:
            return None
        lines = value.shape[1]
        return cls(value, line**-2.0, np.empty((_SIZE, 2 * lines)), np.empty(2 * lines))

    def run(
        self, used: NDArray[np.bool_], project: Array, back: Array, weight: Array, start: int
    ) -> tuple[int, Array]:
        """Fit lines from ``start`` on; return the first that is not done, and sums (channel, 2).

        ``project`` (m, channel), ``back`` (channel, m) and ``weight`` (channel,) are those of
        line_solver.Factor. The channels ``used`` are finite at all lines that are done, and the others
        nowhere. Sums are those of |residual|^2 and of |residual / line|^2.
        """
        kernels, lines = compiled(), self.value.shape[1]
        if kernels is None:
            return start, np.zeros((len(used), 2))
        mine = np.flatnonzero(used)
        rows = np.concatenate([mine, np.flatnonzero(~used)]).astype(np.int64)
        own, room = np.arange(len(mine), dtype=np.int64), np.empty((len(mine), 2 * _TILE))
        sums, forth = np.zeros((len(mine), 2, _WIDE)), _pad_rows(project.T[mine])
        there, weights = _pad_rows(back[mine]), np.ascontiguousarray(weight[mine])
        done = kernels.fit_shared(
            self.value.ctypes.data,
            self.value.strides[0] // 8,
            rows.ctypes.data,
            len(mine),
            len(rows) - len(mine),
            start,
            lines,
            forth.ctypes.data,
            there.ctypes.data,
            weights.ctypes.data,
            sums.ctypes.data,
            self.even.ctypes.data,
            self.z.ctypes.data,
            2 * lines,
            self.misfit.ctypes.data,
            room.ctypes.data,
            own.ctypes.data,
        )
        channel_sums = np.zeros((len(used), 2))
        channel_sums[mine] = sums.sum(axis=2)
        return int(done), channel_sums


def fit_own(
    basis: Array,
    value: ComplexArray,
    noise: LineNoise,
    part: slice,
    out: Solution,
    limits: tuple[float, float],
) -> bool:
    """Fit a run of lines with different weights and add its sums; return False where numpy must do it.

    ``basis`` (channel, m) has orthonormal columns, ``value`` (channel, freq) NaN where missing. Lines whose
    condition is above the second of ``limits`` are left out of the sums and marked as not good; those above
    the first are refined.
    """
    kernels, stride = compiled(), _stride(value, 16)
    stated, size = noise.stated, basis.shape[1]
    if kernels is None or stride is None or not 0 < size <= _SIZE:
        return False
    if (
        stated.dtype != np.float64
        or stated.strides[0] % 8
        or stated.strides[1] % 8
        or not stated.flags.aligned
    ):
        return False
    factor, floor = (
        None if given is None else np.ascontiguousarray(given, dtype=float)
        for given in (noise.factor, noise.floor)
    )
    rows, room = _pad_rows(basis), np.empty((len(value), 3 * _BLOCK))
    pairs = np.ascontiguousarray(symmetric_batches.products(rows))
    sums = np.zeros((len(value), 5, _WIDE))
    kernels.fit_lines(
        value.ctypes.data,
        stride,
        len(value),
        part.start,
        part.stop,
        stated.ctypes.data,
        stated.strides[0] // 8,
        stated.strides[1] // 8,
        None if factor is None else factor.ctypes.data,
        None if floor is None else floor.ctypes.data,
        size,
        rows.ctypes.data,
        pairs.ctypes.data,
        *limits,
        room.ctypes.data,
        sums.ctypes.data,
        out.z.ctypes.data,
        out.inverse.ctypes.data,
        out.misfit.ctypes.data,
        out.explained.ctypes.data,
        out.count.ctypes.data,
        out.good.ctypes.data,
        value.shape[1],
    )
    energy, scaled, lever, weight, used = sums.sum(axis=2).T
    out.energy += energy
    out.scaled += scaled
    out.freedom += 2.0 * (used - lever)
    out.weight += weight
    out.used += used.astype(np.int64)
    return True
