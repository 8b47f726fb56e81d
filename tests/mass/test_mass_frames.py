"""The footplate frame: definition on exact meshes, sense by hints, covariance by influence functions."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np
import pytest

from ct_inertia.bodies import BodySurface
from ct_inertia.frames.anatomy import NO_HINT, AnatomyHints, directions, in_array_words
from ct_inertia.frames.footplate import FootplateFrame, footplate_frame
from ct_inertia.frames.footplate_face import solve_at
from ct_inertia.frames.footplate_sd import Influence, shown_noise
from ct_inertia.frames.landmarks import read_landmarks
from ct_inertia.surface.surface import Surface
from simulate import Ear, Scan, Stapes, rod, simulate_study, stapes_solid
from simulate import footplate_frame as true_frame
from stapeskit import ct2mass
from stapeskit.faults import StapeskitError
from stapeskit.frames import RigidTransform, rotation_from_vector
from stapeskit.registration import displacement

POSE = RigidTransform.from_parts(rotation_from_vector([0.4, -0.9, 1.3]), [31.0, -12.0, 57.0], "scan", "body")


def surface_of(stapes: Stapes, pose: RigidTransform = POSE) -> Surface:
    solid = stapes_solid(stapes).moved(pose)
    return Surface(solid.vertices_mm, solid.faces)


@functools.cache
def found_of(stapes: Stapes) -> FootplateFrame:
    return footplate_frame(surface_of(stapes), AnatomyHints(POSE.rotation[:, 0]))


@pytest.mark.parametrize(
    "stapes",
    [Stapes(), Stapes(family="analytic"), Stapes(family="foreign gutter"), Stapes(warp=0.05, seed=3)],
    ids=str,
)
def test_the_frame_is_that_of_the_definition(stapes: Stapes) -> None:
    truth = POSE @ RigidTransform(true_frame(stapes_solid(stapes)).matrix, "body", "footplate")
    step = displacement(found_of(stapes).scan_from_footplate, truth)
    assert np.all(np.abs(step[:3]) < 2e-8)  # m
    assert np.all(np.abs(np.degrees(step[3:])) < 4e-4)


@pytest.mark.parametrize("step_mm", [0.08, 0.04])
def test_the_frame_of_a_symmetric_body_is_exact_on_any_mesh(step_mm: float) -> None:
    """The analytic stapes is symmetric: its frame is known without any mesh."""
    step = displacement(found_of(Stapes(family="analytic", step_mm=step_mm)).scan_from_footplate, POSE)
    assert np.linalg.norm(step[:3]) < 3e-8


def test_the_frame_turns_with_the_body() -> None:
    other = RigidTransform.from_parts(rotation_from_vector([-2.0, 0.3, 0.8]), [0.0, 1.0, 2.0], "scan", "body")
    hints = AnatomyHints(other.rotation[:, 0])
    found = footplate_frame(surface_of(Stapes(), other), hints).scan_from_footplate
    first = POSE.inverse() @ found_of(Stapes()).scan_from_footplate
    second = other.inverse() @ found
    assert np.all(np.abs(displacement(first, second)) < [1e-8] * 3 + [1e-5] * 3)


def test_a_mirrored_ear_has_the_mirrored_frame() -> None:
    """z = x cross y is superior in a left ear and inferior in a right one."""
    left, right = found_of(Stapes()), found_of(Stapes(mirrored=True))
    assert left.length_mm == pytest.approx(right.length_mm, abs=1e-4)
    assert left.face_area_mm2 == pytest.approx(right.face_area_mm2, rel=1e-5)
    np.testing.assert_allclose(
        np.sort(left.outline_mm[:, 2])[[0, -1]], -np.sort(right.outline_mm[:, 2])[[-1, 0]], atol=1e-4
    )


@pytest.mark.parametrize(
    ("name", "place", "side"),
    [
        ("anterior", [1.0, 0.0, 0.2], None),
        ("posterior", [-1.0, 0.0, 0.2], None),
        ("superior", [0.2, 0.0, 0.6], "left"),
        ("inferior", [0.2, 0.0, -0.6], "left"),
        ("superior", [0.2, 0.0, -0.6], "right"),
        ("inferior", [0.2, 0.0, 0.6], "right"),
    ],
)
@pytest.mark.parametrize("turn", [0.0, np.pi])
def test_every_hint_gives_x_its_sense(name: str, place: list[float], side: str | None, turn: float) -> None:
    half = RigidTransform.from_parts(rotation_from_vector([0.0, turn, 0.0]), np.zeros(3), "body", "body")
    pose = POSE @ half
    hints = AnatomyHints(None, {name: pose.points(place)}, side)
    frame = footplate_frame(surface_of(Stapes(family="analytic"), pose), hints)
    assert frame.scan_from_footplate.rotation[:, 0] @ pose.rotation[:, 0] > 0.999
    assert frame.anterior_from == f"landmark {name}"
    assert not frame.notices


def test_without_a_hint_scan_x_decides_and_is_reported() -> None:
    frame = footplate_frame(surface_of(Stapes()))
    assert frame.scan_from_footplate.rotation[0, 0] > 0.0
    assert frame.anterior_from == NO_HINT
    assert [notice.code for notice in frame.notices] == ["anterior_not_given"]


@pytest.mark.parametrize(("angle_deg", "codes"), [(60.0, []), (80.0, ["anterior_weak"])])
def test_an_anterior_far_off_the_long_axis_is_weak_and_not_missing(angle_deg, codes) -> None:
    turn = np.radians(angle_deg)
    hints = AnatomyHints(np.cos(turn) * POSE.rotation[:, 0] + np.sin(turn) * POSE.rotation[:, 1])
    frame = footplate_frame(surface_of(Stapes()), hints)
    assert frame.scan_from_footplate.rotation[:, 0] @ POSE.rotation[:, 0] > 0.99
    assert [notice.code for notice in frame.notices] == codes


def test_hints_that_contradict_each_other_are_refused() -> None:
    hints = AnatomyHints(POSE.rotation[:, 0], {"anterior": POSE.points([-1.0, 0.0, 0.0])})
    with pytest.raises(StapeskitError) as error:
        footplate_frame(surface_of(Stapes()), hints)
    assert error.value.faults[0].thing == "the anatomical hints"


@pytest.mark.parametrize(
    ("hints", "thing"),
    [
        (AnatomyHints(POSE.rotation[:, 2]), "--anterior"),
        (AnatomyHints(None, {"head": POSE.points([0.0, 9.0, 0.0])}), "landmark head"),
        (AnatomyHints(None, {"footplate_centre": POSE.points([0.0, 3.0, 0.0])}), "landmark footplate_centre"),
        (AnatomyHints(None, {"anterior": POSE.points([0.01, 0.0, 0.3])}), "landmark anterior"),
        (AnatomyHints(None, {"anterior": POSE.points([1.2, 0.0, 0.0]) * 1e3}), "landmark anterior"),  # in um
        (
            AnatomyHints(None, {"superior": POSE.points([0.0, 0.0, 0.6]) * [-1, -1, 1]}, "left"),
            "landmark superior",
        ),  # RAS
    ],
)
def test_hints_that_do_not_fit_the_body_are_refused(hints: AnatomyHints, thing: str) -> None:
    with pytest.raises(StapeskitError) as error:
        footplate_frame(surface_of(Stapes()), hints)
    assert error.value.faults[0].thing == thing


def test_superior_without_a_side_is_refused_alone_and_left_out_beside_anterior() -> None:
    points = {"superior": POSE.points([0.0, 0.0, 0.6])}
    with pytest.raises(StapeskitError):
        AnatomyHints(None, points)
    frame = footplate_frame(surface_of(Stapes()), AnatomyHints(POSE.rotation[:, 0], points))
    (notice,) = frame.notices
    assert notice.code == "file_read"
    assert "--side left" in notice.text


def test_the_directions_are_named_by_the_side() -> None:
    assert directions("left", True)["+z"] == directions("right", True)["-z"] == "superior"
    assert "+x" not in directions("left", False)
    turned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    assert in_array_words(np.array([1.0, 0.0, 0.0]), turned) == "rising y (rows)"
    assert in_array_words(np.array([0.0, 0.0, 1.0]), turned) == "falling z (slices)"


NOTHING = np.zeros((2, 2, 2), dtype=np.float32)
FITTED = BodySurface(NOTHING, np.eye(4), 0.0, 9e-4 * np.eye(3), 0.0, NOTHING, 0.1, level_sd_mm=0.004)


def test_influence_functions_predict_what_a_bump_does() -> None:
    """Heights well inside the face move y and the tilts by the integral of their influence.

    A turn of y moves the rim, which turns y a little more: that is not in the influence functions.
    """
    stapes = Stapes(family="analytic", step_mm=0.02)
    surface = surface_of(stapes)
    base = found_of(stapes).scan_from_footplate
    solved = solve_at(surface, -POSE.rotation[:, 1], 3.7)
    solved = solved.turned(float(np.sign(solved.axes[:, 0] @ base.rotation[:, 0])))
    influence = Influence(solved)
    local = base.inverse().points(surface.vertices_mm)
    normals = np.zeros_like(surface.vertices_mm)
    for corner in range(3):
        np.add.at(normals, surface.faces[:, corner], surface.area_vectors_mm2)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    medial = normals @ POSE.rotation[:, 1] < 0.2

    def height(points: np.ndarray) -> np.ndarray:
        return 1e-4 * np.exp(-((points[:, 0] - 0.6) ** 2 + (points[:, 2] + 0.1) ** 2) / (2.0 * 0.1**2))

    moved = surface.vertices_mm + (height(local) * medial)[:, None] * normals
    found = footplate_frame(Surface(moved, surface.faces), AnatomyHints(POSE.rotation[:, 0]))
    step = displacement(base, found.scan_from_footplate)
    at = base.inverse().points(influence.points)
    predicted = (influence.heights * (height(at) * influence.areas)[:, None]).sum(axis=0)
    predicted[:3] *= 1e-3
    assert step[1] == pytest.approx(predicted[1], rel=1e-3)
    np.testing.assert_allclose(step[[3, 5]], predicted[[3, 5]], rtol=0.15)


def test_noise_of_the_height_scatters_the_frame_as_stated() -> None:
    """White height noise on twelve surfaces: scatter of the frame, and the noise that they show."""
    surface = surface_of(Stapes(family="analytic", step_mm=0.03))
    normals = np.zeros_like(surface.vertices_mm)
    areas = np.zeros(len(surface.vertices_mm))
    for corner in range(3):
        np.add.at(normals, surface.faces[:, corner], surface.area_vectors_mm2)
        np.add.at(areas, surface.faces[:, corner], np.linalg.norm(surface.area_vectors_mm2, axis=1) / 3.0)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    density = 3e-9  # mm4
    rng = np.random.default_rng(5)
    poses, stated, shown = [], [], []
    for _ in range(12):
        noise = rng.standard_normal(len(areas)) * np.sqrt(density / areas)
        shaken = Surface(surface.vertices_mm + noise[:, None] * normals, surface.faces)
        frame = footplate_frame(shaken, AnatomyHints(POSE.rotation[:, 0]), FITTED)
        poses.append(frame.scan_from_footplate)
        stated.append(np.sqrt(np.diag(frame.contributions["noise"])))
        shown.append(shown_noise(solve_at(shaken, -POSE.rotation[:, 1], 3.7)))
    assert np.median(shown) == pytest.approx(density, rel=0.3)
    steps = np.array([displacement(poses[0], pose) for pose in poses[1:]])
    ratio = np.std(steps, axis=0, ddof=1) / np.median(stated, axis=0)
    assert np.all((ratio > 0.5) & (ratio < 1.9))  # chi of 11 at 0.1 %


def test_the_frame_of_real_bone_errs_as_stated(tmp_path: Path) -> None:
    """Turns of the plane in four quiet scans of warped ears, whose shape is not smooth on any scale."""
    errors = []
    for seed in range(4):
        ear = Ear(stapes=Stapes(warp=0.02, seed=seed), bone=False, plate=False)
        truth = simulate_study(ear, Scan(voxel_um=26.0, noise=0.01, seed=seed), None, tmp_path / str(seed))
        anterior = truth.scan_from_footplate.rotation[:, 0]
        found = ct2mass(str(tmp_path / str(seed) / "scan.tif"), anterior=tuple(anterior)).footplate
        step = displacement(truth.scan_from_footplate, found.scan_from_footplate)
        errors.append(step / np.sqrt(np.diag(sum(found.contributions.values()))))
    size = np.sqrt(np.mean(np.square(errors), axis=0))
    assert np.all(size[[3, 5]] < 1.55)  # chi of 4 at 5 %


def test_a_level_that_errs_moves_the_origin_by_its_shift() -> None:
    frame = footplate_frame(surface_of(Stapes()), AnatomyHints(POSE.rotation[:, 0]), FITTED)
    sd = np.sqrt(np.diag(frame.contributions["levels"]))
    np.testing.assert_allclose(sd, [0.0, 4e-6, 0.0, 0.0, 0.0, 0.0])


def test_a_body_far_larger_than_a_stapes_is_refused_before_memory_is_taken_for_it() -> None:
    usual = surface_of(Stapes())
    with pytest.raises(StapeskitError) as error:
        footplate_frame(Surface(8.0 * usual.vertices_mm, usual.faces))
    assert error.value.faults[0].thing == "the surface"


def test_a_round_footplate_has_no_long_axis() -> None:
    column = rod([0.0, 0.0, 0.0], [0.0, 3.0, 0.0], 1.3, 60)
    frame = footplate_frame(Surface(column.vertices_mm, column.faces))
    assert "long_axis_weak" in {notice.code for notice in frame.notices}


POINTS = {"anterior": [1.0, 2.0, 3.0], "Footplate-Center": [4.0, 5.0, 6.0]}


def test_landmarks_of_slicer_are_turned_to_lps(tmp_path: Path) -> None:
    path = tmp_path / "points.mrk.json"
    controls = [{"label": name, "position": place} for name, place in POINTS.items()]
    controls.append({"label": "head", "position": [0, 0, 0], "positionStatus": "undefined"})
    markups = {"coordinateSystem": "RAS", "coordinateUnits": "cm", "controlPoints": controls}
    path.write_text(json.dumps({"markups": [markups]}))
    found = read_landmarks(path)
    np.testing.assert_allclose(found["anterior"], [-10.0, -20.0, 30.0])
    assert set(found) == {"anterior", "footplate_centre"}


@pytest.mark.parametrize(("header", "signs"), [("", [-1, -1, 1]), ("# CoordinateSystem = LPS\n", [1, 1, 1])])
def test_landmarks_of_fcsv_have_the_system_that_they_say(
    tmp_path: Path, header: str, signs: list[int]
) -> None:
    path = tmp_path / "points.fcsv"
    row = '1,1.0,2.0,3.0,0,0,0,1,1,1,0,"anterior"'
    path.write_text(f"{header}{row}\n")
    np.testing.assert_allclose(read_landmarks(path)["anterior"], np.array([1.0, 2.0, 3.0]) * signs)


@pytest.mark.parametrize(
    ("name", "text", "thing"),
    [
        ("a.csv", "name,x_mm,y_mm,z_mm\nanterior,1,2,3\nanterior,1,2,3\n", "landmark anterior"),
        ("a.csv", "name,x_mm,y_mm,z_mm\nelsewhere,1,2,3\n", "the landmarks"),
        ("a.csv", "name,x_mm,y_mm\nanterior,1,2\n", "the columns"),
        ("a.mrk.json", '{"markups": [{"coordinateUnits": "apples"}]}', "coordinateUnits"),
        ("a.mrk.json", '{"points": []}', "the landmark file"),
        ("a.fcsv", "1,2,3\n", "a row of an .fcsv file"),
        ("a.txt", "anterior 1 2 3\n", "--landmarks"),
    ],
)
def test_wrong_landmark_files_are_refused(tmp_path: Path, name: str, text: str, thing: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(StapeskitError) as error:
        read_landmarks(path)
    assert error.value.faults[0].thing == thing


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        (
            "a.csv",
            "name,x_mm,y_mm,z_mm\nanterior,1,2,x\nhead,,2,3\nhead,1,2,3\nsuperior,1\n",
            {("z_mm", 2), ("landmark head", 3), ("landmark head", 4), ("a row", 5)},
        ),
        (
            "a.mrk.json",
            '{"markups": [{"controlPoints": [{"label": "head", "position": [1, "x", 2]}, '
            '{"label": "head", "position": [1, 2, 3]}, {"label": "anterior", "position": [1]}]}]}',
            {("landmark head", 1), ("landmark head", 2), ("landmark anterior", 3)},
        ),
        (
            "a.fcsv",
            "# columns = id,x,y,z,label\n1,1,2,x,head\n2,1\n3,1,2,inf,anterior\n",
            {("landmark head", 2), ("a row of an .fcsv file", 3), ("landmark anterior", 4)},
        ),
    ],
)
def test_all_faults_of_a_landmark_file_come_together(
    tmp_path: Path, name: str, text: str, expected: set[tuple[str, int]]
) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(StapeskitError) as error:
        read_landmarks(path)
    assert {(fault.thing, *fault.where.numbers) for fault in error.value.faults} == expected  # type: ignore[union-attr]
