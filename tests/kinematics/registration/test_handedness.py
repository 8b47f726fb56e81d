"""Positions and beams of which only one is mirrored."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.fault_scenes import scene as drawn
from benchmarks.points_faults import judged as run
from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.measurement import Measurement
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.registration.placement import Placement
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.frames import RigidTransform, rotation_from_vector
from tests.kinematics.simulated import FAULTS, body, scene

POSE = RigidTransform.from_parts(
    rotation_from_vector([0.3, -0.5, 0.2]), [1.0, 2.0, 3.0], "footplate", "vibrometer"
)


def measured(seed, fault="", sd=True, **more):
    made = scene(seed, fault, lines=60, **more)
    data = Measurement("footplate", ("1",), made.freq_hz, (body("stapes", made, sd=sd),), 0)
    return data.mapped(replace_frame(POSE.inverse()))


def replace_frame(pose):
    return RigidTransform(pose.matrix, "vibrometer", "footplate")


@pytest.mark.parametrize("axis", ["x", "y", "z"])
@pytest.mark.parametrize("sd", [True, False])
def test_mirrored_positions_are_refused_with_their_axis(axis, sd):
    data = measured(3, sd=sd).mirrored(axis, points_only=True)
    with pytest.raises(
        StapeskitError, match=rf"only when their {axis} is turned round.*--mirror-points {axis}"
    ):
        points2dof(data, Placement(POSE))
    points2dof(data.mirrored(axis, points_only=True), Placement(POSE))


def test_mirrored_beams_are_refused_and_cured_by_both_options():
    data = measured(4).mirrored("z").mirrored("z", points_only=True)
    with pytest.raises(StapeskitError, match=r"--mirror-points z.*with --mirror z too when it is the dir"):
        points2dof(data, Placement(POSE))
    q = points2dof(data.mirrored("z").mirrored("z", points_only=True), Placement(POSE)).motion.q
    assert np.allclose(q, points2dof(measured(4), Placement(POSE)).motion.q, rtol=1e-9)


def test_when_both_are_mirrored_no_residual_shows_it():
    chi2 = points2dof(measured(5), Placement(POSE)).motion.chi2
    both = points2dof(measured(5).mirrored("y"), Placement(POSE)).motion.chi2
    assert np.sum(both) == pytest.approx(np.sum(chi2), rel=1e-6)


@pytest.mark.parametrize(("one", "two"), [(0, 1), (1, 2), (0, 2)])
def test_exchanged_columns_of_the_positions_are_named(one, two):
    data = measured(4)
    body = data.bodies[0]
    order = [0, 1, 2]
    order[one], order[two] = two, one
    wrong = replace(data, bodies=(replace(body, positions_mm=body.positions_mm[:, order]),))
    with pytest.raises(KinematicsError) as caught:
        points2dof(wrong, Placement(POSE))
    (fault,) = caught.value.faults
    assert f"{'xyz'[one]} and {'xyz'[two]} are exchanged" in str(fault.got)


@pytest.mark.parametrize("fault", ["", *FAULTS])
def test_other_faults_are_not_taken_for_mirrored_axes(fault):
    for seed in range(3):
        result = points2dof(measured(seed, fault), Placement(POSE))
        assert "mirrored_axes" not in {notice.code for notice in result.notices}


@pytest.mark.parametrize("fault", ["sign", "label swap", "position 200 um", "point sign"])
def test_one_fault_beside_position_errors_on_a_small_plate_is_not_taken_for_mirrored_axes(fault):
    for seed in range(1000, 1002):
        made = drawn(seed, "footplate, 5 points 3D", fault, position_sd_mm=0.02)
        run(made, seed, True, 0.02)


@pytest.mark.parametrize(("seed", "sd"), [(1000, True), (5000, False), (5001, False)])
def test_one_laser_of_opposite_sign_is_told_beside_the_mirrored_axes_that_would_be_the_same(seed, sd):
    made = drawn(seed, "stapes, 10 points 3D", "laser sign")
    result = run(made, seed, sd)
    wrong = {c: v.verdict for c, v in enumerate(result.channels) if v.verdict != "ok"}
    assert wrong.items() >= dict.fromkeys(made.culprits, "sign").items()
    assert len(wrong) <= len(made.culprits) + (not sd)
    text = next(notice.text for notice in result.notices if notice.code == "mirrored_axes")
    assert "--mirror-points" in text


def test_flat_sets_of_points_and_parallel_beams_are_left_alone():
    data = measured(6)
    one = data.bodies[0]
    flat = replace(one, positions_mm=one.positions_mm * [1.0, 1.0, 0.0])
    result = points2dof(replace(data, bodies=(flat,)), Placement(POSE))
    assert "mirrored_axes" not in {notice.code for notice in result.notices}
