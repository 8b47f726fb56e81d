"""The plate frame: planes of a mesh, conventions of its axes, fiducials; and the gap around the footplate."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ct_inertia.bodies import BodySurface, MeasuredBody
from ct_inertia.ct2mass import _plate_frame
from ct_inertia.frames.fiducials import PlateFiducials, plate_frame_from_fiducials, read_plate_fiducials
from ct_inertia.frames.footplate import footplate_frame
from ct_inertia.frames.gap import window_gap
from ct_inertia.frames.plate import plane_faces
from ct_inertia.frames.plate_frame import PlateFrame, plate_frame
from ct_inertia.surface.contour import contour
from ct_inertia.surface.fields import refined
from ct_inertia.surface.surface import Surface, as_mesh
from simulate import Ear, Scan, box, coverage_of, simulate_truth
from simulate.solids import joined
from stapeskit.faults import StapeskitError
from stapeskit.frames import RigidTransform, rotation_from_vector
from stapeskit.registration import displacement

POSE = RigidTransform.from_parts(rotation_from_vector([0.2, 0.15, -0.1]), [4.0, 5.0, 6.0], "scan", "plate")
STAPES = POSE.points([0.2, 1.5, 0.1])


def slab(length: float, width: float, pose: RigidTransform = POSE) -> Surface:
    solid = box([-0.5 * length, -0.5, -0.5 * width], [0.5 * length, 0.0, 0.5 * width]).moved(pose)
    return Surface(*refined(solid.vertices_mm, solid.faces, 0.15))


def codes(frame: PlateFrame) -> set[str]:
    return {notice.code for notice in frame.notices}


def framed(surface: Surface, stapes_mm: np.ndarray = STAPES) -> PlateFrame:
    frame = plate_frame(plane_faces(surface), stapes_mm)
    assert frame is not None
    return frame


@pytest.mark.parametrize("turn_deg", [0.0, 35.0, 100.0, 260.0])
def test_the_axes_are_those_of_the_convention(turn_deg: float) -> None:
    turn = rotation_from_vector([0.0, np.radians(turn_deg), 0.0])
    pose = POSE @ RigidTransform.from_parts(turn, np.zeros(3), "plate", "plate")
    frame = framed(slab(4.4, 3.0, pose))
    found = frame.scan_from_plate
    np.testing.assert_allclose(found.translation_mm, POSE.translation_mm, atol=1e-5)
    np.testing.assert_allclose(found.rotation[:, 1], POSE.rotation[:, 1], atol=1e-6)
    assert abs(abs(found.rotation[:, 0] @ pose.rotation[:, 0]) - 1.0) < 1e-9
    assert found.rotation[0, 0] > 0.0
    assert codes(frame) == {"plate_axis_sign"}
    assert not frame.cropped


def test_the_stapes_says_which_face_it_is() -> None:
    below = POSE.points([0.2, -2.0, 0.1])
    frame = framed(slab(4.4, 3.0), below).scan_from_plate
    np.testing.assert_allclose(frame.rotation[:, 1], -POSE.rotation[:, 1], atol=1e-6)
    np.testing.assert_allclose(frame.translation_mm, POSE.points([0.0, -0.5, 0.0]), atol=1e-5)


def test_edges_of_one_length_are_reported_as_ambiguous() -> None:
    assert "plate_axis_ambiguous" in codes(framed(slab(3.0, 2.9)))
    assert "plate_axis_ambiguous" not in codes(framed(slab(3.0, 2.8)))


def test_a_plate_that_the_scan_crops_is_reported() -> None:
    solid = slab(4.4, 3.0)
    local = POSE.inverse().points(solid.vertices_mm)
    cropped = Surface(solid.vertices_mm, solid.faces, np.abs(local[:, 2] - 1.5) < 1e-6)
    frame = framed(cropped)
    assert frame.cropped
    assert "plate_cropped" in codes(frame)


def test_a_ball_is_no_plate() -> None:
    from simulate import ellipsoid

    ball = ellipsoid([0.0, 0.0, 0.0], [1.0, 1.0, 1.0])
    faces = plane_faces(Surface(ball.vertices_mm, ball.faces))
    assert plate_frame(faces, np.array([0.0, 3.0, 0.0])) is None


def test_plastic_without_a_plane_face_leaves_the_plate_frame_out_with_a_warning() -> None:
    """A scan beside which a lump of plastic lies is measured; only M in the plate's axes is missing."""
    from simulate import ellipsoid

    ball = ellipsoid([0.0, 0.0, 0.0], [1.0, 1.0, 1.0])
    plate = Surface(ball.vertices_mm, ball.faces)
    region = SimpleNamespace(named=True, one_of_several=False, scan_from_index=np.eye(4))
    labelled = SimpleNamespace(plate_region=region)
    measured = SimpleNamespace(plate=plate, plate_faces=tuple(plane_faces(plate)), labelled=labelled)
    work = SimpleNamespace(fiducials=None, measured=measured, notices=[])
    moments = SimpleNamespace(centroid_mm=np.array([0.0, 3.0, 0.0]))
    assert _plate_frame(work, moments) is None  # type: ignore[arg-type]
    assert [notice.code for notice in work.notices] == ["plate_not_found"]


@pytest.mark.parametrize(("low_mm", "plate"), [(-0.3, False), (0.05, True)], ids=["a fluid", "a plate"])
def test_a_block_that_covers_the_foot_of_the_stapes_is_a_fluid(low_mm: float, plate: bool) -> None:
    block = slab(4.4, 3.0)
    heights = np.linspace(low_mm, 1.2, 50)
    bone = SimpleNamespace(
        scan_points=lambda _: POSE.points(np.column_stack([0 * heights, heights, 0 * heights]))
    )
    region = SimpleNamespace(named=False, one_of_several=False, scan_from_index=np.eye(4))
    labelled = SimpleNamespace(plate_region=region, box=bone, stapes=np.ones((1, 1, 1), dtype=bool))
    measured = MeasuredBody(labelled, None, None, None, None, block, tuple(plane_faces(block)))  # type: ignore[arg-type]
    work = SimpleNamespace(fiducials=None, measured=measured, notices=[])
    found = _plate_frame(work, SimpleNamespace(centroid_mm=STAPES))  # type: ignore[arg-type]
    assert (found is not None) == plate
    assert [notice.code for notice in work.notices] == ([] if plate else ["plate_not_found"])


def test_the_plate_of_a_scan_is_found_below_two_micrometres() -> None:
    from scipy.ndimage import gaussian_filter

    truth = simulate_truth(Ear(), Scan(voxel_um=40.0, seed=5))
    placed = truth.placed
    plates = [solid for solid, material in placed.solids if material == "plastic"]
    share = sum(coverage_of(solid, placed.shape, placed.voxel_mm, samples=3) for solid in plates)
    noise = np.random.default_rng(1).normal(0.0, 0.1, share.shape)
    field = gaussian_filter(gaussian_filter(share, 1.2) + noise, 0.7).astype(np.float32) - np.float32(0.5)
    transform = np.eye(4)
    transform[:3, :3] *= placed.voxel_mm
    frame = framed(contour(field, transform), truth.centre_of_mass_in_scan_mm)
    step = displacement(truth.scan_from_plate, frame.scan_from_plate)
    sd = np.sqrt(np.diag(frame.covariance))
    assert np.all(np.abs(step) < 4.5 * sd + np.array([2e-7] * 3 + [2e-5] * 3))
    assert np.all(sd < np.array([1e-6] * 3 + [2e-4] * 3))


CORNERS = np.array([[2.2, 0.0, 1.5], [-2.2, 0.0, 1.5], [-2.2, 0.0, -1.5], [2.2, 0.0, -1.5]])


def test_corners_of_the_face_define_the_frame_in_any_order() -> None:
    points = POSE.points(CORNERS)
    for order in ([0, 1, 2, 3], [2, 0, 3, 1]):
        frame = plate_frame_from_fiducials(PlateFiducials(tuple("abcd"), points[order]), STAPES)
        np.testing.assert_allclose(frame.scan_from_plate.matrix, POSE.matrix, atol=1e-9)
        assert frame.source == "fiducials"
        assert codes(frame) == {"plate_axis_sign"}


def test_points_with_places_in_the_plate_are_fitted() -> None:
    local = np.array([*CORNERS, [0.3, 0.7, -0.4]])
    frame = plate_frame_from_fiducials(PlateFiducials(tuple("abcde"), POSE.points(local), local), STAPES)
    np.testing.assert_allclose(frame.scan_from_plate.matrix, POSE.matrix, atol=1e-9)
    with pytest.raises(StapeskitError):  # on a line
        plate_frame_from_fiducials(
            PlateFiducials(("a", "b", "c"), np.arange(3.0)[:, None] * np.ones(3)), STAPES
        )


@pytest.mark.parametrize(
    "local",
    [CORNERS[:3], [*CORNERS[:3], CORNERS[1]], [*CORNERS, [-1.95, 0.45, 1.3]]],
    ids=["three", "one twice", "a pin"],
)
def test_points_that_are_not_the_corners_of_a_face_are_refused(local) -> None:
    """The middle of three corners is .9 mm from that of the face, and the diagonal longer than any edge."""
    points = POSE.points(np.array(local))
    with pytest.raises(StapeskitError) as error:
        plate_frame_from_fiducials(PlateFiducials(tuple("abcde")[: len(points)], points), STAPES)
    assert error.value.faults[0].thing == "the points of --plate-fiducials"


@pytest.mark.parametrize("sd_mm", [None, np.array([0.01, 0.06, 0.03, 0.05, 0.02])], ids=["by hand", "stated"])
def test_corners_that_scatter_give_the_frame_within_its_standard_deviation(sd_mm) -> None:
    """Also where a point of an edge is among them: the origin is that of the face, not of the points."""
    local = np.array([*CORNERS, [0.0, 0.0, -1.5]])
    rng = np.random.default_rng(4)
    scatter = np.full(5, 0.03) if sd_mm is None else sd_mm
    squares = []
    for _ in range(200):
        points = POSE.points(local + scatter[:, None] * rng.normal(size=(5, 3)))
        frame = plate_frame_from_fiducials(PlateFiducials(tuple("abcde"), points, sd_mm=sd_mm), STAPES)
        off = displacement(frame.scan_from_plate, POSE)
        squares.append(off**2 / np.diag(frame.covariance))
    assert np.all(np.abs(np.sqrt(np.mean(squares, axis=0)) - 1.0) < 0.35)


@pytest.mark.parametrize(
    ("factor", "mirror", "thing"),
    [(1e3, 1.0, "the points of --plate-fiducials"), (1e-3, 1.0, "the points of --plate-fiducials"),
     (1.0, -1.0, "the stapes")],
    ids=["um", "m", "a mirrored plane"],
)  # fmt: skip
def test_fiducials_in_another_unit_or_of_a_mirrored_plane_are_refused(factor, mirror, thing) -> None:
    local = CORNERS * np.array([1.0, 1.0, mirror])
    given = PlateFiducials(tuple("abcd"), POSE.points(CORNERS) * factor, local * factor)
    with pytest.raises(StapeskitError) as error:
        plate_frame_from_fiducials(given, STAPES)
    assert error.value.faults[0].thing == thing


def test_fiducials_are_read_with_what_they_have(tmp_path: Path) -> None:
    path = tmp_path / "f.csv"
    path.write_text("name;x_mm;y_mm;z_mm;sd_mm\na;1,5;2;3;0,01\nb;4;5;6;0,02\nc;7;8;1;0,01\n")
    found = read_plate_fiducials(path)
    assert found.names == ("a", "b", "c")
    assert found.plate_mm is None
    np.testing.assert_allclose(found.scan_mm[0], [1.5, 2.0, 3.0])
    np.testing.assert_allclose(found.sd_mm, [0.01, 0.02, 0.01])


@pytest.mark.parametrize(
    ("text", "thing"),
    [
        ("name,x_mm,y_mm\na,1,2\n", "the columns of --plate-fiducials"),
        ("name,x_mm,y_mm,z_mm\na,1,2,3\nb,1,2,\nc,4,5,6\n", "z_mm"),
        ("name,x_mm,y_mm,z_mm\na,1,2,3\na,1,2,4\nc,4,5,6\n", "the names of --plate-fiducials"),
        ("name,x_mm,y_mm,z_mm\na,1,2,3\nb,1,2,4\n", "--plate-fiducials"),
        ("name,x_mm,y_mm,z_mm,sd_mm\na,1,2,3,0\nb,1,2,4,1\nc,4,5,6,1\n", "sd_mm"),
    ],
)
def test_wrong_fiducials_are_refused(tmp_path: Path, text: str, thing: str) -> None:
    path = tmp_path / "f.csv"
    path.write_text(text)
    with pytest.raises(StapeskitError) as error:
        read_plate_fiducials(path)
    assert thing in {fault.thing for fault in error.value.faults}


@pytest.mark.parametrize("gap_mm", [0.05, 0.2])
def test_the_gap_of_exact_surfaces_is_the_one_that_was_built(gap_mm: float) -> None:
    ear = Ear(gap_mm=gap_mm)
    bones = [solid for solid, material in ear.solids() if material == "bone"]
    wall = joined(*bones[1:])
    stapes = Surface(bones[0].vertices_mm, bones[0].faces)
    found = window_gap(footplate_frame(stapes), stapes, Surface(wall.vertices_mm, wall.faces))
    assert found is not None
    assert found.median_mm == pytest.approx(gap_mm, abs=0.003)
    assert found.harmonic_mm <= found.median_mm + found.spread_mm
    assert found.rim_share > 0.9


def test_a_level_that_is_off_changes_the_gap_by_what_its_sd_states() -> None:
    """Both surfaces grow by 10 um along their normals, as they do when the level is too low."""

    def grown(surface: Surface, by_mm: float) -> Surface:
        mesh = as_mesh(surface.vertices_mm, surface.faces).compute_normals(
            point_normals=True, cell_normals=False, split_vertices=False, consistent_normals=False
        )
        return Surface(surface.vertices_mm + by_mm * mesh.point_normals, surface.faces)

    bones = [solid for solid, material in Ear(gap_mm=0.12).solids() if material == "bone"]
    wall = joined(*bones[1:])
    stapes, other = (Surface(part.vertices_mm, part.faces) for part in (bones[0], wall))
    frame = footplate_frame(stapes)
    nothing = np.zeros((2, 2, 2), dtype=np.float32)
    body = BodySurface(nothing, np.eye(4), 0.0, 1e-12 * np.eye(3), 0.0, nothing, 0.1, level_sd_mm=0.01)
    stated = window_gap(frame, stapes, other, (body, body))
    off = window_gap(frame, grown(stapes, 0.01), grown(other, 0.01))
    assert stated is not None and off is not None  # noqa: PT018
    found = abs(off.median_mm - stated.median_mm)
    assert found <= stated.sd_mm < 1.3 * found  # normals at the rounded rim are not all across the gap
