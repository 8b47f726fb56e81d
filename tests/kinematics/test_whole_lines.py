"""Lines without gaps go the short way beside those with gaps, and give what the long way gives."""

from __future__ import annotations

import numpy as np
import pytest

from kinematics.faults.packed import fill
from kinematics.faults.packed.compact import compact
from kinematics.faults.packed.fill import Gaps
from kinematics.faults.packed.whole_lines import measured
from kinematics.fit.beams import beam_set
from kinematics.fit.rigid_fit import fit_lines
from stapeskit.spatial import DOF_NAMES
from tests.kinematics.simulated import body, scene


def gappy_fit(share, sd_by_channel=True):
    made = scene(31, "gain")
    rng = np.random.default_rng(31)
    made.value[rng.uniform(size=made.value.shape) < share] = np.nan
    made.value[7] = np.nan
    size = rng.uniform(0.5, 2.0, (len(made.points), 1)) if sd_by_channel else 1.0
    sd = np.broadcast_to(np.asarray(made.sd) * size, made.value.shape)
    return made, fit_lines(beam_set("stapes", made.positions_mm, made.directions, DOF_NAMES), made.value, sd)


def packed_again(made, fit):
    data = compact(fit, body("stapes", made), made.freq_hz)
    factor = np.full(len(data.part), 0.95 + 0.02j)
    return [data, data.without([3]).repacked(), data.scaled([4], factor).repacked()]


@pytest.mark.parametrize("share", [0.002, 0.02])
def test_both_ways_pack_the_same(share, monkeypatch):
    monkeypatch.setattr(fill, "_SHORT", 0)
    made, fit = gappy_fit(share)
    short = packed_again(made, fit)
    monkeypatch.setattr(Gaps, "_whole", property(lambda gaps: np.zeros(gaps.held.shape[1], dtype=bool)))
    for one, two in zip(short, packed_again(made, fit), strict=True):
        for name in ("y", "a", "rest", "lift", "tau", "freq_hz"):
            expected = getattr(two, name)
            largest = float(np.max(np.abs(expected)))
            np.testing.assert_allclose(getattr(one, name), expected, atol=1e-10 * largest, err_msg=name)


def test_noise_of_the_values_that_are_there():
    made, fit = gappy_fit(0.05)
    share, line = fit.noise.common()
    held, own, ratio = measured(made.value, fit.solution, (share, line))
    there = np.isfinite(made.value)
    np.testing.assert_array_equal(held, there)
    variance = np.where(there, fit.noise.at(slice(None)) ** 2, 0.0)
    live = there.any(axis=1)
    mean = variance[live].sum(axis=1) / there[live].sum(axis=1)
    np.testing.assert_allclose(own[live], mean, rtol=1e-12)
    assert np.all(np.isinf(own[~live]))
    relative = (variance[live] / mean[:, None]).sum(axis=0)
    np.testing.assert_allclose(ratio, np.sqrt(there.sum(axis=0) / relative), rtol=1e-12)
