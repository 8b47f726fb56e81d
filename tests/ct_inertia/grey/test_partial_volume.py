"""The partial-volume integral: exactness, order against the peers' ways, noise and level propagation."""

import numpy as np
import pytest
from skimage.measure import marching_cubes

from legacy.ct_inertia.grey.partial_volume import Share, as_vector, partial_volume_moments, with_voxel_size
from legacy.ct_inertia.grey.psf import edge_sigma
from legacy.ct_inertia.labelling.from_labels import voxel_moments
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.surface.surface import Surface
from legacy.ct_inertia.volume.distance import capped_distance
from legacy.ct_inertia.volume.volume import Volume
from tests.ct_inertia.solids import filled, imaged, implicit_surface, moved, random_rotation

AXES = np.array([0.62, 0.45, 0.3])


def ellipsoid(step=0.03):
    body = implicit_surface(lambda p: np.linalg.norm(p / AXES, axis=-1) - 1.0, (-0.7,) * 3, (0.7,) * 3, step)
    return moved(body, random_rotation(4))


def image(surface, h, psf=1.2, rays=8, offset=0.3):
    low = surface.vertices_mm.min(axis=0) - 9 * h - offset * h
    count = np.ceil((np.ptp(surface.vertices_mm, axis=0) + 18 * h) / h).astype(int)
    shares = filled(surface, count, h, low, rays)
    return Volume(imaged(shares, psf), np.full(3, h), low, np.eye(3))


def whole(volume, sigma=0.0, where=None, **levels):
    where = np.ones(volume.array.shape, bool) if where is None else where
    index = np.argwhere(where)[:, ::-1].astype(float)
    grey = np.asarray(volume.array, float)[where]
    values = {"air": 0.0, "bone": 1.0, "air_sd": 0.0, "bone_sd": 0.0, "sigma_sd_mm": 0.0, **levels}
    return partial_volume_moments(
        Share(index, grey, np.full(len(grey), values.pop("noise", 0.0)), sigma_mm=sigma, **values),
        volume.scan_from_index,
    )


def test_it_is_an_order_better_than_surfaces_and_voxels_at_every_voxel_size():
    body = ellipsoid()
    truth = body.moments()
    table = []
    for h in (0.06, 0.03):
        volume = image(body, h)
        ours = whole(volume, 1.2 * h)
        points, faces, _, _ = marching_cubes(volume.array, 0.5)
        mesh = Surface(
            volume.scan_points(points[:, ::-1]), faces[:, ::-1] if _inward(points, faces) else faces
        )
        binary = voxel_moments(volume.array > 0.5, volume)
        table.append(
            [abs(m.volume_mm3 / truth.volume_mm3 - 1) for m in (ours, mesh.moments(), binary)]
            + [abs(np.trace(m.second_mm5) / np.trace(truth.second_mm5) - 1) for m in (ours, mesh.moments())]
        )
    table = np.array(table)
    assert np.all(table[:, 0] < 2e-4)
    assert np.all(table[:, 3] < 6e-4)
    assert np.all(table[:, 1] > 10 * table[:, 0])
    assert np.all(table[:, 4] > 10 * table[:, 3])
    # A half-level surface shrinks by curvature times the squared blur: second order in the voxel.
    assert np.log2(table[0, 1] / table[1, 1]) == pytest.approx(2.0, abs=0.35)


def _inward(points, faces):
    a, b, c = (points[faces[:, k]][:, ::-1] for k in range(3))
    return np.einsum("ij,ij->", a, np.cross(b, c)) < 0


def test_blur_moves_nothing_but_the_second_moments_and_that_by_its_variance():
    body = ellipsoid()
    for psf in (0.9, 1.5, 2.2):
        h = 0.04
        raw = whole(image(body, h, psf))
        truth = body.moments()
        assert raw.volume_mm3 == pytest.approx(truth.volume_mm3, rel=3e-4)
        assert raw.centroid_mm == pytest.approx(truth.centroid_mm, abs=1e-4)
        extra = np.diag(raw.second_mm5 - truth.second_mm5) / raw.volume_mm3
        assert extra == pytest.approx(np.full(3, (psf * h) ** 2), rel=0.03)


def test_rotating_the_body_rotates_the_result():
    h = 0.05
    body = ellipsoid()
    turn = random_rotation(9)
    here, there = whole(image(body, h), 1.2 * h), whole(image(moved(body, turn), h), 1.2 * h)
    assert there.second_mm5 == pytest.approx(turn @ here.second_mm5 @ turn.T, abs=2e-5)


def test_the_covariance_is_that_of_repeated_scans():
    h = 0.08
    volume = image(ellipsoid(), h, rays=4)
    rng = np.random.default_rng(0)
    noise, air_sd, bone_sd = 0.02, 0.0005, 0.01
    results, told, where = [], None, volume.array > 1e-5
    for _ in range(400):
        noisy = volume.array + noise * rng.standard_normal(volume.array.shape)
        levels = {"air": air_sd * rng.standard_normal(), "bone": 1.0 + bone_sd * rng.standard_normal()}
        sigma = 1.2 * h + 0.003 * rng.standard_normal()
        again = whole(Volume(noisy, volume.spacing_mm, volume.origin_mm, np.eye(3)), sigma, where, **levels)
        results.append(as_vector(again))
        told = told or whole(
            volume, 1.2 * h, where, noise=noise, air_sd=air_sd, bone_sd=bone_sd, sigma_sd_mm=0.003
        )
    covariance = sum(told.contributions.values())
    seen = np.cov(np.array(results).T)
    ratio = np.diag(seen) / np.diag(covariance)
    assert np.all(np.abs(ratio - 1.0) < 0.25)
    away = np.array(results) - as_vector(told)
    distance = np.einsum("ni,ij,nj->n", away, np.linalg.inv(covariance), away)
    assert np.mean(distance) == pytest.approx(10.0, rel=0.1)


def test_voxel_size_scales_with_the_third_and_fifth_power():
    base = whole(image(ellipsoid(), 0.1, rays=4))
    once = with_voxel_size(base, 0.01, np.zeros(3))
    step = np.sqrt(np.diag(once.contributions["voxel_size"])) / np.abs(as_vector(base))
    assert step[0] == pytest.approx(0.03)
    assert step[4:] == pytest.approx(np.full(6, 0.05))


def test_voxel_moments_of_a_box_of_voxels_are_exact():
    mask = np.zeros((9, 12, 15), bool)
    mask[2:7, 1:11, 3:6] = True
    grid = Volume(mask.astype(np.uint8), np.array([0.1, 0.2, 0.3]), np.zeros(3), random_rotation(2))
    m = voxel_moments(mask, grid)
    lengths = np.array([3 * 0.1, 10 * 0.2, 5 * 0.3])
    assert m.volume_mm3 == pytest.approx(lengths.prod())
    expected = grid.direction @ np.diag(lengths**2 / 12.0) @ grid.direction.T * lengths.prod()
    assert m.second_mm5 == pytest.approx(expected, abs=1e-12)
    assert m.centroid_mm == pytest.approx(grid.scan_points([4.0, 5.5, 4.0]))


def test_moments_must_be_those_of_a_body():
    with pytest.raises(ValueError, match="volume of the body must be positive"):
        Moments(-1.0, np.zeros(3), np.eye(3))
    with pytest.raises(ValueError, match="positive definite"):
        Moments(1.0, np.zeros(3), np.diag([1.0, 1.0, -1.0]))


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.02, 0.02, 0.05)])
def test_capped_distance_is_the_exact_one_below_its_cap(spacing):
    from scipy.ndimage import distance_transform_edt

    rng = np.random.default_rng(0)
    mask = rng.random((30, 25, 40)) > 0.995
    exact = distance_transform_edt(~mask, sampling=spacing[::-1])
    cap = 6.5 * max(spacing)
    assert capped_distance(mask, np.array(spacing), cap) == pytest.approx(np.minimum(exact, cap), rel=1e-5)


@pytest.mark.parametrize("psf", [0.9, 1.2, 1.8])
def test_the_blur_is_read_off_edges(psf):
    h = 0.03
    body = ellipsoid()
    volume = image(body, h, psf)
    grey = volume.array + np.float32(0.04) * np.random.default_rng(0).standard_normal(
        volume.array.shape, dtype=np.float32
    )
    sigma, sd = edge_sigma(grey, np.ones(grey.shape, bool), 0.0, 1.0, volume.spacing_mm)
    assert sigma == pytest.approx(psf * h, rel=0.06)
    assert abs(sigma - psf * h) < 3.0 * sd
