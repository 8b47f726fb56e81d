"""Placement: frames, their covariance as shared errors, signs, other axes, the sample that moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kinematics.place.fiducials import FRAMES, Fiducials, read_fiducials
from kinematics.place.handedness import axes_changes
from kinematics.place.placement import place
from kinematics.place.points_on_bone import check_surfaces
from kinematics.place.surfaces import surfaces_of
from stapeskit.faults import StapeskitError
from stapeskit.frames import RigidTransform, rotation_from_vector
from stapeskit.records.mass_matrix import MassMatrix
from stapeskit.records.mass_record import MassRecord
from stapeskit.registration import displacement
from stapeskit.spatial import DOF_NAMES
from tests.motion_command.ears import error_in_sd, mass_of, measured, rewrite, simulated

BONE = np.array([3e-6, 0.0, 0.0, 0.0, 1e-11, 1e-11, 1e-11, 0.0, 0.0, 0.0])


def pose(rng, to, source):
    return RigidTransform.from_parts(
        rotation_from_vector(rng.normal(size=3)), 5.0 * rng.normal(size=3), to, source
    )


def record(rng, sd=(1e-5, 2e-3)):
    spread = np.diag(np.repeat(np.square(sd), 3))
    return MassRecord(
        MassMatrix(BONE), pose(rng, "scan", "footplate"), spread, pose(rng, "scan", "plate"), spread
    )


def frames_of(mass):
    return {
        "scan": RigidTransform.identity("scan", "scan"),
        "plate": mass.scan_from_plate,
        "footplate": mass.scan_from_footplate,
    }


def fiducials(rng, mass, frame, scan_from_vibrometer, noise=0.0, count=6):
    seen = 4.0 * rng.normal(size=(count, 3))
    known = frames_of(mass)[frame].inverse().points(scan_from_vibrometer.points(seen))
    seen = seen + noise * rng.normal(size=seen.shape)
    names = tuple(f"mark {k}" for k in range(count))
    return Fiducials(names, seen, known, frame, np.full(count, max(noise, 0.01)))


@pytest.mark.parametrize("frame", FRAMES)
def test_derivatives_are_those_of_perturbed_frames(frame):
    rng = np.random.default_rng(3)
    mass = record(rng)
    pairs = fiducials(rng, mass, frame, pose(rng, "scan", "vibrometer"))
    placed = place(pairs, mass=mass)
    for column, name in enumerate(placed.names):
        source, _, axis = name.partition(".")
        step = 1e-6 * np.eye(6)[DOF_NAMES.index(axis)]
        if source == "registration":
            assert np.array_equal(placed.derivative[:, column], np.eye(6)[DOF_NAMES.index(axis)])
            continue
        field = "scan_from_plate" if source == "plate_frame" else "scan_from_footplate"
        moved = [
            place(pairs, mass=replace(mass, **{field: getattr(mass, field).perturbed(sign * step)})).transform
            for sign in (1.0, -1.0)
        ]
        slope = (displacement(placed.transform, moved[0]) - displacement(placed.transform, moved[1])) / 2e-6
        assert slope == pytest.approx(placed.derivative[:, column], abs=1e-5)


@pytest.mark.parametrize("frame", ["plate", "scan"])
def test_covariance_of_the_pose_is_that_of_drawn_errors(frame):
    distances = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        mass = record(rng)
        true = pose(rng, "scan", "vibrometer")
        spread = np.repeat([1e-5, 2e-3], 3)
        off = replace(
            mass,
            scan_from_footplate=mass.scan_from_footplate.perturbed(spread * rng.normal(size=6)),
            scan_from_plate=mass.scan_from_plate.perturbed(spread * rng.normal(size=6)),
        )
        placed = place(fiducials(rng, mass, frame, true, 0.02, 5), mass=off)
        error = displacement(placed.transform, mass.scan_from_footplate.inverse() @ true)
        whole = placed.derivative @ placed.covariance @ placed.derivative.T
        distances.append(error @ np.linalg.solve(whole, error))
    assert np.mean(distances) / 6.0 == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / (6.0 * len(distances))))


@pytest.mark.parametrize("frame", [frame for frame in FRAMES if frame != "footplate"])
def test_frames_that_nothing_ties_to_the_footplate_are_refused(frame):
    with pytest.raises(StapeskitError) as caught:
        place(frame=frame)
    assert caught.value.faults[0].got == "no mass.json"
    rng = np.random.default_rng(6)
    bare = replace(record(rng), scan_from_plate=None, plate_covariance=None)
    if frame == "plate":
        with pytest.raises(StapeskitError) as caught:
            place(frame=frame, mass=bare)
        assert caught.value.faults[0].got == "a mass.json without a plate"


def test_signs_of_all_motions_survive_the_way_through_three_frames(tmp_path):
    truth = simulated(tmp_path, exact=True, position_sd_mm=0.0, fiducial_sd_mm=0.0, seed=2)
    result = measured(tmp_path, mass_of(truth))
    for number, body in enumerate(result.motion.bodies):
        true = truth.motion_m[body]
        scale = np.sqrt(np.mean(np.abs(true) ** 2, axis=(0, 1)))
        assert (
            np.max(np.abs(result.motion.q[:, number] - true) / scale) < 2e-3
        )  # files hold four digits of mm


def test_motion_lies_within_its_sd_when_frames_and_fiducials_are_off(tmp_path):
    worst, mean = [], []
    for seed in range(8):
        folder = tmp_path / str(seed)
        truth = simulated(folder, seed=seed, lines=16, fiducial_sd_mm=0.03)
        rng = np.random.default_rng(seed)
        result = measured(folder, mass_of(truth, (1.5e-5, 4e-3), rng), gain_sd=0)
        error = error_in_sd(result, truth)
        worst.append(np.max(np.abs(error)))
        mean.append(np.mean(error**2))
    assert np.mean(mean) == pytest.approx(1.0, abs=0.3)
    assert max(worst) < 6.0


def test_fiducials_are_read_with_every_fault(tmp_path):
    path = tmp_path / "fiducials.csv"
    path.write_text(
        "name,x_mm,y_mm,z_mm,x_ref_mm,y_ref_mm,z_ref_mm,frame,sd_mm\n"
        "a,0,0,0,0,0,0,plate,0.01\na,1,0,0,1,0,0,moon,0.01\nc,0,1,0,0,1e30,0,plate,\nd,0,0,1,0,0,1,scan,-1\n"
        "e,1,2\n"
    )
    with pytest.raises(StapeskitError) as caught:
        read_fiducials(path)
    found = {(fault.thing, fault.where.numbers) for fault in caught.value.faults}
    assert found == {
        ("name", (3,)),
        ("frame", (3,)),
        ("y_ref_mm", (4,)),
        ("sd_mm", (4,)),
        ("sd_mm", (5,)),
        ("frame", (5,)),
        ("a row", (6,)),
    }
    named = [fault for fault in caught.value.faults if fault.thing != "a row"]
    assert all("fiducial" in fault.where.detail for fault in named)


@pytest.mark.parametrize("largest_mm", [None, 20.0])
def test_points_in_metres_are_refused(tmp_path, largest_mm):
    """Also of a base 20 mm wide: its points are then 20 um apart."""
    simulated(tmp_path, in_footplate=True)

    def shrink(table):
        places = table[["x_mm", "y_mm", "z_mm"]]
        base = table["body"] == "base"
        wide = 1.0 if largest_mm is None else largest_mm / places[base].apply(np.ptp).max()
        table[["x_mm", "y_mm", "z_mm"]] = 1e-3 * places.mul(np.where(base, wide, 1.0), axis=0)

    rewrite(tmp_path / "points.csv", shrink)
    with pytest.raises(StapeskitError) as caught:
        measured(tmp_path, fiducials="none")
    things = [fault.thing for fault in caught.value.faults]
    assert things == [f"the extent of the points of body {body}" for body in ("stapes", "base")]
    assert all("those in metres times 1000" in fault.next_step for fault in caught.value.faults)


def turned_points(result_folder, change):
    def turn(table):
        places = table[["x_mm", "y_mm", "z_mm"]].to_numpy() @ np.asarray(change).T
        table[["x_mm", "y_mm", "z_mm"]] = places

    rewrite(result_folder / "points.csv", turn)


@pytest.mark.parametrize(
    "words", [words for words in axes_changes() if "reversed" in words and " and " in words]
)
def test_half_turns_are_named_before_the_sample_is_blamed(tmp_path, words):
    truth = simulated(tmp_path, seed=3)
    turned_points(tmp_path, axes_changes()[words])
    with pytest.raises(StapeskitError) as caught:
        measured(tmp_path, mass_of(truth))
    fault = caught.value.faults[0]
    assert fault.thing == "the points of body stapes"
    assert words in fault.next_step


def test_references_in_another_frame_than_stated_are_refused_with_their_frame(tmp_path):
    """The origins of plate and footplate are half a millimetre apart: the sample was blamed."""
    truth = simulated(tmp_path, seed=3)
    rewrite(tmp_path / "fiducials.csv", lambda table: table.__setitem__("frame", "footplate"))
    with pytest.raises(StapeskitError) as caught:
        measured(tmp_path, mass_of(truth))
    assert "plate instead of footplate" in caught.value.faults[0].next_step


def test_a_slip_in_one_of_three_fiducials_is_reported_without_sd(tmp_path):
    truth = simulated(tmp_path, seed=3)

    path = tmp_path / "fiducials.csv"
    three = [line.rpartition(",")[0] for line in path.read_text().splitlines()[:4]]  # without sd_mm
    path.write_text("\n".join(three))
    rewrite(path, lambda table: table.__setitem__("x_ref_mm", table.x_ref_mm + np.eye(3)[0]))
    codes = {notice.code for notice in measured(tmp_path, mass_of(truth)).notices}
    assert {"fiducials_coplanar", "fiducials_inconsistent"} <= codes


def test_references_in_ras_are_named(tmp_path):
    truth = simulated(tmp_path, seed=3)
    to_scan = truth.scan_from_plate

    def to_ras(table):
        known = to_scan.points(table[["x_ref_mm", "y_ref_mm", "z_ref_mm"]].to_numpy()) * [-1.0, -1.0, 1.0]
        table[["x_ref_mm", "y_ref_mm", "z_ref_mm"]] = known
        table["frame"] = "scan"

    rewrite(tmp_path / "fiducials.csv", to_ras)
    with pytest.raises(StapeskitError) as caught:
        measured(tmp_path, mass_of(truth))
    assert "RAS against LPS" in caught.value.faults[0].next_step
    assert "frame scan" in caught.value.faults[0].next_step


@pytest.mark.parametrize(
    "words", ["the axis x reversed", "the axis y reversed", "the axes x and z exchanged"]
)
def test_positions_in_other_axes_than_the_beams_are_refused(tmp_path, words):
    simulated(tmp_path, seed=4, in_footplate=True, noise=0.003, lines=24, stapes_points=7, bone_points=5)
    turned_points(tmp_path, axes_changes()[words])
    with pytest.raises(StapeskitError) as caught:
        measured(tmp_path, fiducials="none")
    assert words in caught.value.faults[0].got


def test_a_sample_that_moved_is_reported_and_far_ones_are_refused(tmp_path):
    truth = simulated(tmp_path, seed=5)
    mass = mass_of(truth)
    result = measured(tmp_path, mass)
    assert result.checks[0].p_value > 1e-3
    for shift_mm, refused in ((0.15, False), (2.5, True)):
        off = truth.scan_from_footplate.matrix.copy()
        off[:3, 3] += shift_mm * np.array([0.6, 0.0, 0.8])
        moved = replace(result.placement, transform=mass.scan_from_footplate.inverse()
                        @ RigidTransform(off, "scan", "footplate") @ result.placement.transform)  # fmt: skip
        source = result.measurement.mapped(replace_frames(result.placement.transform.inverse()))
        if refused:
            with pytest.raises(StapeskitError):
                check_surfaces(source, moved, mass, surfaces_of(mass))
        else:
            _, notices = check_surfaces(source, moved, mass, surfaces_of(mass))
            assert [notice.code for notice in notices] == ["sample_moved"]


def replace_frames(transform):
    return RigidTransform(transform.matrix, "vibrometer", "footplate")


def test_coordinates_of_the_vibrometer_without_fiducials_are_not_called_micrometres(tmp_path):
    """Divided by a thousand, all points lie at the origin, which is on the footplate."""
    truth = simulated(tmp_path, seed=5)
    with pytest.raises(StapeskitError) as caught:
        measured(tmp_path, mass_of(truth), fiducials="none")
    assert "--fiducials" in caught.value.faults[0].next_step
    assert "with micrometres" not in str(caught.value)


def test_points_that_lie_on_the_bone_raise_no_alarm(tmp_path):
    chances, sizes = [], []
    for seed in range(8):
        folder = tmp_path / str(seed)
        truth = simulated(folder, seed=20 + seed, lines=12, bone_points=4)
        check = measured(folder, mass_of(truth)).checks[0]
        chances.append(check.p_value)
        sizes.append(check.rms_mm / np.sqrt(np.mean(check.expected_sd_mm**2)))
    assert min(chances) > 1e-3
    assert 0.3 < np.mean(sizes) < 1.2


def test_axes_are_those_of_the_file_when_one_is_mirrored(tmp_path):
    truth = simulated(tmp_path, seed=3, mirror="z")
    turned_points(tmp_path, axes_changes()["the axes x and z exchanged"])
    with pytest.raises(StapeskitError) as caught:
        measured(tmp_path, mass_of(truth), mirror="z")
    assert "the axes x and z exchanged" in caught.value.faults[0].next_step


def test_half_turns_of_the_references_are_named_also_where_they_bring_points_near_the_bone(tmp_path):
    truth = simulated(tmp_path, seed=3)
    change = axes_changes()["the axes x and z reversed"]

    def turn(table):
        table[["x_ref_mm", "y_ref_mm", "z_ref_mm"]] @= change.T

    rewrite(tmp_path / "fiducials.csv", turn)
    with pytest.raises(StapeskitError) as caught:
        measured(tmp_path, mass_of(truth))
    assert "the axes x and z reversed" in caught.value.faults[0].next_step


def test_coordinates_in_the_plate_frame_need_no_fiducials():
    rng = np.random.default_rng(5)
    mass = record(rng)
    placed = place(frame="plate", mass=mass)
    assert placed.transform.matrix == pytest.approx(
        (mass.scan_from_footplate.inverse() @ mass.scan_from_plate).matrix
    )
    assert {name.partition(".")[0] for name in placed.names} == {"plate_frame", "footplate_frame"}
    assert place().names == ()
