"""The model: responses, eigenvalues, stability, passivity."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from legacy.fitting.errors import FittingError
from legacy.fitting.model.damping import VISCOUS, DampingLaw
from legacy.fitting.model.model import dynamic_stiffness, modes, passive, simulate, state_matrix
from tests.fitting.cases import FREQ, D, K, M, damping_for


def test_one_degree_of_freedom_has_the_closed_form_eigenvalue() -> None:
    m, k, d = 3.2e-6, 1722.0, 0.0229
    found = modes([[m]], [[k]], [[d]])
    omega, zeta = np.sqrt(k / m), d / (2.0 * np.sqrt(k * m))
    (mode,) = found.pairs
    assert mode.undamped_frequency_hz == pytest.approx(omega / (2.0 * np.pi), rel=1e-12)
    assert mode.damping_ratio == pytest.approx(zeta, rel=1e-12)
    assert mode.frequency_hz == pytest.approx(omega * np.sqrt(1.0 - zeta**2) / (2.0 * np.pi), rel=1e-12)
    assert found.max_real_1_s == pytest.approx(-d / (2.0 * m), rel=1e-12)


def test_overdamped_motion_gives_two_real_roots() -> None:
    m, k, d = 2.0, 3.0, 11.0
    found = modes([[m]], [[k]], [[d]])
    assert found.pairs == ()
    assert found.overdamped_roots_1_s == pytest.approx(sorted(np.roots([m, d, k]).real))


def test_response_is_one_at_low_frequency_and_mass_controlled_at_high() -> None:
    low = simulate(M, K, D, [1e-3] * 3, np.eye(3)).T
    scale = np.sqrt(np.diag(M))
    assert np.allclose(low * scale[:, None] / scale, np.eye(3), atol=1e-9)
    omega = 2.0 * np.pi * 1e9
    high = simulate(M, K, D, [1e9] * 3, np.eye(3)).T
    expected = -np.linalg.solve(M, K + 1j * omega * D) / omega**2
    assert np.allclose(high, expected, rtol=1e-4, atol=0.0)


def test_response_satisfies_the_equation_of_motion() -> None:
    rng = np.random.default_rng(1)
    base = rng.standard_normal((len(FREQ), 3)) + 1j * rng.standard_normal((len(FREQ), 3))
    motion = simulate(M, K, D, FREQ, base)
    omega = 2.0 * np.pi * FREQ[:, None]
    inertia = omega**2 * (motion @ M)
    force = (motion - base) @ K + 1j * omega * ((motion - base) @ D)
    assert np.allclose(inertia, force, atol=1e-9 * np.abs(force).max(axis=0))


def test_eigenvalues_are_the_poles_of_the_response() -> None:
    for mode in modes(M, K, D).pairs:
        value = mode.eigenvalue
        dynamic = value**2 * M + value * D + K
        scale = np.sqrt(np.outer(np.diag(K), np.diag(K)))
        assert abs(np.linalg.det(dynamic / scale)) < 1e-9
        assert np.allclose(dynamic @ mode.shape / np.sqrt(np.diag(K)), 0.0, atol=1e-12)


def test_shapes_have_unit_state_norm() -> None:
    for mode in modes(M, K, D).pairs:
        state = np.concatenate([mode.shape, mode.eigenvalue * mode.shape])
        assert np.linalg.norm(state) == pytest.approx(1.0, rel=1e-12)


def test_state_matrix_has_the_eigenvalues_of_the_modes() -> None:
    values = np.linalg.eigvals(state_matrix(M, K, D))
    expected = sorted(value.imag for value in values if value.imag > 0.0)
    assert [2.0 * np.pi * mode.frequency_hz for mode in modes(M, K, D).pairs] == pytest.approx(expected)


def test_fractional_law_with_exponent_one_is_viscous() -> None:
    nearly = modes(M, K, D, DampingLaw("fractional", 1.0)).pairs
    for one, other in zip(nearly, modes(M, K, D).pairs, strict=True):
        assert one.eigenvalue == pytest.approx(other.eigenvalue, rel=1e-9)
        assert np.allclose(one.shape, other.shape, rtol=1e-6)


@pytest.mark.parametrize("law", [DampingLaw("hysteretic"), DampingLaw("fractional", 0.4)])
def test_nonviscous_eigenvalues_solve_their_own_equation(law: DampingLaw) -> None:
    damping = damping_for(law)
    found = modes(M, K, damping, law)
    assert len(found.pairs) == 3
    assert found.stable
    scale = np.sqrt(np.outer(np.diag(K), np.diag(K)))
    for mode in found.pairs:
        dynamic = mode.eigenvalue**2 * M + law.at(mode.eigenvalue) * damping + K
        assert abs(np.linalg.det(dynamic / scale)) < 1e-9


def test_dynamic_stiffness_of_each_law() -> None:
    omega = np.array([1e4])
    assert np.allclose(dynamic_stiffness(K, D, omega)[0], K + 1e4j * D)
    assert np.allclose(dynamic_stiffness(K, D, omega, DampingLaw("hysteretic"))[0], K + 1j * D)
    half = dynamic_stiffness(K, D, omega, DampingLaw("fractional", 0.5))[0]
    assert np.allclose(half, K + 100.0 * (1.0 + 1.0j) / np.sqrt(2.0) * D)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_positive_matrices_are_always_stable(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    mass, stiffness, damping = (
        (lambda a: a @ a.T + 1e-3 * np.eye(n))(rng.standard_normal((n, n))) for _ in range(3)
    )
    found = modes(mass, stiffness, damping)
    assert found.stable
    assert 2 * len(found.pairs) + len(found.overdamped_roots_1_s) == 2 * n


def test_modes_do_not_depend_on_the_unit_of_length() -> None:
    to_mm = np.diag([1.0, 1e3, 1e3])
    for one, other in zip(
        modes(M, K, D).pairs,
        modes(to_mm @ M @ to_mm, to_mm @ K @ to_mm, to_mm @ D @ to_mm).pairs,
        strict=True,
    ):
        assert one.eigenvalue == pytest.approx(other.eigenvalue, rel=1e-12)


def test_passivity_does_not_depend_on_units_and_sees_a_single_bad_coupling() -> None:
    for unit in (1.0, 1e3, 1e-6):
        change = np.diag([1.0, unit, unit])
        assert passive(change @ D @ change)
    bad = D.copy()
    bad[0, 1] = bad[1, 0] = 1.01 * np.sqrt(D[0, 0] * D[1, 1])
    assert not passive(bad)
    assert passive(np.zeros((2, 2)))
    assert not passive(np.array([[0.0, 1.0], [1.0, 0.0]]))
    assert not passive(np.array([[np.nan, 0.0], [0.0, 1.0]]))


def test_laws_refuse_what_they_cannot_be() -> None:
    for name, exponent, thing, got in (
        ("coulomb", 1.0, "the damping law", "coulomb"),
        ("fractional", 2.5, "the damping exponent", "2.5"),
    ):
        with pytest.raises(FittingError) as refused:
            DampingLaw(name, exponent)
        assert (refused.value.faults[0].thing, refused.value.faults[0].got) == (thing, got)


def test_units_of_damping() -> None:
    assert VISCOUS.unit("N/m") == "N s/m"
    assert VISCOUS.unit("N m") == "N m s"
    assert DampingLaw("hysteretic").unit("N") == "N"
    assert DampingLaw("fractional", 0.5).unit("N/m") == "N s^0.5/m"
    assert DampingLaw("relaxation", 2e-5).unit("N/m") == "N s/m"
    assert DampingLaw("two_relaxations", 2e-5).unit("N m") == "N m s"


def test_a_passive_model_is_never_called_unstable() -> None:
    """K and D of lower rank put eigenvalues onto the imaginary axis, where rounding decides their sign."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        n = int(rng.integers(1, 7))
        units = np.diag(10.0 ** rng.uniform(-4.0, 1.0, n))
        root = rng.standard_normal((n, n))
        mass = units @ (root @ root.T + np.eye(n)) @ units
        parts = [rng.standard_normal((n, int(rng.integers(1, n + 1)))) for _ in range(2)]
        stiffness, damping = (units @ part @ part.T @ units for part in parts)
        found = modes(mass, 1e6 * stiffness, damping)
        if passive(stiffness) and passive(damping):
            assert found.stable
            assert found.max_real_1_s <= 0.0
            assert all(root <= 0.0 for root in found.overdamped_roots_1_s)


def test_slow_growth_is_still_called_unstable() -> None:
    assert not modes([[1.0]], [[1.0]], [[-1e-8]]).stable
    assert not modes(np.eye(2), np.diag([1.0, -1e-9]), np.eye(2)).stable
