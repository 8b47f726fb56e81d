"""Unknowns of damping laws come out alike from every estimator."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.fitting.examples.paper import PAPER_DAMPING_CORRECTED, PAPER_DOF, PAPER_MASS, PAPER_STIFFNESS
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.model.damping import DampingLaw
from legacy.fitting.model.laws import law_of
from legacy.fitting.options import KDOptions
from sample_volumes.shaken_stapes import driven_base, simulated_motion


@pytest.mark.parametrize("estimator", ["ml", "irls", "pinv"])
def test_the_prior_of_a_second_time_does_not_outweigh_the_data(estimator):
    freq, found = np.linspace(200.0, 8000.0, 200), []
    for ratio in (3.0, 40.0):
        law = DampingLaw("two_relaxations", 1e-4, ratio)
        motion = simulated_motion(
            PAPER_MASS, PAPER_STIFFNESS, PAPER_DAMPING_CORRECTED, PAPER_DOF, freq,
            driven_base(freq, PAPER_DOF), 0.003, np.random.default_rng(1), law,
        )  # fmt: skip
        chosen = KDOptions(dof=PAPER_DOF, estimator=estimator, damping=law.name, fluid="none", bands=0)
        found.append(fit_kd(motion, PAPER_MASS, chosen).law.ratio)
    usual = np.array(law_of("two_relaxations").ratios)
    assert np.min(np.abs(np.log(np.array(found)[:, None] / usual))) > 0.01
