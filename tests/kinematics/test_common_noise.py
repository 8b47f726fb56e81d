"""Noise of a reference: kept apart where a whole run shares it, else put into the noise of each record."""

from __future__ import annotations

import numpy as np
import pytest

from kinematics.errors import KinematicsError
from kinematics.measurement import from_arrays
from kinematics.points2dof import Options, points2dof
from kinematics.readers.common_noise import with_common_noise
from kinematics.readers.recording import Recording

FREQ = np.array([100.0, 200.0, 300.0])
LINES = np.arange(3)


def recording(common, size=2.0):
    common = None if common is None else np.asarray(common, dtype=float)
    return Recording("1", FREQ, np.full(3, size * 1j), 1, "file", sd=np.full(3, 0.3), common_sd=common)


def test_one_record_keeps_it_apart():
    shared = [0.1, 0.2, 0.0]
    made, common = with_common_noise(
        [recording(shared), recording(shared)], [0, 0], [LINES, LINES], (1, 3), False
    )
    np.testing.assert_array_equal(common, [shared])
    np.testing.assert_array_equal(made[0].sd, 0.3)


@pytest.mark.parametrize("other", [[0.1, 0.2, 0.2], None])
def test_records_made_one_after_the_other_carry_their_own(other):
    pair = [recording([0.2, 0.2, 0.0]), recording(other)]
    made, common = with_common_noise(pair, [0, 0], [LINES, LINES], (1, 3), False)
    assert common is None
    np.testing.assert_allclose(made[0].sd, [0.5, 0.5, 0.3])


def test_runs_are_looked_at_one_by_one_and_repeats_share_nothing():
    pair = [recording([0.2, 0.2, 0.2]), recording([0.1, 0.1, 0.1])]
    made, common = with_common_noise(pair, [0, 1], [LINES, LINES], (2, 3), False)
    np.testing.assert_array_equal(common, [[0.2] * 3, [0.1] * 3])
    made, common = with_common_noise(pair, [0, 1], [LINES, LINES], (2, 3), True)
    assert common is None
    np.testing.assert_allclose(made[0].sd, 0.5)


def test_it_stands_in_the_covariance_of_the_motion():
    """It adds 2 s^2 q q^H to the covariance and joins what --reference-noise says."""
    rng = np.random.default_rng(0)
    points = [str(k // 3) for k in range(12)]
    places = np.repeat(rng.normal(size=(4, 3)), 3, axis=0)
    body = {
        "points": points,
        "positions_mm": places,
        "directions": np.tile(np.eye(3), (4, 1)),
        "value": np.tile(np.eye(3)[1], 4)[:, None] * np.ones(3) * (1.0 + 0.0j),
        "sd": 0.01,
    }
    plain = from_arrays({"stapes": body}, FREQ)
    shared = np.array([[0.3, 0.1, 0.0]])
    with_it = type(plain)(**{**vars(plain), "common_sd": shared})
    one, two = points2dof(plain).motion, points2dof(with_it).motion
    np.testing.assert_allclose(
        two.covariance - one.covariance,
        2.0 * shared[:, None, :, None, None] ** 2 * one.q[..., :, None] * one.q[..., None, :].conj(),
        atol=1e-20,
    )
    both = points2dof(with_it, options=Options(reference_noise=0.4)).motion
    np.testing.assert_allclose(both.common_sd, np.hypot(shared, 0.4))
    with pytest.raises(KinematicsError, match=r"the noise of the reference must be of shape \(1, 3\)"):
        type(plain)(**{**vars(plain), "common_sd": shared[:, :2]})
