"""Meshes as graphs: connected pieces, positive definite systems, convex hulls."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.native import checked, compiled
from legacy.stapeskit.arrays import Array

Indices = NDArray[np.int64]
# Residual at which conjugate gradients stop, relative to the right-hand side: near rounding, as
# the direct solver is that stands in for them. Most steps: a guard, for steps without progress end it before.
_ACCURACY = 1e-14
_ROUNDS = 2000


def graph_pieces(count: int, edges: NDArray[np.integer]) -> tuple[int, Indices]:
    """Return how many pieces ``count`` nodes joined by edges (m, 2) form, and which (n,) each is in."""
    kernels = compiled()
    if kernels is None:
        from scipy.sparse import csr_matrix
        from scipy.sparse.csgraph import connected_components

        pairs = edges.astype(np.int32)
        ones = np.ones(len(pairs), dtype=np.int8)
        graph = csr_matrix((ones, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
        number, piece = connected_components(graph, directed=False)
        return int(number), piece.astype(np.int64)
    pairs = np.ascontiguousarray(edges, dtype=np.int64)
    piece = np.empty(count, dtype=np.int64)
    number = kernels.graph_pieces(count, pairs.ctypes.data, len(pairs), piece.ctypes.data)
    return int(number), piece


def solver(
    rows: NDArray[np.integer], columns: NDArray[np.integer], values: Array, diagonal: Array
) -> Callable[[Array], Array]:
    """Return what solves A x = b for b (n, k).

    Parameters
    ----------
    rows, columns, values : ndarray, (m,)
        Entries of A; those at one place add up.
    diagonal : ndarray, (n,)
        Added to them. A is symmetric and positive definite.
    """
    kernels, n = compiled(), len(diagonal)
    if kernels is None:
        from scipy.sparse import csc_matrix
        from scipy.sparse.linalg import splu

        place = np.arange(n)
        entries = np.concatenate([values, diagonal])
        where = np.concatenate([rows, place]), np.concatenate([columns, place])
        factors = splu(
            csc_matrix((entries, where), shape=(n, n)),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        return lambda b: np.asarray(factors.solve(b))
    row, col = (np.ascontiguousarray(part, dtype=np.int64) for part in (rows, columns))
    entries, middle = (np.ascontiguousarray(part, dtype=float) for part in (values, diagonal))
    start = np.empty(n + 1, dtype=np.int64)
    column, data = np.empty(n + len(rows), dtype=np.int32), np.empty(n + len(rows))
    checked(
        kernels.assembled(
            *(n, len(row), row.ctypes.data, col.ctypes.data, entries.ctypes.data),
            *(middle.ctypes.data, start.ctypes.data, column.ctypes.data, data.ctypes.data),
        )
    )

    def solve(b: Array) -> Array:
        given = np.ascontiguousarray(b, dtype=float)
        x = np.empty_like(given)
        wide = given.size // n
        checked(
            kernels.solved(
                *(n, start.ctypes.data, column.ctypes.data, data.ctypes.data, wide),
                *(given.ctypes.data, _ACCURACY, _ROUNDS, x.ctypes.data),
            )
        )
        return x

    return solve


def in_hull(points: Indices, asked: Indices) -> NDArray[np.bool_]:
    """Return which points (m, 3) are in the convex hull of points (n, 3) that span a body; integers >= 0."""
    kernels = compiled()
    if kernels is None or max(points.max(), asked.max()) > 511:
        from scipy.spatial import ConvexHull

        inside = np.ones(len(asked), dtype=bool)
        for *normal, offset in ConvexHull(points).equations:
            inside &= asked @ np.array(normal) + offset <= 0.02
        return inside
    points = np.ascontiguousarray(points, dtype=np.int64)
    asked = np.ascontiguousarray(asked, dtype=np.int64)
    inside = np.empty(len(asked), dtype=bool)
    checked(
        kernels.in_hull(points.ctypes.data, len(points), asked.ctypes.data, len(asked), inside.ctypes.data)
    )
    return inside
