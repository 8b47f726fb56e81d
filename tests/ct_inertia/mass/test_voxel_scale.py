"""The voxel scale from stated lengths and balls: estimate, powers of length, and what reaches M."""

import dataclasses

import numpy as np
import pytest

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.grey.ball_diameter import ball_diameter
from legacy.ct_inertia.mass.mass_properties import (
    PointMass,
    footplate_mass_matrix,
    from_density,
    from_mass,
    scaled,
    with_added,
)
from legacy.ct_inertia.mass.voxel_scale import SCANNER_SD, voxel_scale
from legacy.ct_inertia.options import MassOptions
from legacy.ct_inertia.surface.surface import Surface
from legacy.ct_inertia.volume.grid_operations import gaussian
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.frames import RigidTransform
from tests.ct_inertia.shapes import stapes

H = 0.02
FRAME = RigidTransform(np.eye(4), "scan", "footplate")


def volume_with_ball(diameter=0.6, h=H):
    place = (np.indices((80, 80, 80))[::-1] - np.array([39.3, 40.8, 38.1])[:, None, None, None]) * h
    share = np.clip(0.5 + (0.5 * diameter - np.linalg.norm(place, axis=0)) / h, 0.0, 1.0)
    noise = np.random.default_rng(1).normal(0.0, 20.0, share.shape)
    grey = 500.0 + 1000.0 * gaussian(share.astype(np.float32), 1.2) + noise
    return Volume(grey.astype(np.float32), np.full(3, h), np.zeros(3), np.eye(3))


def options(**more):
    return MassOptions("scan.tif", density=(1900.0, None), **more)


def test_a_precise_length_sets_the_scale_and_its_sd():
    row = (0.0, 0.0, 0.0, 8.0, 0.0, 0.0, 8.032, 0.002)
    found = voxel_scale(options(scale_length=[row]), volume_with_ball())
    one = np.hypot(0.002, H / np.sqrt(6.0)) / 8.0
    assert found.sd == pytest.approx(1.0 / np.sqrt(one**-2 + SCANNER_SD**-2))
    assert found.factor == pytest.approx(1.0 + 0.004 * (found.sd / one) ** 2)


def test_a_coarse_length_does_not_replace_what_is_known_of_scanners():
    row = (0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 2.1, 0.1)
    found = voxel_scale(options(scale_length=[row]), volume_with_ball())
    assert abs(found.factor - 1.0) < 5e-4
    assert found.sd == pytest.approx(SCANNER_SD, rel=0.01)


def test_a_ball_is_measured_to_a_tenth_of_a_percent():
    volume = volume_with_ball()
    found, sd = ball_diameter(volume, np.array([0.80, 0.79, 0.75]), 0.61)
    assert found == pytest.approx(0.6, rel=1.5e-3)
    assert 0.0 < sd < 1.5e-3
    scale = voxel_scale(options(scale_ball=[(0.78, 0.82, 0.76, 0.606, 0.0002)]), volume)
    assert scale.factor == pytest.approx(1.01, abs=3.0 * scale.sd + 5e-4)


def test_a_ball_alone_gives_its_ratio_and_the_sd_of_a_ratio(monkeypatch):
    monkeypatch.setattr("legacy.ct_inertia.grey.ball_diameter.ball_diameter", lambda *_: (0.5, 3e-4))
    volume = Volume(np.zeros((2, 2, 2), np.float32), np.full(3, H), np.zeros(3), np.eye(3))
    known = options(scale_ball=[(0.0, 0.0, 0.0, 0.51, 4e-4)], voxel_size_sd_percent=20.0)
    found = voxel_scale(known, volume)
    assert (found.factor, found.sd) == pytest.approx((0.51 / 0.5, 5e-4 / 0.5), rel=1e-4)
    sure = voxel_scale(dataclasses.replace(known, voxel_size_sd_percent=1e-7), volume)
    assert sure.factor == pytest.approx(1.0, abs=1e-6)


def test_what_is_no_ball_alone_in_air_is_refused():
    volume = volume_with_ball()
    for place, size in (((0.1, 0.1, 0.1), 0.6), ((0.78, 0.82, 0.76), 0.05), ((1.05, 0.82, 0.76), 0.3)):
        with pytest.raises(CtInertiaError) as error:
            ball_diameter(volume, np.array(place), size)
        assert "scale_ball" in error.value.faults[0].thing


def test_a_length_of_something_else_is_refused():
    with pytest.raises(CtInertiaError) as error:
        voxel_scale(options(scale_length=[(0.0, 0.0, 0.0, 8.0, 0.0, 0.0, 9.5, 0.01)]), volume_with_ball())
    assert error.value.faults[0].thing == "{scale_length}"


@pytest.mark.parametrize(
    "bare", [lambda m: from_density(m, 1900.0, 30.0), lambda m: from_mass(m, 3e-6, 1e-8)]
)
def test_scaled_properties_are_those_of_a_larger_surface(bare):
    surface, s = stapes(0.1), 1.004
    larger = Surface(surface.vertices_mm * s, surface.faces)
    bead = PointMass(np.array([0.3, 2.0, 0.4]), 2e-7, 1e-8)
    far = dataclasses.replace(bead, position_mm=bead.position_mm * s)
    one = with_added(scaled(bare(surface.moments()), s), [bead])
    two = with_added(bare(larger.moments()), [far])
    first, second = (footplate_mass_matrix(body, FRAME, np.zeros((6, 6)), 0.001) for body in (one, two))
    assert first.matrix == pytest.approx(second.matrix, rel=1e-9, abs=1e-20)
    assert first.covariance == pytest.approx(second.covariance, rel=1e-6, abs=1e-30)
    assert one.density_kg_m3 == pytest.approx(two.density_kg_m3)
    assert one.volume_m3 == pytest.approx(two.volume_m3)


def test_lengths_without_sd_are_refused():
    with pytest.raises(CtInertiaError):
        options(scale_length=["0,0,0,8,0,0,8.03"])
    assert options(scale_length=["0,0,0,8,0,0,8.03+-0.01"]).scale_length[0][-1] == 0.01
