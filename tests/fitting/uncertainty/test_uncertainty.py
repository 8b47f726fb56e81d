"""Intervals: coverage, propagation of common errors, the frame's coherent effect, budgets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.fitting.estimators import ml
from legacy.fitting.estimators.base import EstimatorOptions
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.model.damping import VISCOUS
from legacy.fitting.model.model import simulate
from legacy.fitting.model.observation import Observation, observe
from legacy.fitting.model.parameter_vector import join, split, vector
from legacy.fitting.model.scaled_lines import Scale, assemble
from legacy.fitting.options import KDOptions
from legacy.fitting.uncertainty.covariance import invert
from legacy.stapeskit.frames import rotation_from_vector
from legacy.stapeskit.records.mass_record import frame_derivative
from legacy.stapeskit.records.motion import RigidMotion, SharedErrors
from legacy.stapeskit.spatial import DOF_NAMES, matrix_from_parameters, twist_transfer
from sample_volumes.shaken_stapes import driven_base, simulated_motion
from tests.fitting.cases import (
    DOF,
    FREQ,
    D,
    K,
    M,
    paper_motion,
    six_dof_mass,
    six_dof_matrices,
    six_dof_motion,
    six_dof_parameters,
)

TRUTH = join(K, D)


def motion_transfer(displacement: np.ndarray) -> np.ndarray:
    """X with q' = X q for a footplate frame displaced by (m, rad) in its own axes."""
    return twist_transfer(rotation_from_vector(displacement[3:]).T, displacement[:3])


def with_frame_errors(motion: RigidMotion, covariance: np.ndarray) -> RigidMotion:
    """State that q was computed in a footplate frame of that covariance."""
    columns = []
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-6
        slope = (motion_transfer(step) - motion_transfer(-step)) / 2e-6
        columns.append(motion.q @ slope.T)
    names = tuple(f"footplate_frame.{name}" for name in DOF_NAMES)
    return replace(motion, shared=SharedErrors(names, covariance, np.stack(columns)))


def test_ml_reaches_the_cramer_rao_bound_with_honest_intervals() -> None:
    exact = paper_motion(0.05, None)
    observation = observe(exact, DOF)
    scale = Scale.of(observation, M)
    truth = TRUTH / scale.parameter_units(VISCOUS)
    lines = assemble(observation, M, scale, VISCOUS)
    hessian, _ = ml.normal_equations(truth, lines)
    bound = np.sqrt(np.diag(0.5 * invert(hessian)))
    root = np.linalg.cholesky(exact.covariance)
    rng = np.random.default_rng(11)
    errors, hits, ratios = [], [], []
    for _ in range(300):
        draw = rng.standard_normal((2, *exact.q.shape)) * np.sqrt(0.5)
        noisy = exact.q + np.einsum("rblij,rblj->rbli", root, draw[0] + 1j * draw[1])
        q = np.concatenate([noisy[0, 0], noisy[0, 1]], axis=1)
        made = assemble(replace(observation, q=q), M, scale, VISCOUS)
        found = ml.estimate(made, EstimatorOptions())
        hessian, _ = ml.normal_equations(found.parameters, made)
        error = found.parameters - truth
        errors.append(error)
        hits.append(np.abs(error) < 1.96 * np.sqrt(np.diag(0.5 * invert(hessian))))
        ratios.append(2.0 * found.objective / (1200 - 12))
    relative = np.sqrt(np.mean(np.square(errors), axis=0)) / bound
    assert np.median(relative) < 1.07
    assert relative.max() < 1.2
    assert np.abs(np.mean(errors, axis=0) / bound).max() < 0.22
    assert 0.93 < np.mean(hits) < 0.97
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("estimator", ["pinv", "irls", "constrained"])
def test_other_estimators_have_intervals_that_hold(estimator: str) -> None:
    hits = []
    for seed in range(10):
        fit = fit_kd(paper_motion(0.05, seed), M, KDOptions(estimator=estimator))
        error = join(fit.stiffness, fit.damping) - TRUTH
        hits.append(np.abs(error) < 1.96 * np.sqrt(np.diag(fit.covariance)))
    assert np.mean(hits) > 0.85


def test_attenuation_is_foreseen() -> None:
    """The estimated bias of pinv is the bias that many replicates have."""
    options = KDOptions(estimator="pinv")
    fits = [fit_kd(paper_motion(0.05, seed), M, options) for seed in range(20)]
    estimates = [join(fit.stiffness, fit.damping) for fit in fits]
    error = np.mean(estimates, axis=0) - TRUTH
    unsure = np.std(estimates, axis=0) / np.sqrt(len(fits))
    foreseen = np.mean([fit.budget.bias for fit in fits], axis=0)
    assert np.abs(error / unsure).max() > 8.0
    assert np.all(np.abs(foreseen - error) < 4.0 * unsure + 0.15 * np.abs(error))
    assert any(notice.code == "attenuation_bias" for notice in fits[0].notices)
    assert not np.any(fit_kd(paper_motion(), M).budget.bias)


def test_modes_and_axes_scatter_as_stated() -> None:
    fits = [fit_kd(paper_motion(0.05, seed), M) for seed in range(40)]
    for values, sds in (
        ([[mode.frequency_hz for mode in fit.modes.pairs] for fit in fits], "frequency_sd_hz"),
        (
            [[mode.undamped_frequency_hz for mode in fit.modes.pairs] for fit in fits],
            "undamped_frequency_sd_hz",
        ),
        ([[mode.damping_ratio for mode in fit.modes.pairs] for fit in fits], "damping_ratio_sd"),
        ([np.abs([mode.shape for mode in fit.modes.pairs]) for fit in fits], "shape_sd"),
        ([fit.derived.principal for fit in fits], "principal_sd"),
    ):
        scatter = np.std(values, axis=0)
        stated = np.mean([getattr(fit.derived, sds) for fit in fits], axis=0)
        assert np.all(scatter / stated < 1.5), sds
        assert np.all(scatter / stated > 0.6), sds


def test_mass_scale_moves_k_and_d_alike_and_leaves_the_modes() -> None:
    parameters = six_dof_parameters()
    scale = (0.03**2) * np.outer(parameters, parameters)
    mass = six_dof_mass({"density": scale})
    fit = fit_kd(six_dof_motion(1e-4, 0), mass)
    shares = fit.budget.shares()["mass.density"]
    assert all(shares[name] > 0.9 for name in ("K11", "K22", "K33", "D11", "D22", "D33"))
    for values, sd in zip(
        (fit.stiffness, fit.damping),
        split(np.sqrt(np.diag(fit.budget.sources["mass.density"])), 3),
        strict=True,
    ):
        assert sd == pytest.approx(0.03 * np.abs(values), rel=1e-3)
    for place, mode in enumerate(fit.modes.pairs):
        assert fit.derived.frequency_sd_hz[place] < 1e-3 * mode.frequency_hz


def test_mass_uncertainty_agrees_with_refits() -> None:
    rng = np.random.default_rng(3)
    parameters = six_dof_parameters()
    mass = parameters[0]
    sd = np.array(
        [0.02 * mass, *[50e-6 * mass] * 3, *(0.03 * np.abs(parameters[4:7])), *[0.01 * parameters[4]] * 3]
    )
    covariance = np.diag(sd**2)
    motion = six_dof_motion(0.01, 0)
    fit = fit_kd(motion, six_dof_mass({"levels": covariance}), KDOptions(inplane="load"))
    assert fit.inplane.used
    observation = observe(motion, DOF)
    refits = [
        quick_fit(observation, matrix_from_parameters(parameters + sd * rng.standard_normal(10)))
        for _ in range(2000)
    ]
    scatter = np.std(refits, axis=0)
    stated = np.sqrt(np.diag(fit.budget.sources["mass.levels"]))
    assert stated == pytest.approx(scatter, rel=0.05)


def quick_fit(observation: Observation, mass: np.ndarray) -> np.ndarray:
    """The ml estimate alone, SI."""
    rows = mass[np.ix_([1, 3, 5], [1, 3, 5, 0, 2, 4])]
    scale = Scale.of(observation, rows[:, :3])
    lines = assemble(observation, rows, scale, VISCOUS)
    return ml.estimate(lines, EstimatorOptions()).parameters * scale.parameter_units(VISCOUS)


def test_displaced_frame_is_a_change_of_coordinates_of_everything() -> None:
    """An error of the footplate frame changes M and q together: K' = X^-T K X^-1."""
    mass, stiffness, damping = six_dof_matrices()
    motion = with_frame_errors(six_dof_motion(0.02, None, "xyz"), 1e-10 * np.eye(6))
    fit = fit_kd(motion, six_dof_mass(), KDOptions(dof=DOF_NAMES))
    effect = next(one for one in fit.budget.effects if one.source == "motion")
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-6
        columns = []
        for sign in (1.0, -1.0):
            inverse = np.linalg.inv(motion_transfer(sign * step))
            columns.append([vector(inverse.T @ part @ inverse) for part in (stiffness, damping, mass)])
        k, d, m = ((ahead - behind) / 2e-6 for ahead, behind in zip(*columns, strict=True))
        size = np.concatenate(
            [np.abs(vector(stiffness)).max() * np.ones(21), np.abs(vector(damping)).max() * np.ones(21)]
        )
        assert np.allclose(effect.parameters[:, axis] / size, np.concatenate([k, d]) / size, atol=2e-3)
        expected_mass = m / np.abs(m).max() if np.any(m) else m
        found_mass = vector(effect.mass[axis]) / np.abs(m).max() if np.any(m) else vector(effect.mass[axis])
        assert np.allclose(found_mass, expected_mass, atol=1e-6)


def test_frame_error_does_not_move_frequencies_but_the_axes() -> None:
    """Eigenvalues are invariant under a change of frame; the stiffness centre moves with the frame."""
    covariance = np.diag([1e-10, 0.0, 1e-10, 0.0, 1e-4, 0.0])
    motion = with_frame_errors(six_dof_motion(1e-4, None, "xyz"), covariance)
    fit = fit_kd(motion, six_dof_mass(), KDOptions(dof=DOF_NAMES))
    for place, mode in enumerate(fit.modes.pairs):
        assert fit.derived.frequency_sd_hz[place] < 1e-3 * mode.frequency_hz
    planar = fit_kd(motion, six_dof_mass(), KDOptions(inplane="load"))
    assert planar.derived.principal_sd is not None
    assert planar.derived.principal_sd[:2] == pytest.approx([1e-5, 1e-5], rel=0.35)
    assert planar.derived.principal_sd[2] == pytest.approx(0.01, rel=0.35)


def test_frame_of_the_mass_enters_alone_when_the_motion_does_not_depend_on_it() -> None:
    pose = np.diag([1e-10, 0.0, 1e-10, 0.0, 0.0, 0.0])
    slope = frame_derivative(six_dof_parameters())
    mass = six_dof_mass({"frame": slope @ pose @ slope.T, "levels": 1e-30 * np.eye(10)})
    alone = fit_kd(six_dof_motion(1e-4, None, "y"), mass)
    assert "mass.frame" in alone.budget.sources
    assert "footplate_frame" not in alone.budget.sources
    joined = fit_kd(with_frame_errors(six_dof_motion(1e-4, None, "y"), pose), mass)
    assert "footplate_frame" in joined.budget.sources
    assert "mass.frame" not in joined.budget.sources


def test_shared_errors_are_split_by_source_and_add_up() -> None:
    motion = paper_motion(0.02, 1)
    rng = np.random.default_rng(0)
    root = rng.standard_normal((3, 3)) * 0.01
    derivatives = np.stack([motion.q * factor for factor in (1.0, 0.5j, -0.3)])
    derivatives[1, :, 1] = 0.0
    names = ("gain.stapes", "registration.x", "registration.y")
    shared = replace(motion, shared=SharedErrors(names, root @ root.T, derivatives))
    fit = fit_kd(shared, M)
    assert set(fit.budget.sources) == {"channel_noise", "gain", "registration"}
    assert sum(fit.budget.sources.values()) == pytest.approx(fit.covariance, rel=1e-9)
    for name in fit.parameters:
        assert sum(part[name] for part in fit.budget.shares().values()) == pytest.approx(1.0)
    assert np.all(np.diag(fit.covariance) >= np.diag(fit.noise_covariance))


def test_common_gain_of_both_bodies_changes_nothing() -> None:
    motion = paper_motion(0.02, 1)
    shared = replace(motion, shared=SharedErrors(("gain.all",), np.array([[0.01]]), motion.q[None]))
    fit = fit_kd(shared, M)
    assert np.all(np.diag(fit.budget.sources["gain"]) < 1e-6 * np.diag(fit.noise_covariance))


def test_understated_noise_widens_the_intervals() -> None:
    motion = paper_motion(0.05, 6)
    fit = fit_kd(motion, M)
    understated = fit_kd(replace(motion, covariance=motion.covariance / 9.0), M)
    assert understated.budget.widened == pytest.approx(9.0 * fit.chi2 / fit.n_dof, rel=1e-6)
    assert np.sqrt(np.diag(understated.covariance)) == pytest.approx(
        np.sqrt(np.diag(fit.covariance)) / np.sqrt(fit.budget.widened / (fit.chi2 / fit.n_dof)), rel=1e-6
    )
    assert any(notice.code == "misfit" for notice in understated.notices)
    overstated = fit_kd(replace(motion, covariance=motion.covariance * 9.0), M)
    assert any(notice.code == "noise_overstated" for notice in overstated.notices)


def test_fractional_exponent_widens_the_intervals_of_what_it_resembles() -> None:
    motion = paper_motion(0.02, 3)
    viscous = fit_kd(motion, M)
    fractional = fit_kd(motion, M, KDOptions(damping="fractional"))
    assert fractional.law.exponent == pytest.approx(1.0, abs=0.02)
    assert fractional.laws[0].exponent_sd == pytest.approx(0.0022, rel=0.5)
    assert "damping_exponent" in fractional.budget.sources
    assert fractional.n_dof == viscous.n_dof - 1
    assert fractional.covariance[0, 0] > viscous.covariance[0, 0]


def test_several_runs_narrow_the_intervals() -> None:
    rng = np.random.default_rng(2)
    base = driven_base(FREQ, DOF)
    one = fit_kd(simulated_motion(M, K, D, DOF, FREQ, base, 0.05, rng), M)
    four = fit_kd(simulated_motion(M, K, D, DOF, FREQ, np.repeat(base, 4, axis=0), 0.05, rng), M)
    ratio = np.sqrt(np.diag(four.noise_covariance) / np.diag(one.noise_covariance))
    assert ratio == pytest.approx(0.5 * np.ones(12), rel=0.15)


def test_simulation_of_the_truth_is_within_its_band() -> None:
    from legacy.fitting.report.responses import responses

    fit = fit_kd(paper_motion(0.05, 6), M)
    found = responses(fit)
    truth = simulate(M, K, D, FREQ, fit.observation.base)
    gap = np.abs(np.abs(found.simulated) - np.abs(truth))
    assert np.mean(gap < 2.8 * found.amplitude_sd) > 0.9
    assert np.std(np.concatenate([found.normalised.real, found.normalised.imag])) == pytest.approx(
        1.0, abs=0.05
    )
