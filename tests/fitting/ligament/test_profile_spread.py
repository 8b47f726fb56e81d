"""Where the data are weak, K reaches as far as its profile of chi2, and not as far as its curvature says."""

from __future__ import annotations

import numpy as np

from benchmarks.ring_ears import PISTON, EarSettings, ear
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.ligament.profile_spread import profile_spread
from legacy.fitting.options import KDOptions


def test_nothing_is_added_where_the_data_determine_k() -> None:
    case = ear(EarSettings(0.1, 0.01, lines=40, shared=False), np.random.default_rng(2))
    fit = fit_kd(case.motion, case.mass, KDOptions(bands=0))
    assert profile_spread(fit.ligament).shape == (24, 0)


def test_intervals_hold_in_a_band_wholly_below_the_poles() -> None:
    """Without the profile K of ears like these was up to 9 of its standard deviations off."""
    off, added = [], 0
    for seed in range(4):
        settings = EarSettings(0.1, 0.03, lines=40, shared=False, band_hz=(300.0, 700.0))
        case = ear(settings, np.random.default_rng([31, seed]))
        fit = fit_kd(case.motion, case.mass, KDOptions(bands=0))
        added += profile_spread(fit.ligament).shape[1]
        true = np.diag(case.stiffness)[list(PISTON)]
        off.append((np.diag(fit.stiffness) - true) / np.sqrt(np.diag(fit.covariance)[[0, 3, 5]]))
    assert added > 0
    assert np.mean(np.abs(off) < 1.96) >= 0.9
    assert np.abs(off).max() < 3.5
