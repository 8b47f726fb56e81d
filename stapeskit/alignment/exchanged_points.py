"""Which order of paired points fits best: two, two pairs or a cycle of names exchanged."""

from __future__ import annotations

from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray

from stapeskit.alignment.paired_points import kabsch
from stapeskit.arrays import Array

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
    count = len(a)
    same = tuple(range(count))
    energies = {same: _energy(a, b, weights, same)}
    for order in _candidates(a, b, weights):
        if order not in energies:
            energies[order] = _energy(a, b, weights, order)
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
        rough = _energies(a, b, weights, orders)
        return [tuple(orders[place].tolist()) for place in np.argsort(rough)[:50]]
    if count > _MOST_POINTS:
        return []
    from scipy.optimize import linear_sum_assignment

    corners = max(combinations(range(count), 3), key=lambda triple: _area(a[list(triple)]))
    triples = np.array(list(permutations(range(count), 3)))
    rough = _energies(a[list(corners)], b, weights[list(corners)], triples)
    candidates = []
    for place in np.argsort(rough)[:200]:
        chosen = triples[place]
        rotation, shift, _ = kabsch(a[list(corners)], b[chosen], weights[list(corners)])
        gaps = np.sum(((a @ rotation.T + shift)[:, None] - b[None]) ** 2, axis=2)
        candidates.append(tuple(linear_sum_assignment(gaps)[1].tolist()))
    return candidates


def _area(corners: Array) -> float:
    return float(np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])))


def _energies(a: Array, b: Array, weights: Array, orders: NDArray[np.int_]) -> Array:
    """Return the sum of squares (k,) of proper rotations for many orders (k, n) at once.

    Notes
    -----
    It is |a|^2 + |b|^2 - 2 (s1 + s2 +- s3) with the singular values of the cross product (Umeyama 1991,
    doi:10.1109/34.88573).
    """
    share = weights / np.sum(weights)
    placed = b[orders]
    a0 = a - share @ a
    b0 = placed - np.einsum("n,knj->kj", share, placed)[:, None]
    cross = np.einsum("n,ni,knj->kij", weights, a0, b0)
    values = np.linalg.svd(cross, compute_uv=False)
    values[:, 2] *= np.where(np.linalg.det(cross) < 0.0, -1.0, 1.0)
    size = np.sum(weights[:, None] * a0**2) + np.einsum("n,knj->k", weights, b0**2)
    return np.asarray(size - 2.0 * np.sum(values, axis=1))


def _energy(a: Array, b: Array, weights: Array, order: Order) -> float:
    placed = b[list(order)]
    rotation, shift, _ = kabsch(a, placed, weights)
    return float(np.sum(weights[:, None] * (a @ rotation.T + shift - placed) ** 2))
