"""mass.json: its writer is its checker; the mass matrix moves with its frame."""

from __future__ import annotations

import contextlib
import copy
import json
from pathlib import Path

import numpy as np
import pytest

from stapeskit.faults import StapeskitError
from stapeskit.frames import RigidTransform, rotation_from_vector
from stapeskit.provenance import document_hash, frames_hash
from stapeskit.records.mass_file import mass_json, mass_record, read_mass, read_mass_json
from stapeskit.records.mass_matrix import MassMatrix, frame_derivative, parameter_transfer
from stapeskit.records.mass_record import MassRecord
from stapeskit.spatial import matrix_from_parameters, twist_transfer
from stapeskit.warnings import Notice

PARAMETERS = np.array(
    [3.2e-6, 1.43e-10, 3.5e-9, 4.35e-10, 9.8e-12, 5.0e-12, 1.114e-11, -2.0e-13, -4.0e-13, 3.0e-14]
)
COVARIANCE = np.diag((0.01 * PARAMETERS) ** 2)
SCAN_FROM_FOOTPLATE = RigidTransform.from_parts(
    rotation_from_vector([0.4, -0.7, 1.1]), [3.0, -2.0, 5.0], "scan", "footplate"
)
SCAN_FROM_PLATE = RigidTransform.from_parts(
    rotation_from_vector([-0.2, 0.3, 0.9]), [-1.0, 4.0, -3.0], "scan", "plate"
)


def pose(size_m: float, size_rad: float) -> np.ndarray:
    return np.diag([size_m**2] * 3 + [size_rad**2] * 3)


@pytest.fixture(scope="module")
def record() -> MassRecord:
    parts = {"levels": 0.75 * COVARIANCE, "calibration.slope": 0.25 * COVARIANCE}
    return MassRecord(
        MassMatrix(PARAMETERS, contributions=parts),
        SCAN_FROM_FOOTPLATE,
        pose(5e-6, 1e-3),
        SCAN_FROM_PLATE,
        pose(2e-6, 2e-4),
        density_kg_m3=1600.0,
        volume_m3=float(PARAMETERS[0]) / 1600.0,
        notices=(Notice("anterior_not_given", "No hint."),),
    )


@pytest.fixture
def raw(record: MassRecord) -> dict:
    further = {"found": {"added_masses": []}, "frames": {"z_is": "unknown"}, "mass_known_by": "density"}
    return copy.deepcopy(mass_json(record, {"command": "ct2mass"}, further))


def faults_of(raw: object) -> list[str]:
    """Return the things at fault; each fault names the file and what to do."""
    with pytest.raises(StapeskitError) as caught:
        mass_record(raw)
    assert all(fault.where == "mass.json" and fault.next_step for fault in caught.value.faults)
    return [fault.thing for fault in caught.value.faults]


def test_what_is_written_is_read(tmp_path: Path, record: MassRecord, raw: dict) -> None:
    path = tmp_path / "mass.json"
    path.write_text(json.dumps(raw))
    read = read_mass_json(path)
    for name in ("parameters", "covariance", "matrix", "standard_deviation"):
        assert np.array_equal(getattr(read.mass_matrix, name), getattr(record.mass_matrix, name))
    assert list(read.mass_matrix.contributions) == ["levels", "calibration.slope"]
    assert np.array_equal(read.scan_from_footplate.matrix, SCAN_FROM_FOOTPLATE.matrix)
    assert np.array_equal(read.footplate_covariance, record.footplate_covariance)
    assert np.array_equal(read.plate_covariance, record.plate_covariance)
    assert (read.density_kg_m3, read.volume_m3) == (record.density_kg_m3, record.volume_m3)
    assert read.notices == record.notices
    assert read.raw == raw
    assert mass_json(read, raw["provenance"], raw) == raw
    assert document_hash(read.raw) == document_hash(raw)
    assert read_mass(path).provenance_input == path
    assert read_mass(read) is read


def test_the_keys_of_the_contract_are_there(raw: dict) -> None:
    blocks = {
        "schema", "density_kg_m3", "volume_m3", "mass_kg", "center_of_mass_in_scan_mm", "frames",
        "inertia_about_center_of_mass_in_scan_axes_kg_m2", "inertial_parameters", "mass_matrix",
        "mass_matrix_plate_axes", "mass_matrix_reduced", "warnings", "provenance",
    }  # fmt: skip
    assert blocks <= set(raw)
    poses = {"scan_from_footplate", "scan_from_plate", "plate_from_footplate", "pose_covariance", "z_is"}
    assert poses == set(raw["frames"])
    assert raw["mass_matrix_reduced"]["dof"] == ["y", "alpha", "gamma"]
    assert raw["mass_known_by"] == "density"
    assert np.allclose(
        raw["mass_matrix_reduced"]["matrix_si"], matrix_from_parameters(PARAMETERS)[1::2, 1::2]
    )


def test_statements_are_those_of_the_body(raw: dict) -> None:
    """Kinetic energy is the same in scan axes about the centre of mass and in both frames."""
    plate = SCAN_FROM_PLATE.inverse() @ SCAN_FROM_FOOTPLATE
    q = np.array([1e-7, 2e-7, -1e-7, 1e-4, -2e-4, 3e-4])
    energy = q @ np.array(raw["mass_matrix"]["matrix_si"]) @ q
    arm_m = 1e-3 * (np.array(raw["center_of_mass_in_scan_mm"]) - SCAN_FROM_FOOTPLATE.translation_mm)
    in_scan = twist_transfer(SCAN_FROM_FOOTPLATE.rotation, SCAN_FROM_FOOTPLATE.rotation.T @ arm_m) @ q
    tensor = np.array(raw["inertia_about_center_of_mass_in_scan_axes_kg_m2"])
    of_parts = raw["mass_kg"] * in_scan[:3] @ in_scan[:3] + in_scan[3:] @ tensor @ in_scan[3:]
    assert of_parts == pytest.approx(energy, rel=1e-9, abs=0.0)
    in_plate = twist_transfer(plate.rotation, np.zeros(3)) @ q
    about_plate = np.array(raw["mass_matrix_plate_axes"]["matrix_si"])
    assert in_plate @ about_plate @ in_plate == pytest.approx(energy, rel=1e-9, abs=0.0)


def test_a_record_without_plate_contributions_and_optional_blocks_is_read(raw: dict) -> None:
    raw["frames"] = {
        "scan_from_footplate": raw["frames"]["scan_from_footplate"],
        "plate_from_footplate": None,
    }
    raw["inertial_parameters"].pop("contributions_si")
    raw["mass_matrix_plate_axes"] = None
    for optional in ("mass_matrix_reduced", "warnings", "found", "density_kg_m3", "volume_m3"):
        raw.pop(optional)
    read = mass_record(raw)
    assert read.plate_from_footplate is None
    assert read.plate_covariance is None
    assert not read.footplate_covariance.any()
    assert list(read.mass_matrix.contributions) == ["unspecified"]


def test_words_about_the_covariance_of_a_pose_can_be_left_out(raw: dict, record: MassRecord) -> None:
    for pose in raw["frames"]["pose_covariance"].values():
        del pose["names"], pose["convention"]
    assert np.array_equal(mass_record(raw).footplate_covariance, record.footplate_covariance)


def test_another_density_keeps_the_hash_of_the_frames(raw: dict) -> None:
    other = copy.deepcopy(raw)
    other["inertial_parameters"]["values_si"][0] *= 1.1
    assert frames_hash(other) == frames_hash(raw)
    assert document_hash(other) != document_hash(raw)


def put(value: object, *keys: object):
    """Return an edit that sets one value of a record; None removes it."""

    def edit(raw: dict) -> None:
        place = raw
        for key in keys[:-1]:
            place = place[key]
        if value is None:
            place.pop(keys[-1])
        else:
            place[keys[-1]] = value(place[keys[-1]]) if callable(value) else value

    return edit


def times(factor: float):
    return lambda value: factor * value


def correlated_beyond_one(raw: dict) -> None:
    covariance = np.array(raw["inertial_parameters"]["covariance_si"])
    covariance[0, 1] = covariance[1, 0] = 2.0 * np.sqrt(covariance[0, 0] * covariance[1, 1])
    raw["inertial_parameters"]["covariance_si"] = covariance.tolist()


TENSOR = "inertia_about_center_of_mass_in_scan_axes_kg_m2"
POSE = ("frames", "pose_covariance", "scan_from_footplate", "matrix_si")
LEVELS = ("inertial_parameters", "contributions_si", "levels")
CUBE = np.array([3.2e-6, 0, 0, 0, 1e-12, 1e-12, 9e-12, 0, 0, 0]).tolist()


@pytest.mark.parametrize(("edit", "thing"), [
    (put("other/1", "schema"), "schema"),
    (put(None, "inertial_parameters"), "inertial_parameters.values_si"),
    (put("scan", "mass_matrix", "axes"), "mass_matrix.axes"),
    (put(["m"], "inertial_parameters", "names"), "inertial_parameters.names"),
    (put(["y"], "mass_matrix", "dof"), "mass_matrix.dof"),
    (put([1.0, 2.0], "inertial_parameters", "values_si"), "inertial_parameters.values_si"),
    (put(CUBE, "inertial_parameters", "values_si"), "the principal moments in the mass matrix"),
    (put(times(1.001), "mass_matrix", "matrix_si", 3, 3), "mass_matrix.matrix_si"),
    (put(4.0e-6, "mass_kg"), "mass_kg"),
    (put([0.0, 0.0, 0.0], "center_of_mass_in_scan_mm"), "center_of_mass_in_scan_mm"),
    (put("heavy", "density_kg_m3"), "density_kg_m3"),
    (put(-1.0, "volume_m3"), "density_kg_m3 times volume_m3"),
    (put(1700.0, "density_kg_m3"), "density_kg_m3 times volume_m3"),
    (put(["y", "q"], "mass_matrix_reduced", "dof"), "mass_matrix_reduced.dof"),
    (put([], "frames"), "frames.scan_from_footplate"),
    (put(np.diag([1.0, 1, -1, 1]).tolist(), "frames", "scan_from_footplate"), "scan_from_footplate"),
    (put(None, "frames", "scan_from_plate"), "frames.plate_from_footplate"),
    (put(None, "frames", "plate_from_footplate"), "frames.plate_from_footplate"),
    (put(times(1.1), "frames", "plate_from_footplate", 0, 3), "frames.plate_from_footplate"),
    (put(times(-1.0), *POSE, 0, 0), ".".join(POSE)),
    (put(["x"], *POSE[:-1], "names"), ".".join((*POSE[:-1], "names"))),
    (put(times(-1.0), "inertial_parameters", "covariance_si", 4, 4), "inertial_parameters.covariance_si"),
    (correlated_beyond_one, "inertial_parameters.covariance_si"),
    (put(times(2.0), *LEVELS, 0, 0), "inertial_parameters.covariance_si"),
    (put(times(-1.0), "mass_matrix", "standard_deviation_si", 0, 0), "mass_matrix.standard_deviation_si"),
    (put(times(3.0), "mass_matrix_reduced", "standard_deviation_si", 0, 0),
     "mass_matrix_reduced.standard_deviation_si"),
    (put(times(3.0), "mass_matrix_plate_axes", "matrix_si", 3, 4), "mass_matrix_plate_axes.matrix_si"),
    (put(times(3.0), TENSOR, 0, 1), TENSOR),
    (put([{"code": 3}], "warnings"), "warnings"),
])  # fmt: skip
def test_what_does_not_follow_or_cannot_be_is_refused(raw: dict, edit, thing: str) -> None:
    edit(raw)
    assert thing in faults_of(raw)


def test_all_faults_come_at_once(raw: dict) -> None:
    raw["frames"]["plate_from_footplate"][0][3] += 1.0
    raw["center_of_mass_in_scan_mm"] = [9.0, 9.0, 9.0]
    raw["warnings"] = 3
    wrong = {"frames.plate_from_footplate", "center_of_mass_in_scan_mm", "warnings"}
    assert set(faults_of(raw)) == wrong


@pytest.mark.parametrize("text", ["{", "[1]", "[" * 100_000, None])
def test_what_is_no_json_object_is_refused(tmp_path: Path, text: str | None) -> None:
    path = tmp_path / "mass.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(StapeskitError) as caught:
        read_mass_json(path)
    assert caught.value.faults[0].thing == "the mass file"


def test_with_added_masses_density_times_volume_is_the_bone_alone(raw: dict) -> None:
    raw["density_kg_m3"] *= 0.8
    raw["found"]["added_masses"] = [{"position_mm": [0.0, 0.0, 0.0], "mass_kg": 6.4e-7, "sd_kg": None}]
    assert mass_record(raw).mass_matrix.parameters[0] == PARAMETERS[0]


def places_of(value: object, path: tuple = ()):
    """Yield the path of every value in nested lists and objects, the first of equal entries only."""
    yield path
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from places_of(entry, (*path, key))
    elif isinstance(value, list) and value:
        yield from places_of(value[0], (*path, 0))


FREE = {"provenance", "warnings", "found", "mass_known_by"}


@pytest.mark.parametrize("junk", ["abc", float("nan"), -1.0, [], {}, True, 10**400, [[1.0], [1.0, 2.0]]])
def test_no_junk_anywhere_ends_in_a_traceback_or_is_believed(raw: dict, junk: object) -> None:
    for path in list(places_of(raw))[1:]:
        spoiled = copy.deepcopy(raw)
        put(junk, *path)(spoiled)
        free = FREE & {path[0]} or path[-1] in ("convention", "z_is")
        absent = junk in ([], {}) and path[-1] in {
            "contributions_si",
            "mass_matrix_reduced",
            "pose_covariance",
        }
        with contextlib.suppress(StapeskitError):
            mass_record(spoiled)
            assert free or absent or (junk == {} and path[0] == "mass_matrix_plate_axes"), path


def test_the_writer_refuses_what_the_reader_would(record: MassRecord) -> None:
    wrong = MassRecord(record.mass_matrix, SCAN_FROM_FOOTPLATE, density_kg_m3=1600.0, volume_m3=1.0)
    with pytest.raises(StapeskitError):
        mass_json(wrong)


def test_a_moved_mass_matrix_keeps_the_energy_and_moves_back() -> None:
    matrix = MassMatrix(PARAMETERS, np.diag(PARAMETERS**2))
    rotation, shift = rotation_from_vector([0.3, 1.0, -0.4]), np.array([1e-3, -2e-4, 5e-4])
    moved = matrix.moved(rotation, shift, "elsewhere", "others")
    q = np.array([1e-7, 2e-7, -1e-7, 1e-4, -2e-4, 3e-4])
    q_new = twist_transfer(rotation, shift) @ q
    assert q_new @ moved.matrix @ q_new == pytest.approx(q @ matrix.matrix @ q, rel=1e-9, abs=0.0)
    back = moved.moved(rotation.T, -rotation @ shift, "footplate_centre", "footplate")
    assert np.allclose(back.parameters, PARAMETERS, rtol=1e-9, atol=1e-22)
    scale = np.outer(np.abs(PARAMETERS), np.abs(PARAMETERS))
    assert np.max(np.abs(back.covariance - matrix.covariance) / scale) < 1e-7


def test_the_frame_derivative_is_the_change_under_a_displaced_frame() -> None:
    derivative = frame_derivative(PARAMETERS)
    for axis, step in enumerate([1e-7] * 3 + [1e-5] * 3):
        ends = []
        for sign in (1.0, -1.0):
            motion = sign * step * np.eye(6)[axis]
            ends.append(parameter_transfer(rotation_from_vector(motion[3:]).T, motion[:3]) @ PARAMETERS)
        central = (ends[0] - ends[1]) / (2.0 * step)
        size = np.maximum(np.abs(central), 1e-6 * np.max(np.abs(central)))
        assert np.max(np.abs(derivative[:, axis] - central) / size) < 1e-5
    assert derivative[1, 0] == pytest.approx(-PARAMETERS[0])


def test_the_error_of_the_plate_frame_turns_the_matrix_in_plate_axes(record: MassRecord) -> None:
    """Against a Monte Carlo of both frames, from the body in scan axes."""
    sure = MassRecord(
        MassMatrix(PARAMETERS), SCAN_FROM_FOOTPLATE, pose(5e-6, 1e-3), SCAN_FROM_PLATE, pose(2e-6, 2e-3)
    )
    rng, drawn = np.random.default_rng(1), []
    sd = [np.sqrt(np.diag(sure.footplate_covariance)), np.sqrt(np.diag(sure.plate_covariance))]
    for _ in range(4000):
        footplate, plate = (size * rng.normal(size=6) for size in sd)
        turned = SCAN_FROM_PLATE.perturbed(plate).rotation.T @ SCAN_FROM_FOOTPLATE.rotation
        drawn.append(matrix_from_parameters(parameter_transfer(turned, footplate[:3]) @ PARAMETERS))
    spread, stated = np.std(drawn, axis=0), sure.plate_mass_matrix.standard_deviation
    there = stated > 1e-3 * np.max(stated[3:, 3:])
    assert np.max(np.abs(spread[there] / stated[there] - 1.0)) < 0.06
