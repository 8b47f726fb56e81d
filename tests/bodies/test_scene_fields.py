"""Operations on fields: smoothing, shares of voxels, local means, distances."""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, gaussian_filter

from ct_inertia.grey.cells import mean_by_cells, noise_correlation
from ct_inertia.voxels.distance import capped_distance
from ct_inertia.voxels.fields import blur, local_ratio, share_above, smooth


def test_smoothing_is_a_convolution():
    field = np.random.default_rng(0).random((31, 70, 18)).astype(np.float32)
    width = np.array([0.6, 1.7, 1.1])
    assert smooth(field, width) == pytest.approx(
        gaussian_filter(field, width, truncate=4.3, mode="nearest"), abs=2e-5
    )


@pytest.mark.parametrize("normal", [(0, 0, 1), (1, 1, 0), (1, 1, 1), (1, 2, 3)])
def test_share_of_a_half_space_has_its_place_and_width(normal):
    """Summed over planes at all places, a voxel's share has the mean 1/2 and the variance 1/12 of a cube."""
    direction = np.array(normal) / np.linalg.norm(normal)
    index = np.argwhere(np.ones((5, 5, 5), dtype=bool)).reshape(5, 5, 5, 3) - 2.0
    places = np.linspace(-1.5, 1.5, 601)
    shares = []
    for place in places:
        field = (0.4 * (index @ direction - place)).astype(np.float32)
        shares.append(share_above(field, np.ones(field.shape, dtype=bool))[2, 2, 2])
    fall = -np.gradient(np.array(shares, dtype=float), places)
    step = places[1] - places[0]
    assert fall.sum() * step == pytest.approx(1.0, abs=1e-3)
    assert (fall * places).sum() * step == pytest.approx(0.0, abs=1e-3)
    assert (fall * places**2).sum() * step == pytest.approx(1.0 / 12.0, rel=0.03)


@pytest.mark.parametrize("crosses", [(0.0, 0.0, 0.0), (0.3, -0.5, 0.0), (-0.4, 0.2, 0.6)])
def test_blur_leaves_the_volume_and_adds_its_covariance(crosses):
    body = np.zeros((40, 44, 42), dtype=np.float32)
    body[15:25, 15:25, 15:25] = 1.0
    added, spacing = np.diag([2.25, 1.5, 3.0]), np.array([0.02, 0.03, 0.025])
    added[[0, 0, 1], [1, 2, 2]] = added[[1, 2, 2], [0, 0, 1]] = crosses
    image = blur(body, added * np.outer(spacing, spacing), spacing)
    assert image.sum() == pytest.approx(body.sum(), rel=1e-5)
    place = np.stack(np.meshgrid(*map(np.arange, body.shape), indexing="ij"), axis=-1) - 19.5
    before, after = (
        np.einsum("zyx,zyxi,zyxj->ij", part, place, place) / part.sum() for part in (body, image)
    )
    np.testing.assert_allclose(after - before, added - np.eye(3) / 12.0, rtol=4e-3, atol=1e-3)


def test_local_ratio_is_a_weighted_mean():
    rng = np.random.default_rng(1)
    value = gaussian_filter(rng.random((40, 44, 36)), 4.0).astype(np.float32)
    weight = (rng.random(value.shape) > 0.4).astype(np.float32)
    ratio = local_ratio(value * weight, weight, np.full(3, 2.0), 1e-3)
    exact = gaussian_filter(value * weight, 2.0) / gaussian_filter(weight, 2.0)
    inner = (slice(6, -6),) * 3
    assert np.std((ratio - exact)[inner]) < 0.1 * np.std(value[inner])


@pytest.mark.parametrize("spacing", [(0.02, 0.02, 0.02), (0.02, 0.03, 0.025)])
def test_capped_distances_are_exact(spacing):
    mask = gaussian_filter(np.random.default_rng(2).standard_normal((30, 34, 28)), 3.0) > 0.02
    spacing = np.array(spacing)
    exact = np.minimum(distance_transform_edt(~mask, sampling=spacing[::-1]), 0.15)
    assert capped_distance(mask, spacing, 0.15) == pytest.approx(exact, abs=1e-6)


def test_correlation_of_smoothed_noise():
    """The kernel's sum squared over its sum of squares, to the third power."""
    noise = gaussian_filter(np.random.default_rng(3).standard_normal((60, 60, 60)), 0.8).astype(np.float32)
    place = np.arange(-6, 7)
    kernel = np.exp(-0.5 * (place / 0.8) ** 2)
    exact = (kernel.sum() ** 2 / (kernel**2).sum()) ** 3
    assert noise_correlation(noise, np.ones(noise.shape, dtype=bool)) == pytest.approx(exact, rel=0.1)


def test_standard_error_by_cells_sees_unevenness():
    rng = np.random.default_rng(4)
    where = np.ones((40, 40, 40), dtype=bool)
    white = rng.standard_normal(where.size)
    mean, error = mean_by_cells(white, where, 8)
    assert error == pytest.approx(1.0 / np.sqrt(where.size), rel=0.3)
    assert abs(mean) < 5.0 * error
    assert mean_by_cells(white + 0.02 * np.argwhere(where)[:, 0], where, 8)[1] > 4.0 * error
