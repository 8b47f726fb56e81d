"""K about the footplate centre is a square of the height: what first order leaves out of its uncertainty."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.fitting.ligament.inplane_stiffness import InplaneStiffness
from legacy.fitting.ligament.plane_transfer import curvature_of_transfer, slopes_of_transfer
from legacy.fitting.model.parameter_vector import join, split


def inplane_of(rng: np.random.Generator, covariance: np.ndarray) -> InplaneStiffness:
    roots = rng.standard_normal((2, 3, 3))
    return InplaneStiffness(roots[0] @ roots[0].T, roots[1] @ roots[1].T, covariance, True)


def test_a_height_of_zero_adds_the_mean_square_of_its_square() -> None:
    """h^2 k of a normal h of mean zero has the mean sd^2 k and the variance 2 sd^4 k^2."""
    covariance = np.zeros((9, 9))
    covariance[4, 4] = 0.3**2
    inplane = InplaneStiffness(np.diag([0.0, 5.0, 0.0]), np.diag([0.0, 2.0, 0.0]), np.zeros((12, 12)), True)
    wanted = np.zeros((12, 12))
    wanted[3, 3], wanted[9, 9], wanted[3, 9] = 3 * 0.3**4 * 25, 3 * 0.3**4 * 4, 3 * 0.3**4 * 10
    wanted[9, 3] = wanted[3, 9]
    assert curvature_of_transfer(covariance, inplane) == pytest.approx(wanted, abs=1e-15)


def test_first_and_second_order_make_the_mean_square_error_of_draws() -> None:
    rng = np.random.default_rng(5)
    root = 0.3 * rng.standard_normal((9, 9))
    coupling, covariance = rng.standard_normal((3, 3)), root @ root.T
    inplane = inplane_of(rng, np.zeros((12, 12)))
    draws = (coupling.ravel() + rng.standard_normal((400_000, 9)) @ root.T).reshape(-1, 3, 3)
    added = [draws @ part @ draws.swapaxes(1, 2) for part in (inplane.stiffness, inplane.damping)]
    rows, columns = np.triu_indices(3)
    entries = np.concatenate([part[:, rows, columns] for part in added], axis=1)
    slope, _ = slopes_of_transfer(coupling, covariance, inplane)
    found = slope @ covariance @ slope.T + curvature_of_transfer(covariance, inplane)
    exact = [coupling @ part @ coupling.T for part in (inplane.stiffness, inplane.damping)]
    errors = entries - np.concatenate([part[rows, columns] for part in exact])
    drawn = errors.T @ errors / len(errors)
    size = np.sqrt(np.outer(np.diag(found), np.diag(found)))
    assert np.abs(drawn - found).max() < 0.02 * size.max()
    assert np.abs((drawn - found) / size).max() < 0.02


def test_the_mean_answers_to_the_stiffness_in_the_plane_by_height_and_its_variance() -> None:
    rng = np.random.default_rng(6)
    root = rng.standard_normal((9, 9))
    coupling, spread = rng.standard_normal((3, 3)), (root @ root.T).reshape(3, 3, 3, 3)
    _, slope = slopes_of_transfer(coupling, root @ root.T, inplane_of(rng, np.eye(12)))
    entries = rng.standard_normal(12)
    wanted = [
        coupling @ part @ coupling.T + sum(part[a, b] * spread[:, a, :, b] for a, b in np.ndindex(3, 3))
        for part in split(entries, 3)
    ]
    assert slope @ entries == pytest.approx(join(*wanted))
