"""The simulated beam experiment against the checked facts about the paper's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from legacy.fitting.examples import beam_page
from legacy.fitting.examples.beam import Beam, transport_to_tip
from legacy.fitting.examples.beam_experiment import (
    Setup,
    coefficients,
    cube_mass,
    damping_time,
    deviations,
    first_frequencies,
    fit_beam,
    measured,
    tip_motion,
)
from legacy.fitting.examples.paper import TABLE_1_THEORY

MASSLESS = Setup(beam_has_mass=False)
FULL = Setup()


def test_cube_with_its_beam_piece() -> None:
    mass = cube_mass(Beam())
    assert 1e3 * mass[0, 0] == pytest.approx(8.49, abs=0.005)
    assert 1e9 * mass[1, 1] == pytest.approx(365.5, abs=0.05)
    assert cube_mass(Beam(), 1e-4)[0, 1] == pytest.approx(-1e-4 * mass[0, 0])


def test_mass_of_the_beam_lowers_both_frequencies() -> None:
    """About -3 to -4 % and -10 to -20 %."""
    change = first_frequencies(FULL) / first_frequencies(MASSLESS) - 1.0
    assert -0.04 < change[0] < -0.03
    assert -0.20 < change[1] < -0.10


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_100_um_change_the_frequencies_by_0_3_percent_and_330_um_by_1(sign: float) -> None:
    bare = first_frequencies(MASSLESS)
    change = first_frequencies(MASSLESS, sign * 1e-4) / bare - 1.0
    assert change == pytest.approx(sign * np.array([-0.003, 0.003]), abs=1e-4)
    change = first_frequencies(MASSLESS, sign * 330e-6) / bare - 1.0
    assert np.abs(change) == pytest.approx(0.01, abs=1e-3)


@pytest.mark.parametrize("estimator", ["ml", "irls", "pinv", "constrained"])
def test_every_estimator_returns_the_theory_where_its_model_holds(estimator: str) -> None:
    fit = fit_beam(measured(MASSLESS, None), Beam(), "massless", estimator)
    assert coefficients(fit.stiffness) == pytest.approx(TABLE_1_THEORY, rel=1e-4)


def test_neglected_beam_mass_shows_in_chi2_and_in_k() -> None:
    motion = measured(FULL, None)
    neglected = fit_beam(motion, Beam(), "massless")
    condensed = fit_beam(motion, Beam(), "condensed")
    theory = Beam().coefficients
    wrong = np.abs(coefficients(neglected.stiffness) / theory - 1.0)
    better = np.abs(coefficients(condensed.stiffness) / theory - 1.0)
    assert wrong[2] > 0.15
    assert better.max() < 0.025
    assert neglected.chi2 > 30.0 * condensed.chi2


def test_condensed_equations_are_wrong_only_in_fourth_order_of_frequency() -> None:
    setup = Setup(freq_hz=np.array([10.0, 20.0]))
    beam, omega = setup.beam, 2.0 * np.pi * setup.freq_hz
    base = np.tile(np.array([1e-6, 1e-5], dtype=complex), (2, 1))
    tip = tip_motion(setup, base)
    own, coupling = beam.condensed_mass_si()
    carried = base @ transport_to_tip(beam.length_mm * 1e-3).T
    force = omega[:, None] ** 2 * (tip @ (cube_mass(beam) + own).T + carried @ coupling.T)
    dynamic = (1.0 + 1j * omega * damping_time(setup))[:, None, None] * beam.stiffness_si()
    gap = np.abs(force - np.einsum("lij,lj->li", dynamic, tip - carried))
    assert np.all((gap[1] / gap[0] > 14.0) & (gap[1] / gap[0] < 20.0))


def test_misaligned_centre_of_mass() -> None:
    """100 um: the pseudo-inverse is off by 4 to 9 %, ml by less than 1 %."""
    crude = deviations(MASSLESS, "massless", "pinv", 5, 1e-4)
    assert np.all((crude.absolute_percent > 4.0) & (crude.absolute_percent < 9.0))
    good = deviations(MASSLESS, "massless", "ml", 5, 1e-4)
    assert good.absolute_percent.max() < 1.0


def test_page(tmp_path: Path, capsys) -> None:
    assert beam_page.main([str(tmp_path / "beam.html"), "2"]) == 0
    html = (tmp_path / "beam.html").read_text(encoding="utf-8")
    for words in ("What is simulated", "Deviation from Table 1", "100 µm", "Figs. 3 and 4", "does not print"):
        assert words in html
    assert beam_page.main([]) == 2
    assert "usage" in capsys.readouterr().err
