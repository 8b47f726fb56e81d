"""Which order of paired points fits best: two, two pairs or a cycle of names exchanged."""

from __future__ import annotations

from itertools import combinations, permutations

import numpy as np

from legacy.stapeskit.alignment.paired_points import kabsch, misfits
from legacy.stapeskit.arrays import Array

Order = tuple[int, ...]
# All orders of up to this many points are tried; of more, those that fit three of the points.
_ALL_ORDERS = 7
_MOST_POINTS = 40
# Orders whose sum of squares is within this of the best cannot be distinguished.
_ALIKE = 6.0


def best_order(a: Array, b: Array, weights: Array) -> tuple[Order, float]:
    """Return the order of the points b that fits the points a, and its weighted sum of squares.

    Parameters
    ----------
    a, b : ndarray, (n, 3)
        mm; point k of a belongs to point order[k] of b.
    weights : ndarray, (n,)

    Notes
    -----
    Of orders that fit alike the one that moves fewest points is returned: symmetric sets of points fit in
    several orders.
    """
    orders = list(dict.fromkeys([tuple(range(len(a))), *_candidates(a, b, weights)]))
    energies = dict(zip(orders, misfits(a, b[np.array(orders)], weights)[0].tolist(), strict=True))
    lowest = min(energies.values())
    alike = [order for order, energy in energies.items() if energy < lowest + _ALIKE]
    order = min(
        alike,
        key=lambda candidate: (sum(k != place for place, k in enumerate(candidate)), energies[candidate]),
    )
    return order, energies[order]


def cycles(order: Order) -> list[tuple[int, ...]]:
    """Return the cycles of an order, points in their place left out."""
    remaining, cycles = set(range(len(order))), []
    while remaining:
        cycle = [min(remaining)]
        remaining.discard(cycle[0])
        while (following := order[cycle[-1]]) in remaining:
            cycle.append(following)
            remaining.discard(following)
        if len(cycle) > 1:
            cycles.append(tuple(cycle))
    return cycles


def _candidates(a: Array, b: Array, weights: Array) -> list[Order]:
    count = len(a)
    if count <= _ALL_ORDERS:
        orders = np.array(list(permutations(range(count))))
        rough = misfits(a, b[orders], weights)[0]
        return [tuple(orders[place].tolist()) for place in np.argsort(rough)[:50]]
    if count > _MOST_POINTS:
        return []
    from scipy.optimize import linear_sum_assignment
    from scipy.spatial.distance import cdist

    corners = list(max(combinations(range(count), 3), key=lambda triple: _area(a[list(triple)])))
    triples = np.array(list(permutations(range(count), 3)))
    rough = misfits(a[corners], b[triples], weights[corners])[0]
    rotations, shifts, _ = kabsch(a[corners], b[triples[np.argsort(rough)[:200]]], weights[corners])
    return [
        tuple(linear_sum_assignment(cdist(a @ rotation.T + shift, b, "sqeuclidean"))[1].tolist())
        for rotation, shift in zip(rotations, shifts, strict=True)
    ]


def _area(corners: Array) -> float:
    return float(np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])))
