"""Symmetric matrices as vectors of their independent entries, row by row: K11, K12, ..., Dnn."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array

Indices = NDArray[np.intp]


@cache
def upper(n: int) -> tuple[Indices, Indices]:
    """Return rows and columns of the independent entries of a symmetric n x n matrix."""
    return np.triu_indices(n)


@cache
def _places(n: int) -> Indices:
    square = np.empty((n, n), dtype=np.intp)
    rows, columns = upper(n)
    square[rows, columns] = square[columns, rows] = np.arange(len(rows))
    return square


@cache
def basis(n: int) -> Array:
    """Return the derivative of a symmetric matrix by its independent entries, (n (n + 1) / 2, n, n)."""
    return np.stack([symmetric(row, n) for row in np.eye(n * (n + 1) // 2)])


@cache
def diagonal(n: int) -> list[int]:
    """Return the places of the diagonal among the independent entries."""
    return [int(place) for place in np.diag(_places(n))]


@cache
def diagonals(n: int) -> list[int]:
    """Return the places of the diagonals of K and D among the parameters."""
    return [*diagonal(n), *(n * (n + 1) // 2 + place for place in diagonal(n))]


def symmetric(entries: Array, n: int) -> Array:
    """Return symmetric matrices (..., n, n) of their independent entries (..., n (n + 1) / 2)."""
    return np.asarray(entries)[..., _places(n)]


def vector(matrix: Array) -> Array:
    """Return the independent entries of symmetric matrices: the inverse of `symmetric`."""
    rows, columns = upper(matrix.shape[-1])
    return np.asarray(matrix[..., rows, columns])


def split(parameters: Array, n: int) -> tuple[Array, Array]:
    """Return K and D (..., n, n) of parameter vectors (..., n (n + 1))."""
    half = n * (n + 1) // 2
    return symmetric(parameters[..., :half], n), symmetric(parameters[..., half : 2 * half], n)


def join(stiffness: Array, damping: Array) -> Array:
    """Return the parameter vector of K and D: the inverse of `split`."""
    return np.concatenate([vector(stiffness), vector(damping)], axis=-1)


def names(n: int) -> tuple[str, ...]:
    """Return the parameter names of an n x n model: K11, K12, ..., Dnn."""
    rows, columns = upper(n)
    return tuple(f"{letter}{i + 1}{j + 1}" for letter in "KD" for i, j in zip(rows, columns, strict=True))


def sizes(stiffness: Array, damping: Array) -> Array:
    """Return sqrt(Xii Xjj) of every entry of X = K and D, with which entries of different units compare.

    Infinite where Xii or Xjj is zero, at its bound: nothing is small or large against it.
    """
    roots = [np.sqrt(np.abs(np.diag(part))) for part in (stiffness, damping)]
    products = join(*(np.outer(root, root) for root in roots))
    return np.where(products > 0.0, products, np.inf)
