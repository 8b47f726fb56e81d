"""The peers of the benchmarks measure what they claim: known bodies, one small scan."""

from __future__ import annotations

import importlib
import json

import numpy as np
import pytest
import trimesh

from benchmarks.ct_accuracy import against
from benchmarks.peers import measures
from sample_volumes.phantom import Ear, scene, truth, write_scan

HALF = 19000.0


@pytest.mark.parametrize(
    "way", ["voxel_count", "marching_cubes", "vtk_flying_edges", "simpleitk_otsu", "surface_nets"]
)
def test_each_way_measures_a_box(way):
    rounded = 0.04 if way == "surface_nets" else 0.02
    spacing = 0.05
    low, high = np.array([11, 7, 9]), np.array([51, 37, 29])
    grey = np.full((40, 50, 60), 8000.0, dtype=np.float32)
    grey[low[2] : high[2], low[1] : high[1], low[0] : high[0]] = 30000.0
    sides = (high - low) * spacing
    volume, centre, second = getattr(measures, way)(grey, spacing, HALF)
    assert volume == pytest.approx(np.prod(sides), rel=rounded)
    np.testing.assert_allclose(centre, (0.5 * (low + high) - 0.5) * spacing, atol=1e-3)
    np.testing.assert_allclose(second, np.diag(sides**2) / 12 * np.prod(sides), rtol=3 * rounded, atol=2e-3)


def test_exact_moments_have_no_error_and_a_wrong_frame_has():
    from legacy.ct_inertia.surface.surface import Surface
    from sample_volumes.bodies import moved, stapes_in_footplate
    from sample_volumes.phantom import Solid

    placed = scene(Ear(voxel_mm=(0.1, 0.1, 0.1)))
    stapes = stapes_in_footplate()
    solid = moved(Solid(stapes.vertices_mm, stapes.faces), placed.scan_from_footplate)
    moments = Surface(solid.vertices, solid.faces).moments()
    found = moments.volume_mm3, moments.centroid_mm, moments.second_mm5
    exact = truth(placed)
    assert max(map(abs, against(exact, *found).values())) < 1e-9
    off = np.array(exact["scan_from_footplate"])
    off[:3, 3] += 0.01 * off[:3, 1]
    assert against(exact, *found, off)["matrix"] > 0.3


def test_the_watershed_parts_two_boxes_and_sums_the_one_of_the_true_volume():
    from benchmarks.peers.watershed import watershed_integral
    from legacy.ct_inertia.volume.grid_operations import gaussian

    grey = np.zeros((40, 50, 60), dtype=np.float32)
    grey[10:30, 10:40, 10:30] = 1.0
    grey[10:30, 10:40, 33:45] = 1.0
    exact, levels = 20 * 30 * 20 * 0.02**3, (8000.0, 30000.0)
    seen = 8000.0 + 22000.0 * gaussian(grey, 1.0)
    volume, centre, second, _ = watershed_integral(seen, 0.02, levels, 0.02, exact)
    assert volume == pytest.approx(exact, rel=2e-3)
    np.testing.assert_allclose(centre, np.array([19.5, 24.5, 19.5]) * 0.02, atol=5e-4)
    np.testing.assert_allclose(np.diag(second), exact * np.array([0.4, 0.6, 0.4]) ** 2 / 12, rtol=0.01)


def test_a_row_of_the_conditions_holds_errors_and_warnings(tmp_path):
    from benchmarks.ct_conditions import made, row

    cells = row(tmp_path, made(tmp_path, 40, ("--cupping", "10"), seed=2), False).split(" | ")
    volume, stated = (float(cell.rstrip(" %")) for cell in cells[:2])
    assert abs(volume) < 3.0 * stated < 1.0
    assert "bone_cupping" in cells[-1]


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    path = tmp_path_factory.mktemp("scan") / "scan.ome.tif"
    placed = scene(Ear(voxel_mm=(0.05, 0.05, 0.05)))
    write_scan(path, placed)
    return path, truth(placed)


@pytest.mark.parametrize("peer", ["skimage_trimesh", "vtk_trimesh", "vtk_connectivity", "simpleitk"])
def test_each_peer_writes_mesh_labels_and_mass_of_the_stapes(peer, scan, tmp_path):
    path, exact = scan
    importlib.import_module(f"benchmarks.peers.{peer}").main(path, tmp_path, HALF)
    found = json.loads((tmp_path / "mass.json").read_text(encoding="utf-8"))
    assert found["volume_mm3"] == pytest.approx(exact["volume_m3"] * 1e9, rel=0.08)
    np.testing.assert_allclose(found["center_of_mass_mm"], exact["center_of_mass_in_scan_mm"], atol=0.04)
    mesh = trimesh.load_mesh(tmp_path / "stapes.ply")
    assert mesh.volume == pytest.approx(exact["volume_m3"] * 1e9, rel=0.08)
    inertia = 1900e-15 * mesh.moment_inertia
    np.testing.assert_allclose(found["inertia_kg_m2"], inertia, atol=0.05 * np.trace(inertia))
    assert (tmp_path / "labels.nrrd").stat().st_size > 1000
