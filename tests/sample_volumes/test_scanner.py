"""Noise, cupping, stored numbers, density gradients and plates of the phantom against closed forms."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import tifffile

from legacy.ct_inertia.read_scan import read_volume
from legacy.ct_inertia.surface.surface import Surface
from legacy.stapeskit.spatial import check_inertia
from sample_volumes import bodies
from sample_volumes.density import graded_mass
from sample_volumes.old_study import main
from sample_volumes.phantom import Ear, Renderer, render, scene, truth
from sample_volumes.scanner import add_noise, cup

COARSE = Ear(voxel_mm=(0.06, 0.06, 0.06))
ALONE = replace(COARSE, bone=False, plate=False, noise=0.0)


def test_graded_box_has_the_closed_form_of_a_box_with_a_linear_density():
    a, b, c, g, rho = 2.0, 3.0, 1.0, 0.2, 1500.0
    solid = bodies.box(np.array([0.5, -1.0, 2.0]), np.array([0.5 + a, -1.0 + b, 2.0 + c]))
    mass = graded_mass(Surface(solid.vertices, solid.faces), rho, g)
    total = rho * a * b * c * 1e-9
    assert mass.mass_kg == pytest.approx(total, rel=1e-12)
    shift = g * b / 6.0
    np.testing.assert_allclose(mass.com_mm, [0.5 + a / 2, 0.5 + shift, 2.0 + c / 2], rtol=1e-12)
    height2 = b**2 / 12.0 - shift**2
    wanted = total * 1e-6 * np.diag([height2 + c**2 / 12, a**2 / 12 + c**2 / 12, a**2 / 12 + height2])
    np.testing.assert_allclose(mass.inertia_about_com, wanted, rtol=1e-9, atol=1e-24)


def test_without_a_gradient_the_quadrature_is_the_polyhedron():
    stapes = bodies.stapes_in_footplate()
    mass, moments = graded_mass(stapes, 1000.0, 0.0), stapes.moments()
    np.testing.assert_allclose(mass.com_mm, moments.centroid_mm, atol=1e-10)
    np.testing.assert_allclose(mass.inertia_about_com, 1e-12 * moments.inertia_mm5, rtol=1e-9, atol=1e-21)


def test_rendered_gradient_carries_the_mass_and_the_centre_of_the_truth():
    ear = replace(ALONE, gradient=0.1, voxel_mm=(0.04, 0.04, 0.04))
    placed = scene(ear)
    behind = truth(placed)
    grey = Renderer(placed).contrast(0, placed.shape[2]).astype(float)
    z, y, x = np.indices(grey.shape)
    centre = np.array([(grey * axis).sum() for axis in (x, y, z)]) / grey.sum() * 0.04
    assert grey.sum() * 0.04**3 * 1e-9 * 1382.4 == pytest.approx(behind["mass_kg"], rel=2e-4)
    np.testing.assert_allclose(centre, behind["center_of_mass_in_scan_mm"], atol=3e-4)
    check_inertia(np.array(behind["mass_matrix_si"]))
    moved = np.linalg.norm(np.subtract(behind["center_of_mass_in_scan_mm"], behind["centroid_in_scan_mm"]))
    assert moved > 0.03


def test_correlated_noise_keeps_its_size_and_is_correlated_as_asked():
    ear = replace(COARSE, noise_correlation_voxels=0.8)
    whole = np.zeros((40, 60, 60), dtype=np.float32)
    add_noise(whole, 0, ear)
    part = np.zeros((7, 60, 60), dtype=np.float32)
    add_noise(part, 20, ear)
    np.testing.assert_allclose(part, whole[20:27], atol=1e-6)
    assert whole.std() == pytest.approx(ear.noise, rel=0.02)
    neighbour = np.exp(-1.0 / (4.0 * 0.8**2))
    for axis in range(3):
        beside = np.roll(whole, 1, axis=axis)
        inner = tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        found = np.corrcoef(whole[inner].ravel(), beside[inner].ravel())[0, 1]
        assert found == pytest.approx(neighbour, abs=0.02)


def test_cupping_takes_its_share_in_the_middle_and_nothing_at_the_border():
    grey = np.ones((2, 41, 41), dtype=np.float32)
    cup(grey, 0.08)
    assert grey[0, 20, 20] == pytest.approx(0.92)
    assert grey[1, 0, 0] == pytest.approx(1.0)
    assert grey[0, 20, 30] == pytest.approx(1.0 - 0.08 * (1.0 - (10 / 20.5) ** 2))


@pytest.mark.parametrize("dtype", ["uint8", "int16", "float32"])
def test_stored_numbers_are_the_grey_values_of_the_uint16_scan(dtype, tmp_path):
    plain = render(scene(COARSE)).astype(float)
    main(["--voxel-um", "60", "--gap-um", "200", "--only", "scan", "--dtype", dtype, "--out", str(tmp_path)])
    volume = tifffile.imread(tmp_path / "scan.tif")
    assert volume.dtype.newbyteorder("=") == np.dtype(dtype)
    step = 257.0 if dtype == "uint8" else 1.0
    zero = -32768.0 if dtype == "int16" else 0.0
    assert np.abs((volume.astype(float) - zero) * step - plain).max() <= 0.501 * (step + 1.0)
    assert read_volume(tmp_path / "scan.tif").array.dtype.itemsize == np.dtype(dtype).itemsize


def test_air_near_zero_is_clipped():
    volume = render(scene(replace(COARSE, levels=(500.0, 9000.0, 30000.0))))
    assert 0.2 < np.mean(volume == 0) < 0.5


@pytest.mark.parametrize("gap", [0.0, 0.05, -0.03])
def test_the_plate_stands_off_the_nearest_point_of_the_stapes_as_asked(gap):
    placed = scene(replace(COARSE, plate_gap_mm=gap))
    scan_from_plate = placed.scan_from_footplate @ placed.footplate_from_plate
    stapes = scan_from_plate.inverse().points(placed.solids[0][0].vertices)
    assert stapes[:, 1].min() == pytest.approx(gap, abs=1e-9)


def test_a_plate_can_leave_the_field_of_view():
    placed = scene(replace(COARSE, plate_reach=2.0))
    grey = Renderer(placed).contrast(0, placed.shape[2])
    border = np.concatenate([grey[:, 0].ravel(), grey[:, -1].ravel(), grey[..., 0].ravel()])
    assert border.max() > 0.3
    assert placed.shape == scene(COARSE).shape


def test_options_reach_truth_and_calibration(tmp_path):
    words = "--voxel-um 120 --gradient 5 --dtype int16 --levels 9000,15000,31000 --cupping 4"
    main([*words.split(), "--noise-correlation", "0.7", "--only", "scan", "--out", str(tmp_path)])
    behind = json.loads((tmp_path / "truth.json").read_text(encoding="utf-8"))
    assert behind["gradient"] == pytest.approx(0.05)
    assert behind["levels"] == [9000.0 - 32768.0, 15000.0 - 32768.0, 31000.0 - 32768.0]
    line = tomllib.loads((tmp_path / "calibration.toml").read_text(encoding="utf-8"))
    assert line["points"] == [[-23768, 0], [-1768, 1382.4]]
