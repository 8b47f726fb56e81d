"""Weighted least squares at many lines: one factorisation where the noise allows it, else one per line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.fit import symmetric_batches
from legacy.kinematics.fit.line_gram import DOUBTFUL, REFINE, SINGULAR, determining, each_line, spans
from legacy.kinematics.fit.line_kernels import SharedPass, fit_own
from legacy.kinematics.fit.line_noise import LineNoise, blocks
from legacy.kinematics.fit.line_sums import Solution
from legacy.stapeskit.arrays import Array, ComplexArray

# Lines that are solved one by one where channels come and go: first few, then twice as many each time.
_FEW, _MANY = 64, 1024


@dataclass(frozen=True)
class Factor:
    """Least squares of one set of channels with fixed relative weights.

    Attributes
    ----------
    used : ndarray, (channel,), bool
    weight : ndarray, (channel,)
        1 / share^2; zero where not used.
    project : ndarray, (m, channel)
        Orthonormal coefficients of the readings.
    back : ndarray, (channel, m)
        Fitted readings per coefficient; zero at channels not used.
    turn : ndarray, (m, m)
        Coefficients in the basis of the beams per orthonormal coefficient.
    leverage : ndarray, (channel,)
    good : bool
        The channels determine the motion.
    """

    used: NDArray[np.bool_]
    weight: Array
    project: Array
    back: Array
    turn: Array
    leverage: Array
    good: bool


def factorised(basis: Array, share: Array, used: NDArray[np.bool_]) -> Factor:
    """Factorise the beams of the channels used, each divided by its share of the noise."""
    size = basis.shape[1]
    plain = np.where(used, 1.0 / share, 0.0)
    u, s, vt = np.linalg.svd(plain[:, None] * basis, full_matrices=False)
    good = len(s) == size and bool(s[-1] ** 2 > SINGULAR * s[0] ** 2)
    root = plain[:, None]
    if not good and (roots := determining(basis, plain)) is not None:
        root, good = roots[:, None], True
        u, s, vt = np.linalg.svd(root * basis, full_matrices=False)
    turn = (vt.T / s) if good else np.zeros((size, size))
    u = u if good else np.zeros((len(basis), size))
    back = np.ascontiguousarray(np.where(used[:, None], basis @ turn, 0.0))
    project = np.ascontiguousarray((u * root).T)
    return Factor(used, plain**2, project, back, turn, np.sum(u**2, axis=1), good)


def solve(basis: Array, value: ComplexArray, noise: LineNoise) -> Solution:
    """Fit all lines.

    Parameters
    ----------
    basis : ndarray, (channel, m)
        Orthonormal columns.
    value : ndarray, (channel, freq), complex
        NaN where missing.
    noise : LineNoise

    Notes
    -----
    Channels whose noise keeps its ratios over frequency share one singular value decomposition per pattern
    of missing channels; every other line has its own Gram matrix of the orthonormal columns. Compiled code
    reads the data once; numpy copies them in pieces that stay in the processor's cache. Residuals live there
    only.
    """
    channels, lines = value.shape
    out = Solution(channels, lines, basis.shape[1])
    common = noise.common()
    if common is None:
        _fit_unequal_weights(basis, value, noise, slice(0, lines), out)
        return out
    one_pass = SharedPass.of(value, common[1], basis.shape[1])
    if one_pass is None:
        _blockwise(basis, value, noise, common, out)
    else:
        _in_one_pass(basis, noise, common, one_pass, out)
    return out


def _fit_unequal_weights(
    basis: Array, value: ComplexArray, noise: LineNoise, part: slice, out: Solution
) -> None:
    """Fit a run of lines with different weights."""
    if fit_own(basis, value, noise, part, out, (REFINE, DOUBTFUL)):
        left = part.start + np.flatnonzero(~out.good[part])
        for run in spans(len(value), len(left)):
            lines = left[run]
            few = Solution(len(value), len(lines), basis.shape[1])
            each_line(basis, value[:, lines], LineNoise(noise.at(lines)), slice(0, len(lines)), few)
            out.take(lines, few)
        return
    runs = [slice(part.start + run.start, part.start + run.stop) for run in spans(len(value), _width(part))]
    room = np.empty(3 * len(value) * max((_width(run) for run in runs), default=0))
    for run in runs:
        each_line(basis, value, noise, run, out, room)


def _width(part: slice) -> int:
    return int(part.stop - part.start)


def _in_one_pass(
    basis: Array, noise: LineNoise, common: tuple[Array, Array], one_pass: SharedPass, out: Solution
) -> None:
    """Fit all lines by compiled code, which stops where other channels are missing than before."""
    value, (share, line) = one_pass.value, common
    channels, lines = value.shape
    everything = np.ones(channels, dtype=bool)
    recent = factorised(basis, share, everything)
    factors = {everything.tobytes(): recent}
    shared = _Shared(line, one_pass.z[: basis.shape[1]], one_pass.misfit, out)
    at, own, width = 0, 0, _FEW
    while at < lines:
        done, sums = one_pass.run(recent.used, recent.project, recent.back, recent.weight, at)
        if recent.good:
            out.energy += sums[:, 0]
            out.scaled += sums[:, 1] * recent.weight
        if done > at:
            _finish(recent, slice(at, done), shared)
        if done == lines:
            return
        width = min(2 * width, _MANY) if own == done else _FEW
        at, stop = done, min(done + width, lines)
        finite = np.isfinite(value[:, at:stop])
        used = finite[:, 0].copy()
        if np.all(finite == used[:, None]) and not np.array_equal(used, recent.used):
            if used.tobytes() not in factors:
                factors[used.tobytes()] = factorised(basis, share, used)
            recent = factors[used.tobytes()]
        else:
            _fit_unequal_weights(basis, value, noise, slice(at, stop), out)
            at = own = stop


def _blockwise(
    basis: Array, value: ComplexArray, noise: LineNoise, common: tuple[Array, Array], out: Solution
) -> None:
    """Fit all lines by linear algebra of blocks."""
    share, line = common
    channels, lines = value.shape
    everything = np.ones(channels, dtype=bool)
    recent = factorised(basis, share, everything)
    factors = {everything.tobytes(): recent}
    parts = list(blocks(channels, lines))
    room = np.empty(2 * channels * max((part.stop - part.start for part in parts), default=0))
    shared = _Shared(line, np.empty((basis.shape[1], 2 * lines)), np.empty(2 * lines), out)
    done: list[tuple[slice, Factor]] = []
    for part in parts:
        y = room[: 2 * channels * (part.stop - part.start)].view(complex).reshape(channels, -1)
        np.copyto(y, value[:, part])
        if not (_fits(y, recent) and _reduce(y, recent, part, shared)):
            np.copyto(y, value[:, part])
            finite = np.isfinite(y)
            used = finite[:, 0].copy()
            if not np.all(finite == used[:, None]):
                each_line(basis, value, noise, part, out)
                continue
            if used.tobytes() not in factors:
                factors[used.tobytes()] = factorised(basis, share, used)
            recent = factors[used.tobytes()]
            y[~used] = 0.0
            _reduce(y, recent, part, shared)
        if done and done[-1][1] is recent and done[-1][0].stop == part.start:
            part = slice(done.pop()[0].start, part.stop)
        done.append((part, recent))
    for part, factor in done:
        _finish(factor, part, shared)


@dataclass(frozen=True)
class _Shared:
    """What the blocks fill: noise per line, coefficients (m, 2 freq) and misfit (2 freq) by part."""

    line: Array
    z: Array
    misfit: Array
    out: Solution


def _fits(y: ComplexArray, factor: Factor) -> bool:
    """Blank the channels that a factorisation leaves out, unless one of them was measured."""
    if np.all(factor.used):
        return True
    if np.any(np.isfinite(y[~factor.used])):
        return False
    y[~factor.used] = 0.0
    return True


def _reduce(y: ComplexArray, factor: Factor, part: slice, shared: _Shared) -> bool:
    """Fit one block, using up ``y``; return False when it holds values that are not finite."""
    from scipy.linalg.blas import dgemm

    r = y.view(float)
    z = factor.project @ r
    dgemm(-1.0, z.T, factor.back.T, 1.0, r.T, overwrite_c=1)
    np.multiply(r, r, out=r)
    misfit = factor.weight @ r
    if not np.all(np.isfinite(misfit)):
        return False
    at = slice(2 * part.start, 2 * part.stop)
    shared.z[:, at], shared.misfit[at] = z, misfit
    if factor.good:
        shared.out.energy += r @ np.ones(r.shape[1])
        shared.out.scaled += (r @ np.repeat(shared.line[part] ** -2.0, 2)) * factor.weight
    return True


def _finish(factor: Factor, part: slice, shared: _Shared) -> None:
    """Store what a run of blocks with one factorisation found."""
    out, line, width = shared.out, shared.line[part], part.stop - part.start
    out.good[part] = factor.good
    out.count[part] = int(np.sum(factor.used))
    if not factor.good:
        return
    z = shared.z[:, 2 * part.start : 2 * part.stop]
    misfit = shared.misfit[2 * part.start : 2 * part.stop]
    out.z[:, part] = (factor.turn @ z).view(complex)
    out.inverse[:, part] = symmetric_batches.pack(factor.turn @ factor.turn.T)[:, None] * (2.0 * line**2)
    out.misfit[part] = (misfit[::2] + misfit[1::2]) / line**2
    size = np.sum(z**2, axis=0)
    out.explained[part] = (size[::2] + size[1::2]) / line**2
    out.freedom += 2.0 * width * np.where(factor.used, 1.0 - factor.leverage, 0.0)
    out.weight += width * factor.weight / np.max(factor.weight)
    out.used += width * factor.used
