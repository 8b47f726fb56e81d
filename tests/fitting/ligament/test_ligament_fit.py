"""Height and tilt of the ligament's plane from the coupling, and how K about the centre answers to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.ring_ears import EarSettings, ear
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.ligament.ligament_fit import LigamentFit, coupling_units
from legacy.fitting.ligament.plane_transfer import slopes_of_transfer
from legacy.fitting.model.parameter_vector import join
from legacy.fitting.options import KDOptions


@pytest.fixture(scope="module")
def ligament() -> LigamentFit:
    case = ear(EarSettings(0.1, 0.01, lines=60, shared=False), np.random.default_rng(2))
    found = fit_kd(case.motion, case.mass, KDOptions(bands=0)).ligament
    assert found is not None
    return found


def test_the_height_is_the_mean_of_both_weighted_by_their_variances(ligament: LigamentFit) -> None:
    coupling, covariance = np.zeros((3, 3)), np.eye(9)
    coupling[1, 1], coupling[2, 0] = 1e-4, -4e-4
    covariance[4, 4], covariance[6, 6] = 1e-10, 4e-10
    made = replace(ligament, coupling=coupling, coupling_covariance=covariance)
    assert made.heights_m == (1e-4, 4e-4)
    assert made.heights_sd_m == pytest.approx((1e-5, 2e-5))
    value, sd = made.height
    assert value == pytest.approx((1e-4 / 1.0 + 4e-4 / 4.0) / (1.0 + 0.25))
    assert sd == pytest.approx(1e-5 / np.sqrt(1.25))
    # Heights Y11 and -Y20 whose errors go against each other: their mean is known better than either.
    covariance[[4, 6], [4, 6]], covariance[[4, 6], [6, 4]] = 4e-10, 1e-10
    assert made.height == pytest.approx((2.5e-4, np.sqrt(0.25 * (4.0 + 4.0 - 2.0) * 1e-10)))


def test_a_small_turn_gives_the_coupling_from_which_the_tilt_is_read(ligament: LigamentFit) -> None:
    """Turn diag(K_xx, K_yy, K_zz) about z and about x: Y = K_r K_c^-1 to first order."""
    axial = np.diag([3000.0, 1000.0, 5000.0])
    inplane = replace(ligament.inplane, stiffness=np.diag([3000.0, 5000.0, 1e-3]))
    piston = np.diag([1000.0, 1e-3, 1e-3])
    for about, place in (((1e-3, 0.0), 0), ((0.0, 1e-3), 1)):
        x, z = about
        turn = np.array([[1.0, -z, 0.0], [z, 1.0, -x], [0.0, x, 1.0]])
        turned = turn @ axial @ turn.T
        coupling = np.zeros((3, 3))
        coupling[0, 0], coupling[0, 1] = turned[1, 0] / 3000.0, turned[1, 2] / 5000.0
        spread = 1e-8 * np.eye(9)
        made = replace(
            ligament,
            inplane=inplane,
            plane_stiffness=piston,
            coupling=coupling,
            coupling_covariance=spread,
        )
        assert [sd for _, sd in made.tilt_rad] == pytest.approx([1e-4 / 0.8, 1e-4 / (2.0 / 3.0)])
        assert made.tilt_rad[place][0] == pytest.approx(1e-3, rel=1e-6)
        assert made.tilt_rad[1 - place][0] == pytest.approx(0.0, abs=1e-9)


def test_slopes_are_derivatives_of_what_the_plane_adds(ligament: LigamentFit) -> None:
    coupling, inplane = ligament.coupling, ligament.inplane

    def added(y: np.ndarray) -> np.ndarray:
        return join(*(y @ part @ y.T for part in (inplane.stiffness, inplane.damping)))

    by_coupling, by_inplane = slopes_of_transfer(coupling, np.zeros((9, 9)), inplane)
    step = 1e-3 * coupling
    change = (added(coupling + step) - added(coupling - step)) / 2.0
    assert by_coupling @ step.ravel() == pytest.approx(change, rel=1e-9)
    whole = join(inplane.stiffness, inplane.damping)
    assert by_inplane @ whole == pytest.approx(added(coupling))


def test_covariances_are_positive_and_chi2_has_a_probability(ligament: LigamentFit) -> None:
    assert np.linalg.eigvalsh(ligament.coupling_covariance)[0] > 0.0
    assert 0.0 < ligament.p_value < 1.0
    assert ligament.fluid is None
    assert not ligament.terms


def test_a_change_about_the_centre_holds_for_heights_that_change_by_as_much_as_they_are(
    ligament: LigamentFit,
) -> None:
    equations, inplane = ligament.equations, ligament.inplane
    change = np.zeros(equations.unknowns)
    change[:12] = 0.1 * np.arange(12)
    change[equations.coupling] = np.linspace(-1.0, 1.0, 9)
    there = ligament.coupling + change[equations.coupling].reshape(3, 3) * coupling_units(ligament.lines)
    wanted = [
        there @ part @ there.T - ligament.coupling @ part @ ligament.coupling.T
        for part in (inplane.stiffness, inplane.damping)
    ]
    found = ligament.change_about_centre(change) - ligament.to_plane @ change
    assert found == pytest.approx(join(*wanted), rel=1e-9)
