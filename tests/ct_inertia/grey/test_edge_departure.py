"""The asymmetry of edges: closed forms of a coat and of a bent grey scale, and none without them."""

import numpy as np
import pytest
from scipy.special import ndtr

from legacy.ct_inertia.grey.edge_departure import PLACES, Profiles, long_tails, skewness
from legacy.ct_inertia.grey.edge_shape import edge_shape
from legacy.ct_inertia.grey.grey_scale import bend_of_scale
from legacy.ct_inertia.volume.grid_operations import gaussian

H = 0.025
SHAPE = (56, 60, 64)


def profiles(mean, scatter=1e-3, seed=0):
    noise = scatter * np.random.default_rng(seed).standard_normal((400, len(PLACES)))
    return Profiles(mean + noise, np.arange(400) // 4, np.arange(1200.0).reshape(400, 3), 0.0)


def factor(mean, level_sd=0.0):
    edges = profiles(mean)
    return skewness(lambda: edges, lambda: edges, level_sd)


def bent(height):
    step = ndtr(PLACES)
    return step + 4.0 * height * step * (1.0 - step)


def test_a_bent_scale_skews_the_edge_by_its_share_of_the_second_hermite_function():
    """4 Phi (1 - Phi) has the area 4 / sqrt(pi), 5/6 of it as second moment: -1 / (3 sqrt(pi)) He2 phi."""
    odd = 0.5 * (factor(bent(0.1)) - factor(bent(-0.1)))
    assert odd == pytest.approx(-0.1 / (3.0 * np.sqrt(np.pi)), rel=0.15)


def test_a_coat_skews_the_edge_the_other_way_with_the_cube_of_its_thickness():
    def coated(thick, grey=0.15):
        return ndtr(PLACES) + grey * (ndtr(PLACES + thick) - ndtr(PLACES))

    thin, thick = (factor(coated(t)) for t in (0.9, 1.4))
    assert thin > 0.0
    assert thick / thin == pytest.approx((1.4 / 0.9) ** 3, rel=0.25)


def test_shift_width_and_noise_are_no_skewness():
    for shift, width in ((0.0, 1.0), (0.3, 1.1), (-0.2, 0.9)):
        assert factor(ndtr((PLACES - shift) / width)) == 0.0


def test_a_level_of_bone_that_may_be_wrong_hides_the_skewness_that_it_makes():
    wrong = 1.03 * ndtr(PLACES)
    assert factor(wrong) > 0.0
    assert factor(wrong, 0.03) == 0.0


def test_a_level_of_bone_that_may_be_wrong_hides_the_long_tails_that_it_makes():
    tails = ndtr(PLACES) + 0.012 * (PLACES**3 - 3.0 * PLACES) * -np.exp(-0.5 * PLACES**2) / np.sqrt(
        2.0 * np.pi
    )
    assert long_tails(profiles(tails), 0.0)
    assert not long_tails(profiles(tails), 0.3)
    assert not long_tails(profiles(ndtr(PLACES)), 0.0)


def test_profiles_found_in_other_noise_have_the_last_word():
    seen = profiles(bent(0.12))
    assert skewness(lambda: seen, lambda: seen, 0.0) < 0.0
    assert skewness(lambda: seen, lambda: profiles(ndtr(PLACES)), 0.0) == 0.0
    assert skewness(lambda: seen, lambda: None, 0.0) == 0.0


def test_bone_whose_level_slopes_is_compared_with_its_own_level():
    edges = profiles(ndtr(PLACES))
    bone = 900.0 + 0.2 * edges.points_mm[:, 1]
    grey = 100.0 + (bone - 100.0)[:, None] * edges.values
    seen = Profiles((grey - 100.0) / 800.0, edges.cells, edges.points_mm, 0.0)
    assert seen.between((100.0, 900.0), 100.0, bone).values == pytest.approx(edges.values)


@pytest.mark.parametrize(("gamma", "sign"), [(0.7, -1.0), (1.0, 0.0), (1.5, 1.0)])
def test_a_ball_exported_with_a_gamma_shows_it_between_any_levels(gamma, sign):
    away = np.linalg.norm(np.indices(SHAPE) - np.array(SHAPE)[:, None, None, None] / 2.0, axis=0)
    grey = gaussian(np.clip(16.5 - away, 0.0, 1.0).astype(np.float32), 1.3)
    grey += np.float32(0.02) * np.random.default_rng(3).standard_normal(SHAPE, dtype=np.float32)
    grey = np.clip((grey + 0.2) / 1.7, 0.0, 1.0).astype(np.float32) ** np.float32(gamma)
    air, bone = (0.2 / 1.7) ** gamma, (1.2 / 1.7) ** gamma
    nothing = np.zeros(SHAPE, dtype=bool)
    shape = edge_shape(grey, ~nothing, nothing, (air, air + 0.95 * (bone - air)), np.full(3, H), 0.02)
    found, _ = shape.departures(air, lambda points: np.full(len(points), bone), 1e-3 * (bone - air))
    assert np.sign(found) == sign


def test_a_bent_scale_brightens_the_middle_and_neither_air_nor_bone():
    share = np.array([0.0, 0.5, 1.0], dtype=np.float32)
    height = 0.08
    found = bend_of_scale(share, -height / (3.0 * np.sqrt(np.pi)))
    assert found == pytest.approx([0.0, height, 0.0], abs=1e-7)
