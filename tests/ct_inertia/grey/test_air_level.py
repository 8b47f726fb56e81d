"""Levels, blur and fitted bodies: closed forms, clipped and correlated noise, uneven bone, the plate."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from legacy.ct_inertia.bodies import PlateFace
from legacy.ct_inertia.grey import level_fit
from legacy.ct_inertia.grey.air_level import Air, Surroundings, air_shell, measure_air, unclipped
from legacy.ct_inertia.grey.bone_level import measure_bone
from legacy.ct_inertia.grey.level_fit import body_share, fit_bodies, grow_mask
from legacy.ct_inertia.grey.plate_face import displaced_share
from legacy.ct_inertia.grey.psf import edge_sigma
from legacy.ct_inertia.labelling.from_scan import find_bodies
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.volume.distance import capped_distance
from legacy.ct_inertia.volume.volume import Volume
from sample_volumes.phantom import Ear, render, scene, truth

H = 0.04
SIGMA = 1.25 * H
SPACING = np.full(3, H)


def places(count, step=H, shift=(0.013, 0.007, -0.011)):
    axis = (np.arange(count) - count / 2.0) * step
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    return x - shift[0], y - shift[1], z - shift[2]


def blurred_ball(radius, sigma=SIGMA, count=56):
    """Exact image of a ball under a Gaussian: the radial convolution in closed form."""
    r = np.sqrt(sum(p**2 for p in places(count))) + 1e-9
    inner, outer = (radius - r) / sigma, (radius + r) / sigma
    tails = (np.exp(-0.5 * inner**2) - np.exp(-0.5 * outer**2)) * sigma / (r * np.sqrt(2.0 * np.pi))
    return (ndtr(inner) - ndtr(-outer) - tails).astype(np.float32)


def blurred_slab(thickness, count=48):
    x, y, z = places(count)
    away = 0.8 * x + 0.36 * y + 0.48 * z
    return (ndtr((thickness / 2 - away) / SIGMA) - ndtr((-thickness / 2 - away) / SIGMA)).astype(np.float32)


def blurred_tube(outer, wall, count=56):
    """Image of an endless tube along z: a disc less a disc, blurred on a five times finer grid."""
    fine = 5
    axis = (np.arange(count * fine) - (count * fine - 1) / 2.0) * H / fine
    y, x = np.meshgrid(axis, axis, indexing="ij")
    r = np.hypot(x - 0.011, y + 0.006)
    ring = np.clip(0.5 + (outer - r) * fine / H, 0, 1) - np.clip(0.5 + (outer - wall - r) * fine / H, 0, 1)
    image = gaussian_filter(ring, SIGMA * fine / H, truncate=6.0)
    flat = image.reshape(count, fine, count, fine)[:, fine // 2, :, fine // 2]
    return np.repeat(flat[None].astype(np.float32), count, axis=0)


@pytest.mark.parametrize("radius", [0.3, 0.45, 0.6])
def test_a_ball_too_small_for_pure_bone_gives_its_level(radius):
    image = blurred_ball(radius)
    fit = fit_bodies(1000.0 * image, image > 1e-5, SPACING, 950.0, 1.05 * SIGMA, 0.0)
    assert fit.contrast == pytest.approx(1000.0, rel=1e-3)
    assert fit.sigma_mm == pytest.approx(SIGMA, rel=0.02)
    assert fit.body.sum() * H**3 == pytest.approx(4.0 / 3.0 * np.pi * radius**3, rel=2e-3)
    assert abs(fit.contrast - 1000.0) < 3.0 * fit.relative_sd * fit.contrast


@pytest.mark.parametrize("height", [0.0, 0.15])
def test_a_body_of_which_a_part_is_not_compared_keeps_its_blur(height):
    """Bone beside a plate is there, though its grey values are not compared: cut off, its edge is sharp."""
    image = blurred_ball(0.45)
    z = (np.arange(len(image)) - 0.5 * (len(image) - 1)) * H
    reach, clear = image > 1e-5, np.broadcast_to(z > -height, image.T.shape).T
    fit = fit_bodies(image, reach & clear, SPACING, 0.95, 1.05 * SIGMA, 0.0, beside=reach & ~clear)
    assert fit.contrast == pytest.approx(1.0, rel=1e-3)
    assert fit.sigma_mm == pytest.approx(SIGMA, rel=0.02)
    cut_off = fit_bodies(image, reach & clear, SPACING, 0.95, 1.05 * SIGMA, 0.0)
    assert abs(cut_off.contrast - 1.0) > 2.0 * abs(fit.contrast - 1.0)


def test_loud_noise_does_not_lower_the_level():
    rng = np.random.default_rng(0)
    image = blurred_ball(0.5)
    own = image > 1e-5
    errors = []
    for _ in range(3):
        noisy = (image + 0.15 * rng.standard_normal(image.shape)).astype(np.float32)
        fit = fit_bodies(noisy, own, SPACING, 0.97, SIGMA, 0.15)
        errors.append((fit.contrast - 1.0) / fit.relative_sd)
        assert fit.contrast == pytest.approx(1.0, abs=6e-3)
    assert np.abs(np.mean(errors)) < 3.0


def test_the_share_of_voxels_in_a_ball_converges_with_the_square_of_the_voxel():
    errors = []
    for step in (0.08, 0.04, 0.02):
        count = int(1.4 / step)
        r = np.sqrt(sum(p**2 for p in places(count, step)))
        # About the slope of a blurred edge at its middle, 1 / (1.25 sqrt(2 pi)) per voxel.
        field = (0.5 + 0.32 * (0.5 - r) / step).astype(np.float32)
        whole = np.ones(field.shape, bool)
        share = body_share(field, np.full(field.shape, 0.5, np.float32), whole)
        errors.append(share.sum() * step**3 / (4.0 / 3.0 * np.pi * 0.5**3) - 1.0)
    assert np.abs(errors[-1]) < 1e-3
    assert np.log2(np.abs(errors[0] / errors[2])) / 2.0 > 1.7


@pytest.mark.parametrize("shape", [(20, 21, 22), (5, 5, 5), (3, 3, 3), (2, 5, 6), (9, 7, 49)])
def test_shares_are_the_same_without_compiled_kernels(monkeypatch, shape):
    rng = np.random.default_rng(3)
    field, whole = rng.normal(size=shape).astype(np.float32), rng.random(shape) < 0.97
    level = np.full(shape, 0.2, np.float32)
    share = body_share(field, level, whole)
    monkeypatch.setattr(level_fit, "compiled", lambda: None)
    assert np.array_equal(share, body_share(field, level, whole))


def test_spread_is_a_dilation():
    from scipy.ndimage import binary_dilation

    mask = np.random.default_rng(0).random((9, 11, 13)) > 0.98
    assert np.array_equal(grow_mask(mask), binary_dilation(mask, np.ones((3, 3, 3))))
    assert np.array_equal(grow_mask(mask, corners=False), binary_dilation(mask))


@pytest.mark.parametrize(
    ("image", "bound"),
    [(blurred_slab(0.5), 0.006), (blurred_ball(0.6), 0.02), (blurred_tube(0.5, 0.35), 0.02)],
)
def test_the_blur_read_off_plane_and_bent_edges(image, bound):
    rng = np.random.default_rng(1)
    noisy = image + np.float32(0.03) * rng.standard_normal(image.shape, dtype=np.float32)
    sigma, sd = edge_sigma(noisy, np.ones(image.shape, bool), 0.0, 1.0, SPACING, 0.03)
    assert sigma == pytest.approx(SIGMA, rel=bound)
    assert sd < 0.05 * SIGMA


def test_flat_edges_count_where_there_are_bent_ones_too():
    image = np.maximum(blurred_slab(0.5, 48), 0.0)
    rod = blurred_tube(0.16, 0.16, 48)
    both = np.concatenate([image, rod])
    rng = np.random.default_rng(2)
    noisy = both + np.float32(0.02) * rng.standard_normal(both.shape, dtype=np.float32)
    sigma, _ = edge_sigma(noisy, np.ones(both.shape, bool), 0.0, 1.0, SPACING, 0.02)
    assert sigma == pytest.approx(SIGMA, rel=0.01)


@pytest.mark.parametrize("true", [0.0, 0.5, 1.5])
def test_clipped_noise_is_put_right_on_average(true):
    noise, count = 100.0, 60
    grey = true * noise + noise * np.random.default_rng(3).standard_normal((count,) * 3)
    clipped = np.maximum(grey, 0.0).astype(np.float32)
    air = Air(true * noise, noise, 1.0, 1.0, 0.3)
    whole = np.ones(clipped.shape, bool)
    expected = np.full(clipped.shape, true * noise, np.float32)
    known = unclipped(clipped, whole, air, expected)
    assert known.mean() == pytest.approx(true * noise, abs=4.0 * noise / count**1.5)
    read_off = unclipped(clipped, whole, air)
    assert read_off.mean() == pytest.approx(true * noise, abs=0.06 * noise)
    assert unclipped(clipped, whole, Air(0.0, noise, 1.0, 1.0, 0.0)) is clipped


def surroundings(grey):
    bone = np.zeros(grey.shape, bool)
    bone[18:46, 18:46, 18:46] = True
    return Surroundings(grey.astype(np.float32), bone, np.zeros(grey.shape, bool), SPACING)


@pytest.mark.parametrize("width", [0.0, 0.7, 1.0])
def test_the_correlation_of_noise_is_that_of_sums_of_it(width):
    rng = np.random.default_rng(4)
    white = rng.standard_normal((64, 64, 64))
    noise = white if width == 0.0 else gaussian_filter(white, width, mode="wrap")
    around = surroundings(100.0 + noise)
    distance = capped_distance(around.bone, SPACING, 20 * H)
    air = measure_air(around, air_shell(around, distance, 5 * H), 100.0)
    # The sum over all lags of a Gaussian of width s: (2 sqrt(pi) s)^3 of its own variance.
    exact = 1.0 if width == 0.0 else (2.0 * np.sqrt(np.pi) * width) ** 3
    assert air.correlation == pytest.approx(exact, rel=0.2)
    assert abs(air.level - 100.0) < 4.0 * air.sd


def test_fluid_as_faint_as_noise_is_no_air():
    rng = np.random.default_rng(3)
    noise = gaussian_filter(rng.standard_normal((64, 64, 64)), 1.0, mode="wrap")
    noise *= 30.0 / noise.std()
    wet = np.zeros((64, 64, 64))
    wet[48:, :, 20:] = 150.0
    for fluid in (0.0, 1.0):
        around = surroundings(1000.0 + noise + fluid * wet)
        shell = air_shell(around, capped_distance(around.bone, SPACING, 20 * H), 3 * H)
        air = measure_air(around, shell, 1000.0)
        # Taken for air, a fifth of the shell would shift the level by 30 and look like long correlation.
        assert abs(air.level - 1000.0) < 2.0
        assert air.noise == pytest.approx(30.0, rel=0.02)
        assert air.correlation == pytest.approx((2.0 * np.sqrt(np.pi)) ** 3, rel=0.2)


def test_a_slope_of_the_air_is_told_and_noise_is_not():
    rng = np.random.default_rng(6)
    grey = 1000.0 + 40.0 * rng.standard_normal((64, 64, 64))
    x, _, _ = places(64)
    for change, found in ((0.0, 0.0), (12.0, 12.0)):
        around = surroundings(grey + change * x)
        shell = air_shell(around, capped_distance(around.bone, SPACING, 0.3), 0.2)
        air = measure_air(around, shell, 1000.0)
        assert air.slope[0] == pytest.approx(found, rel=0.1)
        assert air.slope[1:] == (0.0, 0.0)


def uneven(change, noise=0.04, seed=5):
    """A cube of bone in air whose level is 1000 * (1 + change(x, y, z))."""
    rng = np.random.default_rng(seed)
    around = surroundings(np.zeros((64, 64, 64)))
    x, y, z = places(64)
    level = 1000.0 * (1.0 + change(x, y, z))
    grey = level * gaussian_filter(around.bone.astype(float), 0.8)
    grey += 1000.0 * noise * rng.standard_normal(grey.shape)
    air = Air(0.0, 1000.0 * noise, 0.1, 1.0, 0.0)
    return measure_bone(
        Surroundings(grey.astype(np.float32), around.bone, around.foreign, SPACING), air, 0.9 * H
    )


def test_even_bone_is_not_warned_of():
    for seed in range(5):
        bone = uneven(lambda x, y, z: 0.0 * x, seed=seed)
        assert bone.notices == ()
        assert not np.any(bone.slope)
        assert abs(bone.level - 1000.0) < 4.0 * bone.sd


def test_a_slope_of_the_level_is_found_and_told():
    bone = uneven(lambda x, y, z: 0.3 * x)
    assert [notice.code for notice in bone.notices] == ["bone_inhomogeneous"]
    assert bone.slope == pytest.approx([300.0, 0.0, 0.0], abs=30.0)
    there = bone.moved_to(bone.place_mm + np.array([0.1, 0.0, 0.0]))
    assert there.level - bone.level == pytest.approx(30.0, abs=3.0)


def test_a_dense_core_is_told_and_widens_the_uncertainty():
    bone = uneven(lambda x, y, z: 0.1 * (np.sqrt(x**2 + y**2 + z**2) < 0.2))
    assert [notice.code for notice in bone.notices] == ["bone_inhomogeneous"]
    assert bone.sd > 5.0


def measured(ear):
    placed = scene(ear)
    known = truth(placed)
    bodies = find_bodies(Volume(render(placed), np.array(ear.voxel_mm), np.zeros(3), np.eye(3)))
    away = np.linalg.norm(bodies.moments.centroid_mm - known["center_of_mass_in_scan_mm"])
    return bodies, bodies.moments.volume_mm3 * 1e-9 / known["volume_m3"] - 1.0, away * 1e3


@pytest.mark.parametrize("gap", [0.0, -0.03])
def test_near_on_and_sunk_into_the_plate(gap):
    bodies, volume, away = measured(Ear(voxel_mm=(0.035,) * 3, bone=False, plate_gap_mm=gap))
    assert abs(volume) < 1e-3
    assert away < 0.8
    assert bodies.plate_face is not None
    assert bodies.moments.contributions["plate"][0, 0] > 0.0


@pytest.mark.parametrize("depth", [0.0, 0.5 * H, 3.0 * H])
def test_bone_displaces_as_much_plastic_as_lies_behind_the_face(depth):
    """A block of bone of 1 mm2, its flat end on the plate or in it, in plastic a third as bright."""
    x, y, z = places(60)
    sides = np.prod([ndtr((0.5 - a) / SIGMA) - ndtr((-0.5 - a) / SIGMA) for a in (x, y)], axis=0)
    bone = sides * (ndtr((z + depth) / SIGMA) - ndtr((z - 0.6) / SIGMA))
    covered = sides * (ndtr((z + depth) / SIGMA) - ndtr(z / SIGMA)) / 3.0
    noisy = bone - covered + 0.03 * np.random.default_rng(4).standard_normal(bone.shape)
    corner = np.array([float(p.min()) for p in (x, y, z)])
    volume = Volume(noisy.astype(np.float32), SPACING, corner, np.eye(3))
    none = np.zeros(bone.shape, bool)
    cut = Cut(np.zeros(3, np.int64), volume.array, bone > 0.5, none, none, "")
    face = PlateFace(np.array([0.0, 0.0, 1.0]), 0.0, SIGMA, 0.0, 1.0 / 3.0, 0.0)
    found = displaced_share(face, volume, cut, volume.array, 1.0, ~none)
    total = 0.0 if found is None else float(found.sum()) * H**3
    assert total == pytest.approx(depth / 3.0, abs=1.2e-3)


def test_crura_as_gutters(tmp_path):
    from sample_volumes.gutter import write_gutter_stapes

    mesh = write_gutter_stapes(tmp_path / "gutter.ply", 0.04)
    _, volume, away = measured(Ear(voxel_mm=(0.04,) * 3, plate=False, bone=False, stapes=mesh))
    assert abs(volume) < 4e-3
    assert away < 3.0


def test_a_gradient_of_density_is_weighted_and_told():
    ear = Ear(voxel_mm=(0.035,) * 3, plate=False, bone=False, gradient=0.05)
    bodies, volume, away = measured(ear)
    assert "bone_inhomogeneous" in {notice.code for notice in bodies.notices}
    assert abs(volume) < 2e-3
    assert away < 1.5
    shift = np.sqrt(np.trace(bodies.moments.contributions["inhomogeneity"][1:4, 1:4]))
    assert shift == pytest.approx(0.037, rel=0.2)
