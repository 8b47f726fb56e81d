"""The parameter vector: independent entries of symmetric K, then of D, row by row (K11, K12, ..., Dnn)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array
from legacy.stapeskit.spatial import DOF_UNITS


@lru_cache(maxsize=16)
def pairs(n: int) -> tuple[tuple[int, int], ...]:
    """Return the index pairs (row <= column) of the independent entries of a symmetric n x n matrix."""
    return tuple((row, column) for row in range(n) for column in range(row, n))


def entry_names(n: int) -> tuple[str, ...]:
    """Return the parameter names of an n x n model, (n (n + 1),): K11, K12, ..., Dnn."""
    return tuple(f"{letter}{row + 1}{column + 1}" for letter in "KD" for row, column in pairs(n))


@lru_cache(maxsize=16)
def basis(n: int) -> Array:
    """Return the derivative of a symmetric matrix by its independent entries, (n (n + 1) / 2, n, n)."""
    derivative = np.zeros((len(pairs(n)), n, n))
    for place, (row, column) in enumerate(pairs(n)):
        derivative[place, row, column] = derivative[place, column, row] = 1.0
    derivative.setflags(write=False)
    return derivative


@lru_cache(maxsize=16)
def _places(n: int) -> NDArray[np.intp]:
    """Return the place of every entry of an n x n matrix in the vector of its independent entries."""
    filled = np.empty((n, n), dtype=np.intp)
    for place, (row, column) in enumerate(pairs(n)):
        filled[row, column] = filled[column, row] = place
    filled.setflags(write=False)
    return filled


@lru_cache(maxsize=16)
def _upper_indices(n: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns of the independent entries: fits ask for them tens of thousands of times."""
    return np.triu_indices(n)


def vector(matrix: Array) -> Array:
    """Return the independent entries (..., n (n + 1) / 2) of symmetric matrices (..., n, n)."""
    rows, columns = _upper_indices(matrix.shape[-1])
    return matrix[..., rows, columns]


def matrix(entries: Array, n: int) -> Array:
    """Return the symmetric matrix (n, n) of its independent entries."""
    return np.asarray(entries)[_places(n)]


def split(parameters: Array, n: int) -> tuple[Array, Array]:
    """Return K and D (n, n) of a parameter vector (n (n + 1),)."""
    half = n * (n + 1) // 2
    return matrix(parameters[:half], n), matrix(parameters[half : 2 * half], n)


def join(stiffness: Array, damping: Array) -> Array:
    """Return the parameter vector of K and D: the inverse of split."""
    return np.concatenate([vector(stiffness), vector(damping)])


def entry_units(dof: tuple[str, ...]) -> list[list[str]]:
    """Return the unit of every entry of a stiffness matrix: N/m, N or N m/rad by its row and column."""
    table = {
        ("m", "m"): "N/m",
        ("m", "rad"): "N",
        ("rad", "m"): "N",
        ("rad", "rad"): "N m/rad",
    }
    return [[table[DOF_UNITS[row], DOF_UNITS[column]] for column in dof] for row in dof]
