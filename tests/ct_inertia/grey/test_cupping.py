"""Cupping of bone is told and counted; clean scans and bone of changing density raise no alarm."""

import numpy as np
import pytest

from legacy.ct_inertia.grey.cupping import deep_cupping_notice, find_cupping
from legacy.ct_inertia.labelling.from_scan import find_bodies
from legacy.ct_inertia.volume.volume import Volume
from sample_volumes.phantom import Ear, render, scene, truth


def measured(h=0.04, **settings):
    placed = scene(Ear(voxel_mm=(h,) * 3, gap_mm=0.1, **settings))
    volume = Volume(render(placed), np.full(3, h), np.zeros(3), np.eye(3))
    return find_bodies(volume), truth(placed)


def codes(bodies):
    return [notice.code for notice in bodies.notices]


@pytest.mark.parametrize("seed", [1, 2])
def test_cupping_is_told_and_its_uncertainty_covers_what_it_does(seed):
    bodies, exact = measured(cupping=0.1, pose_seed=seed, noise_seed=seed)
    assert "bone_cupping" in codes(bodies)
    moments = bodies.moments
    assert "cupping" in moments.contributions
    sd = np.sqrt(np.diag(sum(moments.contributions.values())))
    volume = exact["volume_m3"] * 1e9
    assert abs(moments.volume_mm3 - volume) < 2.5 * sd[0]
    away = moments.centroid_mm - np.array(exact["center_of_mass_in_scan_mm"])
    assert np.linalg.norm(away) < 2.5 * np.linalg.norm(sd[1:4])
    assert np.linalg.norm(sd[1:4]) < 0.04


@pytest.mark.parametrize("settings", [{}, {"pose_seed": 5, "noise_seed": 5}, {"gradient": 0.05}])
def test_clean_scans_and_changing_density_are_no_cupping(settings):
    bodies, _ = measured(**settings)
    assert "bone_cupping" not in codes(bodies)
    assert "cupping" not in bodies.moments.contributions


def field(places, rng):
    return 20000.0 + rng.normal(0.0, 400.0, len(places))


def test_only_a_paraboloid_that_opens_outward_counts():
    rng = np.random.default_rng(1)
    places = rng.uniform([1.0, 2.0, 0.5], [4.0, 3.5, 4.0], (30_000, 3))
    squared = (places[:, 0] - 2.0) ** 2 + (places[:, 1] - 1.0) ** 2
    flat = field(places, rng)

    def found(values, sloping=False):
        return find_cupping(values, places, 18000.0, 1.0, sloping)

    cup = found(flat + 90.0 * squared, sloping=True)
    assert cup.curvature == pytest.approx(90.0, rel=0.1)
    # What a level and a slope cannot follow is the paraboloid about the middle of the places.
    left = cup.at(places)
    assert abs(left.mean()) < 1e-6 * 90.0
    assert np.abs(places.T @ left).max() < 1e-6 * len(places)
    assert found(flat + 90.0 * squared).at(places).mean() == pytest.approx(0.0, abs=1e-6)
    assert found(flat) is None
    assert found(flat - 90.0 * squared) is None
    assert found(flat + 700.0 * places[:, 0]) is None
    assert found(flat + 300.0 * (places[:, 2] - 1.0) ** 2) is None


def test_bone_that_is_darker_inside_is_told_and_brighter_is_not():
    (notice,) = deep_cupping_notice(-200.0, 20000.0)
    assert notice.code == "bone_cupping"
    assert "by 1.0 %" in notice.text
    assert deep_cupping_notice(200.0, 20000.0) == ()
    assert deep_cupping_notice(-30.0, 20000.0) == ()
