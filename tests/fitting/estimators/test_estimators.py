"""One contract for all estimators, and what each of them adds."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.fitting.errors import FittingError
from legacy.fitting.estimators import ESTIMATORS, estimator, ml, pinv
from legacy.fitting.estimators.base import EstimatorOptions
from legacy.fitting.estimators.semidefinite_roots import is_positive_definite, nearest_inside
from legacy.fitting.model.damping import VISCOUS, DampingLaw
from legacy.fitting.model.model import modes, passive
from legacy.fitting.model.observation import observe
from legacy.fitting.model.parameter_vector import join, split
from legacy.fitting.model.scaled_lines import (
    Lines,
    Scale,
    assemble,
    backward,
    cholesky,
    evaluate,
    forward,
    real_rows,
    regressor,
)
from legacy.stapeskit.records.motion import RigidMotion
from legacy.stapeskit.spatial import DOF_NAMES
from tests.fitting.cases import DOF, D, K, M, damping_for, paper_motion, six_dof_matrices, six_dof_motion

OPTIONS = EstimatorOptions()


def lines_of(motion: RigidMotion, mass: np.ndarray, dof: tuple[str, ...], law: DampingLaw = VISCOUS):
    """Scaled equations, and the units of their parameters."""
    observation = observe(motion, dof, with_load=False)
    scale = Scale.of(observation, mass)
    return assemble(observation, mass, scale, law), scale.parameter_units(law)


def weak_lines(seed: int) -> Lines:
    """Few lines below the resonances with as much noise as signal: the free optimum is often not passive."""
    motion = paper_motion(0.6, seed, 24)
    keep = motion.freq_hz < 3000.0
    return lines_of(motion, M, DOF)[0].select(keep)


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("law", [VISCOUS, DampingLaw("hysteretic"), DampingLaw("fractional", 0.6)])
def test_exact_data_give_exact_matrices(name: str, law: DampingLaw) -> None:
    lines, units = lines_of(paper_motion(seed=None, law=law), M, DOF, law)
    found = estimator(name).estimate(lines, OPTIONS)
    truth = join(K, damping_for(law)) / units
    assert found.converged
    assert found.active == ()
    sizes = np.abs(join(np.sqrt(np.outer(np.diag(K), np.diag(K))), np.sqrt(np.outer(np.diag(D), np.diag(D)))))
    assert np.allclose(found.parameters, truth, atol=1e-9 * sizes.max() / np.abs(units).max() + 1e-9)


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("dof", [("y",), ("y", "gamma"), ("x", "y", "z", "alpha", "gamma"), DOF_NAMES])
def test_any_number_of_degrees_of_freedom(name: str, dof: tuple[str, ...]) -> None:
    mass, stiffness, damping = (
        part[np.ix_(*[[DOF_NAMES.index(one) for one in dof]] * 2)] for part in six_dof_matrices()
    )
    from sample_volumes.shaken_stapes import driven_base, simulated_motion

    freq = np.linspace(400.0, 5000.0, 120)
    base = np.concatenate([driven_base(freq, dof, one) for one in dof[:3]])
    motion = simulated_motion(mass, stiffness, damping, dof, freq, base, 0.05, None)
    lines, units = lines_of(motion, mass, dof)
    found = estimator(name).estimate(lines, OPTIONS)
    assert np.allclose(found.parameters, join(stiffness, damping) / units, atol=1e-8)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_scores_vanish_at_the_estimate(name: str) -> None:
    lines, _ = lines_of(paper_motion(), M, DOF)
    found = estimator(name).estimate(lines, EstimatorOptions(tolerance=1e-20))
    terms = estimator(name).scores(found.parameters, lines, OPTIONS)
    assert terms.shape == (200, 12)
    assert np.all(np.abs(terms.sum(axis=0)) < 1e-5 * np.abs(terms).sum(axis=0))


@pytest.mark.parametrize("name", ESTIMATORS)
def test_units_do_not_matter(name: str) -> None:
    """Lengths in mm instead of m change nothing but pinv, whose rows are weighted by their SI units."""
    motion = paper_motion()
    change = np.diag([1.0, 1e-3, 1e-3])
    q = motion.q @ np.linalg.inv(change)
    covariance = np.linalg.inv(change) @ motion.covariance @ np.linalg.inv(change).T
    other = RigidMotion(
        motion.runs, motion.bodies, DOF, motion.freq_hz, q, covariance, motion.chi2, motion.n_dof
    )
    lines, _ = lines_of(motion, M, DOF)
    moved, _ = lines_of(other, change @ M @ change, DOF)
    first = estimator(name).estimate(lines, OPTIONS).parameters
    second = estimator(name).estimate(moved, OPTIONS).parameters
    assert np.allclose(first, second, atol=1e-7) == (name != "pinv")


def test_unknown_estimator_is_refused() -> None:
    with pytest.raises(FittingError, match=f"the estimator must be one of {', '.join(ESTIMATORS)}"):
        estimator("tls")


def test_pinv_is_the_pseudo_inverse_of_the_stacked_si_equations() -> None:
    motion = paper_motion()
    omega = 2.0 * np.pi * motion.freq_hz
    stapes, base = motion.q[0, 0], motion.q[0, 1]
    rows, right = [], []
    for line, w in enumerate(omega):
        dq = stapes[line] - base[line]
        a = np.zeros((3, 6), dtype=complex)
        for place, (i, j) in enumerate([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]):
            a[i, place] = dq[j]
            a[j, place] = dq[i]
        full = np.hstack([a, 1j * w * a])
        force = w**2 * M @ stapes[line]
        rows += [full.real, full.imag]
        right += [force.real, force.imag]
    stacked = np.vstack(rows)
    norms = np.linalg.norm(stacked, axis=0)
    expected = np.linalg.pinv(stacked / norms) @ np.concatenate(right) / norms
    lines, units = lines_of(motion, M, DOF)
    found = pinv.estimate(lines, OPTIONS).parameters * units
    assert np.allclose(found, expected, rtol=1e-8)


def test_ml_gradient_is_that_of_its_objective() -> None:
    lines, _ = lines_of(paper_motion(0.2, 5), M, DOF)
    at = ml.estimate(lines, OPTIONS).parameters * 1.05
    _, gradient = ml.normal_equations(at, lines)
    for place in range(12):
        step = np.zeros(12)
        step[place] = 1e-6
        ahead, behind = (np.sum(ml.whiten(at + sign * step, lines).distance) for sign in (1.0, -1.0))
        assert (ahead - behind) / 2e-6 == pytest.approx(2.0 * gradient[place], rel=1e-5, abs=1e-2)


def test_ml_objective_is_the_distance_to_the_nearest_consistent_motion() -> None:
    """e^H Ce^-1 e equals the least (y - y0)^H S^-1 (y - y0) over all y0 that satisfy the equations."""
    motion = paper_motion(0.3, 2, 12)
    observation = observe(motion, DOF)
    lines, units = lines_of(motion, M, DOF)
    p = join(K, D) / units
    distance = ml.whiten(p, lines).distance
    for line in (0, 5, 11):
        w = 2.0 * np.pi * motion.freq_hz[line]
        z = K + 1j * w * D
        b = np.hstack([z - w**2 * M, -z])
        y, s = observation.q[line], observation.covariance[line]
        nearest = y - s @ b.conj().T @ np.linalg.solve(b @ s @ b.conj().T, b @ y)
        gap = y - nearest
        assert np.allclose(b @ nearest / np.abs(b @ y).max(), 0.0, atol=1e-8)
        assert distance[line] == pytest.approx((gap.conj() @ np.linalg.solve(s, gap)).real, rel=1e-8)


def test_ml_uses_correlation_between_the_bodies() -> None:
    """A common error of both bodies hurts less, and chi2 is right, when the covariance declares it."""
    clean = paper_motion(0.01, None)
    rng = np.random.default_rng(4)
    joint = np.zeros((1, 200, 6, 6), dtype=complex)
    small = [clean.covariance[0, body] for body in range(2)]
    common = 400.0 * small[1]
    joint[0, :, :3, :3], joint[0, :, 3:, 3:] = small[0] + common, small[1] + common
    joint[0, :, :3, 3:] = joint[0, :, 3:, :3] = common
    draw = (rng.standard_normal((200, 6)) + 1j * rng.standard_normal((200, 6))) * np.sqrt(0.5)
    q = clean.q[0].transpose(1, 0, 2).reshape(200, 6) + np.einsum(
        "lij,lj->li", np.linalg.cholesky(joint[0]), draw
    )
    q = q.reshape(1, 200, 2, 3).transpose(0, 2, 1, 3)
    shared = RigidMotion(
        ("1",), ("stapes", "base"), DOF, clean.freq_hz, q, joint, clean.chi2, clean.n_dof, reference="base:y"
    )
    blind = RigidMotion(
        ("1",),
        ("stapes", "base"),
        DOF,
        clean.freq_hz,
        q,
        np.stack([joint[:, :, :3, :3], joint[:, :, 3:, 3:]], axis=1),
        clean.chi2,
        clean.n_dof,
    )
    errors, ratios = [], []
    for motion in (shared, blind):
        lines, units = lines_of(motion, M, DOF)
        found = ml.estimate(lines, OPTIONS)
        errors.append(np.linalg.norm(found.parameters - join(K, D) / units))
        ratios.append(2.0 * found.objective / (1200 - 12))
    assert errors[0] < 0.8 * errors[1]
    assert ratios[0] == pytest.approx(1.0, abs=0.12)
    assert abs(ratios[1] - 1.0) > 0.15


def test_t4_shrugs_off_outlying_lines() -> None:
    motion = paper_motion(0.05, 7)
    rng = np.random.default_rng(8)
    q = motion.q.copy()
    bad = rng.choice(200, 6, replace=False)
    q[0, :, bad] += 10.0 * (paper_motion(0.05, 9).q - paper_motion(0.05, None).q)[0][:, bad].transpose(
        1, 0, 2
    )
    spoiled = RigidMotion(
        motion.runs, motion.bodies, DOF, motion.freq_hz, q, motion.covariance, motion.chi2, motion.n_dof
    )
    lines, units = lines_of(spoiled, M, DOF)
    truth = join(K, D) / units
    plain = ml.estimate(lines, OPTIONS)
    robust = ml.estimate(lines, EstimatorOptions(robust="t4"))
    assert np.linalg.norm(robust.parameters - truth) < np.linalg.norm(plain.parameters - truth)
    assert robust.weights is not None
    assert set(np.argsort(robust.weights)[:5]) <= set(bad)


@pytest.mark.parametrize("name", ["ml", "irls"])
def test_weak_data_still_give_a_stable_and_passive_model(name: str) -> None:
    held = 0
    for seed in range(12):
        lines = weak_lines(seed)
        found = estimator(name).estimate(lines, OPTIONS)
        stiffness, damping = split(found.parameters, 3)
        assert passive(stiffness)
        assert passive(damping)
        assert modes(lines.mass, stiffness, damping).stable
        held += bool(found.active)
    assert held > 0


def test_held_ml_is_the_best_passive_model_around() -> None:
    lines = next(
        lines
        for lines in map(weak_lines, range(40))
        if ml.estimate(lines, OPTIONS).active == ("damping_psd",)
    )
    found = ml.estimate(lines, OPTIONS)
    rng = np.random.default_rng(0)
    for _ in range(200):
        near = found.parameters + 0.02 * rng.standard_normal(12)
        near = nearest_inside(near, 3, 1e-9)
        assert np.sum(ml.whiten(near, lines).distance) > found.objective - 1e-4


def test_kernels_line_by_line() -> None:
    rng = np.random.default_rng(3)
    a = rng.standard_normal((40, 4, 4)) + 1j * rng.standard_normal((40, 4, 4))
    hermitian = a @ a.conj().transpose(0, 2, 1)
    factor = cholesky(np.moveaxis(hermitian, 0, 2))
    assert np.allclose(np.moveaxis(factor, 2, 0), np.linalg.cholesky(hermitian))
    right = rng.standard_normal((4, 40)) + 1j * rng.standard_normal((4, 40))
    solved = backward(factor, forward(factor, right))
    assert np.allclose(solved.T, np.linalg.solve(hermitian, right.T[..., None])[..., 0])
    indefinite = np.diag([1.0, -1.0])[:, :, None].astype(complex)
    with np.errstate(invalid="ignore"):
        assert np.isnan(cholesky(indefinite)[1, 1, 0].real)


def test_residual_is_linear_in_the_parameters() -> None:
    lines, units = lines_of(paper_motion(), M, DOF)
    p = join(K, D) / units
    linear = np.einsum("ilp,p->il", regressor(lines.dq, lines.factor), p) - lines.force
    assert np.allclose(evaluate(p, lines).residual, linear)
    assert real_rows(linear).shape == (1200,)


def test_two_directions_identify_six_degrees_of_freedom() -> None:
    mass, stiffness, damping = six_dof_matrices()
    lines, units = lines_of(six_dof_motion(0.02, None, "yxz"), mass, DOF_NAMES)
    found = ml.estimate(lines, OPTIONS)
    assert np.allclose(found.parameters, join(stiffness, damping) / units, atol=1e-8)
    assert is_positive_definite(found.parameters, 6)
