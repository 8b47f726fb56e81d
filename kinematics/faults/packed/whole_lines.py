"""Lines without gaps of data that have some elsewhere: their sums and their motion, by compiled code."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.packed.gathering import motion_of
from kinematics.fit.line_kernels import mixed
from kinematics.fit.line_noise import blocks
from kinematics.fit.line_sums import Solution

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Held = NDArray[np.bool_]
Lines = NDArray[np.intp]
# Vectors that compiled mixing takes at a time (SIZE of kernels.h), and values of a block: 2.5 MB.
_COLUMNS = 6
_BLOCK = 160_000


def within(lines: Lines) -> slice | Lines:
    """Return sorted lines (n,) as a slice where they follow one another."""
    if len(lines) and lines[-1] - lines[0] == len(lines) - 1:
        return slice(int(lines[0]), int(lines[-1]) + 1)
    return lines


def mixed_whole(
    value: ComplexArray, live: Held, lines: Lines, gaps: Held, vectors: ComplexArray
) -> ComplexArray:
    """Return the values (channel, n) of lines without gaps times vectors (n, k).

    Parameters
    ----------
    value : ndarray, (channel, line), complex
    live : ndarray, (channel,), bool
        Channels that are used; the others give zero.
    lines : ndarray, (n,), int
    gaps : ndarray, (n,), bool
        Which of them have gaps: they are left out.
    vectors : ndarray, (n, k), complex
    """
    made = np.zeros((len(value), vectors.shape[1]), dtype=complex)
    given = np.where(gaps[:, None], 0.0, vectors)
    for part in blocks(len(value), len(lines), _BLOCK):
        here = within(lines[part])
        block = value[:, here].copy() if isinstance(here, slice) else value[:, here]
        block[:, gaps[part]] = 0.0
        if not np.all(live):
            block[~live] = 0.0
        for start in range(0, given.shape[1], _COLUMNS):
            columns = slice(start, start + _COLUMNS)
            made[:, columns] += mixed(block, given[part, columns])
    return made


def motion_whole(
    back: Array, divisor: ComplexArray, value: ComplexArray, live: Held, lines: Lines
) -> ComplexArray:
    """Return the motion (m, n) of lines whose live channels are all there; of no meaning at others.

    ``back`` (m, channel) are the rows of the solution for values divided by ``divisor`` (channel,).
    """
    given = value[:, within(lines)]
    if np.all(live):
        return motion_of(back, divisor, given)
    return motion_of(back[:, live], divisor[live], given[live])


def measured(
    value: ComplexArray, solution: Solution, common: tuple[Array, Array]
) -> tuple[Held, Array, Array]:
    """Return where values are, and what noise of the form a_c b_f they have.

    Parameters
    ----------
    value : ndarray, (channel, line), complex
    solution : Solution
        Of the fit: how many channels each line has.
    common : tuple of ndarray
        Part of the noise by channel (channel,) and by line (line,).

    Returns
    -------
    ndarray, (channel, line), bool
        Where there is a value.
    ndarray, (channel,)
        Mean variance of the values of each channel; infinite without any.
    ndarray, (line,)
        One over the size of the noise at each line, relative to that; zero without any.
    """
    share, line = common[0] ** 2, common[1] ** 2
    live = solution.used > 0
    whole = solution.good & (solution.count == np.sum(live))
    held = np.broadcast_to(live[:, None], value.shape).copy()
    gaps = np.flatnonzero(~whole)
    own, used = live * np.sum(line[whole]), live * float(np.sum(whole))
    parts = [gaps[part] for part in blocks(len(value), len(gaps))]
    for lines in parts:
        there = np.isfinite(value[:, lines])
        held[:, lines] = there
        own += there @ line[lines]
        used += np.sum(there, axis=1)
    own = np.where(used > 0.0, share * own / np.maximum(used, 1.0), np.inf)
    ratio = share / own
    mean, number = np.full(len(line), np.sum(ratio[live])), np.full(len(line), float(np.sum(live)))
    for lines in parts:
        mean[lines], number[lines] = ratio @ held[:, lines], np.sum(held[:, lines], axis=0)
    mean *= line
    return held, own, np.sqrt(number / np.where(mean > 0.0, mean, np.inf))


__all__ = ["measured", "mixed_whole", "motion_whole", "within"]
