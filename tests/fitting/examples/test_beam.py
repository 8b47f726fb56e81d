"""The beam experiment: Eqs. 6, 7, 9, Table 1, and a finer beam model as its judge."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.fitting.examples.beam import (
    Beam,
    deviations_percent,
    difference,
    element_mass,
    element_stiffness,
    transport_to_tip,
)
from legacy.fitting.examples.paper import TABLE_1_THEORY


def clamped_chain(beam: Beam, elements: int) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness and mass (SI) of a beam of many elements, base nodes first."""
    size = 2 * (elements + 1)
    stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
    length = beam.length_mm * 1e-3 / elements
    bending = beam.young_n_mm2 * beam.second_moment_mm4 * 1e-6
    for place in range(elements):
        block = slice(2 * place, 2 * place + 4)
        stiffness[block, block] += bending * element_stiffness(length)
        mass[block, block] += beam.mass_kg / elements * element_mass(length)
    return stiffness, mass


def test_table_1_theory() -> None:
    beam = Beam()
    assert beam.second_moment_mm4 == pytest.approx(0.4428675, rel=1e-9)
    assert beam.coefficients == pytest.approx(TABLE_1_THEORY, rel=1e-5)


def test_eq_6_is_the_static_stiffness_of_many_elements() -> None:
    beam = Beam()
    stiffness, _ = clamped_chain(beam, 8)
    inner, tip = np.arange(2, 16), np.arange(16, 18)
    condensed = stiffness[np.ix_(tip, tip)] - stiffness[np.ix_(tip, inner)] @ np.linalg.solve(
        stiffness[np.ix_(inner, inner)], stiffness[np.ix_(inner, tip)]
    )
    assert np.allclose(condensed, beam.stiffness_si(), rtol=1e-9)


def test_rigid_motion_of_base_and_tip_makes_no_difference() -> None:
    base = np.array([0.3, 0.02])
    tip = transport_to_tip(48.0) @ base
    assert np.allclose(difference(tip, base, 48.0), 0.0, atol=1e-15)
    assert difference([1.0, 0.2], [0.4, 0.1], 48.0) == pytest.approx([1.0 - 0.4 + 48.0 * 0.1, 0.1])


def test_transport_agrees_with_the_beam_stiffness() -> None:
    beam = Beam()
    stiffness, _ = clamped_chain(beam, 1)
    q = np.array([0.1, 0.02, -0.05, 0.04])
    moved = difference(q[2:], q[:2], beam.length_mm * 1e-3)
    assert np.allclose(stiffness[2:] @ q, beam.stiffness_si() @ moved)


def test_condensed_mass_keeps_the_rigid_body_momentum() -> None:
    beam = Beam()
    tip_mass, coupling = beam.condensed_mass_si()
    length = beam.length_mm * 1e-3
    rigid = tip_mass + coupling
    whole = element_mass(length) * beam.mass_kg
    motion = np.vstack([np.linalg.inv(transport_to_tip(length)), np.eye(2)])
    assert np.allclose(rigid, (whole @ motion)[2:], rtol=1e-12)
    total = motion.T @ whole @ motion
    assert total[0, 0] == pytest.approx(beam.mass_kg, rel=1e-12)
    assert total[1, 1] == pytest.approx(beam.mass_kg * length**2 / 3.0, rel=1e-12)


def test_free_beam_mass() -> None:
    assert Beam().mass_kg * 1e3 == pytest.approx(3.05, abs=0.005)


def test_deviations_are_eq_9() -> None:
    theory = np.array(TABLE_1_THEORY)
    printed = np.array([3.17, 1.28, 0.38])
    assert deviations_percent(theory * (1.0 - printed / 100.0), theory) == pytest.approx(printed)
