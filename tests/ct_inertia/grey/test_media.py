"""What is soft around a body, and other bone beside it, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from legacy.ct_inertia.grey.air_level import Air
from legacy.ct_inertia.grey.neighbours import away_from_others, neighbour_share, separate_from_neighbours
from legacy.ct_inertia.grey.soft_tissue import soft_tissue_covariance, subtract_soft_tissue, taken_off
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.volume.distance import capped_distance
from tests.ct_inertia.balls import AIR, BONE, ball, cut_of, places, plate, volume_of
from tests.oracles import ellipsoid_moments

SPACING, SIGMA = 0.03, 0.036
SPACINGS = np.full(3, SPACING)
REACH = 0.15
NO_NOISE = Air(AIR, 10.0, 1.0, 1.0, 0.0)


@pytest.fixture(scope="module")
def bare():
    x, y, z = places((44, 44, 44), SPACING)
    return ball(np.sqrt(x * x + y * y + z * z), 0.4, SIGMA)


def in_medium(share, level):
    return level + (1.0 - level) * share


@pytest.mark.parametrize("level", [0.05, 0.1, 0.2])
def test_a_medium_is_taken_off_to_within_its_stated_sd(bare, level):
    share = in_medium(bare, level)
    cut = cut_of(share, share > 0.5 * (1.0 + level))
    distance = capped_distance(cut.stapes, SPACINGS, 3.0 * REACH)
    soft = taken_off(cut, (distance, None), REACH, SPACINGS, (NO_NOISE, BONE), SIGMA)
    own = distance <= REACH
    truth = ellipsoid_moments(np.full(3, 0.4))
    middle = np.full(3, 0.5 * 43 * SPACING)
    moments = Moments(truth.volume, middle, truth.second)
    covariance = soft_tissue_covariance(soft, own, cut, volume_of(share, SPACING), moments)
    left = (soft.grey - AIR) / (BONE - AIR)
    off = float((left - bare)[own].sum()) * SPACING**3
    added = float((share - bare)[own].sum()) * SPACING**3
    sd = float(np.sqrt(covariance[0, 0]))
    assert soft.level == pytest.approx(level, rel=0.15)
    assert abs(off) < 2.0 * sd
    assert sd < 0.2 * added


def test_a_bare_body_has_nothing_soft_around_it(bare):
    cut = cut_of(bare, bare > 0.5)
    distance = capped_distance(cut.stapes, SPACINGS, 3.0 * REACH)
    assert subtract_soft_tissue(cut, (distance, None), REACH, SPACINGS, (NO_NOISE, BONE, None), SIGMA) is None


def two_plates(gap_mm, other=1.0, thickness_mm=0.4):
    """A plate at each side of x = 0 in a box that is wide along x."""
    x, _, _ = places((64, 24, 24), SPACING)
    shift = 0.5 * (gap_mm + thickness_mm)
    mine = plate(x + shift, thickness_mm, SIGMA)
    theirs = other * plate(x - shift, thickness_mm, SIGMA)
    stapes, others = (mine > 0.5) & (x < 0.0), (theirs > 0.5 * other) & (x > 0.0)
    return x, mine, theirs, cut_of(mine + theirs, stapes, others)


def parted(cut):
    distance = capped_distance(cut.stapes, SPACINGS, 3.0 * REACH)
    away = away_from_others(cut, distance, REACH, SPACINGS, SIGMA)
    return separate_from_neighbours(cut, (distance, away), REACH, SPACINGS, (AIR, BONE), SIGMA)


def test_far_bone_exchanges_nothing():
    _, _, _, cut = two_plates(0.6)
    result = parted(cut)
    assert result.foreign is None
    assert result.behind is None


@pytest.mark.parametrize("gap_mm", [0.07, 0.085])
def test_the_border_of_two_like_plates_is_the_middle_of_their_gap(gap_mm):
    x, mine, _, cut = two_plates(gap_mm)
    result = parted(cut)
    inner = np.zeros(x.shape, dtype=bool)
    inner[6:-6, 6:-6, :] = True
    assert not np.any(result.own & inner & (x > SPACING))
    assert not np.any(~result.own & inner & cut.stapes)
    held = (cut.grey - AIR) / (BONE - AIR) - result.foreign
    total = held[result.own & inner].sum() + result.behind[inner].sum()
    assert total == pytest.approx(mine[inner].sum(), rel=3e-3)


def test_what_blur_carries_over_the_border_is_the_tail_of_a_plane():
    x, _, theirs, cut = two_plates(0.08)
    result = parted(cut)
    line = (slice(12, 13), slice(12, 13), slice(None))
    mine = result.own[line].ravel()
    expected = theirs[line].ravel()[mine]
    assert np.allclose(result.foreign[line].ravel()[mine], expected, atol=0.02)
    edge = ndtr(-(0.04 - x[line].ravel()[mine]) / SIGMA)
    assert np.allclose(expected, edge, atol=1e-6)


@pytest.mark.parametrize(("other", "shown"), [(0.8, 0.8), (0.98, 1.0), (1.5, 1.5)])
def test_the_contrast_of_other_bone_is_that_of_its_inside(other, shown):
    _, _, _, cut = two_plates(0.2, other)
    assert neighbour_share(cut, (AIR, BONE)) == pytest.approx(shown, abs=2e-3)
