"""A grey scale that is not linear: what it adds to shares of bone, with and without noise."""

import numpy as np
import pytest
from scipy.special import ndtr

from legacy.ct_inertia.grey.grey_scale import bend_of_scale


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.15])
def test_noise_leaves_the_effect_of_a_bend_as_it_is(noise):
    """Noise lowers the mean of w (1 - w) by its variance, in air and inside bone as well."""
    height, u = 0.05, np.linspace(-12.0, 12.0, 40_000)
    share = ndtr(u) - ndtr(u - 6.0)  # a wall of six widths
    seen = share + noise * np.random.default_rng(1).standard_normal(u.size)
    bend = bend_of_scale(seen.astype(np.float32), -height / (3.0 * np.sqrt(np.pi)), noise)
    added = 4.0 * height * share * (1.0 - share)
    assert float(np.mean(bend)) == pytest.approx(float(np.mean(added)), rel=0.1)
