"""Start rotations of the search: proper, and spread as evenly as the uniform distribution."""

import numpy as np

from legacy.kinematics.registration.icp_search import even_rotations


def test_rotations_are_proper_and_even():
    turns = even_rotations(600)
    assert np.allclose(np.einsum("nij,nkj->nik", turns, turns), np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.det(turns), 1.0)
    # Uniform rotations have E R = 0 and E R_ij^2 = 1/3 (Miles 1965, Biometrika 52:636).
    assert np.abs(turns.mean(axis=0)).max() < 0.02
    assert np.allclose((turns**2).mean(axis=0), 1.0 / 3.0, atol=0.02)


def test_the_nearest_start_comes_closer_with_the_cube_root_of_their_number():
    rng = np.random.default_rng(0)
    quaternions = rng.normal(size=(200, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1)[:, None]
    w, x, y, z = quaternions.T
    wanted = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)

    def mean_angle(count):
        traces = np.einsum("aij,bij->ab", wanted, even_rotations(count)).max(axis=1)
        return np.mean(np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0)))

    assert 0.25 < np.log(mean_angle(100) / mean_angle(1600)) / np.log(16.0) < 0.42
