"""mass.json is checked before it is believed; the mass matrix moves with its frame."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest

from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.frames import rotation_from_vector
from legacy.stapeskit.records.mass_checks import Checked
from legacy.stapeskit.records.mass_record import MassMatrix, frame_derivative, read_mass_record
from legacy.stapeskit.spatial import matrix_from_parameters, twist_transfer
from tests.kinematics.records import (
    PARAMETERS,
    SCAN_FROM_FOOTPLATE,
    mass_record,
    write_record,
)


def test_a_record_is_read(tmp_path):
    record = read_mass_record(write_record(tmp_path))
    assert np.allclose(record.mass_matrix.matrix, matrix_from_parameters(PARAMETERS))
    assert np.allclose(record.scan_from_footplate.matrix, SCAN_FROM_FOOTPLATE.matrix)
    assert record.plate_from_footplate is not None
    assert record.plate_covariance[0, 0] == pytest.approx(4e-12)
    assert record.notices[0].code == "anterior_not_given"
    assert record.mass_matrix.standard_deviation[0, 0] == pytest.approx(0.01 * PARAMETERS[0])


def test_a_record_without_plate_or_contributions_is_read(tmp_path):
    raw = mass_record()
    raw["frames"]["plate_from_footplate"] = None
    raw["frames"].pop("scan_from_plate")
    raw["frames"].pop("pose_covariance")
    raw["inertial_parameters"].pop("contributions_si")
    raw["mass_matrix_plate_axes"] = None
    for optional in ("mass_matrix_reduced", "warnings", "found"):
        raw.pop(optional)
    record = read_mass_record(write_record(tmp_path, raw))
    assert record.plate_from_footplate is None
    assert record.plate_covariance is None
    assert np.array_equal(record.footplate_covariance, np.zeros((6, 6)))
    assert list(record.mass_matrix.contributions) == ["unspecified"]


def change(*keys_and_value):
    *keys, value = keys_and_value

    def apply(raw):
        place = raw
        for key in keys[:-1]:
            place = place[key]
        if value is None:
            place.pop(keys[-1])
        else:
            place[keys[-1]] = value

    return apply


BIG = [[1e-5 if i == j else 0.0 for j in range(6)] for i in range(6)]


@pytest.mark.parametrize(
    ("edit", "match"),
    [
        (change("schema", "other/1"), 'schema must be "stapeskit.mass/1"; got other/1'),
        (
            change("inertial_parameters", None),
            r"inertial_parameters.values_si must be given; got none \(mass.json\).",
        ),
        (
            change("inertial_parameters", "about", "com"),
            'inertial_parameters.about must be "footplate_centre"',
        ),
        (change("mass_matrix", "axes", "scan"), 'mass_matrix.axes must be "footplate"'),
        (change("inertial_parameters", "names", ["m"]), "inertial_parameters.names must be"),
        (change("mass_matrix", "dof", ["y"]), "mass_matrix.dof must be"),
        (change("inertial_parameters", "values_si", [1.0, 2.0]), r"finite numbers of shape \(10,\)"),
        (change("inertial_parameters", "values_si", ["a"] * 10), r"finite numbers of shape \(10,\)"),
        (change("inertial_parameters", "covariance_si", [[1.0]]), r"finite numbers of shape \(10, 10\)"),
        (change("mass_matrix", "matrix_si", BIG), "triangle|matrix of inertial_parameters"),
        (change("mass_kg", 4.0e-6), "mass_kg must be"),
        (change("center_of_mass_in_scan_mm", [0.0, 0.0, 0.0]), "center_of_mass_in_scan_mm must be where"),
        (change("mass_matrix_reduced", "matrix_si", [[1.0]]), "mass_matrix_reduced.matrix_si must"),
        (change("frames", "scan_from_footplate", np.diag([1.0, 1, -1, 1]).tolist()), "right-handed"),
    ],
)
def test_every_fault_of_a_record_is_refused(tmp_path, edit, match):
    raw = mass_record()
    edit(raw)
    with pytest.raises(StapeskitError, match=match):
        read_mass_record(write_record(tmp_path, raw))


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("{", "must be mass.json, a JSON object; got Expecting"),
        ("[1]", "a JSON object; got list"),
        (None, "an existing mass.json"),
    ],
)
def test_what_is_no_record_is_refused(tmp_path, text, match):
    path = tmp_path / "mass.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(StapeskitError, match=match):
        read_mass_record(path)


def test_all_faults_come_at_once(tmp_path):
    raw = mass_record()
    raw["frames"]["plate_from_footplate"][0][3] += 1.0
    raw["center_of_mass_in_scan_mm"] = [9.0, 9.0, 9.0]
    with pytest.raises(StapeskitError) as caught:
        read_mass_record(write_record(tmp_path, raw))
    assert len(str(caught.value).splitlines()) == 2


def times(factor, *keys):
    """Return an edit that scales one number of a record."""

    def apply(raw):
        place = raw
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] *= factor

    return apply


def moved_plate(raw):
    raw["frames"]["plate_from_footplate"][0][3] += 1.0


def correlated_beyond_one(raw):
    covariance = np.array(raw["inertial_parameters"]["covariance_si"])
    covariance[0, 1] = covariance[1, 0] = 2.0 * np.sqrt(covariance[0, 0] * covariance[1, 1])
    raw["inertial_parameters"]["covariance_si"] = covariance.tolist()


TENSOR = "inertia_about_center_of_mass_in_scan_axes_kg_m2"
POSE = ("frames", "pose_covariance", "scan_from_footplate", "matrix_si")


@pytest.mark.parametrize(
    ("edit", "match"),
    [
        (change("mass_kg", float("nan")), "mass_kg must be a finite number; got NaN or infinity"),
        (change("mass_kg", "abc"), 'mass_kg must be a finite number; got "abc"'),
        (change("mass_kg", True), "mass_kg must be a finite number; got True"),
        (change("mass_kg", -3.2e-6), "mass_kg must be positive"),
        (change("density_kg_m3", "heavy"), "density_kg_m3 must be a finite number"),
        (change("density_kg_m3", 1700.0), "density_kg_m3 times volume_m3 must be mass_kg"),
        (change("center_of_mass_in_scan_mm", "q"), "center_of_mass_in_scan_mm must be finite numbers"),
        (change("frames", []), "frames must be an object; got \\[\\]"),
        (change("frames", "scan_from_footplate", 0, 0, "x"), "frames.scan_from_footplate must be finite"),
        (change("frames", "scan_from_plate", "abc"), 'frames.scan_from_plate must be .* got "abc"'),
        (
            change("frames", "scan_from_plate", None),
            "scan_from_plate must be given together with plate_from_foot",
        ),
        (change("frames", "plate_from_footplate", None), "null in a file without|given together with"),
        (moved_plate, r"plate_from_footplate must be inverse\(scan_from_plate\).*1 mm"),
        (
            times(-1.0, *POSE, 0, 0),
            "scan_from_footplate.matrix_si must be a covariance .*a variance of -2.5e",
        ),
        (times(-1.0, "inertial_parameters", "covariance_si", 4, 4), "a covariance .*a variance of -"),
        (correlated_beyond_one, "positive semidefinite"),
        (
            times(2.0, "inertial_parameters", "contributions_si", "levels", 0, 0),
            "the sum of contributions_si",
        ),
        (times(-1.0, "mass_matrix", "standard_deviation_si", 0, 0), "must be zero or positive"),
        (times(3.0, "mass_matrix", "standard_deviation_si", 0, 0), "must be that of inertial_parameters"),
        (times(-1.0, "mass_matrix_reduced", "standard_deviation_si", 0, 0), "must be zero or positive"),
        (
            times(3.0, "mass_matrix_plate_axes", "matrix_si", 3, 4),
            "must be mass_matrix turned into the plate",
        ),
        (times(3.0, TENSOR, 0, 1), "must be the tensor of inertial_parameters"),
        (change("warnings", [{"code": 3}]), "warnings must be a list of objects"),
    ],
)
def test_contradictions_and_wrong_types_are_refused(tmp_path, edit, match):
    raw = mass_record()
    edit(raw)
    with pytest.raises(StapeskitError, match=match) as caught:
        read_mass_record(write_record(tmp_path, raw))
    for line in str(caught.value).splitlines():
        assert "(mass.json). " in line


def test_with_added_masses_density_times_volume_is_the_bone_alone(tmp_path):
    raw = mass_record()
    raw["density_kg_m3"] *= 0.8
    raw["found"]["added_masses"] = [{"position_mm": [0.0, 0.0, 0.0], "mass_kg": 6.4e-7, "sd_kg": None}]
    assert read_mass_record(write_record(tmp_path, raw)).mass_matrix.parameters[0] == PARAMETERS[0]


def places_of(value, path=()):
    """Yield the path of every value in nested lists and objects, the first of equal entries only."""
    yield path
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from places_of(entry, (*path, key))
    elif isinstance(value, list) and value:
        yield from places_of(value[0], (*path, 0))


@pytest.mark.parametrize("junk", ["abc", float("nan"), -1.0, [], {}, True, 10**400, [[1.0], [1.0, 2.0]]])
def test_no_junk_anywhere_ends_in_a_traceback(tmp_path, junk):
    read = {"density_kg_m3", "volume_m3", "mass_kg", "frames", "inertial_parameters", "mass_matrix"}
    for path in list(places_of(mass_record()))[1:]:
        raw = mass_record()
        change(*path, junk)(raw)
        written = write_record(tmp_path, raw)
        if path[0] in read and path[-1] not in ("names", "convention"):
            with contextlib.suppress(StapeskitError):
                read_mass_record(written)
                harmless = junk in ([], {}) and path[-1] in ("contributions_si", "scan_from_plate")
                assert harmless or path[-1] == "pose_covariance", path
        else:
            with contextlib.suppress(StapeskitError):
                read_mass_record(written)


@pytest.mark.parametrize("size", [1e-4, 1e-2, 1.0])
@pytest.mark.parametrize(("one_two", "two_one", "good"), [
    (1.0, 1.0, True), (-0.5, -0.5, True), (1.01, 1.01, False), (-1.01, -1.01, False), (0.5, 0.4, False),
])  # fmt: skip
def test_a_covariance_is_judged_by_its_correlations_whatever_its_size(size, one_two, two_one, good):
    scale = np.array([3e-6, 1e-9, 1e-12])
    correlations = np.array([[1.0, one_two, 0.0], [two_one, 1.0, 0.0], [0.0, 0.0, 0.0]])
    checked = Checked({}, "mass.json")
    matrix = checked.covariance_of((size**2 * correlations * np.outer(scale, scale)).tolist(), "a", scale)
    assert (matrix is not None, checked.faults == []) == (good, good)


def test_mass_matrix_checks_its_parts():
    with pytest.raises(StapeskitError, match="10 numbers"):
        MassMatrix("footplate_centre", "footplate", np.ones(3))
    with pytest.raises(StapeskitError, match="covariance noise"):
        MassMatrix("footplate_centre", "footplate", PARAMETERS, {"noise": np.eye(3)})


def test_moved_mass_matrix_keeps_the_energy():
    matrix = MassMatrix("footplate_centre", "footplate", PARAMETERS, {"levels": np.diag(PARAMETERS**2)})
    rotation, shift = rotation_from_vector([0.3, 1.0, -0.4]), np.array([1e-3, -2e-4, 5e-4])
    moved = matrix.moved(rotation, shift, "elsewhere", "others")
    q = np.array([1e-7, 2e-7, -1e-7, 1e-4, -2e-4, 3e-4])
    q_new = twist_transfer(rotation, shift) @ q
    assert q_new @ moved.matrix @ q_new == pytest.approx(q @ matrix.matrix @ q, rel=1e-12)
    back = moved.moved(rotation.T, -rotation @ shift, "footplate_centre", "footplate")
    assert np.allclose(back.parameters, PARAMETERS, rtol=1e-9, atol=1e-22)
    scale = np.outer(np.abs(PARAMETERS), np.abs(PARAMETERS))
    assert np.max(np.abs(back.covariance - matrix.covariance) / scale) < 1e-7


def test_frame_derivative_is_the_change_under_a_displaced_frame():
    derivative = frame_derivative(PARAMETERS)
    assert derivative[1, 0] == pytest.approx(-PARAMETERS[0])
    assert derivative[2, 5] == pytest.approx(-PARAMETERS[1])
    assert derivative[1, 5] == pytest.approx(PARAMETERS[2])
    assert np.allclose(derivative[0], 0.0, atol=1e-20)
