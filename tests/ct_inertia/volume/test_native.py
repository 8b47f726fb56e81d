"""The compiled kernels and their twins in numpy, scipy and VTK: the same numbers for every type."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hatch_build import system_compiler
from legacy.ct_inertia.grey.level_fit import grow_mask
from legacy.ct_inertia.grey.partial_volume import Share, partial_volume_moments
from legacy.ct_inertia.grey.psf import edge_sigma
from legacy.ct_inertia.surface.contours import contoured
from legacy.ct_inertia.surface.isosurface import largest_part
from legacy.ct_inertia.volume.distance import capped_distance
from legacy.ct_inertia.volume.grid_operations import (
    boxes_and_sizes,
    dilated,
    eroded,
    gaussian,
    interpolated,
    labelled,
    majority,
    used_box,
    watershed,
)
from legacy.ct_inertia.volume.interior_histogram import interior
from legacy.ct_inertia.volume.mask_statistics import (
    deviation,
    every_nth,
    gather_voxels,
    look_up,
    lowest,
    places_between,
    sums,
)
from legacy.ct_inertia.volume.mesh_graphs import graph_pieces, in_hull, solver
from legacy.ct_inertia.volume.normal_distribution import normal_cdf, normal_quantile
from legacy.ct_inertia.volume.volume import Volume
from legacy.ct_inertia.volume.working_copy import working_box
from legacy.stapeskit.compiled_kernels import SWITCH, built_library, library_name, load

ROOT = Path(__file__).resolve().parents[3]


def both(monkeypatch, work):
    """Return what some work gives with the kernels, and without."""
    ours = work()
    with monkeypatch.context() as patch:
        for module in list(sys.modules.values()):
            if getattr(module, "__name__", "").startswith("ct_inertia") and hasattr(module, "compiled"):
                patch.setattr(module, "compiled", lambda: None)
        theirs = work()
    return ours, theirs


def exactly(monkeypatch, work):
    """Say that some work gives the same arrays with the kernels and without, to the bit."""
    ours, theirs = both(monkeypatch, work)
    for a, b in zip(ours, theirs, strict=True):
        assert np.array_equal(a, b)
    return ours


def closely(monkeypatch, work, relative=1e-12):
    ours, theirs = both(monkeypatch, work)
    for a, b in zip(ours, theirs, strict=True):
        a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
        assert np.max(np.abs(a - b), initial=0.0) <= relative * np.max(np.abs(b), initial=1e-300)


SHAPES = [(1, 1, 1), (1, 7, 3), (5, 1, 9), (17, 13, 40), (30, 24, 33)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("share", [0.0, 0.03, 0.3, 0.6, 1.0])
def test_masks(monkeypatch, shape, share):
    rng = np.random.default_rng(int(1e3 * share) + shape[1])
    mask, inner = rng.random(shape) < share, rng.random(shape) < 0.7

    def work():
        found = []
        for corners in (False, True):
            labels, count = labelled(mask, corners)
            boxes, sizes = boxes_and_sizes(labels, count)
            found += [labels, count, [[(s.start, s.stop) for s in box] for box in boxes], sizes]
            table = rng_table(count)
            found.append(look_up(labels, table))
        out = np.zeros((40, 40, 80), dtype=np.int32)[: shape[0], : shape[1], : shape[2]]
        labelled(mask, out=out)
        box = used_box(mask)
        found += [out, [] if box is None else [(s.start, s.stop) for s in box]]
        found += [grow(mask, rounds) for grow in (dilated, eroded) for rounds in (1, 3)]
        found += [dilated(mask & inner, 4, inner), grow_mask(mask), grow_mask(mask, corners=False)]
        found += [majority(np.pad(mask, 2)), every_nth(mask, 1), every_nth(mask, 7)]
        return found

    def rng_table(count):
        table = np.random.default_rng(1).random(count + 1) < 0.5
        table[0] = False
        return table

    exactly(monkeypatch, work)


@pytest.mark.parametrize("spacing", [(0.02, 0.02, 0.02), (0.01, 0.03, 0.02)])
@pytest.mark.parametrize("cap", [0.005, 0.07, 0.24])
def test_distances(monkeypatch, spacing, cap):
    rng = np.random.default_rng(2)
    masks = [rng.random((23, 31, 40)) < share for share in (0.0, 0.0005, 0.05, 1.0)]
    exactly(monkeypatch, lambda: [capped_distance(m, np.array(spacing), cap) for m in masks])


@pytest.mark.parametrize("shape", [(4, 5, 6), (21, 34, 28), (3, 2, 600)])
def test_grey_values(monkeypatch, shape):
    rng = np.random.default_rng(3)
    grey = rng.normal(9000.0, 2000.0, shape).astype(np.float32)
    mask, inner = rng.random(shape) < 0.4, rng.random(shape) < 0.5
    places = rng.uniform(-1.0, 1.2, (500, 3)) * np.array(shape)
    widths = (0.7, 1.0, 2.5, np.array([0.0, 0.4, 1.3]))
    exactly(monkeypatch, lambda: [gaussian(grey, sigma, 3.0) for sigma in widths])
    exactly(monkeypatch, lambda: gather_voxels(grey, mask, inner, (1.5, 2.5)))
    exactly(monkeypatch, lambda: [places_between(grey, mask, 8000.0, 9500.0, np.array([1, 1, 1]))])
    closely(monkeypatch, lambda: [interpolated(grey, places)])
    closely(monkeypatch, lambda: [deviation(grey, mask, 9000.0), sums(grey, mask).mean])
    ours, theirs = both(monkeypatch, lambda: sums(grey, mask))
    for name in ("count", "total"):
        for a, b in zip(getattr(ours, name), getattr(theirs, name), strict=True):
            assert np.allclose(a, b, rtol=1e-12, atol=0.0)
    assert np.allclose(ours.eighth_total, theirs.eighth_total, rtol=1e-12, atol=0.0)
    assert np.array_equal(ours.eighth_count, theirs.eighth_count)


@pytest.mark.parametrize("dtype", ["uint8", "int8", "uint16", "int16", "uint32", "int32", "float32", ">u2"])
@pytest.mark.parametrize("block", [(1, 1, 2), (2, 2, 2), (3, 1, 2)])
def test_block_means_and_lowest_values_of_every_type(monkeypatch, dtype, block):
    rng = np.random.default_rng(4)
    whole = rng.integers(0, 120, (24, 30, 36)).astype(dtype)
    spacing = np.array([0.02 / b for b in block[::-1]])
    for array in (whole, whole[::-1], whole[:, 2:, 4:]):
        volume = Volume(array, spacing, np.zeros(3), np.eye(3))
        size = np.array(array.shape[::-1])
        low, high = np.array([5, 4, 3]), size - 7

        def work(volume=volume, low=low, high=high):
            made = working_box(volume, low, high, 0.0, 1, 0.02)
            return [made.grey, made.volume.origin_mm]

        assert exactly(monkeypatch, work)[0].dtype == np.float32
    mask = rng.random(whole.shape) < 0.3
    exactly(monkeypatch, lambda: lowest(whole, mask))


@pytest.mark.parametrize("shape", [(3, 3, 3), (9, 14, 300), (40, 25, 19)])
def test_the_inside_of_materials(monkeypatch, shape):
    rng = np.random.default_rng(5)
    grey = np.where(rng.random(shape) < 0.5, 8000.0, 30000.0) + rng.normal(0.0, 300.0, shape)
    grey[:, : shape[1] // 2] = 8000.0 + rng.normal(0.0, 100.0, grey[:, : shape[1] // 2].shape)
    grey = grey.astype(np.float32)

    def work():
        found = interior(grey, 250.0, 40.0)
        return [found.bins, found.histogram, found.filled(8000.0, 400.0), found.filled(20000.0, 3000.0)]

    exactly(monkeypatch, work)


def test_moments_and_what_is_not_known_of_them(monkeypatch):
    rng = np.random.default_rng(6)
    n = 250_000
    share = Share(
        rng.integers(0, 200, (n, 3)).astype(float),
        rng.uniform(8000.0, 30000.0, n),
        rng.uniform(100.0, 900.0, n),
        *(8000.0, 30000.0, 5.0, 20.0, 0.021, 0.001, 1.3),
    )
    transform = np.eye(4)
    transform[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0] * 0.02
    transform[:3, 3] = (3.0, -2.0, 11.0)

    def work():
        found = partial_volume_moments(share, transform)
        parts = [found.contributions[name] for name in ("noise", "levels", "psf")]
        return [found.volume_mm3, found.centroid_mm, found.second_mm5, *parts]

    closely(monkeypatch, work, 1e-11)


def test_the_blur_read_off_edges(monkeypatch):
    z, y, x = np.indices((40, 44, 48)) * 0.02
    away = 0.3 - np.sqrt((z - 0.4) ** 2 + (y - 0.44) ** 2 + (x - 0.5) ** 2)
    grey = (8000.0 + 22000.0 * normal_cdf(away / 0.025)).astype(np.float32)
    near = np.abs(away) < 0.05
    closely(monkeypatch, lambda: edge_sigma(grey, near, 8000.0, 30000.0, np.full(3, 0.02), 0.01))


def test_contours_of_a_ball_and_of_noise(monkeypatch):
    rng = np.random.default_rng(7)
    z, y, x = np.indices((24, 26, 28))
    ball = (9.0 - np.sqrt((z - 12.2) ** 2 + (y - 12.7) ** 2 + (x - 13.1) ** 2)).astype(np.float32)
    noise = rng.normal(size=(12, 9, 15)).astype(np.float32)
    levels = (np.arange(5 * 6 * 7) % 3).reshape(5, 6, 7).astype(np.float32)
    for field, level in ((ball, 0.25), (noise, 0.1), (levels, 1.0), (noise, 99.0)):
        (points, faces), (seen, wanted) = both(monkeypatch, lambda f=field, v=level: contoured(f, v))
        assert len(points) == len(seen)
        assert len(faces) == len(wanted)
        if len(faces) == 0:
            continue
        # VTK keeps points in single precision and may begin a triangle at another corner.
        ours, theirs = (sorted_corners(p[f]) for p, f in ((points, faces), (seen, wanted)))
        assert np.max(np.abs(ours - theirs)) < 2e-5


def sorted_corners(corners):
    """Return triangles (m, 3, 3) in an order of their own: the smallest corner first, then by all corners."""
    rough = np.round(corners, 3)
    first = np.array([min(range(3), key=lambda k: tuple(t[k])) for t in rough])
    turned = corners[np.arange(len(corners))[:, None], (first[:, None] + np.arange(3)) % 3]
    middle = np.round(turned, 3).reshape(len(turned), 9)
    return turned[np.lexsort(middle.T)]


@pytest.mark.parametrize("ties", [False, True])
def test_floods_take_equal_heights_in_the_same_order(monkeypatch, ties):
    rng = np.random.default_rng(12)
    height = gaussian(rng.normal(size=(20, 26, 31)).astype(np.float32), 1.5)
    if ties:
        height = np.round(height * 20.0)
    markers, _ = labelled(height > np.quantile(height, 0.93))
    mask = height > np.quantile(height, 0.25)
    found = exactly(monkeypatch, lambda: [watershed(height, markers, mask)])[0]
    assert np.count_nonzero(found) > 0.9 * np.count_nonzero(mask)


def test_graphs(monkeypatch):
    rng = np.random.default_rng(8)
    edges = rng.integers(0, 300, (180, 2))
    exactly(monkeypatch, lambda: graph_pieces(300, edges))
    exactly(monkeypatch, lambda: graph_pieces(5, np.zeros((0, 2), dtype=int)))
    z, y, x = np.indices((20, 20, 20))
    middles = ((5.0, 7), (2.0, 16))
    large, small = (r - np.sqrt((z - c) ** 2 + (y - c) ** 2 + (x - c) ** 2) for r, c in middles)
    two = np.maximum(large, small)
    points, faces = contoured(two.astype(np.float32), 0.1)
    kept, _ = largest_part(points, faces)
    assert 0 < len(kept) < len(points)
    exactly(monkeypatch, lambda: largest_part(points, faces))


def test_positive_definite_systems(monkeypatch):
    rng = np.random.default_rng(9)
    n = 400
    i, j = rng.integers(0, n, (2, 2500))
    w = rng.uniform(0.0, 50.0, len(i))
    rows, columns = np.concatenate([i, j, i, j]), np.concatenate([j, i, i, j])
    values = np.concatenate([-w, -w, w, w])
    mass, b = rng.uniform(0.1, 1.0, n), rng.normal(size=(n, 3))
    closely(monkeypatch, lambda: [solver(rows, columns, values, mass)(b)], 1e-11)


def test_hulls(monkeypatch):
    rng = np.random.default_rng(10)
    ball = np.round(rng.normal(size=(3000, 3)) * 9.0 + 60.0).astype(np.int64)
    box = np.stack(np.meshgrid(*[np.arange(10, 20)] * 3), axis=-1).reshape(-1, 3)
    asked = rng.integers(0, 110, (4000, 3))
    for points in (ball, box):
        exactly(monkeypatch, lambda p=points: [in_hull(p, asked)])
        assert np.all(in_hull(points, points))
    assert not np.any(in_hull(box, np.array([[9, 15, 15], [20, 15, 15], [15, 15, 40]])))


def test_the_normal_distribution(monkeypatch):
    z = np.concatenate([np.linspace(-37.0, 9.0, 4001), [-np.inf, np.inf]])
    tails = [10.0 ** np.linspace(-300.0, -0.31, 3001), 1.0 - 10.0 ** np.linspace(-15.0, -0.31, 500)]
    p = np.concatenate(tails)
    for work in (lambda: normal_cdf(z), lambda: normal_quantile(p)):
        ours, theirs = both(monkeypatch, work)
        assert np.allclose(ours, theirs, rtol=2e-13, atol=1e-14)
    assert np.array_equal(normal_quantile([0.0, 1.0, 0.5]), [-np.inf, np.inf, 0.0])
    assert np.isnan(normal_quantile(-0.1))


@pytest.mark.parametrize("dtype", ["uint8", "int8", "uint16", "int16"])
def test_labels_of_regions(monkeypatch, dtype):
    from legacy.ct_inertia.labelling.label_box import _labels, _Region

    rng = np.random.default_rng(11)
    array = rng.integers(0, 120, (33, 41, 52)).astype(dtype)
    volume = Volume(array, np.full(3, 0.01), np.zeros(3), np.eye(3))
    step, fine = np.array([5, 4, 3]), np.array([2, 2, 2])
    cells = rng.random((9, 8, 10)) < 0.4
    own = rng.uniform(-300.0, 300.0, cells.shape)
    regions = [
        _Region(2, cells, 40.0, np.array([0, 4, 3]), step),
        _Region(3, cells[::-1], 1e9, np.array([2, 0, 1]), step),
        _Region(1, cells, own.astype(np.float32), np.array([20, 9, 7]), fine),
        _Region(1, cells[:3], -np.inf, np.array([1, 1, 20]), np.ones(3, dtype=np.int64)),
    ]
    low, high = np.array([3, 0, 2]), np.array([50, 41, 33])
    labels = exactly(monkeypatch, lambda: [_labels(volume, regions, 0.0, low, high)])[0]
    assert set(np.unique(labels)) == {0, 1, 2}


def test_the_kernels_are_there_where_a_compiler_is_and_can_be_left_out():
    code = "from ct_inertia.native import which; print(which())"
    built = "numpy" if system_compiler() is None else "compiled"
    for switch, wanted in (("numpy", "numpy"), ("", built)):
        said = subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | {SWITCH: switch},
            capture_output=True,
            text=True,
            cwd=ROOT,
        )
        assert said.stdout.strip() == wanted, said.stderr


def test_the_name_of_the_library_follows_its_sources(tmp_path):
    (tmp_path / "a.c").write_bytes(b"int a;\n")
    first = library_name(tmp_path, b"library")
    (tmp_path / "a.c").write_bytes(b"int a;\r\n")
    assert library_name(tmp_path, b"library") == first
    (tmp_path / "a.c").write_bytes(b"int b;\n")
    assert library_name(tmp_path, b"library") != first


def test_a_damaged_library_is_not_loaded(tmp_path):
    (tmp_path / "a.c").write_bytes(b"int a;\n")
    whole = tmp_path / library_name(tmp_path, b"library")
    whole.write_bytes(b"library")
    assert built_library(tmp_path) == whole
    whole.write_bytes(b"librarx")
    assert built_library(tmp_path) is None
    assert load(tmp_path, {}) is None


def test_a_whole_ear_weighs_the_same_without_the_kernels(monkeypatch):
    from legacy.ct_inertia.labelling.from_scan import find_bodies
    from tests.ct_inertia.ears import ear

    volume = ear(h=0.04, seed=3).volume

    def work():
        found = find_bodies(volume)
        return [found.moments.volume_mm3, found.moments.centroid_mm, found.moments.second_mm5]

    closely(monkeypatch, work, 1e-9)
