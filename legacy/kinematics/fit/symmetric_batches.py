"""Small symmetric matrices of many lines at once: their entries in rows, the lines along them."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array

# Keeps the root of a pivot of zero from dividing by zero.
_TINY = 1e-300


@cache
def places(size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return row and column (p,) of the packed entries: the lower triangle, p = size (size + 1) / 2."""
    return np.tril_indices(size)


def pack(matrices: Array) -> Array:
    """Return the packed entries (p, ...) of symmetric matrices (..., m, m)."""
    rows, columns = places(matrices.shape[-1])
    return np.moveaxis(matrices[..., rows, columns], -1, 0)


def unpack(packed: Array, size: int) -> Array:
    """Return symmetric matrices (freq, m, m) of packed entries (p, freq)."""
    rows, columns = places(size)
    order = np.empty((size, size), dtype=np.intp)
    order[rows, columns] = order[columns, rows] = np.arange(len(rows))
    return np.ascontiguousarray(packed.T)[:, order.ravel()].reshape(-1, size, size)


def products(left: Array, right: Array | None = None) -> Array:
    """Return the packed products (c, p) whose weighted sums are Gram matrices of the rows (c, m)."""
    rows, columns = places(left.shape[1])
    other = left if right is None else right
    return left[:, rows] * other[:, columns]


def doubled(size: int) -> Array:
    """Return the weight (p,) of each packed entry in a quadratic form: 2 off the diagonal."""
    rows, columns = places(size)
    return np.where(rows == columns, 1.0, 2.0)


def congruence(matrix: Array) -> Array:
    """Return K (q, p) with K @ packed(S) = packed(matrix S matrix^T), for ``matrix`` (n, m)."""
    rows, columns = places(matrix.shape[1])
    high, low = places(matrix.shape[0])
    straight = matrix[high][:, rows] * matrix[low][:, columns]
    crossed = matrix[high][:, columns] * matrix[low][:, rows]
    return np.where(rows == columns, straight, straight + crossed)


def transformed(matrix: Array, packed: Array) -> Array:
    """Return matrix S matrix^T, (freq, n, n), of packed symmetric matrices S, (p, freq)."""
    size = len(matrix)
    rows, columns = places(size)
    order = np.empty((size, size), dtype=np.intp)
    order[rows, columns] = order[columns, rows] = np.arange(len(rows))
    return np.asarray((packed.T @ congruence(matrix)[order.ravel()].T).reshape(-1, size, size))


def inverse(packed: Array, size: int) -> Array:
    """Return the packed inverses (p, freq) of symmetric positive definite matrices.

    Parameters
    ----------
    packed : ndarray, (p, freq)
        Where a matrix is not positive definite the result is large or not finite.
    size : int

    Notes
    -----
    A = L L^T and A^-1 = L^-T L^-1 (Cholesky), each step for all lines at once.
    """
    at = {pair: place for place, pair in enumerate(zip(*(k.tolist() for k in places(size)), strict=True))}
    low = packed.copy()
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for j in range(size):
            pivot = low[at[j, j]]
            for k in range(j):
                pivot -= low[at[j, k]] ** 2
            np.sqrt(np.maximum(pivot, _TINY, out=pivot), out=pivot)
            for i in range(j + 1, size):
                entry = low[at[i, j]]
                for k in range(j):
                    entry -= low[at[i, k]] * low[at[j, k]]
                entry /= pivot
        for j in range(size):
            low[at[j, j]] = 1.0 / low[at[j, j]]
            for i in range(j + 1, size):
                total = low[at[i, j]] * low[at[j, j]]
                for k in range(j + 1, i):
                    total += low[at[i, k]] * low[at[k, j]]
                low[at[i, j]] = -total / low[at[i, i]]
        entries = np.empty_like(low)
        for (i, j), place in at.items():
            total = low[at[i, i]] * low[at[i, j]]
            for k in range(i + 1, size):
                total += low[at[k, i]] * low[at[k, j]]
            entries[place] = total
    return entries


def times(packed: Array, vectors: Array) -> Array:
    """Return the products (m, ..., freq) of packed matrices (p, freq) with vectors (m, ..., freq)."""
    rows, columns = places(len(vectors))
    product = np.zeros_like(vectors)
    for place, (i, j) in enumerate(zip(rows.tolist(), columns.tolist(), strict=True)):
        entry = packed[place]
        product[i] += entry * vectors[j]
        if i != j:
            product[j] += entry * vectors[i]
    return product


def condition(packed: Array, inverses: Array, size: int) -> Array:
    """Return the Frobenius condition numbers (freq,); they bound those of the 2-norm from above."""
    weight = doubled(size)
    with np.errstate(invalid="ignore", over="ignore"):
        numbers = np.sqrt((weight @ packed**2) * (weight @ inverses**2))
    return np.where(np.isfinite(numbers), numbers, np.inf)
