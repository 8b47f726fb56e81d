"""Which beams belong to one laser, and how the noise of lasers differs where nobody states it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array

Index = NDArray[np.intp]
# Beams closer than this belong to one laser: heads of a 3D vibrometer stand farther apart.
_ONE_LASER_DEG = 8.0
# Directions are compared in pairs: more of them than this are gathered in cells of this width (rad) before.
_MOST_PAIRED, _CELL = 1000, 0.04
# Probability that lasers of equal noise are called different.
_CHANCE = 1e-3


def group_lasers(directions: Sequence[Array]) -> tuple[tuple[Index, ...], Array]:
    """Group beams into lasers: neighbours within 8 degrees belong together.

    Parameters
    ----------
    directions : sequence of ndarray, (channel, 3)
        By body.

    Returns
    -------
    lasers : tuple of ndarray
        By body: the laser (from 0) of each channel.
    means : ndarray, (laser, 3)
        Mean direction of each laser.
    """
    every = np.concatenate(directions)
    distinct, owner = np.unique(np.round(every, 9), axis=0, return_inverse=True)
    owner = owner.reshape(-1)
    if len(distinct) > _MOST_PAIRED:
        cells, cell = np.unique(np.round(distinct / _CELL), axis=0, return_inverse=True)
        distinct, owner = cells / np.linalg.norm(cells, axis=1)[:, None], cell.reshape(-1)[owner]
    group = np.arange(len(distinct))
    near = distinct @ distinct.T > np.cos(np.deg2rad(_ONE_LASER_DEG))
    for _ in range(len(distinct)):
        lowest = np.array([np.min(group[near[row]]) for row in range(len(distinct))])
        if np.array_equal(lowest, group):
            break
        group = lowest
    labels = group[owner]
    first = list(dict.fromkeys(labels.tolist()))
    numbers = np.array([first.index(label) for label in labels.tolist()])
    means = np.stack([every[numbers == k].mean(axis=0) for k in range(len(first))])
    means /= np.linalg.norm(means, axis=1)[:, None]
    ends = np.cumsum([len(part) for part in directions])[:-1]
    return tuple(np.split(numbers, ends)), means


def laser_channels(directions: Array, live: Sequence[int]) -> list[list[int]]:
    """Return the channels in use of each laser, of directions (channel, 3) of one body."""
    used = np.array(live, dtype=np.intp)
    if not len(used):
        return []
    (laser,), means = group_lasers([directions[used]])
    return [used[laser == k].tolist() for k in range(len(means))]


def noise_shares(laser: Index, energy: Array) -> Array | None:
    """Return the noise of each channel's laser over their mean, (channel,); None when lasers look alike.

    Parameters
    ----------
    laser : ndarray, (channel,)
        As of group_lasers.
    energy : ndarray, (channel,)
        Residual energy of each channel over that of equal noise, corrected for leverage; NaN where unknown.

    Notes
    -----
    Channels of one laser differ too. The logarithms of their energies are compared between the lasers by
    Fisher's analysis of variance, so that lasers must differ by more than the channels of one laser do.
    A vibrometer that reports x, y and z instead of its beams is the case in mind: its beams lie within some
    20 degrees of z, so that x and y are several times as noisy as z.
    """
    from scipy.stats import f as fisher

    known = np.isfinite(energy) & (energy > 0.0)
    logs = np.log(energy, where=known, out=np.zeros(len(energy)))
    names, group = np.unique(laser, return_inverse=True)
    number = np.bincount(group[known], minlength=len(names))
    within = int(np.sum(number)) - len(names)
    if len(names) < 2 or np.any(number == 0) or within < 1:
        return None
    mean = np.bincount(group[known], logs[known], minlength=len(names)) / number
    scatter = float(np.sum((logs[known] - mean[group[known]]) ** 2)) / within
    whole = float(np.average(mean, weights=number))
    between = float(np.sum(number * (mean - whole) ** 2)) / (len(names) - 1)
    if fisher.sf(between / max(scatter, np.finfo(float).tiny), len(names) - 1, within) > _CHANCE:
        return None
    return np.asarray(np.exp(0.5 * (mean - whole))[group])
