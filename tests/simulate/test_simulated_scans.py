"""Simulated scans: exact partial volumes with their order, blur, noise and storing, and every file format."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

import simulate
from simulate import Ear, Scan, Stapes

SMALL = Scan(voxel_um=(60.0, 70.0, 80.0), samples=3, seed=5)


def clean(scan):
    """Return the same scan without noise, rings and quantisation: float32 grey values."""
    return replace(scan, noise=0.0, rings=0.0, dtype="float32", steps=None, window=None)


@pytest.fixture(scope="module")
def ear() -> Ear:
    return Ear()


def test_box_aligned_with_voxels_is_exact():
    h = np.array([0.05, 0.04, 0.03])
    ends = ((2.1, 7.1), (3.0, 6.0), (4.25, 9.25))
    low, high = np.array(ends).T
    counts = (12, 12, 14)
    share = simulate.coverage_of(simulate.box(low * h, high * h), counts, h, samples=10)
    x, y, z = (_covered(count, *pair) for count, pair in zip(counts, ends, strict=True))
    assert np.abs(share - np.einsum("i,j,k->kji", x, y, z)).max() < 1e-6


def _covered(count, low, high):
    """Share of voxels k - 0.5 to k + 0.5 between two ends, in voxels."""
    k = np.arange(count)
    return np.clip(np.minimum(k + 0.5, high) - np.maximum(k - 0.5, low), 0.0, 1.0)


def test_coverage_sums_to_the_volume_and_converges():
    solid, rng = simulate.stapes_solid(Stapes()), np.random.default_rng(3)
    shape = tuple(int(n) for n in np.ceil((np.ptp(solid.vertices_mm, axis=0) + 0.5) / 0.06))
    squares = np.zeros(4)
    for _ in range(6):
        shift = 0.2 - solid.vertices_mm.min(axis=0) + rng.uniform(-0.03, 0.03, 3)
        moved = simulate.Solid(solid.vertices_mm + shift, solid.faces)
        exact = moved.moments()
        for place, samples in enumerate((1, 2, 4, 8)):
            share = simulate.coverage_of(moved, shape, [0.06] * 3, samples)
            assert share.min() > -1e-6
            assert share.max() < 1.0 + 1e-6
            squares[place] += (share.sum() * 0.06**3 / exact.volume_mm3 - 1.0) ** 2
        z, y, x = np.indices(share.shape)
        centre = np.array([(share * part).sum() for part in (x, y, z)]) / share.sum() * 0.06
        assert centre == pytest.approx(exact.centroid_mm, abs=5e-5)
    # Heights vanish at the silhouette at best linearly: the rule converges with an order of 1.5 to 2.
    error = np.sqrt(squares / 6.0)
    assert np.polyfit(np.log([1.0, 2.0, 4.0, 8.0]), np.log(error), 1)[0] < -1.5
    assert error[3] < error[0] * 8.0**-1.5


def test_noise_free_scan_holds_the_mass_of_all_bodies():
    ear = Ear(bone=False, plate=False)
    truth = simulate.simulate_truth(ear, replace(SMALL, samples=8))
    grey = simulate.render(truth.placed, clean(truth.scan)).astype(float)
    air, _, bone = truth.scan.levels
    volume = (grey - air).sum() / (bone - air) * np.prod(truth.placed.voxel_mm)
    assert volume == pytest.approx(truth.volume_m3 * 1e9, rel=5e-5)
    index = np.indices(grey.shape)[::-1].reshape(3, -1)
    centre = (index * (grey - air).ravel()).sum(axis=1) / (grey - air).sum() * truth.placed.voxel_mm
    assert centre == pytest.approx(
        truth.scan_from_footplate.points(truth.ear.solid.moments().centroid_mm), abs=2e-4
    )


def test_flat_face_is_an_error_function_of_the_blur():
    scan = clean(Scan(voxel_um=50.0, samples=4, blur_voxels=1.5, shape=(40, 40, 60)))
    slab = simulate.box([0.0, 0.0, 1.01], [3.0, 3.0, 1.51])
    placed = replace(scan.placed(Ear()), solids=((slab, "plastic"),))
    grey = simulate.render(placed, scan)[:, 20, 20].astype(float)
    air, plastic, _ = scan.levels
    height = np.arange(len(grey)) * 0.05 - 1.01
    # The voxel itself adds a variance of 1/12.
    sigma = 0.05 * np.hypot(1.5, np.sqrt(1.0 / 12.0))
    expected = ndtr(height / sigma) - ndtr((height - 0.5) / sigma)
    assert np.abs((grey - air) / (plastic - air) - expected).max() < 0.01


def test_noise_has_its_standard_deviation_and_correlation():
    scan = Scan(voxel_um=60.0, samples=2, noise=0.05, dtype="float32", shape=(60, 60, 60))
    for sigma in (0.0, 1.0):
        noisy = replace(scan, noise_correlation_voxels=sigma)
        truth = simulate.simulate_truth(Ear(), noisy)
        noise = simulate.render(truth.placed, noisy) - simulate.render(truth.placed, clean(noisy))
        noise = noise / (scan.levels[2] - scan.levels[0])
        assert noise.std() == pytest.approx(0.05, rel=0.05)
        neighbours = np.mean(noise[:, :, 1:] * noise[:, :, :-1]) / noise.var()
        assert neighbours == pytest.approx(np.exp(-0.25 / sigma**2) if sigma else 0.0, abs=0.05)
