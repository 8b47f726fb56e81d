"""The footplate frame: known phantoms, every flip and transpose, hints, faults, covariance."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.frames.anatomy import AnatomyHints
from legacy.ct_inertia.frames.footplate import footplate_frame, footplate_pose
from legacy.ct_inertia.frames.footplate_face import FACE_ANGLE_DEG
from legacy.ct_inertia.surface.surface import Surface
from legacy.stapeskit.frames import rotation_from_vector, vector_from_rotation
from tests.ct_inertia.shapes import PARTS, box, moved, outward, signed_permutations, stapes


def small_motion(frame, rotation, shift):
    """Origin (mm) and rotation (rad) of a found frame against the one the body was built in."""
    found = rotation.T @ frame.scan_from_footplate.rotation
    turn = np.diag([np.sign(found[0, 0]), 1.0, np.sign(found[0, 0])])
    return rotation.T @ (frame.scan_from_footplate.translation_mm - shift), vector_from_rotation(found @ turn)


@cache
def known_frame():
    """The frame of the stapes in its own axes."""
    return footplate_frame(stapes(), AnatomyHints(anterior=(1.0, 0.0, 0.0)))


def codes(frame):
    return [notice.code for notice in frame.notices]


class TestTheFrameOfAKnownStapes:
    def test_stands_where_the_footplate_was_built(self):
        frame = known_frame()
        origin, rotation = small_motion(frame, np.eye(3), np.zeros(3))
        assert np.abs(origin[[0, 2]]).max() < 1e-3
        assert 0.0 < origin[1] < 0.008
        assert np.degrees(np.abs(rotation)).max() < 0.02
        assert np.allclose(frame.scan_from_footplate.rotation, np.eye(3), atol=1e-3)

    def test_measures_footplate_and_height(self):
        frame = footplate_frame(stapes())
        assert frame.length_mm == pytest.approx(2.87, abs=0.03)
        assert frame.width_mm == pytest.approx(1.375, abs=0.03)
        assert frame.height_mm == pytest.approx(3.48, abs=0.03)
        assert frame.face_rms_mm < 0.02

    def test_height_of_the_centre_is_that_of_the_exact_face(self):
        # Flat part (offset ellipse) at height 0, and the rim (circle of 0.1 mm) up to the angle of the face.
        a, b, r = 1.35, 0.6, 0.1
        flat = np.pi * a * b
        t = np.linspace(0.0, 2.0 * np.pi, 2001)[:-1]
        speed = np.hypot(a * np.sin(t), b * np.cos(t))
        perimeter = speed.mean() * 2.0 * np.pi
        theta = np.linspace(0.0, np.radians(FACE_ANGLE_DEG), 2001)
        ring = r * (perimeter + 2.0 * np.pi * r * np.sin(theta))
        area = flat + np.trapezoid(ring, theta)
        expected = np.trapezoid(ring * r * (1.0 - np.cos(theta)), theta) / area
        frame = footplate_frame(stapes(0.03))
        assert frame.scan_from_footplate.translation_mm[1] == pytest.approx(expected, abs=1.5e-3)
        assert frame.face_area_mm2 == pytest.approx(area, rel=0.02)

    @settings(max_examples=5, deadline=None, phases=(Phase.explicit, Phase.generate))
    @given(st.tuples(*[st.floats(-3.0, 3.0)] * 3), st.tuples(*[st.floats(-50.0, 50.0)] * 3))
    def test_moves_with_the_body(self, vector, shift):
        rotation = rotation_from_vector(vector)
        reference = known_frame()
        hints = AnatomyHints(anterior=rotation[:, 0])
        pose = footplate_pose(moved(stapes(), rotation, shift), hints, 0.0)
        expected = rotation @ reference.scan_from_footplate.rotation
        assert np.allclose(pose.rotation, expected, atol=1e-5)
        origin = rotation @ reference.scan_from_footplate.translation_mm + shift
        assert np.allclose(pose.translation_mm, origin, atol=1e-4)

    def test_does_not_depend_on_the_triangles(self):
        coarse, fine = (footplate_frame(stapes(step)) for step in (0.06, 0.03))
        apart = coarse.scan_from_footplate.translation_mm - fine.scan_from_footplate.translation_mm
        assert np.abs(apart).max() < 3e-3
        turn = coarse.scan_from_footplate.rotation.T @ fine.scan_from_footplate.rotation
        assert np.degrees(np.linalg.norm(vector_from_rotation(turn))) < 0.1

    def test_covariance_covers_surface_noise(self):
        rng = np.random.default_rng(4)
        surface = stapes()
        clean = footplate_frame(surface)
        normalised = []
        for _ in range(12):
            noisy = Surface(
                surface.vertices_mm + rng.normal(0.0, 0.004, surface.vertices_mm.shape), surface.faces
            )
            frame = footplate_frame(noisy)
            origin, rotation = small_motion(
                frame, clean.scan_from_footplate.rotation, clean.scan_from_footplate.translation_mm
            )
            sd = np.sqrt(np.diag(frame.contributions["noise"]))
            normalised.append(np.concatenate([origin * 1e-3, rotation]) / sd)
        rms = np.sqrt(np.mean(np.square(normalised), axis=0))
        assert np.all(rms < 1.8), rms
        assert np.all(rms > 0.15), rms


class TestEveryFlipAndTranspose:
    def test_parts_keep_their_names(self):
        """A mirrored stapes is one of the other side: superior goes to -z, everything else stays."""
        for turn in list(signed_permutations())[::3]:
            names = {name: turn @ point for name, point in PARTS.items()}
            landmarks = {name: names[name] for name in ("anterior", "head")}
            pose = footplate_pose(moved(stapes(0.08), turn), AnatomyHints(landmarks=landmarks), 0.0)
            local = {name: pose.inverse().points(p) for name, p in names.items()}
            side = np.sign(np.linalg.det(turn))
            assert local["head"][1] > 2.5
            assert local["anterior"][0] > 1.2
            assert local["posterior"][0] < -1.2
            assert local["superior"][2] * side > 0.5
            assert local["inferior"][2] * side < -0.5

    @pytest.mark.parametrize(("side", "sign"), [("left", 1.0), ("right", -1.0)])
    @pytest.mark.parametrize("name", ["superior", "inferior"])
    def test_superior_and_inferior_tell_anterior_when_the_side_is_known(self, side, sign, name):
        hints = AnatomyHints(landmarks={name: np.array(PARTS[name])}, side=side)
        frame = footplate_frame(stapes(0.06), hints)
        assert frame.scan_from_footplate.rotation[0, 0] * sign > 0.99

    def test_side_alone_changes_nothing(self):
        left, right = (footplate_frame(stapes(0.06), AnatomyHints(side=side)) for side in ("left", "right"))
        assert np.array_equal(left.scan_from_footplate.matrix, right.scan_from_footplate.matrix)


class TestHints:
    def test_without_any_x_is_the_sense_along_scan_x(self):
        for turn in (np.eye(3), np.diag([-1.0, 1.0, -1.0])):
            frame = footplate_frame(moved(stapes(0.06), turn))
            assert frame.scan_from_footplate.rotation[0, 0] > 0.99
            assert "anterior_not_given" in codes(frame)

    @pytest.mark.parametrize("anterior", [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (-0.4, 0.9, 0.1)])
    def test_only_the_sign_of_anterior_counts(self, anterior):
        frame = footplate_frame(stapes(0.06), AnatomyHints(anterior=anterior))
        assert frame.scan_from_footplate.rotation[0, 0] * np.sign(anterior[0]) > 0.99
        assert "anterior_not_given" not in codes(frame)

    def test_a_weak_direction_is_told(self):
        assert "anterior_weak" in codes(footplate_frame(stapes(0.06), AnatomyHints(anterior=(0.2, 1.0, 0.0))))

    def test_a_direction_square_to_the_footplate_is_refused(self):
        with pytest.raises(CtInertiaError, match=r"--anterior must be within 87 degrees of the long axis"):
            footplate_frame(stapes(0.06), AnatomyHints(anterior=(0.01, 0.0, 1.0)))

    def test_contradicting_hints_are_refused(self):
        hints = AnatomyHints((-1.0, 0.0, 0.0), {"anterior": np.array(PARTS["anterior"])})
        with pytest.raises(
            CtInertiaError, match=r"of one mind .* --anterior says .*; landmark anterior says"
        ):
            footplate_frame(stapes(0.06), hints)

    def test_a_wrong_side_contradicts(self):
        marks = {name: np.array(PARTS[name]) for name in ("anterior", "superior")}
        footplate_frame(stapes(0.06), AnatomyHints(landmarks=marks, side="left"))
        with pytest.raises(CtInertiaError, match="wrong --side or a mirrored scan"):
            footplate_frame(stapes(0.06), AnatomyHints(landmarks=marks, side="right"))

    def test_a_landmark_at_the_centre_tells_nothing(self):
        hints = AnatomyHints(landmarks={"anterior": np.array([0.02, 0.0, 0.0])})
        with pytest.raises(CtInertiaError, match=r"landmark anterior must be at least 0.1 mm off"):
            footplate_frame(stapes(0.06), hints)

    def test_superior_needs_the_side(self):
        with pytest.raises(CtInertiaError, match="landmark superior must be given together with the side"):
            AnatomyHints(landmarks={"superior": np.array(PARTS["superior"])})

    def test_superior_without_side_is_left_out_beside_a_better_hint(self):
        marks = {name: np.array(PARTS[name]) for name in ("anterior", "superior")}
        assert "side_not_given" in codes(footplate_frame(stapes(0.06), AnatomyHints(landmarks=marks)))

    def test_a_head_on_the_medial_side_is_refused(self):
        hints = AnatomyHints(landmarks={"head": np.array([0.0, -0.9, 0.0])})
        with pytest.raises(CtInertiaError, match="landmark head must be on the lateral side"):
            footplate_frame(stapes(0.06), hints)

    def test_a_footplate_centre_elsewhere_is_refused(self):
        hints = AnatomyHints(landmarks={"footplate_centre": np.array([0.0, 3.0, 0.0])})
        with pytest.raises(CtInertiaError, match="landmark footplate_centre must be within 1 mm"):
            footplate_frame(stapes(0.06), hints)

    @pytest.mark.parametrize("direction", [(0.0, 0.0, 0.0), (np.nan, 1.0, 0.0), (1.0, 0.0)])
    def test_a_direction_that_is_none_is_refused(self, direction):
        with pytest.raises(CtInertiaError, match="--anterior must be a non-zero direction"):
            AnatomyHints(anterior=direction)

    def test_an_unknown_side_is_refused(self):
        with pytest.raises(CtInertiaError, match="--side must be left or right; got up"):
            AnatomyHints(side="up")

    def test_a_landmark_that_is_no_point_is_refused(self):
        with pytest.raises(CtInertiaError, match="landmark head must be three finite numbers"):
            AnatomyHints(landmarks={"head": (1.0, np.inf, 0.0)})


class TestBodiesThatAreNoStapes:
    def test_two_equal_faces_are_told_and_the_head_settles_it(self):
        plate = box((3.0, 1.4, 0.4))
        assert "footplate_ambiguous" in codes(footplate_frame(plate))
        for sign in (1.0, -1.0):
            hints = AnatomyHints(landmarks={"head": np.array([0.0, 0.0, 1.1 * sign])})
            frame = footplate_frame(plate, hints)
            assert frame.scan_from_footplate.rotation[2, 1] * sign == pytest.approx(1.0, abs=1e-6)
            assert frame.scan_from_footplate.translation_mm[2] * sign == pytest.approx(-0.2, abs=0.02)

    def test_a_round_footplate_is_told(self):
        from skimage.measure import marching_cubes

        grid = np.stack(np.meshgrid(*[np.arange(-1.5, 1.5, 0.1)] * 3, indexing="ij"), axis=-1)
        level = np.maximum(np.hypot(grid[..., 0], grid[..., 1]) - 1.2, np.abs(grid[..., 2] - 0.02) - 0.6)
        vertices, faces, _, _ = marching_cubes(level, 0.0)
        assert "long_axis_weak" in codes(footplate_frame(outward(vertices * 0.1 - 1.5, faces)))


@pytest.mark.parametrize("name", ["conventions.md", "conventions.svg"])
def test_the_pages_state_the_cone_of_the_definition(name):
    page = Path(__file__).parents[3] / "docs" / name
    assert f"within {FACE_ANGLE_DEG:g}° of −y" in page.read_text(encoding="utf-8")
