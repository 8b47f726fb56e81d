"""What data can tell: identities of the bounds, and words for the combinations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.model.parameter_vector import join
from legacy.fitting.options import KDOptions
from legacy.fitting.uncertainty.identifiability import Identifiability, identifiability, relative_sizes
from legacy.stapeskit.records.motion import RigidMotion
from tests.fitting.cases import D, K, M, paper_motion


def known(motion: RigidMotion, mass: np.ndarray = M) -> Identifiability:
    return fit_kd(motion, mass, KDOptions(bands=0)).identifiability


def test_the_same_lines_twice_halve_every_variance() -> None:
    motion = paper_motion(0.05, None)
    twice = RigidMotion(
        ("1", "2"),
        motion.bodies,
        motion.dof,
        motion.freq_hz,
        *(np.concatenate([part, part]) for part in (motion.q, motion.covariance, motion.chi2, motion.n_dof)),
    )
    once, both = known(motion), known(twice)
    assert both.bound_si == pytest.approx(once.bound_si / np.sqrt(2.0))
    assert both.eigenvalues == pytest.approx(2.0 * once.eigenvalues)
    assert both.condition == pytest.approx(once.condition)
    assert both.worst == pytest.approx(once.worst / np.sqrt(2.0))


def test_bounds_are_the_spread_of_estimates_and_the_worst_combination_is_the_longest_axis() -> None:
    fit = fit_kd(paper_motion(0.02, None), M, KDOptions(bands=0))
    found = fit.identifiability
    assert found.bound_si == pytest.approx(np.sqrt(np.diag(fit.noise_covariance)), rel=0.02)
    sizes = relative_sizes(join(K, D), 3)
    scaled = fit.noise_covariance / np.outer(sizes, sizes)
    assert found.worst == pytest.approx(np.sqrt(np.linalg.eigvalsh(scaled)[-1]), rel=0.05)
    assert found.relative == pytest.approx(found.bound_si / sizes, rel=1e-3)


def test_relative_numbers_do_not_depend_on_the_unit_of_length() -> None:
    motion = paper_motion(0.05, None)
    unit = np.array([1e3, 1.0, 1.0])
    scaled = replace(motion, q=motion.q * unit, covariance=motion.covariance * np.outer(unit, unit))
    here, there = known(motion), known(scaled, M / np.outer(unit, unit))
    assert there.relative == pytest.approx(here.relative, rel=1e-6)
    assert there.combinations[0][0] == pytest.approx(here.combinations[0][0], rel=1e-6)


def test_words_name_entries_by_weight_and_a_warning_those_that_are_weak() -> None:
    fit = fit_kd(paper_motion(0.3, 1, 30), M, KDOptions(bands=0))
    found = fit.identifiability
    (notice,) = found.notices()
    assert notice.code == "weak_identifiability"
    weak = [name for name, value in zip(found.names, found.relative, strict=True) if value > 0.1]
    assert weak[0] in notice.text
    lead, weight = found.combinations[0][1][0]
    assert found.describe(0).startswith(f"{weight:.2f} {lead}")
    assert known(paper_motion(0.01, 1)).notices() == []


def test_a_deflection_that_does_not_move_makes_the_equations_singular() -> None:
    lines = fit_kd(paper_motion(0.05, None), M, KDOptions(bands=0)).lines
    still = replace(lines, dq=lines.dq * np.array([1.0, 1.0, 0.0])[:, None])
    assert identifiability(join(np.eye(3), np.eye(3)), still, np.ones(12)).condition == np.inf
