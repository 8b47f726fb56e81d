"""The error budget against closed forms of one degree of freedom."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.fitting.budget import without_rounding
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.kd_fit import KDFit
from legacy.fitting.options import KDOptions
from legacy.fitting.uncertainty.covariance import NOISE
from legacy.stapeskit.records.mass_record import MassMatrix
from sample_volumes.shaken_stapes import driven_base, simulated_motion
from tests.fitting.cases import six_dof_parameters

MASS, STIFFNESS, DAMPING, DENSITY_SD = float(six_dof_parameters()[0]), 1500.0, 0.02, 0.03
FREQ = np.linspace(400.0, 6000.0, 60)


@pytest.fixture(scope="module")
def piston() -> KDFit:
    """A mass on one spring and dashpot whose density is known to 3 %."""
    matrices = [np.array([[value]]) for value in (MASS, STIFFNESS, DAMPING)]
    motion = simulated_motion(*matrices, ("y",), FREQ, driven_base(FREQ, ("y",)), 0.02, None)
    parameters = six_dof_parameters()
    density = DENSITY_SD**2 * np.outer(parameters, parameters)
    mass = MassMatrix("footplate_centre", "footplate", parameters, {"density": density})
    return fit_kd(motion, mass, KDOptions(dof=("y",), bands=0))


def test_sources_add_up_to_the_covariance_and_shares_to_one(piston: KDFit) -> None:
    budget = piston.budget
    assert sum(budget.sources.values()) == pytest.approx(budget.covariance)
    for name in budget.names:
        assert sum(share[name] for share in budget.shares().values()) == pytest.approx(1.0)


def test_density_scales_k_and_d(piston: KDFit) -> None:
    brought = piston.budget.deviations()["mass.density"]
    assert brought["K11"] == pytest.approx(DENSITY_SD * STIFFNESS, rel=1e-3)
    assert brought["D11"] == pytest.approx(DENSITY_SD * DAMPING, rel=1e-3)


def test_modes_follow_by_the_delta_method_and_do_not_see_the_density(piston: KDFit) -> None:
    """f = sqrt(K / M) / 2 pi and the ratio D / 2 sqrt(K M): a density cancels in both."""
    noise = piston.budget.sources[NOISE]
    frequency = np.sqrt(STIFFNESS / MASS) / (2.0 * np.pi)
    by_stiffness = 0.5 * frequency / STIFFNESS
    assert piston.derived.undamped_frequency_sd_hz[0] == pytest.approx(
        by_stiffness * np.sqrt(noise[0, 0]), rel=1e-3
    )
    ratio = DAMPING / (2.0 * np.sqrt(STIFFNESS * MASS))
    slopes = np.array([-0.5 * ratio / STIFFNESS, ratio / DAMPING])
    assert piston.derived.damping_ratio_sd[0] == pytest.approx(np.sqrt(slopes @ noise @ slopes), rel=1e-3)
    assert piston.derived.principal is None


def test_a_variance_that_rounding_made_negative_is_zero_and_no_other() -> None:
    stiffness, damping = np.diag([1500.0, 1e-3]), np.diag([0.02, 1e-8])
    variance = np.array([4.0, 1e-24, -1e-26, 1e-6, -1e-8, 1e-20])
    covariance = np.diag(variance) + 1e-30
    held = without_rounding(covariance, stiffness, damping)
    assert np.diag(held) == pytest.approx([4.0, 1e-24, 0.0, 1e-6, -1e-8, 1e-20])
    assert not np.any(held[2])
