"""Noise of a reference: kept apart where a whole run shares it, else put into the noise of each record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.kinematics.faults.diagnose import diagnose
from legacy.kinematics.fit.body_noise import fit_with_noise
from legacy.kinematics.fit.reference_noise import bound_record_noise
from legacy.kinematics.fit_options import Options
from legacy.kinematics.measurement import RecordNoise, from_arrays
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.readers.common_noise import noise_of_records, with_common_noise
from legacy.kinematics.readers.recording import Recording
from legacy.stapeskit.faults import Place, StapeskitError
from legacy.stapeskit.records.motion_files import standard_deviation
from legacy.stapeskit.spatial import point_rows
from tests.kinematics.simulated import body, measurement, readings, scene

FREQ = np.array([100.0, 200.0, 300.0])
LINES = np.arange(3)


def recording(common, size=2.0):
    common = None if common is None else np.asarray(common, dtype=float)
    return Recording("1", FREQ, np.full(3, size * 1j), 1, Place("file"), sd=np.full(3, 0.3), common_sd=common)


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
    with pytest.raises(StapeskitError, match=r"the noise of the reference must be of shape \(1, 3\)"):
        type(plain)(**{**vars(plain), "common_sd": shared[:, :2]})


def scanned(seed, moving=range(6)):
    """Return points read one after the other with a noisy reference, and their true motion."""
    made = scene(1, lines=80, count=6)
    made.q[:, [k for k in range(6) if k not in moving]] *= 0.01
    rng = np.random.default_rng([seed, 6])
    clean = readings(made.positions_mm, made.directions, made.q)
    share = 0.04
    factor = 1.0 + share * np.repeat(rng.normal(size=(6, 80, 2)) @ [1.0, 1j], 3, axis=0)
    own = 0.005 * np.sqrt(np.mean(np.abs(clean) ** 2))
    read = clean * factor + own * (rng.normal(size=(*clean.shape, 2)) @ [1.0, 1j])
    held = replace(
        body("stapes", made), displacement=read[None], sd=np.hypot(own, share * np.abs(read))[None]
    )
    records = tuple(RecordNoise(0, (("stapes", str(k + 1)),), np.full(80, share)) for k in range(6))
    return replace(measurement(held, freq_hz=made.freq_hz), record_noise=records), made.q


def test_points_scanned_with_a_noisy_reference_state_their_motion_honestly():
    scores, plain, found, blamed = [], [], 0, 0
    for seed in range(14):
        measured, q = scanned(seed)
        made = points2dof(measured)
        error = np.abs(made.motion.q[0, 0] - q) ** 2
        scores.append(np.mean(error / (2.0 * standard_deviation(made.motion)[0, 0] ** 2), axis=0))
        found += bool(made.diagnoses[0, 0].findings)
        if seed % 2:  # a few show what taking the noise for that of channels does
            continue
        alone = points2dof(replace(measured, record_noise=()))
        plain.append(np.mean(error / (2.0 * standard_deviation(alone.motion)[0, 0] ** 2), axis=0))
        blamed += bool(alone.diagnoses[0, 0].findings)
    assert np.all(np.abs(np.mean(scores, axis=0) - 1.0) < 0.15)
    assert np.max(np.abs(np.mean(plain, axis=0) - 1.0)) > 0.4
    assert found <= 1 < blamed


def searched_usually(measured):
    """Return the findings of a search that takes the noise of a point's beams for bounded, not for common."""
    one = measured.bodies[0]
    basis = np.linalg.qr(point_rows(one.positions_mm * 1e-3, one.directions))[0]
    fit = points2dof(measured).fits[0, 0]
    bounded = bound_record_noise(measured, 0, one, basis)[0]
    return diagnose(measured, one, fit_with_noise(measured, 0, bounded, fit.beams, "none")[0], True).findings


def test_noise_of_records_is_no_fault_where_motion_is_little_but_noise():
    """Beams of a point seem to turn with the noise that they share along motions that are not excited."""
    assert searched_usually(scanned(1, moving=(1,))[0])
    for seed in range(10):
        assert not points2dof(scanned(seed, moving=(1,))[0]).diagnoses[0, 0].findings


@pytest.mark.parametrize("factor", [-1.0, 1.3])
def test_a_fault_beside_noise_of_records_is_found_in_its_channel(factor):
    for seed in (1, 3):
        measured, _ = scanned(seed, moving=(1,))
        measured.bodies[0].displacement[:, 7] *= factor
        (finding,) = points2dof(measured).diagnoses[0, 0].findings
        assert finding.channels == [7]


def test_records_of_several_points_are_told_from_one_record_of_all():
    one = [replace(recording([0.2, 0.1, 0.0]), body="stapes", point=name) for name in ("1", "1", "2")]
    other = [replace(recording([0.3, 0.1, 0.0]), body="stapes", point="3") for _ in range(2)]
    flat, take = [*one, *other], [0] * 5
    found = noise_of_records(flat, take, [LINES] * 5, (1, 3))
    assert [part.points for part in found] == [(("stapes", "1"), ("stapes", "2")), (("stapes", "3"),)]
    np.testing.assert_array_equal(found[1].sd, [0.3, 0.1, 0.0])
    assert noise_of_records(one, [0] * 3, [LINES] * 3, (1, 3)) == ()
    mixed = [*one, replace(recording([0.3, 0.1, 0.0]), body="stapes", point="1"), *other]
    assert [part.points for part in noise_of_records(mixed, [0] * 6, [LINES] * 6, (1, 3))] == [
        (("stapes", "2"),),
        (("stapes", "3"),),
    ]
