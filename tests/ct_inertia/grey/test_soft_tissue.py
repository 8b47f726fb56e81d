"""Fluid or ligament around the footplate is found, told and taken off; long voxels; covered plates."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from legacy.ct_inertia.frames.covered_plate import covered_face
from legacy.ct_inertia.frames.plane_faces import PlaneFace
from legacy.ct_inertia.grey.air_level import Air, Surroundings
from legacy.ct_inertia.grey.edge_shape import edge_shape
from legacy.ct_inertia.grey.level_fit import BodyFit
from legacy.ct_inertia.grey.soft_tissue import subtract_soft_tissue, taken_off
from legacy.ct_inertia.grey.thin_bone import thin_bone
from legacy.ct_inertia.labelling.from_scan import find_bodies
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.volume.distance import capped_distance
from legacy.ct_inertia.volume.normal_distribution import normal_cdf
from legacy.ct_inertia.volume.volume import Volume
from sample_volumes.phantom import Ear, render, scene, truth

H = 0.04


def codes(bodies):
    return [notice.code for notice in bodies.notices]


def scan(voxel_mm=(H, H, H), **settings):
    placed = scene(Ear(voxel_mm=voxel_mm, gap_mm=0.15, **settings))
    return placed, Volume(render(placed), np.array(voxel_mm), np.zeros(3), np.eye(3))


def in_fluid(placed, volume, level):
    """Fill what lies around the footplate, up to 0.1 mm above its medial face: g = b + (1 - b) m."""
    air, _, bone = placed.ear.levels
    lateral, origin = placed.scan_from_footplate.rotation[:, 1], placed.scan_from_footplate.translation_mm
    x, y, z = reversed(np.meshgrid(*map(np.arange, volume.array.shape), indexing="ij", sparse=True))
    height = sum(lateral[k] * (index * volume.spacing_mm[k] - origin[k]) for k, index in enumerate((x, y, z)))
    there = level / (1.0 + np.exp((height - 0.1) / 0.03)) / (1.0 + np.exp((-0.35 - height) / 0.03))
    share = (volume.array - air) / (bone - air)
    grey = air + (bone - air) * (there + (1.0 - there) * share)
    return Volume(np.rint(grey).astype(np.uint16), volume.spacing_mm, np.zeros(3), np.eye(3))


def sd(bodies):
    return np.sqrt(np.diag(sum(bodies.moments.contributions.values())))


def test_bubbles_of_air_in_fluid_are_no_missing_bone():
    placed, volume = scan((0.03,) * 3, plate=False)
    air, _, bone = placed.ear.levels
    share = (volume.array - air) / (bone - air)
    rng = np.random.default_rng(5)
    places = [0.03 * index for index in np.ogrid[tuple(slice(n) for n in share.shape)]]
    solid = np.argwhere(share > 0.9)
    fluid = np.ones(share.shape)
    for centre in solid[rng.integers(len(solid), size=12)] * 0.03:
        square = sum((place - middle) ** 2 for place, middle in zip(places, centre, strict=True))
        fluid[square < rng.uniform(0.1, 0.25) ** 2] = 0.0
    fluid = gaussian_filter(fluid, 1.0)
    grey = air + (bone - air) * (share + 0.3 * fluid * (1.0 - share))
    bodies = find_bodies(Volume(np.rint(grey).astype(np.uint16), np.full(3, 0.03), np.zeros(3), np.eye(3)))
    assert "soft_surroundings" in codes(bodies)
    off = bodies.moments.volume_mm3 - truth(placed)["volume_m3"] * 1e9
    assert abs(off) < 2.0 * sd(bodies)[0]
    assert abs(off) < 0.02 * bodies.moments.volume_mm3


@pytest.mark.parametrize("voxel_mm", [0.03, 0.05])  # of 0.05 mm, hardly any bone lies deeper than the blur
def test_fluid_around_the_footplate_is_taken_off_and_told(voxel_mm):
    placed, volume = scan((voxel_mm,) * 3, plate=False)
    exact = truth(placed)["volume_m3"] * 1e9
    wet, dry = find_bodies(in_fluid(placed, volume, 0.25)), find_bodies(volume)
    assert "soft_surroundings" in codes(wet)
    assert "soft_surroundings" not in codes(dry)
    assert abs(dry.moments.volume_mm3 / exact - 1.0) < 2e-3
    assert "surroundings" in wet.moments.contributions
    # Counted as bone, the fluid within reach of the blur would add several percent.
    assert abs(wet.moments.volume_mm3 / exact - 1.0) < 1e-2
    assert abs(wet.moments.volume_mm3 - exact) < 2.0 * sd(wet)[0]
    assert wet.frame_doubt is not None


def tapered_wall(fluid):
    """A slab and a wall on it that tapers off, in air or under fluid; voxels of 25 um, blur of 30 um."""
    fine = np.indices((60, 60, 40)).astype(float) + 0.5
    z, y, _ = fine
    slab = z < 20
    half = 0.5 * np.clip((40 - z) * 0.4, 0.0, None)
    body = np.clip(half - np.abs(y - 30.3) + 0.5, 0.0, 1.0) * (half > 0)
    body[slab] = 1.0
    medium = fluid / (1.0 + np.exp((z - 40) / 1.5))
    share = gaussian_filter(body + (1.0 - body) * medium, 1.2)
    grey = (100.0 + 1000.0 * share + np.random.default_rng(5).normal(0.0, 15.0, share.shape)).astype(
        np.float32
    )
    stapes = share > 0.5
    none = np.zeros_like(stapes)
    cut = Cut(np.zeros(3, dtype=int), grey, stapes, none, none, "alone")
    spacing = np.full(3, 0.025)
    reach = 4.2 * 0.03 + 0.025
    distance = capped_distance(stapes, spacing, 2.0 * reach)
    levels = (Air(100.0, 15.0, 0.1, 1.0, 0.0), 1100.0, None)
    soft = subtract_soft_tissue(cut, (distance, None), reach, spacing, levels, 0.03)
    return 0.0 if soft is None else float(soft.taken[:, 15:45].sum() / body[20:].sum())


def test_bone_that_tapers_off_below_the_blur_is_no_soft_medium():
    assert abs(tapered_wall(0.0)) < 0.005
    assert tapered_wall(0.25) > 0.5


def gap_beside_darker_bone(bright):
    """Return what is subtracted as soft around a slab beside one of another brightness, over its volume."""
    sigma, spacing = 0.05, np.full(3, 0.035)
    x = (np.arange(60) - 30.0) * 0.035
    share = slab(x, -0.6, -0.05, sigma) + bright * slab(x, 0.05, 0.6, sigma)
    share = np.broadcast_to(share, (40, 40, 60))
    grey = 100.0 + 1000.0 * share + np.random.default_rng(2).normal(0.0, 20.0, share.shape)
    stapes, others = (np.broadcast_to(part & (np.abs(x) < 0.65), share.shape) for part in (x < 0, x > 0))
    stapes, others = stapes & (share > 0.5), others & (share > 0.5 * bright)
    cut = Cut(np.zeros(3, dtype=int), grey.astype(np.float32), stapes, others, stapes & False, "test")
    reach = 4.2 * sigma + 0.035
    distances = capped_distance(stapes, spacing, 2.0 * reach), capped_distance(others, spacing, reach)
    soft = taken_off(cut, distances, reach, spacing, (Air(100.0, 20.0, 0.1, 1.0, 0.0), 1100.0), sigma)
    own = distances[0] <= np.minimum(distances[1], reach)
    middle = np.s_[12:28, 12:28]
    return float(soft.taken[middle][own[middle]].sum() / stapes[middle].sum())


def slab(x, low, high, sigma):
    return normal_cdf((x - low) / sigma) - normal_cdf((x - high) / sigma)


@pytest.mark.parametrize("bright", [0.75, 1.0, 1.3])
def test_a_gap_beside_bone_of_another_density_holds_nothing_soft(bright):
    assert abs(gap_beside_darker_bone(bright)) < 1e-3


@pytest.mark.parametrize("seed", [3, 5])
def test_cupping_of_three_percent_at_coarse_voxels_is_told_and_moves_no_volume(seed):
    placed, volume = scan(cupping=0.03, pose_seed=seed, noise_seed=seed)
    bodies = find_bodies(volume)
    assert "bone_cupping" in codes(bodies) or "bone_inhomogeneous" in codes(bodies)
    exact = truth(placed)["volume_m3"] * 1e9
    assert bodies.moments.volume_mm3 == pytest.approx(exact, rel=2e-3)
    assert sd(bodies)[0] / exact < 5e-3


def test_a_blur_that_is_longer_along_long_voxels_is_seen_and_evened_out():
    spacing, sigma = np.array([0.03, 0.03, 0.06]), np.array([0.036, 0.036, 0.072])
    place = np.indices((40, 80, 80))[::-1] * spacing[:, None, None, None]
    away = place - np.array([1.203, 1.207, 1.211])[:, None, None, None]
    ball = np.linalg.norm(away, axis=0) - 0.8
    towards = away / np.linalg.norm(away, axis=0)
    width = np.sqrt(np.einsum("kzyx,k->zyx", towards**2, sigma**2))
    grey = (1000.0 / (1.0 + np.exp(1.702 * ball / width))).astype(np.float32)
    nothing = np.zeros(grey.shape, dtype=bool)
    found = edge_shape(grey, np.abs(ball) < 0.1, nothing, (0.0, 1000.0), spacing)
    assert found.uneven
    assert np.sqrt(np.diag(found.covariance_mm2)) == pytest.approx(sigma, rel=0.08)
    placed, volume = scan(tuple(spacing), plate=False, bone=False)
    bodies = find_bodies(volume)
    second = placed.scan_from_footplate.rotation
    exact = np.array(truth(placed)["mass_matrix_si"])[3:, 3:]
    inertia = second.T @ bodies.moments.inertia_mm5 @ second
    com = second.T @ (bodies.moments.centroid_mm - placed.scan_from_footplate.translation_mm)
    about = inertia + bodies.moments.volume_mm3 * (com @ com * np.eye(3) - np.outer(com, com))
    about *= placed.ear.density_kg_m3 * 1e-15
    root = np.sqrt(np.diag(exact))
    assert np.abs((about - exact) / np.outer(root, root)).max() < 3e-3


def test_a_face_of_the_plate_that_cannot_be_fitted_is_told():
    samples = np.random.default_rng(1).uniform(-1.0, 1.0, (50, 3)) * [1.0, 1.0, 0.0]
    face = PlaneFace(np.array([0.0, 0.0, 1.0]), np.zeros(3), np.eye(3)[:, :2], np.zeros((3, 3)), 4.0, samples)
    empty = Volume(np.zeros((5, 5, 5), dtype=np.uint16), np.full(3, H), np.zeros(3), np.eye(3))
    kept, notices = covered_face(face, [face], None, empty, 0.05)
    assert [notice.code for notice in notices] == ["plate_face_covered"]
    assert "--plate-fiducials" in notices[0].text
    assert np.sqrt(kept.covariance[0, 0]) > 0.05
    assert np.array_equal(kept.normal, face.normal)


def test_the_level_of_bone_one_voxel_thick_is_found():
    rng = np.random.default_rng(3)
    body = np.zeros((9, 60, 60), dtype=np.float32)
    body[4, 5:-5, 5:-5] = 1.0
    grey = (1000.0 + 5000.0 * body + rng.normal(0.0, 50.0, body.shape)).astype(np.float32)
    nothing = np.zeros(body.shape, dtype=bool)
    around = Surroundings(grey, body > 0.5, nothing, np.full(3, H))
    fit = BodyFit(5000.0, 1e-3, 0.2 * H, body)
    whole = tuple(slice(0, n) for n in body.shape)
    found = thin_bone(fit, around, ~nothing, whole, Air(1000.0, 50.0, 1.0, 1.0, 0.0))
    assert found is not None
    assert abs(found.level - 6000.0) < 5.0 * max(found.sd, 1.0)
    assert found.sd < 100.0


def test_fluid_all_around_is_no_plate():
    placed, volume = scan(plate=False, bone=False)
    air, _, bone = placed.ear.levels
    away = np.max(
        np.abs(np.indices(volume.array.shape).T - 0.5 * volume.size[::-1]) / volume.size[::-1], axis=-1
    ).T
    share = (volume.array - air) / (bone - air)
    grey = air + (bone - air) * (share + (away < 0.42) * 0.35 * (1.0 - share))
    wet = find_bodies(Volume(np.rint(grey).astype(np.uint16), volume.spacing_mm, np.zeros(3), np.eye(3)))
    exact = truth(placed)["volume_m3"] * 1e9
    assert wet.plate is None
    assert "soft_surroundings" in codes(wet)
    assert abs(wet.moments.volume_mm3 - exact) < 2.0 * sd(wet)[0] < 0.6 * exact
