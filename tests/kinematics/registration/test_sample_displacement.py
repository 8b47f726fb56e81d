"""Measured points against the surfaces of a scan: shifts found, single points named, no false alarm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from legacy.kinematics.measurement import from_arrays
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.registration.align_to_scan import align_to_scan
from legacy.kinematics.registration.fiducials import Fiducials
from legacy.kinematics.registration.icp_refine import Cloud
from legacy.kinematics.registration.placement import place, place_on_surface
from legacy.kinematics.registration.sample_displacement import check_surfaces
from legacy.kinematics.registration.scan_surfaces import (
    OTHER_BONE,
    ScanSurfaces,
    label_surface,
    read_labels,
    read_mesh,
)
from legacy.stapeskit.alignment.registration import fit_rigid
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.frames import RigidTransform, rotation_from_vector
from legacy.stapeskit.records.mass_record import read_mass_record
from tests.kinematics.records import SCAN_FROM_FOOTPLATE, SCAN_FROM_PLATE, write_record
from tests.kinematics.surfaces import box, on_faces, wedge, write_labels

TOP = 1.6
STAPES = box([0.3, 0.5, -0.4], [1.9, 3.0, 0.2])
PLATE = wedge()
VIBROMETER = RigidTransform.from_parts(
    rotation_from_vector([0.5, -1.2, 2.0]), [3.0, -4.0, 12.0], "scan", "vibrometer"
)
MARKS = np.array(
    [[-2.0, 0, -1.3], [2.0, 0, -1.3], [2.0, 0, 1.3], [-2.0, 0, 1.3], [0, 0.7, 0], [1.5, 0.5, -0.8]]
)


def bone_labels():
    """Return labels [z, y, x], 0.05 mm, of a block whose top lies at z = TOP, with a step along x."""
    z, _, x = np.meshgrid(np.arange(60), np.arange(100), np.arange(100), indexing="ij")
    labels = np.zeros((60, 100, 100), dtype=np.uint8)
    labels[0.05 * z <= TOP - 0.4 * (x < 40)] = OTHER_BONE
    return labels


def write_scan(folder):
    """Write a folder as ct2mass leaves it; return it and its surfaces."""
    write_record(folder)
    for name, surface, pose in (("stapes", STAPES, SCAN_FROM_FOOTPLATE), ("plate", PLATE, SCAN_FROM_PLATE)):
        mesh = trimesh.Trimesh(pose.points(surface.vertices_mm), surface.faces, process=False)
        mesh.export(folder / f"{name}.ply")
    write_labels(folder / "labels.nrrd", bone_labels(), 0.05)
    return folder, ScanSurfaces.beside(folder / "mass.json")


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return write_scan(tmp_path_factory.mktemp("scan"))


def bone_places(count=9, seed=0):
    """Return points on the top of the bone and on its step, scan mm."""
    rng = np.random.default_rng([seed, 1])
    x = rng.uniform(0.4, 4.4, count)
    x = np.where(np.abs(x - 2.0) < 0.3, x + 0.7, x)
    y = rng.uniform(0.8, 4.2, count)
    return np.column_stack([x, y, np.where(x < 1.975, TOP - 0.4, TOP) + 0.025])


def setting(seed, sd=0.01, shift=(0.0, 0.0, 0.0), bodies=("stapes", "base"), stated=True):
    """Return a measurement in vibrometer coordinates and its fiducials in the plate frame."""
    rng = np.random.default_rng([seed, 5])
    true = {
        "stapes": SCAN_FROM_FOOTPLATE.points(on_faces(STAPES, rng, 8)),
        "base": bone_places(9, seed) + np.asarray(shift),
    }
    made = {}
    for name in bodies:
        seen = VIBROMETER.inverse().points(true[name]) + sd * rng.normal(size=true[name].shape)
        made[name] = {
            "points": tuple(str(k) for k in range(len(seen))),
            "positions_mm": seen,
            "directions": np.tile(VIBROMETER.inverse().vectors([0.0, 0.0, 1.0]), (len(seen), 1)),
            "value": rng.normal(size=(len(seen), 4)) + 0j,
            "position_sd_mm": sd if stated else np.nan,
        }
    pose = VIBROMETER.inverse() @ SCAN_FROM_PLATE
    seen = pose.points(MARKS) + 0.01 * rng.normal(size=MARKS.shape)
    marks = Fiducials(tuple("abcdef"), seen, MARKS, ("plate",) * 6, np.full(6, 0.01))
    return from_arrays(made, np.arange(1.0, 5.0), frame="vibrometer"), marks


def checked(scan, measurement, marks, bone=None):
    mass = read_mass_record(scan[0] / "mass.json")
    mass = replace(mass, plate_covariance=np.zeros((6, 6)))
    return check_surfaces(measurement, place(marks, mass=mass), mass, scan[1], bone)


def test_points_in_their_place_raise_no_alarm(scan):
    codes = []
    p_values = []
    for seed in range(20):
        placement = checked(scan, *setting(seed))
        codes += [notice.code for notice in placement.notices]
        p_values += [check.p_value for check in placement.checks]
    assert not codes
    assert 0.25 < np.mean(p_values) < 0.95
    assert [check.surface for check in placement.checks] == ["stapes", "bone"]


@pytest.mark.parametrize("stated", [True, False])
def test_a_shift_is_found_and_measured(scan, stated):
    found, shifts, size = 0, [], 0.08 if stated else 0.15
    for seed in range(6):
        moved = checked(scan, *setting(seed, shift=(0.0, 0.0, size), stated=stated))
        texts = [notice.text for notice in moved.notices if notice.code == "sample_moved"]
        found += len(texts) == 1 and "of base lie" in texts[0]
        base = moved.checks[1]
        in_scan = SCAN_FROM_FOOTPLATE.rotation @ base.shift_mm
        shifts.append(in_scan[2])
        assert base.size_mm[0] == pytest.approx(np.linalg.norm(base.shift_mm))
        assert not moved.checks[0].notices
    assert found == 6
    assert base.open_motions
    assert "not seen: " in texts[0]
    assert np.mean(shifts) == pytest.approx(size, abs=0.04)


def test_one_point_off_the_surface_is_named(scan):
    measurement, marks = setting(3)
    base = measurement.bodies[1]
    wrong = base.positions_mm.copy()
    wrong[4] += VIBROMETER.inverse().vectors([0.0, 0.0, 0.3])
    moved = replace(measurement, bodies=(measurement.bodies[0], replace(base, positions_mm=wrong)))
    notices = checked(scan, moved, marks).notices
    assert [notice.code for notice in notices] == ["point_off_surface"]
    assert "point 4 of base lies +2" in notices[0].text


def test_coplanar_fiducials_are_told_from_their_mirror_image_by_the_points(scan):
    measurement, marks = setting(1)
    flat = replace(
        marks, names=tuple("abcd"), vibrometer_mm=marks.vibrometer_mm[:4], reference_mm=MARKS[:4],
        frames=("plate",) * 4, sd_mm=np.full(4, 0.01),
    )  # fmt: skip
    assert "fiducials_coplanar" in [notice.code for notice in checked(scan, measurement, flat).notices]
    with pytest.raises(StapeskitError, match=r"right-handed; got points that lie .* --mirror"):
        checked(scan, measurement.mirrored("y"), flat.mirrored("y"))


def test_bone_points_beside_the_measurement_are_checked(scan):
    measurement, marks = setting(2, bodies=("stapes",))
    seen = VIBROMETER.inverse().points(bone_places(5) + np.array([0.0, 0.0, 0.1]))
    bone = Cloud(tuple("abcde"), seen, np.full(5, 0.01), "bone")
    codes = [notice.code for notice in checked(scan, measurement, marks, bone).notices]
    assert codes == ["sample_moved"]
    with pytest.raises(StapeskitError, match="--bone-points must be at least 3 points; got 2"):
        checked(scan, measurement, marks, Cloud(("a", "b"), seen[:2], None, "bone"))
    with pytest.raises(StapeskitError, match=r"--bone-points must be points within 1 mm of other bone"):
        checked(scan, measurement, marks, replace(bone, points_mm=seen + 40.0))


def test_plate_points_tie_the_vibrometer(scan):
    """Plate points alone, and beside fiducials: the pose, its shared errors, and what is refused."""
    measurement, marks = setting(4)
    mass, surfaces = read_mass_record(scan[0] / "mass.json"), scan[1]
    rng = np.random.default_rng(9)
    places = SCAN_FROM_PLATE.points(on_faces(PLATE, rng, 60))
    seen = VIBROMETER.inverse().points(places) + 0.01 * rng.normal(size=places.shape)
    plate = Cloud(tuple(str(k) for k in range(60)), seen, np.full(60, 0.01))
    wanted = SCAN_FROM_FOOTPLATE.inverse() @ VIBROMETER
    placements = [
        align_to_scan(measurement, given, "footplate", mass, surfaces, plate) for given in (None, marks)
    ]
    for placement in placements:
        assert np.allclose(placement.transform.points(seen), wanted.points(seen), atol=0.02)
        assert {name.split(".")[0] for name in placement.names} == {"registration", "footplate_frame"}
        assert placement.registration.kind == "plate points"
        assert len(placement.checks) == 2
        assert not placement.notices
    alone, both = (np.diag(placement.registration.covariance_si) for placement in placements)
    assert np.all(both < alone)
    with pytest.raises(
        StapeskitError, match=r"--plate-points must be given with a mass.json that has a plate"
    ):
        align_to_scan(
            measurement, None, "footplate", mass, ScanSurfaces.beside(scan[0] / "x" / "mass.json"), plate
        )


def test_a_surface_registration_moves_the_motion_as_its_derivatives_say(scan):
    """Displace the vibrometer and the footplate frame by a little and fit the motion again."""
    measurement, _ = setting(5)
    beams = np.array([[0.3, 0, 1], [-0.2, 0.3, 1], [-0.2, -0.3, 1]])
    beams = VIBROMETER.inverse().vectors(beams / np.linalg.norm(beams, axis=1)[:, None])
    one = measurement.bodies[0]
    rng = np.random.default_rng(4)
    three = {
        "points": tuple(np.repeat(one.points, 3)),
        "positions_mm": np.repeat(one.positions_mm, 3, axis=0),
        "directions": np.tile(beams, (len(one.points), 1)),
        "value": rng.normal(size=(3 * len(one.points), 4, 2)) @ [1.0, 1j],
        "sd": 0.1,
    }
    data = from_arrays({"stapes": three}, np.arange(1.0, 5.0), frame="vibrometer", order=0)
    mass = read_mass_record(scan[0] / "mass.json")
    fit = fit_rigid(VIBROMETER.inverse().points(MARKS), MARKS, 0.01, to="scan", source="vibrometer")
    placement = place_on_surface(fit, mass)
    motion = points2dof(data, placement).motion
    shared, size = motion.shared, np.max(np.abs(motion.q), axis=(0, 1, 2))
    assert np.allclose(shared.covariance[:6, :6], fit.covariance_si)
    assert np.allclose(shared.covariance[6:12, 6:12], mass.footplate_covariance)
    for start, moved in enumerate(
        (
            lambda e: place_on_surface(replace(fit, transform=fit.transform.perturbed(e)), mass),
            lambda e: place_on_surface(
                fit, replace(mass, scan_from_footplate=mass.scan_from_footplate.perturbed(e))
            ),
        )
    ):
        for axis in range(6):
            step = np.zeros(6)
            step[axis] = 1e-6
            ends = [points2dof(data, moved(sign * step)).motion.q for sign in (1.0, -1.0)]
            numeric = (ends[0] - ends[1]) / 2e-6
            wanted = shared.derivatives[6 * start + axis]
            scale = np.maximum(np.max(np.abs(wanted), axis=(0, 1, 2)), size)
            assert np.allclose(wanted / scale, numeric / scale, atol=2e-3)


def test_label_surfaces_meet_a_plane_within_a_tenth_of_a_voxel(tmp_path):
    """A tilted plane through a label volume: distances of the boundary from the plane, outward normals."""
    normal = np.array([0.2, -0.3, 0.93])
    normal /= np.linalg.norm(normal)
    index = np.stack(np.meshgrid(*(np.arange(60),) * 3, indexing="ij"), axis=-1)[..., ::-1] * 0.02
    labels = np.where((index - 0.6) @ normal < 0.0, OTHER_BONE, 0)
    read = read_labels(write_labels(tmp_path / "labels.nrrd", labels, 0.02, (1.0, 2.0, 3.0)))
    centre = np.array([1.6, 2.6, 3.6])
    surface = label_surface(read, OTHER_BONE, centre[None])
    points, normals = surface.samples(500)
    inner = np.all(np.abs(points - centre) < 0.4, axis=1)
    assert np.std((points[inner] - centre) @ normal) < 0.1 * 0.02
    assert abs(np.mean((points[inner] - centre) @ normal)) < 0.1 * 0.02
    assert np.mean(normals[inner] @ normal) > 0.95
    assert label_surface(read, OTHER_BONE, centre[None] + 5.0) is None
    assert label_surface(read, 7, centre[None]) is None


def test_labels_in_ras_are_turned(tmp_path):
    path = write_labels(
        tmp_path / "labels.nrrd", np.ones((3, 4, 5)), 0.1, (1, 2, 3), "right-anterior-superior"
    )
    assert read_labels(path).scan_from_index[:, 3].tolist() == [-1, -2, 3]
    assert read_labels(path).array.shape == (3, 4, 5)


@pytest.mark.parametrize(
    ("damage", "match"),
    [
        (lambda raw: b"nothing", "must be an NRRD as ct2mass writes it; got no NRRD header"),
        (lambda raw: raw.replace(b"sizes", b"size_"), "got no field 'sizes'"),
        (lambda raw: raw[:-20], "must be an NRRD"),
        (lambda raw: raw.replace(b"encoding: gzip", b"encoding: hex"), "got encoding hex"),
    ],
)
def test_damaged_labels_are_refused(tmp_path, damage, match):
    path = write_labels(tmp_path / "labels.nrrd", np.ones((3, 4, 5)))
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(StapeskitError, match=match):
        read_labels(path)


def test_damaged_meshes_are_refused(tmp_path):
    with pytest.raises(StapeskitError, match="the surface of the plate must be an existing mesh"):
        read_mesh(tmp_path / "plate.ply", "plate")
    (tmp_path / "plate.ply").write_text("no mesh")
    with pytest.raises(StapeskitError, match="the surface of the plate must be a triangle mesh"):
        read_mesh(tmp_path / "plate.ply", "plate")
