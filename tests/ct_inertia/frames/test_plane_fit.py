"""Planes fitted to grey values: a blurred box in closed form, whole and cut by the border of the scan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from legacy.ct_inertia.frames.plane_faces import PlaneFace, large_faces
from legacy.ct_inertia.frames.plane_fit import _is_covered, fit_to_grey_values
from legacy.ct_inertia.frames.plate_frame import plate_frame
from legacy.ct_inertia.surface.isosurface import iso_surface
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.frames import rotation_from_vector, vector_from_rotation

HALF = np.array([1.6, 0.25, 1.1])
VOXEL, SIGMA = 0.025, 0.031
AIR, PLASTIC = 8000.0, 15000.0


def scanned_box(rotation, centre, size, noise, seed=1, voxel=VOXEL, half=HALF, bone=None):
    """Grey values of a box in the scan: blurred by a Gaussian in closed form, with noise."""
    z, y, x = np.meshgrid(*(voxel * np.arange(n) for n in size[::-1]), indexing="ij")
    points = np.stack([x, y, z], axis=-1) - centre
    local = points @ rotation
    edges = ndtr((half - local) / SIGMA) - ndtr((-half - local) / SIGMA)
    grey = AIR + (PLASTIC - AIR) * edges.prod(axis=-1)
    if bone is not None:
        grey[np.linalg.norm(local - bone, axis=-1) < 0.4] = 30000.0
    grey += np.random.default_rng(seed).normal(0.0, noise, grey.shape)
    return Volume(np.round(grey).astype(np.uint16), np.full(3, voxel), np.zeros(3), np.eye(3))


def surface_of(volume, step=3):
    """Coarse closed surface of the box, and which of its vertices cap it at the border."""
    from scipy.ndimage import gaussian_filter

    coarse = volume.array[step // 2 :: step, step // 2 :: step, step // 2 :: step].astype(np.float32)
    share = np.clip((gaussian_filter(coarse, 0.7) - AIR) / (PLASTIC - AIR), -1.0, 1.0)
    scale = np.diag([*(volume.spacing_mm * step), 1.0])
    scale[:3, 3] = volume.spacing_mm * (step // 2)
    surface = iso_surface(share, 0.5, scale)
    index = (surface.vertices_mm - scale[:3, 3]) / (volume.spacing_mm * step)
    last = np.array(share.shape[::-1]) - 1
    return surface, np.any((index < -0.02) | (index > last + 0.02), axis=1)


def frame_of(volume, rotation, centre):
    surface, border = surface_of(volume)
    above = rotation @ [0.1, 1.2, 0.0] + centre
    return plate_frame(surface, above, border, volume, SIGMA)


def deviation(frame, rotation, top):
    found = rotation.T @ frame.scan_from_plate.rotation
    turn = np.diag([np.sign(found[0, 0]), 1.0, np.sign(found[0, 0])])
    return rotation.T @ (frame.scan_from_plate.translation_mm - top), vector_from_rotation(found @ turn)


@pytest.mark.parametrize("vector", [(0.0, 0.0, 0.0), (0.05, 0.2, -0.1), (0.4, -0.7, 0.2)])
def test_a_noisy_box_is_found_far_below_a_voxel(vector):
    rotation = rotation_from_vector(vector)
    reach = np.abs(rotation) @ HALF + 0.3
    size = np.ceil(2.0 * reach / VOXEL).astype(int)
    centre = 0.5 * size * VOXEL + [0.004, -0.007, 0.003]
    frame = frame_of(scanned_box(rotation, centre, size, 400.0), rotation, centre)
    origin, turn = deviation(frame, rotation, centre + rotation @ [0.0, HALF[1], 0.0])
    assert np.abs(origin).max() < 1e-3
    assert np.abs(turn).max() < 2e-4
    sd = np.sqrt(np.diag(frame.covariance))
    assert np.all(np.abs(np.concatenate([1e-3 * origin, turn])) < 3.5 * sd)
    assert not frame.cropped


def test_bone_on_the_face_does_not_count():
    rotation = rotation_from_vector((0.05, 0.2, -0.1))
    reach = np.abs(rotation) @ HALF + 0.4
    size = np.ceil(2.0 * reach / VOXEL).astype(int)
    centre = 0.5 * size * VOXEL
    volume = scanned_box(rotation, centre, size, 400.0, bone=np.array([0.6, 0.3, 0.2]))
    surface, border = surface_of(scanned_box(rotation, centre, size, 400.0))
    above = rotation @ [0.1, 1.2, 0.0] + centre
    frame = plate_frame(surface, above, border, volume, SIGMA)
    origin, turn = deviation(frame, rotation, centre + rotation @ [0.0, HALF[1], 0.0])
    assert np.abs(origin).max() < 1e-3
    assert np.abs(turn).max() < 2e-4


@pytest.mark.parametrize("degrees", [8.0, 11.0, 30.0])
def test_a_border_that_cuts_the_plate_at_a_small_angle_is_kept_apart(degrees):
    """The scan ends on a plane that leaves the plate's face by a few degrees and crops a sixth of it."""
    rotation = rotation_from_vector(np.radians([0.0, 0.0, degrees]))
    reach = np.abs(rotation) @ HALF + 0.3
    size = np.ceil(2.0 * reach / VOXEL).astype(int)
    centre = 0.5 * size * VOXEL
    top = centre + rotation @ [0.0, HALF[1], 0.0]
    cut = top + rotation @ [1.0, 0.0, 0.0]
    size[1] = int(cut[1] / VOXEL)
    frame = frame_of(scanned_box(rotation, centre, size, 400.0), rotation, centre)
    assert frame.cropped
    origin, turn = deviation(frame, rotation, top)
    assert np.abs(turn).max() < 3e-4
    assert abs(origin[1]) < 1e-3
    # What is left of the face ends where its plane leaves the scan, half a voxel behind the last centre.
    edge = (VOXEL * (size[1] - 0.5) - top[1]) / np.sin(np.radians(degrees))
    assert origin[0] == pytest.approx(0.5 * (edge - HALF[0]), abs=2e-3)
    assert abs(origin[2]) < 2e-3


def test_blurred_bone_above_most_of_the_face_does_not_move_it():
    rotation, centre, size = (
        rotation_from_vector((0.05, 0.2, -0.1)),
        np.array([2.2, 1.0, 1.8]),
        (176, 80, 144),
    )
    volume = scanned_box(rotation, centre, size, 350.0)
    z, y, x = np.meshgrid(*(VOXEL * np.arange(n) for n in size[::-1]), indexing="ij")
    local = (np.stack([x, y, z], axis=-1) - centre) @ rotation
    bone = (
        22000.0 * ndtr((local[..., 1] - HALF[1] - 7.0 * SIGMA) / SIGMA) * ndtr((0.7 - local[..., 0]) / SIGMA)
    )
    near = Volume(
        np.round(volume.array + bone).astype(np.uint16), volume.spacing_mm, volume.origin_mm, np.eye(3)
    )
    surface, border = surface_of(volume)
    above = rotation @ [0.1, 1.2, 0.0] + centre
    frame = plate_frame(surface, above, border, near, SIGMA)
    shift, turn = deviation(frame, rotation, centre + rotation @ [0.0, HALF[1], 0.0])
    assert abs(shift[1]) < 5e-4
    assert np.abs(turn).max() < 5e-4
    assert abs(shift[1]) < 3e3 * np.sqrt(frame.covariance[1, 1])


def test_a_sample_at_the_rim_covers_its_own_cell_and_no_other():
    """A piece of surface that rounding adds or drops must not move the whole grid of cells."""
    rng = np.random.default_rng(4)
    samples = np.column_stack([rng.uniform(-2.0, 2.0, (4000, 2)), np.zeros(4000)])
    face = PlaneFace(np.array([0.0, 0.0, 1.0]), np.zeros(3), np.eye(3)[:, :2], np.eye(3), 16.0, samples)
    points = np.column_stack([rng.uniform(-2.5, 2.5, (3000, 2)), np.zeros(3000)])
    rim = np.vstack([samples, [-2.13, 0.05, 0.0]])
    changed = _is_covered(face, points) != _is_covered(replace(face, samples_mm=rim), points)
    assert np.all(np.linalg.norm(points[changed] - rim[-1], axis=1) < 0.3)


def test_a_long_low_side_that_its_surface_shows_tilted_is_fitted():
    """Over its height such a side moves by 15 um; its length, along the axis of the tilt, does not count."""
    size = np.ceil(2.0 * (HALF + 0.3) / VOXEL).astype(int)
    centre = 0.5 * size * VOXEL
    volume = scanned_box(np.eye(3), centre, size, 400.0)
    faces = large_faces(*surface_of(volume))
    side = next(face for face in faces if face.normal[2] > 0.99)
    turn = rotation_from_vector([0.06, 0.0, 0.0])
    tilted = replace(side, normal=turn @ side.normal, basis=turn @ side.basis)
    (fitted,) = fit_to_grey_values([tilted], [tilted], volume, SIGMA)
    assert fitted is not tilted
    assert np.arccos(fitted.normal[2]) < 2e-3
    assert abs(fitted.point_mm[2] - centre[2] - HALF[2]) < 1e-3
