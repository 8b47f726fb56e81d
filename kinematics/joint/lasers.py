"""Which beams belong to one laser head."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array

ONE_LASER_DEG = 8.0
"""Beams of one head that scans a middle ear lie closer than this, heads of a 3D vibrometer farther apart."""
_MOST_HEADS = 6  # parallel groups of beams up to here are heads, however close
_MOST_PAIRED, _CELL_RAD = 1000, 0.04  # more directions than this are first gathered in cells of this width


def laser_numbers(directions: Array) -> NDArray[np.intp]:
    """Number the laser of each channel from 0, in the order of first use.

    Parameters
    ----------
    directions : ndarray, (c, 3)
        Unit vectors, of all bodies together.

    Notes
    -----
    Beams in few exactly parallel groups of at least three are one head a group (heads far away, or reported
    axes). Otherwise beams that are linked by steps below 8 degrees belong together.
    """
    rounded = np.round(directions, 3) + 0.0
    distinct, owner, number = np.unique(rounded, axis=0, return_inverse=True, return_counts=True)
    owner = owner.reshape(-1)
    if len(distinct) > _MOST_HEADS or np.min(number, initial=3) < 3:
        from scipy.sparse.csgraph import connected_components

        if len(distinct) > _MOST_PAIRED:
            cells, cell = np.unique(np.round(distinct / _CELL_RAD), axis=0, return_inverse=True)
            distinct, owner = cells, cell.reshape(-1)[owner]
        distinct = distinct / np.linalg.norm(distinct, axis=1)[:, None]
        near = distinct @ distinct.T > np.cos(np.deg2rad(ONE_LASER_DEG))
        owner = connected_components(near)[1][owner]
    first = list(dict.fromkeys(owner.tolist()))
    return np.array([first.index(label) for label in owner.tolist()], dtype=np.intp)
