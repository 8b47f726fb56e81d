"""Least squares over K >= 0, D >= 0: the nearest semidefinite matrix in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.fitting.estimators.semidefinite import nearest
from legacy.fitting.model.parameter_vector import join, pairs, split

N = 3
# Squared Frobenius norm of both matrices: entries off the diagonal count twice.
FROBENIUS = np.diag([2.0 if row == column else 4.0 for row, column in pairs(N)] * 2)


def clipped(matrix):
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


@pytest.mark.parametrize("seed", range(3))
def test_the_nearest_matrices_have_the_negative_eigenvalues_cut(seed):
    rng = np.random.default_rng(seed)
    stiffness, damping = ((part + part.T) / 2.0 for part in rng.normal(size=(2, N, N)))
    target = join(stiffness, damping)
    start = join(np.eye(N), np.eye(N))
    found, gap, _ = nearest(FROBENIUS, FROBENIUS @ target, start, N, 1e-10)
    for part, wanted in zip(split(found, N), (stiffness, damping), strict=True):
        assert np.allclose(part, clipped(wanted), atol=1e-4)
    assert 0.0 <= gap < 1e-6


def test_a_target_inside_is_kept():
    target = join(np.diag([1.0, 2.0, 3.0]), np.eye(N))
    found, _, _ = nearest(FROBENIUS, FROBENIUS @ target, join(np.eye(N), np.eye(N)), N, 1e-12)
    assert np.allclose(found, target, atol=1e-5)


def test_a_bound_on_an_entry_holds():
    target = join(np.diag([1.0, 2.0, 3.0]), np.eye(N))
    upper = np.full(len(target), np.inf)
    upper[0] = 0.5
    start = join(0.25 * np.eye(N), 0.25 * np.eye(N))
    found, _, _ = nearest(FROBENIUS, FROBENIUS @ target, start, N, 1e-12, upper=upper)
    assert found[0] == pytest.approx(0.5, abs=1e-5)
    assert np.allclose(found[1:], target[1:], atol=1e-5)
