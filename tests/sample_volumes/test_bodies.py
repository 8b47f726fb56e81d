"""The made bodies against closed forms, the gap all round, and the frame of the made stapes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.ct_inertia.frames.anatomy import AnatomyHints
from legacy.ct_inertia.frames.footplate import footplate_frame
from legacy.ct_inertia.surface.surface import Surface
from sample_volumes import bodies
from sample_volumes.analytic import analytic_stapes, write_analytic_stapes
from sample_volumes.phantom import Ear, Renderer, scene, truth


def surface(solid):
    return Surface(solid.vertices, solid.faces)


def test_box_has_the_moments_of_a_box():
    low, high = np.array([-1.0, 0.5, 2.0]), np.array([2.0, 1.5, 4.0])
    found = surface(bodies.box(low, high)).moments()
    sides = high - low
    assert found.volume_mm3 == pytest.approx(6.0, rel=1e-14)
    np.testing.assert_allclose(found.centroid_mm, (low + high) / 2, atol=1e-14)
    np.testing.assert_allclose(found.second_mm5, np.diag(6.0 * sides**2 / 12.0), atol=1e-12)


def test_ellipsoid_converges_to_its_closed_form_with_the_square_of_the_step():
    radii, centre = np.array([0.4, 0.2, 0.3]), np.array([5.0, -3.0, 1.0])
    volume = 4.0 / 3.0 * np.pi * radii.prod()
    wanted = np.diag(volume * radii**2 / 5.0)
    errors = []
    for steps in (24, 48, 96):
        found = surface(bodies.ellipsoid(centre, radii, steps)).moments()
        np.testing.assert_allclose(found.centroid_mm, centre, atol=1e-12)
        errors.append([1.0 - found.volume_mm3 / volume, np.abs(found.second_mm5 - wanted).max()])
    ratios = np.array(errors[:-1]) / np.array(errors[1:])
    np.testing.assert_allclose(ratios, 4.0, rtol=0.06)


def test_rod_converges_to_a_cylinder():
    start, end, radius = np.array([1.0, 2.0, 3.0]), np.array([2.0, 3.5, 2.0]), 0.3
    length = np.linalg.norm(end - start)
    errors = []
    for sides in (24, 48):
        found = surface(bodies.rod(start, end, radius, sides)).moments()
        np.testing.assert_allclose(found.centroid_mm, (start + end) / 2, atol=1e-12)
        errors.append(1.0 - found.volume_mm3 / (np.pi * radius**2 * length))
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.02)


def test_ring_is_what_lies_between_its_outlines():
    turns = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
    circle = np.column_stack([np.cos(turns), np.sin(turns)])
    found = surface(bodies.ring(circle, 2.0 * circle, -0.25, 0.5)).volume_mm3
    assert found == pytest.approx(0.75 * np.pi * (4.0 - 1.0), rel=1e-4)


@pytest.mark.parametrize("gap_mm", [0.03, 0.06, 0.2])
def test_wall_of_the_oval_window_keeps_its_gap_in_space_all_round(gap_mm):
    """Nearest distance from every point of the outline, over the height of the window, to the real stapes."""
    from scipy.spatial import cKDTree

    stapes = bodies.stapes_in_footplate()
    corners = stapes.vertices_mm[stapes.faces]
    shares = np.random.default_rng(1).dirichlet(np.ones(3), (len(corners), 60))
    tree = cKDTree(np.einsum("mnk,mkc->mnc", shares, corners).reshape(-1, 3))
    outline = bodies.footplate_outline(stapes, gap_mm)
    heights = np.linspace(-0.15, bodies.WINDOW_TOP_MM, 25)
    walls = np.stack([np.insert(outline, 1, y, axis=1) for y in heights])
    nearest = tree.query(walls)[0].min(axis=0)
    assert nearest.min() > gap_mm - 0.006
    assert nearest.max() < gap_mm + 0.015


def test_made_stapes_has_the_frame_of_its_construction():
    rotation = bodies.rotation_from_vector([0.4, -1.1, 0.7])
    made = analytic_stapes()
    placed = Surface(made.vertices_mm @ rotation.T + [3.0, 4.0, 5.0], made.faces)
    frame = footplate_frame(placed, AnatomyHints(anterior=rotation[:, 0])).scan_from_footplate
    np.testing.assert_allclose(frame.rotation, rotation, atol=1e-3)
    centre = rotation.T @ (frame.translation_mm - [3.0, 4.0, 5.0])
    np.testing.assert_allclose(centre[[0, 2]], 0.0, atol=2e-3)
    assert 0.0 < centre[1] < 0.02
    assert made.euler_characteristic == 0


def test_made_stapes_renders_to_its_exact_moments(tmp_path):
    path = write_analytic_stapes(tmp_path / "made.ply")
    ear = Ear(voxel_mm=(0.05,) * 3, psf_voxels=0.0, noise=0.0, plate=False, bone=False, stapes=path)
    placed = scene(ear)
    grey = Renderer(placed).contrast(0, placed.shape[2]).astype(float)
    exact = analytic_stapes().moments()
    assert grey.sum() * 0.05**3 == pytest.approx(exact.volume_mm3, rel=2e-5)
    assert truth(placed)["volume_m3"] == pytest.approx(exact.volume_mm3 * 1e-9, rel=1e-9)
    z, y, x = np.indices(grey.shape)
    index = np.array([(grey * axis).sum() for axis in (x, y, z)]) / grey.sum()
    np.testing.assert_allclose(index * 0.05, truth(placed)["center_of_mass_in_scan_mm"], atol=5e-5)


@pytest.mark.parametrize("voxel_mm", [(0.025,) * 3, (0.06,) * 3, (0.03, 0.02, 0.045)])
def test_real_stapes_renders_within_2e_5_in_volume_and_50_nm_in_centre(voxel_mm):
    placed = scene(Ear(voxel_mm=voxel_mm, psf_voxels=0.0, noise=0.0, plate=False, bone=False, pose_seed=4))
    grey = Renderer(placed).contrast(0, placed.shape[2]).astype(float)
    behind = truth(placed)
    assert grey.sum() * np.prod(voxel_mm) == pytest.approx(behind["volume_m3"] * 1e9, rel=2e-5)
    z, y, x = np.indices(grey.shape)
    index = np.array([(grey * axis).sum() for axis in (x, y, z)]) / grey.sum()
    np.testing.assert_allclose(index * voxel_mm, behind["center_of_mass_in_scan_mm"], atol=5e-5)


def test_incus_stands_off_the_head_or_grows_onto_it():
    from scipy.ndimage import label

    bare = Ear(voxel_mm=(0.06,) * 3, noise=0.0, plate=False, bone=False)
    counts = []
    for gap_mm in (None, 0.25, -0.05):
        placed = scene(replace(bare, incus_gap_mm=gap_mm))
        counts.append(label(Renderer(placed).contrast(0, placed.shape[2]) > 0.5)[1])
    assert counts == [1, 2, 1]


def test_bone_that_reaches_out_touches_the_border_and_changes_neither_shape_nor_pose():
    coarse = Ear(voxel_mm=(0.1,) * 3, noise=0.0)
    inside, outside = scene(coarse), scene(replace(coarse, bone_reach=2.0))
    assert inside.shape == outside.shape
    np.testing.assert_array_equal(inside.scan_from_footplate.matrix, outside.scan_from_footplate.matrix)
    border = []
    for placed in (inside, outside):
        grey = Renderer(placed).contrast(0, placed.shape[2])
        border.append(max(grey[:, 0].max(), grey[:, -1].max(), grey[:, :, 0].max(), grey[:, :, -1].max()))
    assert border[0] < 0.01
    assert border[1] > 0.9


def test_a_bigger_field_of_view_holds_the_same_image():
    small = scene(Ear(voxel_mm=(0.08,) * 3, noise=0.0))
    big = scene(replace(small.ear, shape=tuple(n + 40 for n in small.shape)))
    a = Renderer(small).contrast(0, small.shape[2])
    b = Renderer(big).contrast(0, big.shape[2])
    np.testing.assert_allclose(b[20:-20, 20:-20, 20:-20], a, atol=2e-2)
    assert b.sum() == pytest.approx(a.sum(), rel=1e-4)
