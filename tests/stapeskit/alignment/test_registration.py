"""The rigid fit: exact, never a reflection, with a covariance and a target error that hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from legacy.kinematics.registration.fiducials import Fiducials, read_fiducials
from legacy.kinematics.registration.placement import place
from legacy.stapeskit.alignment.fiducial_faults import undo_mirror
from legacy.stapeskit.alignment.registration import displacement, fit_rigid
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.frames import RigidTransform, rotation_from_vector
from legacy.stapeskit.records.mass_record import read_mass_record
from tests.kinematics.records import SCAN_FROM_FOOTPLATE, SCAN_FROM_PLATE, mass_record, write_record

MARKS = np.array([[-10.0, 0, -8], [10, 0, -8], [10, 0, 8], [-10, 0, 8], [0, 3, 0], [4, 5, -3]])
POSE = RigidTransform.from_parts(
    rotation_from_vector([0.5, -1.2, 2.0]), [30.0, -400.0, 12.0], "plate", "vibrometer"
)
SEEN = POSE.inverse().points(MARKS)


def fit(seen=SEEN, known=MARKS, sd=None, **more):
    return fit_rigid(seen, known, sd, to="plate", source="vibrometer", **more)


@given(st.integers(0, 200))
def test_exact_points_give_the_exact_pose(seed):
    rng = np.random.default_rng(seed)
    pose = RigidTransform.from_parts(
        rotation_from_vector(rng.uniform(-1.8, 1.8, 3)), rng.uniform(-300, 300, 3), "plate", "vibrometer"
    )
    found = fit(pose.inverse().points(MARKS), MARKS, rng.uniform(0.01, 0.1, len(MARKS)))
    assert np.allclose(found.transform.matrix, pose.matrix, atol=1e-9)
    assert found.rms_mm < 1e-9
    assert not found.notices


def test_covariance_and_target_error_hold():
    rng = np.random.default_rng(1)
    sd = np.array([0.02, 0.05, 0.05, 0.03, 0.08, 0.04])
    target = POSE.inverse().points([[0.0, 6.0, 0.0]])
    expected = fit(sd=sd)
    errors, misses, distances = [], [], []
    for _ in range(1500):
        found = fit(SEEN, MARKS + sd[:, None] * rng.normal(size=MARKS.shape), sd)
        errors.append(displacement(found.transform, POSE))
        misses.append(found.transform.points(target) - POSE.points(target))
        distances.append(errors[-1] @ np.linalg.solve(found.covariance_si, errors[-1]))
    ratio = np.std(errors, axis=0) / np.sqrt(np.diag(expected.covariance_si))
    assert np.all(np.abs(ratio - 1.0) < 0.07)
    assert np.mean(distances) / 6.0 == pytest.approx(1.0, abs=0.06)
    rms = np.sqrt(np.mean(np.sum(np.square(misses), axis=-1)))
    assert rms == pytest.approx(expected.target_registration_error(target)[0], rel=0.05)


def test_sd_is_estimated_when_not_stated():
    rng = np.random.default_rng(2)
    sizes = [fit(SEEN, MARKS + 0.05 * rng.normal(size=MARKS.shape)).sd_mm[0] ** 2 for _ in range(400)]
    assert np.mean(sizes) == pytest.approx(0.05**2, rel=0.05)


def test_residuals_too_large_for_their_sd_are_told():
    wrong = MARKS.copy()
    wrong[3, 0] += 1.0
    found = fit(SEEN, wrong, 0.02, names=("a", "b", "c", "d", "e", "f"))
    assert [notice.code for notice in found.notices] == ["fiducials_inconsistent"]
    assert "fiducial d lies 1 mm from where the others put it" in found.notices[0].text
    assert "x_ref_mm too large by 1 mm" in found.notices[0].text
    assert found.covariance_si[0, 0] > 10 * fit(sd=0.02).covariance_si[0, 0]


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_blunder_is_told_without_stated_sd(noise):
    names = ("a", "b", "c", "d", "e", "f")
    for worst in range(len(MARKS)):
        wrong = MARKS + noise * np.random.default_rng(worst).normal(size=MARKS.shape)
        wrong[worst, 1] += 2.0
        (notice,) = fit(SEEN, wrong, names=names).notices
        assert notice.code == "fiducials_inconsistent"
        assert f"fiducial {names[worst]} lies " in notice.text


def test_honest_scatter_raises_no_alarm_without_stated_sd():
    rng = np.random.default_rng(7)
    alarms = sum(len(fit(SEEN, MARKS + 0.1 * rng.normal(size=MARKS.shape)).notices) for _ in range(500))
    assert alarms <= 2
    small = MARKS.copy()
    small[2, 0] += 0.04
    assert not fit(SEEN, small).notices


def test_never_a_reflection():
    flat = MARKS[:4]
    found = fit(SEEN[:4] * [1, 1, 1], flat)
    assert np.linalg.det(found.transform.rotation) == pytest.approx(1.0)
    assert [notice.code for notice in found.notices] == ["fiducials_coplanar"]
    mirrored = fit(SEEN[:4] * [1, 1, -1], flat)
    assert mirrored.rms_mm < 1e-9
    assert mirrored.notices[0].code == "fiducials_coplanar"


def test_mirrored_coordinates_are_refused_where_the_points_show_it():
    with pytest.raises(StapeskitError, match=r"must be right-handed.*--mirror"):
        fit(SEEN * [1, 1, -1])


@pytest.mark.parametrize(
    ("target", "source", "told"),
    [
        ("plate", "vibrometer", ("{mirror}",)),
        ("scan", "vibrometer", ("{mirror}", "ct2mass")),  # either of the two may be mirrored
        ("scan", "plate", ("of the scan", "plate's coordinates")),
    ],
)
def test_the_step_names_every_frame_that_may_be_mirrored(target, source, told):
    assert all(words in undo_mirror(target, source) for words in told)
    assert ("ct2mass" in undo_mirror(target, source)) == ("ct2mass" in told)


def test_three_fiducials_are_few():
    assert "only 3 fiducials" in fit(SEEN[[0, 1, 4]], MARKS[[0, 1, 4]]).notices[0].text


@pytest.mark.parametrize(
    ("seen", "known", "sd", "match"),
    [
        (SEEN[:2], MARKS[:2], None, "at least 3 paired points"),
        (SEEN, MARKS[:5], None, "paired points"),
        (SEEN * np.nan, MARKS, None, "finite"),
        (np.outer(np.arange(4), [1, 2, 3]), MARKS[:4], None, "spread over a plane"),
        (np.zeros((4, 3)), MARKS[:4], None, "spread over a plane"),
        (SEEN, MARKS, 0.0, "sd_mm of a fiducial must be positive"),
        (SEEN, MARKS, np.nan, "sd_mm of a fiducial must be positive"),
    ],
)
def test_impossible_fits_are_refused(seen, known, sd, match):
    with pytest.raises(StapeskitError, match=match):
        fit(seen, known, sd)


def test_displacement_is_what_perturbed_undoes():
    small = np.array([1e-4, -2e-4, 3e-4, 0.01, -0.02, 0.03])
    assert np.allclose(displacement(POSE, POSE.perturbed(small)), small, atol=1e-12)


HEAD = "name,x_mm,y_mm,z_mm,x_ref_mm,y_ref_mm,z_ref_mm"


def write_fiducials(folder, rows, head=HEAD):
    path = folder / "fiducials.csv"
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


def rows_of(names, seen, known, extra=None):
    return [
        ",".join([name, *(f"{value:.12g}" for value in (*a, *b)), *([] if extra is None else [extra[k]])])
        for k, (name, a, b) in enumerate(zip(names, seen, known, strict=True))
    ]


def test_fiducials_are_read(tmp_path):
    path = write_fiducials(tmp_path, rows_of("abcdef", SEEN, MARKS, ["scan,0.1"] * 6), HEAD + ",frame,sd_mm")
    read = read_fiducials(path)
    assert read.names == tuple("abcdef")
    assert set(read.frames) == {"scan"}
    assert read.sd_mm.tolist() == [0.1] * 6
    assert np.allclose(read.mirrored("y").vibrometer_mm, SEEN * [1, -1, 1])
    assert read_fiducials(write_fiducials(tmp_path, rows_of("abcdef", SEEN, MARKS))).frames[0] == "plate"
    with pytest.raises(StapeskitError, match="--mirror must be x, y or z"):
        read.mirrored("w")


@pytest.mark.parametrize(
    ("head", "row", "match"),
    [
        (HEAD.replace("z_ref_mm", "z_ref"), "a,1,2,3,4,5,6", "no column z_ref_mm"),
        (HEAD, "a,1,2,x,4,5,6", 'z_mm must be a number; got "x"'),
        (HEAD, "a,1,2,,4,5,6", "z_mm must be a finite number; got an empty or NaN cell"),
        (HEAD, "first,1,2,3,4,5,6", "name must be given, and different.*first again"),
        (HEAD, ",1,2,3,4,5,6", "name must be given.*an empty cell"),
        (HEAD + ",frame", "a,1,2,3,4,5,6,moon", "frame must be plate, scan or footplate; got moon"),
        (HEAD + ",sd_mm", "a,1,2,3,4,5,6,0", "sd_mm must be positive"),
        (HEAD + ",sd_mm", "a,1,2,3,4,5,6,", "stated for all fiducials or for none"),
    ],
)
def test_faulty_fiducials_are_named(tmp_path, head, row, match):
    good = "first,0,0,0,0,0,0" + (",plate" if "frame" in head else "") + (",0.1" if "sd_mm" in head else "")
    with pytest.raises(StapeskitError, match=match):
        read_fiducials(write_fiducials(tmp_path, [good, row], head))


@pytest.fixture
def mass(tmp_path):
    return read_mass_record(write_record(tmp_path))


def marks_in(frame):
    """The marks, given in plate coordinates, in another frame."""
    to = {"plate": np.eye(4), "scan": SCAN_FROM_PLATE.matrix}
    to["footplate"] = (SCAN_FROM_FOOTPLATE.inverse() @ SCAN_FROM_PLATE).matrix
    matrix = to[frame]
    return MARKS @ matrix[:3, :3].T + matrix[:3, 3]


TRUE = SCAN_FROM_FOOTPLATE.inverse() @ SCAN_FROM_PLATE @ POSE


@pytest.mark.parametrize(
    ("frames", "sources"),
    [
        (["plate"] * 6, ["registration", "plate_frame", "footplate_frame"]),
        (["scan"] * 6, ["registration", "footplate_frame"]),
        (["footplate"] * 6, ["registration"]),
        (
            ["plate", "scan", "plate", "footplate", "scan", "scan"],
            ["registration", "plate_frame", "footplate_frame"],
        ),
    ],
)
def test_every_frame_of_fiducials_leads_to_the_footplate(mass, frames, sources):
    known = np.stack([marks_in(frame)[k] for k, frame in enumerate(frames)])
    placed = place(Fiducials(tuple("abcdef"), SEEN, known, tuple(frames)), mass=mass)
    assert np.allclose(placed.transform.matrix, TRUE.matrix, atol=1e-6)
    assert list(dict.fromkeys(name.split(".")[0] for name in placed.names)) == sources
    assert placed.derivative.shape == (6, len(placed.names))
    assert placed.covariance.shape == (len(placed.names),) * 2


def test_frames_move_the_pose_as_the_derivative_says(mass):
    """Displace plate and footplate frames in the record and refit."""
    frames = ("plate", "scan", "plate", "footplate", "scan", "scan")
    known = np.stack([marks_in(frame)[k] for k, frame in enumerate(frames)])
    fiducials = Fiducials(tuple("abcdef"), SEEN, known, frames)
    placed = place(fiducials, mass=mass)
    rng = np.random.default_rng(4)
    for source, moved_frame in (("footplate_frame", "footplate"), ("plate_frame", "plate")):
        small = 1e-7 * rng.normal(size=6)
        scan_from_footplate, scan_from_plate = SCAN_FROM_FOOTPLATE, SCAN_FROM_PLATE
        if moved_frame == "footplate":
            scan_from_footplate = scan_from_footplate.perturbed(small)
        else:
            scan_from_plate = scan_from_plate.perturbed(small)
        moved = type(mass)(
            mass.mass_matrix,
            scan_from_footplate,
            scan_from_plate.inverse() @ scan_from_footplate,
            mass.footplate_covariance,
            mass.plate_covariance,
            (),
            {},
        )
        change = displacement(placed.transform, place(fiducials, mass=moved).transform)
        columns = [k for k, name in enumerate(placed.names) if name.startswith(source)]
        assert np.allclose(change, placed.derivative[:, columns] @ small, atol=1e-5 * np.linalg.norm(small))


def test_without_fiducials_the_frame_is_named(mass):
    assert place().transform.matrix.tolist() == np.eye(4).tolist()
    assert place().names == ()
    scan = place(frame="scan", mass=mass)
    assert np.allclose(scan.transform.matrix, SCAN_FROM_FOOTPLATE.inverse().matrix)
    assert {name.split(".")[0] for name in scan.names} == {"footplate_frame"}
    plate = place(frame="plate", mass=mass)
    assert np.allclose(plate.transform.matrix, (SCAN_FROM_FOOTPLATE.inverse() @ SCAN_FROM_PLATE).matrix)
    assert {name.split(".")[0] for name in plate.names} == {"plate_frame", "footplate_frame"}


def test_frames_need_their_mass_record(tmp_path, mass):
    marks = Fiducials(tuple("abcdef"), SEEN, MARKS, ("plate",) * 6)
    with pytest.raises(
        StapeskitError, match="the frame of the fiducials plate must be given together with --mass"
    ):
        place(marks)
    with pytest.raises(StapeskitError, match=r"got no mass record \(marks\.csv, frame\)"):
        place(replace(marks, path=tmp_path / "marks.csv"))
    with pytest.raises(StapeskitError, match="--frame scan must be given together with --mass"):
        place(frame="scan")
    with pytest.raises(StapeskitError, match=r"--frame must be footplate, plate or scan"):
        place(frame="moon", mass=mass)
    raw = mass_record()
    raw["frames"]["plate_from_footplate"] = raw["frames"]["scan_from_plate"] = None
    raw["mass_matrix_plate_axes"] = None
    with pytest.raises(StapeskitError, match=r"a mass\.json without a plate"):
        place(marks, mass=read_mass_record(write_record(tmp_path, raw)))


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
    assert mine == pytest.approx(fitzpatrick_west(marks, target, 0.03), rel=1e-3)


def test_errors_that_differ_by_axis_are_weighted_and_told():
    """Depth known ten times less well: Monte Carlo of the pose, its covariance, chi2 and the target error."""
    rng = np.random.default_rng(3)
    sd, known = np.array([0.01, 0.01, 0.1]), 0.005
    target = POSE.inverse().points([[0.0, 4.0, 0.0]])
    distances, misses, plain, chi2 = [], [], [], []
    for _ in range(400):
        seen = SEEN + sd * rng.normal(size=SEEN.shape)
        marks = MARKS + known * rng.normal(size=MARKS.shape)
        found = fit(seen, marks, np.tile(sd, (6, 1)), target_sd_mm=known)
        e = displacement(found.transform, POSE)
        distances.append(e @ np.linalg.solve(found.covariance_si, e))
        misses.append(np.linalg.norm(found.transform.points(target) - POSE.points(target)))
        plain.append(np.linalg.norm(fit(seen, marks).transform.points(target) - POSE.points(target)))
        chi2.append(found.chi2)
    assert np.mean(distances) / 6.0 == pytest.approx(1.0, abs=0.08)
    assert np.mean(chi2) == pytest.approx(12.0, rel=0.06)
    rms = np.sqrt(np.mean(np.square(misses)))
    expected = fit(sd=np.tile(sd, (6, 1)), target_sd_mm=known).target_registration_error(target)[0]
    assert rms == pytest.approx(expected, rel=0.05)
    assert rms < 0.95 * np.sqrt(np.mean(np.square(plain)))


def test_sd_columns_by_axis(tmp_path):
    head = HEAD + ",sd_x_mm,sd_y_mm,sd_z_mm,sd_ref_mm"
    read = read_fiducials(
        write_fiducials(tmp_path, rows_of("abcdef", SEEN, MARKS, ["0.01,0.02,0.3,0.005"] * 6), head)
    )
    assert read.sd_mm[2].tolist() == [0.01, 0.02, 0.3]
    assert read.sd_ref_mm.tolist() == [0.005] * 6
    for columns in ("sd_x_mm,sd_y_mm,sd_mm", "sd_x_mm,sd_y_mm,sd_ref_mm"):
        path = write_fiducials(tmp_path, rows_of("abcdef", SEEN, MARKS, ["1,1,1"] * 6), HEAD + "," + columns)
        with pytest.raises(StapeskitError, match="sd of the fiducials must be sd_mm, or all three"):
            read_fiducials(path)
