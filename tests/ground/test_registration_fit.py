"""The rigid fit: exact, never a reflection, with a covariance and a target error that hold; faults named."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stapeskit.faults import Fault, StapeskitError, collect_faults
from stapeskit.frames import RigidTransform, rotation_from_vector
from stapeskit.registration import Registration, displacement, fit_rigid

MARKS = np.array([[-10.0, 0, -8], [10, 0, -8], [10, 0, 8], [-10, 0, 8], [0, 3, 0], [4, 5, -3]])
POSE = RigidTransform.from_parts(
    rotation_from_vector([0.5, -1.2, 2.0]), [30.0, -400.0, 12.0], "plate", "vibrometer"
)
SEEN = POSE.inverse().points(MARKS)
NAMES = tuple("abcdef")


def fit(seen=SEEN, known=MARKS, sd=None, names=NAMES) -> Registration:
    return fit_rigid(seen, known, sd, to="plate", source="vibrometer", names=names[: len(seen)])


def refused(*arguments) -> Fault:
    with pytest.raises(StapeskitError) as caught:
        fit(*arguments)
    (fault,) = caught.value.faults
    return fault


def text_of(found: Registration) -> str:
    (notice,) = [notice for notice in found.notices if notice.code == "fiducials_inconsistent"]
    return notice.text


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000))
def test_exact_points_give_the_exact_pose(seed):
    rng = np.random.default_rng(seed)
    pose = RigidTransform.from_parts(
        rotation_from_vector(rng.uniform(-1.8, 1.8, 3)), rng.uniform(-300, 300, 3), "plate", "vibrometer"
    )
    found = fit(pose.inverse().points(MARKS), MARKS, rng.uniform(0.01, 0.1, len(MARKS)))
    assert np.allclose(found.transform.matrix, pose.matrix, atol=1e-9)
    assert found.rms_mm < 1e-9
    assert not found.notices


def test_covariance_and_chi2_hold():
    rng = np.random.default_rng(1)
    sd = np.array([0.02, 0.05, 0.05, 0.03, 0.08, 0.04])
    expected = fit(sd=sd)
    errors, distances, chi2 = [], [], []
    for _ in range(1200):
        found = fit(SEEN, MARKS + sd[:, None] * rng.normal(size=MARKS.shape), sd)
        errors.append(displacement(found.transform, POSE))
        distances.append(errors[-1] @ np.linalg.solve(found.covariance_si, errors[-1]))
        chi2.append(found.chi2)
    ratio = np.std(errors, axis=0) / np.sqrt(np.diag(expected.covariance_si))
    assert np.all(np.abs(ratio - 1.0) < 0.08)
    assert np.mean(distances) / 6.0 == pytest.approx(1.0, abs=0.06)
    assert np.mean(chi2) == pytest.approx(12.0, rel=0.05)


def test_the_sd_is_estimated_when_it_is_not_stated():
    rng = np.random.default_rng(2)
    sizes = [fit(SEEN, MARKS + 0.05 * rng.normal(size=MARKS.shape)).sd_mm[0] ** 2 for _ in range(400)]
    assert np.mean(sizes) == pytest.approx(0.05**2, rel=0.05)
    assert np.isnan(fit().chi2)


def fitzpatrick_west(marks, target, sd):
    """TRE of equal isotropic errors: sd^2 (3 / n)(1 + mean over the principal axes of d^2 / f^2)."""
    centred = marks - marks.mean(axis=0)
    axes = np.linalg.svd(centred)[2]

    def square(points, axis):
        return np.sum(points**2, axis=-1) - (points @ axis) ** 2

    off = target - marks.mean(axis=0)
    ratio = sum(square(off, axis) / np.mean(square(centred, axis)) for axis in axes)
    return np.sqrt(3.0 * sd**2 / len(marks) * (1.0 + ratio / 3.0))


@pytest.mark.parametrize("marks", [MARKS[:3], MARKS[:4], MARKS, MARKS * [0.1, 1.0, 1.0]])
def test_target_error_is_that_of_fitzpatrick_and_west(marks):
    target = np.array([3.0, 9.0, -2.0])
    found = fit(POSE.inverse().points(marks), marks, 0.03)
    mine = found.target_registration_error(POSE.inverse().points(target))[0]
    assert mine == pytest.approx(fitzpatrick_west(marks, target, 0.03), rel=1e-9)


def test_displacement_is_what_perturbed_undoes():
    small = np.array([1e-4, -2e-4, 3e-4, 0.01, -0.02, 0.03])
    assert np.allclose(displacement(POSE, POSE.perturbed(small)), small, atol=1e-12)


@pytest.mark.parametrize(("seen", "known", "sd", "thing"), [
    (SEEN[:2], MARKS[:2], None, "a registration"),
    (SEEN, MARKS[:5], None, "a registration"),
    (SEEN * np.nan, MARKS, None, "the coordinates of fiducials"),
    (np.outer(np.arange(4), [1, 2, 3]), MARKS[:4], None, "fiducials"),
    (np.zeros((4, 3)), MARKS[:4], None, "fiducials"),
    (SEEN, MARKS, 0.0, "sd_mm of a fiducial"),
    (SEEN, MARKS, np.nan, "sd_mm of a fiducial"),
    (3.0 * SEEN, MARKS, 0.01, "the fiducials of the vibrometer and plate frames"),
])  # fmt: skip
def test_impossible_fits_are_refused(seen, known, sd, thing):
    assert refused(seen, known, sd).thing == thing


def test_units_are_named():
    for unit, size_mm in {"m": 1e3, "inches": 25.4, "cm": 10.0}.items():
        assert f"vibrometer coordinates seem to be in {unit}" in refused(SEEN / size_mm).next_step
        assert f"plate coordinates seem to be in {unit}" in refused(SEEN * size_mm).next_step
    assert "vibrometer coordinates seem to be in m" in refused(1e-3 * SEEN * [1, 1, -1]).next_step
    assert "seem" not in refused(3.0 * SEEN).next_step


# ---- what is right raises no alarm


@pytest.mark.parametrize("sd", [None, 0.1])
def test_honest_scatter_raises_no_alarm(sd):
    """One alarm in 1000 is expected: at most 4 of 600 with a probability of 0.9996."""
    rng = np.random.default_rng(7)
    alarms = sum(len(fit(SEEN, MARKS + 0.1 * rng.normal(size=MARKS.shape), sd).notices) for _ in range(600))
    assert alarms <= 4


def test_what_marks_cannot_resolve_is_not_reported_without_sd():
    small = MARKS.copy()
    small[2, 0] += 0.04
    assert not fit(SEEN, small).notices


def test_few_or_coplanar_fiducials_are_reported_and_never_reflected():
    assert [n.code for n in fit(SEEN[[0, 1, 4]], MARKS[[0, 1, 4]]).notices] == ["fiducials_coplanar"]
    for signs in ([1, 1, 1], [1, 1, -1]):
        found = fit(SEEN[:4] * signs, MARKS[:4])
        assert found.rms_mm < 1e-9
        assert np.linalg.det(found.transform.rotation) == pytest.approx(1.0)
        assert [notice.code for notice in found.notices] == ["fiducials_coplanar"]


# ---- what is wrong is named


@pytest.mark.parametrize("sd", [0.02, None])
def test_one_mistyped_coordinate_is_named_and_the_covariance_grows(sd):
    right = 0
    for seed in range(60):
        rng = np.random.default_rng([seed, 9])
        known, worst, axis = MARKS.copy(), int(rng.integers(6)), int(rng.integers(3))
        known[worst, axis] += rng.choice([-1.0, 1.0]) * 0.5
        found = fit(SEEN + 0.02 * rng.normal(size=SEEN.shape), known, sd)
        right += f"fiducial {NAMES[worst]} lies " in text_of(found)
        assert sd is None or found.covariance_si[0, 0] > 3.0 * fit(sd=0.02).covariance_si[0, 0]
    assert right >= 57


def test_the_cell_that_is_off_is_named():
    wrong = MARKS.copy()
    wrong[3, 0] += 1.0
    text = text_of(fit(SEEN, wrong, 0.02))
    assert "fiducial d lies 1 mm" in text
    assert "add -1, " in text


@pytest.mark.parametrize("sd", [0.01, None])
def test_a_wrong_scale_is_named(sd):
    assert " 0.9804 times " in text_of(fit(1.02 * SEEN, MARKS, sd))


@pytest.mark.parametrize("count", [6, 11])
@pytest.mark.parametrize("sd", [0.02, None])
def test_exchanged_names_are_refused_by_name(sd, count):
    rng = np.random.default_rng(count)
    known = rng.uniform(-8.0, 8.0, (count, 3))
    seen = POSE.inverse().points(known) + 0.02 * rng.normal(size=known.shape)
    known[[0, 1]] = known[[1, 0]]
    fault = refused(seen, known, sd, tuple("abcdefghijk"))
    assert fault.thing == "the names of the fiducials"
    assert fault.got.startswith("a and b exchanged")


def test_a_misfit_without_a_cause_is_reported_where_no_sd_is_stated():
    """Residuals of 0.4 mm are eight times the accuracy of marks; those of that accuracy are none."""
    rng = np.random.default_rng(6)
    known = rng.uniform(-3.0, 3.0, (11, 3))
    noise = rng.normal(size=known.shape)
    assert "no single cause" in text_of(
        fit(POSE.inverse().points(known) + 0.4 * noise, known, None, "abcdefghijk")
    )
    found = fit(POSE.inverse().points(known) + 0.05 * noise, known, None, tuple("abcdefghijk"))
    assert not [notice for notice in found.notices if notice.code == "fiducials_inconsistent"]


@pytest.mark.parametrize("sd", [0.02, None])
def test_what_no_pose_brings_within_a_millimetre_is_refused(sd):
    rng = np.random.default_rng(2)
    fault = refused(SEEN + 0.02 * rng.normal(size=SEEN.shape), MARKS[[1, 2, 0, 3, 5, 4]], sd)
    assert fault.thing == "the fiducials"
    assert "no single cause" in fault.next_step


@pytest.mark.parametrize("sd", [0.02, None])
@pytest.mark.parametrize("signs", [[1, 1, -1], [-1, 1, 1], [-1, -1, -1]])
def test_mirrored_coordinates_are_refused_where_the_points_show_it(signs, sd):
    fault = refused(SEEN * signs, MARKS, sd)
    assert (fault.thing, fault.expected) == ("the coordinates of the vibrometer frame", "right-handed")
    assert "--mirror" in fault.next_step
    assert "correct fiducial" not in fault.next_step


def test_one_mark_off_the_plane_leaves_two_readings():
    flat = np.vstack([MARKS[:4], [[2.0, 3.0, 1.0]]])
    fault = refused(POSE.inverse().points(flat) * [1, 1, -1], flat, 0.02)
    assert "--mirror" in fault.next_step
    assert "correct fiducial e" in fault.next_step


def test_a_mistyped_coordinate_is_seldom_taken_for_another_cause():
    """A refusal would claim certainty: none in 300 random sets with one coordinate off by 0.3 to 20 mm."""
    rng = np.random.default_rng(11)
    for trial in range(300):
        known = rng.uniform(-9.0, 9.0, (rng.integers(5, 8), 3))
        seen = POSE.inverse().points(known) + 0.02 * rng.normal(size=known.shape)
        place = rng.integers(len(known)), rng.integers(3)
        change = rng.choice([-1.0, 1.0]) * np.exp(rng.uniform(-1.2, 3.0))
        if abs(change + 2.0 * known[place]) > 0.5:  # else it is another sign
            known[place] += change
        faults = []
        with collect_faults(faults):
            fit(seen, known, 0.02 if trial % 2 else None, tuple("abcdefg"))
        assert {fault.thing for fault in faults} <= {"the fiducials"}  # too far off, whatever the cause
