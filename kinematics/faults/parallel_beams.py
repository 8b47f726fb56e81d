"""Which beams belong to one laser: those that are nearly parallel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stapeskit.arrays import Array

# Beams within 8 degrees of each other belong to one laser.
_SAME_BEAM = float(np.cos(np.radians(8.0)))


def group_parallel_beams(directions: Array, live: Sequence[int]) -> list[list[int]]:
    """Return the channels in use of each beam direction, of directions (channel, 3)."""
    groups: list[list[int]] = []
    left = np.array(live, dtype=np.intp)
    while len(left):
        near = directions[left] @ directions[left[0]] > _SAME_BEAM
        near[0] = True
        groups.append(left[near].tolist())
        left = left[~near]
    return groups
