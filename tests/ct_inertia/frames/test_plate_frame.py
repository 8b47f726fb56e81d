"""The plate frame from faces and from fiducials."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.frames.plate_fiducials import plate_frame_from_fiducials, read_plate_fiducials
from legacy.ct_inertia.frames.plate_frame import plate_frame, positive_sense
from legacy.ct_inertia.surface.surface import Surface
from legacy.ct_inertia.surface.surface_field import Mesh, refine_edges
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.frames import rotation_from_vector, vector_from_rotation
from tests.ct_inertia.shapes import box, moved, outward

SIZE = (4.0, 1.0, 3.0)
POSES = [((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), ((0.3, -0.8, 1.9), (5.0, -3.0, 40.0))]


def fine(surface, edge=0.06):
    mesh = refine_edges(Mesh(surface.vertices_mm, surface.faces), edge)
    return Surface(mesh.points, mesh.faces)


fine_box = cache(lambda size: fine(box(size)))


def plate(size=SIZE, noise=0.0, seed=0):
    surface = fine_box(size)
    rng = np.random.default_rng(seed)
    return Surface(surface.vertices_mm + rng.normal(0.0, noise, surface.vertices_mm.shape), surface.faces)


def stapes_above(rotation, shift):
    return rotation @ [0.2, 1.5, 0.1] + shift


def codes(frame):
    return [notice.code for notice in frame.notices]


def deviation(frame, rotation, shift, origin=(0.0, 0.5, 0.0)):
    """Origin (mm) in plate axes and rotation (rad) against the box's own frame."""
    found = rotation.T @ frame.scan_from_plate.rotation
    turn = np.diag([np.sign(found[0, 0]), 1.0, np.sign(found[0, 0])])
    return rotation.T @ (frame.scan_from_plate.translation_mm - shift) - origin, vector_from_rotation(
        found @ turn
    )


@pytest.mark.parametrize(("vector", "shift"), POSES)
def test_a_box_has_its_own_frame(vector, shift):
    rotation = rotation_from_vector(vector)
    frame = plate_frame(moved(plate(), rotation, shift), stapes_above(rotation, shift))
    origin, turn = deviation(frame, rotation, np.array(shift))
    assert np.abs(origin).max() < 1e-6
    assert np.abs(turn).max() < 1e-6
    assert len(frame.outline_mm) == 4
    assert not frame.cropped
    assert positive_sense(frame.scan_from_plate.rotation[:, 0]) @ frame.scan_from_plate.rotation[:, 0] > 0.0
    assert "plate_axis_sign" in codes(frame)


def test_the_face_looks_at_the_stapes():
    below = np.array([0.0, -2.0, 0.0])
    assert plate_frame(plate(), below).scan_from_plate.rotation[1, 1] == pytest.approx(-1.0)


def test_noise_stays_within_the_covariance():
    normalised = []
    for seed in range(10):
        rotation = rotation_from_vector(np.random.default_rng(seed).normal(size=3))
        frame = plate_frame(moved(plate(noise=0.004, seed=seed), rotation), stapes_above(rotation, (0, 0, 0)))
        origin, turn = deviation(frame, rotation, np.zeros(3))
        assert np.abs(origin).max() < 1e-3
        assert np.abs(turn).max() < 4e-4
        normalised.append(np.concatenate([origin * 1e-3, turn]) / np.sqrt(np.diag(frame.covariance)))
    rms = np.sqrt(np.mean(np.square(normalised), axis=0))
    assert np.all(rms < 1.7), rms
    assert np.all(rms > 0.2), rms


def test_bone_glued_over_a_corner_does_not_move_the_frame():
    surface = plate()
    vertices = surface.vertices_mm.copy()
    lump = (vertices[:, 1] > 0.49) & (np.hypot(vertices[:, 0] - 1.5, vertices[:, 2] - 1.0) < 0.8)
    vertices[lump, 1] += 0.3 + 0.3 * np.sin(7.0 * vertices[lump, 0])
    origin, turn = deviation(
        plate_frame(Surface(vertices, surface.faces), stapes_above(np.eye(3), 0)), np.eye(3), 0
    )
    assert np.abs(origin).max() < 1e-3
    assert np.abs(turn).max() < 1e-4


def test_a_cropped_plate_is_told_and_keeps_its_axes():
    surface = plate()
    border = surface.vertices_mm[:, 0] > 1.999
    frame = plate_frame(surface, stapes_above(np.eye(3), 0), border)
    assert frame.cropped
    assert "plate_cropped" in codes(frame)
    assert np.allclose(frame.scan_from_plate.rotation, np.eye(3), atol=1e-6)


def test_a_border_that_cuts_at_a_shallow_angle_crops_all_the_same():
    slope = 0.31
    lower = np.array([[x, -0.5, z] for x in (-2.0, 2.0) for z in (-1.5, 1.5)])
    cut = np.array([[1.0, z] for z in (-1.5, 1.5)])
    upper = np.column_stack([np.r_[-2.0, -2.0, cut[:, 0]], np.full(4, 0.5), np.r_[-1.5, 1.5, cut[:, 1]]])
    end = np.array([[2.0, 0.5 - slope, z] for z in (-1.5, 1.5)])
    corners = np.vstack([lower, upper, end])
    hull = ConvexHull(corners)
    sides = np.cross(*(corners[hull.simplices[:, k]] - corners[hull.simplices[:, 0]] for k in (1, 2)))
    inward = np.einsum("ij,ij->i", sides, hull.equations[:, :3]) < 0.0
    surface = fine(Surface(corners, np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)))
    points = surface.vertices_mm
    border = np.abs(points[:, 1] - 0.5 + slope * (points[:, 0] - 1.0)) < 1e-6
    frame = plate_frame(surface, stapes_above(np.eye(3), 0), border)
    assert frame.cropped
    np.testing.assert_allclose(frame.scan_from_plate.translation_mm, [-0.5, 0.5, 0.0], atol=1e-5)


def test_a_plate_without_an_edge_in_view_is_told():
    surface = plate()
    border = np.any(np.abs(surface.vertices_mm[:, [0, 2]]) > np.array([1.999, 1.499]), axis=1)
    frame = plate_frame(surface, stapes_above(np.eye(3), 0), border)
    assert "plate_edges_not_visible" in codes(frame)
    assert frame.covariance[4, 4] > 0.5


def test_a_square_plate_is_ambiguous():
    frame = plate_frame(plate((3.0, 1.0, 3.05)), stapes_above(np.eye(3), 0))
    assert "plate_axis_ambiguous" in codes(frame)
    assert "plate_axis_ambiguous" not in codes(plate_frame(plate(), stapes_above(np.eye(3), 0)))


def test_a_round_plate_has_its_centre():
    angle = np.linspace(0.0, 2.0 * np.pi, 241)[:-1]
    lift = np.array([0.0, 0.5, 0.0])
    ring = np.column_stack([np.cos(angle), np.zeros(240), np.sin(angle)]) * 2.0
    points = np.vstack([ring + lift, ring - lift, lift[None], -lift[None]])
    k, after = np.arange(240), np.roll(np.arange(240), -1)
    faces = [np.column_stack(c) for c in ((k, after, after + 240), (k, after + 240, k + 240))]
    faces += [np.column_stack([after, k, 0 * k + 480]), np.column_stack([k + 240, after + 240, 0 * k + 481])]
    disc = fine(outward(points, np.vstack(faces)), 0.1)
    frame = plate_frame(disc, stapes_above(np.eye(3), 0))
    assert "plate_edges_not_visible" in codes(frame)
    assert np.allclose(frame.scan_from_plate.translation_mm, [0.0, 0.5, 0.0], atol=0.02)


def test_a_body_without_a_face_towards_the_stapes_is_refused():
    with pytest.raises(
        CtInertiaError, match="the plate must be a solid with a plane face towards the stapes"
    ):
        plate_frame(plate(), np.zeros(3))


CORNERS = np.array([[-2.0, 0.5, -1.5], [2.0, 0.5, -1.5], [2.0, 0.5, 1.5], [-2.0, 0.5, 1.5]])


def write(path, scan, reference=None, extra=""):
    header = "name,x_mm,y_mm,z_mm" + (",x_ref_mm,y_ref_mm,z_ref_mm" if reference is not None else "")
    rows = scan if reference is None else np.hstack([scan, reference])
    lines = [f"p{k}," + ",".join(f"{value:.9f}" for value in row) for k, row in enumerate(rows)]
    path.write_text("\n".join([header, *lines]) + "\n" + extra)
    return path


class TestFiducials:
    rotation = rotation_from_vector((0.3, -0.8, 1.9))
    shift = np.array([5.0, -3.0, 40.0])

    def test_with_coordinates_in_the_plate_give_the_rigid_fit(self, tmp_path):
        reference = np.vstack([CORNERS, [[0.0, 1.5, 0.3]]])
        path = write(tmp_path / "f.csv", reference @ self.rotation.T + self.shift, reference)
        frame = plate_frame_from_fiducials(read_plate_fiducials(path), np.zeros(3))
        assert np.allclose(frame.scan_from_plate.rotation, self.rotation, atol=1e-7)
        assert np.allclose(frame.scan_from_plate.translation_mm, self.shift, atol=1e-6)
        assert frame.source == "fiducials"

    def test_corners_in_any_order_give_the_frame_of_the_face(self, tmp_path):
        path = write(tmp_path / "f.csv", CORNERS[[2, 0, 3, 1]] @ self.rotation.T + self.shift)
        above = self.rotation @ [0.0, 2.0, 0.0] + self.shift
        frame = plate_frame_from_fiducials(read_plate_fiducials(path), above)
        origin, turn = deviation(frame, self.rotation, self.shift)
        assert np.abs(origin).max() < 1e-6
        assert np.abs(turn).max() < 1e-6
        assert "plate_axis_sign" in codes(frame)

    def test_a_mirrored_set_is_refused(self, tmp_path):
        reference = np.vstack([CORNERS, [[0.0, 1.5, 0.3]]])
        path = write(tmp_path / "f.csv", reference * [-1.0, 1.0, 1.0], reference)
        with pytest.raises(StapeskitError, match="mirror image"):
            plate_frame_from_fiducials(read_plate_fiducials(path), np.zeros(3))

    def test_corners_of_a_square_are_ambiguous(self, tmp_path):
        path = write(tmp_path / "f.csv", CORNERS * [0.75, 1.0, 1.0])
        frame = plate_frame_from_fiducials(read_plate_fiducials(path), np.array([0.0, 2.0, 0.0]))
        assert "plate_axis_ambiguous" in codes(frame)

    def test_points_on_a_line_are_refused(self, tmp_path):
        path = write(tmp_path / "f.csv", np.outer([0.0, 1.0, 2.0], [1.0, 1.0, 1.0]))
        with pytest.raises(CtInertiaError, match="must be corners of a face; got points on a line"):
            plate_frame_from_fiducials(read_plate_fiducials(path), np.zeros(3))

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("name,x_mm,y_mm\na,1,2\n", "got no z_mm"),
            ("name,x_mm,y_mm,z_mm,x_ref_mm\na,1,2,3,4\n", "got no y_ref_mm, z_ref_mm"),
            ("name,x_mm,y_mm,z_mm\na,1,2,3\nb,1,2,4\n", "at least 3 points; got 2"),
            ("name,x_mm,y_mm,z_mm\na,1,2,3\na,1,2,4\nb,1,0,0\n", "must be different; got a, a, b"),
            (
                "name,x_mm,y_mm,z_mm\na,1,2,3\nb,1,,4\nc,1,0,0\n",
                "y_mm must be a finite number; got nothing .*line 3",
            ),
            ("name,x_mm,y_mm,z_mm,sd_mm\na,1,2,3,1\nb,1,2,4,0\nc,1,0,0,1\n", "sd_mm must be positive"),
        ],
    )
    def test_a_faulty_file_is_told(self, tmp_path, text, message):
        path = tmp_path / "f.csv"
        path.write_text(text)
        with pytest.raises(CtInertiaError, match=message):
            read_plate_fiducials(path)
