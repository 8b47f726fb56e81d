"""The model against closed forms and the paper's printed numbers: responses, modes, axes, laws."""

import numpy as np
import pytest

from fitting.laws import LAWS, DampingLaw
from fitting.model import modes, moved_eigenvalues, principal_axes, simulate
from tests.fit.fit_cases import D, K, M


def test_axes_follow_a_shift_and_a_turn():
    diagonal, shift, turn = np.diag([1500.0, 1e-3, 3e-3]), np.array([0.2e-3, -0.1e-3]), 0.1
    rotation = np.array([[1, 0, 0], [0, np.cos(turn), -np.sin(turn)], [0, np.sin(turn), np.cos(turn)]])
    # alpha and gamma turn about y as (x, z) do: axis at the angle t is (cos t, -sin t)
    move = np.array([[1.0, -shift[1], shift[0]], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    k = move.T @ rotation.T @ diagonal @ rotation @ move
    found = principal_axes(k)
    assert found[:2] == pytest.approx(shift)
    assert abs(found[2]) == pytest.approx(turn)
    assert found[3:] == pytest.approx(np.diag(diagonal))


def test_one_degree_of_freedom_is_the_oscillator():
    mass, stiffness, damping = 3e-6, 1500.0, 0.02
    found = modes([[mass]], [[stiffness]], [[damping]]).pairs[0]
    ratio = damping / (2.0 * np.sqrt(stiffness * mass))
    assert found.undamped_frequency_hz == pytest.approx(np.sqrt(stiffness / mass) / (2.0 * np.pi))
    assert found.damping_ratio == pytest.approx(ratio)
    freq = np.array([100.0, 3000.0])
    omega = 2.0 * np.pi * freq
    closed = (stiffness + 1j * omega * damping) / (stiffness + 1j * omega * damping - omega**2 * mass)
    moved = simulate([[mass]], [[stiffness]], [[damping]], freq, np.ones((2, 1)))
    assert moved[:, 0] == pytest.approx(closed)


def test_hysteretic_eigenvalue_in_closed_form():
    mass, stiffness, loss = 3e-6, 1500.0, 0.3
    found = modes([[mass]], [[stiffness]], [[loss * stiffness]], DampingLaw("hysteretic")).pairs[0]
    assert found.eigenvalue**2 == pytest.approx(-(stiffness / mass) * (1.0 + 1j * loss), rel=1e-9)


def test_fractional_and_relaxation_with_their_viscous_limit():
    viscous = modes(M, K, D)
    for law in (DampingLaw("fractional", 1.0), DampingLaw("relaxation", 1e-12)):
        found = modes(M, K, D, law)
        assert [mode.eigenvalue for mode in found.pairs] == pytest.approx(
            [mode.eigenvalue for mode in viscous.pairs], rel=1e-6
        )


@pytest.mark.parametrize("name", list(LAWS))
def test_eigenvalues_solve_their_equation_under_every_law(name):
    law = DampingLaw(name, {"fractional": 0.6, "relaxation": 3e-5}.get(name, 0.0))
    damping = D * (2.0 * np.pi * 2700.0) ** (1.0 - law.time_power)
    for mode in modes(M, K, damping, law).pairs:
        value = mode.eigenvalue
        factor = law.factor(np.array([-1j * value]))[0]
        pencil = value**2 * M + factor * damping + K
        root = np.sqrt(np.diag(M))
        scaled = pencil / np.outer(root, root) / abs(value) ** 2
        assert np.linalg.svd(scaled, compute_uv=False)[-1] < 1e-9


def test_eigenvalues_near_by_are_those_of_each_model():
    rng = np.random.default_rng(0)
    factors = 1.0 + 0.05 * rng.standard_normal(20)
    stack = np.tile(M, (20, 1, 1))
    for law in (DampingLaw(), DampingLaw("hysteretic")):
        damping = D * (2.0 * np.pi * 2700.0) ** (1.0 - law.time_power)
        middle = modes(M, K, damping, law)
        values, _ = moved_eigenvalues(
            middle, stack, factors[:, None, None] * K, np.tile(damping, (20, 1, 1)), law
        )
        for number in (0, 7):
            own = modes(M, factors[number] * K, damping, law)
            assert values[number] == pytest.approx([mode.eigenvalue for mode in own.pairs], rel=1e-8)
