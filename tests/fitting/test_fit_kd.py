"""The one call: choices, diagnostics, warnings, faults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from legacy.fitting.errors import FittingError
from legacy.fitting.examples.paper import PAPER_DAMPING_PRINTED
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.inplane_load import choose_inplane_load
from legacy.fitting.model.damping import DampingLaw
from legacy.fitting.model.laws import LAWS
from legacy.fitting.model.parameter_vector import entry_names, entry_units, join, split
from legacy.fitting.model.principal_axes import principal_axes
from legacy.fitting.options import KDOptions
from legacy.fitting.report.sections import kd_page
from legacy.stapeskit.records.motion import RigidMotion
from legacy.stapeskit.spatial import DOF_NAMES
from sample_volumes.shaken_stapes import driven_base, simulated_motion
from tests.fitting.cases import (
    DOF,
    FREQ,
    D,
    K,
    M,
    damping_for,
    paper_motion,
    six_dof_mass,
    six_dof_matrices,
    six_dof_motion,
)


def relative(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Error of every entry over sqrt(Xii Xjj)."""
    root = np.sqrt(np.diag(truth))
    return (found - truth) / np.outer(root, root)


def codes(fit) -> set[str]:
    return {notice.code for notice in fit.notices}


# --- choices ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("estimator", ["ml", "irls", "pinv", "constrained"])
def test_exact_data_give_exact_matrices_in_si(estimator: str) -> None:
    fit = fit_kd(paper_motion(seed=None), M, KDOptions(estimator=estimator))
    assert np.abs(relative(fit.stiffness, K)).max() < 1e-9
    assert np.abs(relative(fit.damping, D)).max() < 1e-9
    assert fit.chi2 < 1e-9
    assert fit.modes.stable
    assert fit.passive == (True, True)


@pytest.mark.parametrize("name", ["viscous", "hysteretic", "fractional", "relaxation", "two_relaxations"])
def test_comparison_picks_the_true_damping_law(name: str) -> None:
    exponent = 0.2 if name == "two_relaxations" else 0.5
    law = DampingLaw(name, exponent).scaled(1.0 / (2.0 * np.pi * 2000.0))
    fit = fit_kd(paper_motion(0.02, 5, law=law), M, KDOptions(damping="compare"))
    assert fit.law.name == name
    assert np.abs(relative(fit.stiffness, K)).max() < 0.05
    if name == "fractional":
        assert fit.law.exponent == pytest.approx(0.5, abs=0.03)
    assert np.abs(relative(fit.damping, damping_for(fit.law))).max() < 0.1
    if name in ("relaxation", "two_relaxations"):
        assert fit.law.exponent == pytest.approx(law.exponent, rel=0.1)
        assert abs(fit.law.exponent - law.exponent) < 3.0 * next(
            one.exponent_sd for one in fit.laws if one.law == fit.law
        )
    if name == "relaxation":
        assert "398 µs (1 / 2πf of the lowest line)" in kd_page(fit, {}).html()
    assert [one.law.name for one in fit.laws] == list(LAWS)


def test_in_plane_motion_enters_as_load_where_it_matters() -> None:
    motion, mass = six_dof_motion(0.01, 1), six_dof_mass()
    auto, ignored = fit_kd(motion, mass), fit_kd(motion, mass, KDOptions(inplane="ignore"))
    assert auto.inplane.used
    assert auto.inplane.dof == ("x", "z", "beta")
    sd = auto.standard_deviation[0]
    assert np.all(np.abs(auto.stiffness - K) < 3.0 * sd)
    assert np.abs(relative(auto.stiffness, K)).max() < 0.02
    loaded = fit_kd(motion, mass, KDOptions(inplane="load"))
    assert np.abs(relative(loaded.stiffness, K)).max() < 0.02
    assert np.abs(relative(ignored.stiffness, K)).max() > 0.05
    assert "neglected_motion" in codes(ignored)
    assert "neglected_motion" not in codes(auto)
    exact = fit_kd(six_dof_motion(1e-7, None), mass)
    assert np.abs(relative(exact.stiffness, K)).max() < 0.002
    assert exact.ligament.height[0] == pytest.approx(0.0, abs=1e-8)


def test_the_covariance_with_the_plane_of_the_ligament_is_that_of_the_errors() -> None:
    """Squared distances over the stated covariance of 16 repetitions: chi2 of 12 degrees of freedom each."""
    total, truth = 0.0, join(K, D)
    for seed in range(16):
        fit = fit_kd(six_dof_motion(0.003, 200 + seed, lines=40), six_dof_mass(), KDOptions(bands=0))
        sd = np.sqrt(np.diag(fit.ligament.plane_covariance))
        off = (join(fit.ligament.plane_stiffness, fit.ligament.plane_damping) - truth) / sd
        total += off @ np.linalg.solve(fit.ligament.plane_covariance / np.outer(sd, sd), off)
    assert 1e-4 < chi2.sf(total, 12 * 16) < 1.0 - 1e-4


def test_in_plane_noise_does_no_harm() -> None:
    """A stapes that is held in its plane: rocking moves its centre of mass, and only noise is measured there.

    The equations of the model hold with Y = 0; without the coupling, mere noise would be left out.
    """
    clean = paper_motion(0.05, None)
    places = [DOF_NAMES.index(name) for name in DOF]
    outside = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        noise = six_dof_motion(0.05, None).covariance
        draw = (rng.standard_normal((1, 2, 200, 6)) + 1j * rng.standard_normal((1, 2, 200, 6))) * np.sqrt(0.5)
        q = np.einsum("rblij,rblj->rbli", np.linalg.cholesky(noise), draw)
        q[..., places] += clean.q
        motion = RigidMotion(("1",), clean.bodies, DOF_NAMES, FREQ, q, noise, clean.chi2, clean.n_dof)
        mass = six_dof_matrices()[0].copy()
        mass[np.ix_(places, places)] = M
        fit = fit_kd(motion, mass)
        deviation = (fit.stiffness - K) / fit.standard_deviation[0]
        outside += int(np.sum(np.abs(deviation[np.triu_indices(3)]) > 1.96))
        assert fit.ligament is not None
        problem = replace(fit.problem, coupling=None)
        _, choice = choose_inplane_load(problem, "auto")
        assert not choice.used
        assert "not significant" in choice.reason
    assert outside <= 5


def test_in_plane_load_needs_its_mass_and_its_motion() -> None:
    with pytest.raises(FittingError, match="--inplane load must be given with measured motion outside --dof"):
        fit_kd(paper_motion(), M, KDOptions(inplane="load"))
    with pytest.raises(FittingError, match="given with the mass matrix of all six degrees of freedom"):
        fit_kd(six_dof_motion(0.01, 0), M, KDOptions(inplane="load"))
    assert not fit_kd(six_dof_motion(0.01, 0), M).inplane.used


def test_band_and_excluded_ranges_leave_lines_out() -> None:
    motion = paper_motion(0.02, 1)
    fit = fit_kd(motion, M, KDOptions(band_hz=(500.0, 4000.0), exclude_hz=[(900.0, 1100.0), (50.0, 60.0)]))
    freq = fit.observation.freq_hz
    assert freq.min() >= 500.0
    assert freq.max() <= 4000.0
    assert not np.any((freq >= 900.0) & (freq <= 1100.0))
    inside = (FREQ >= 500.0) & (FREQ <= 4000.0) & ~((FREQ >= 900.0) & (FREQ <= 1100.0))
    assert len(freq) == inside.sum()


def test_missing_lines_are_dropped_and_told() -> None:
    motion = paper_motion(0.02, 1)
    q = motion.q.copy()
    q[0, 0, 10] = np.nan
    q[0, 1, 20:23] = np.nan
    covariance = motion.covariance.copy()
    covariance[0, 0, 10] = np.nan
    fit = fit_kd(replace(motion, q=q, covariance=covariance), M)
    assert fit.observation.dropped == 4
    assert fit.n_dof == 2 * 3 * 196 - 12
    assert "lines_dropped" in codes(fit)


def test_per_reference_motion_with_joint_covariance() -> None:
    """Dividing all by the base's y leaves K and D where they are; its own variance is zero then."""
    motion = paper_motion(0.02, 1)
    reference = motion.q[0, 1, :, 0]
    n = 3
    joint = np.zeros((1, 200, 6, 6), dtype=complex)
    joint[0, :, :3, :3], joint[0, :, 3:, 3:] = motion.covariance[0]
    stacked = np.concatenate([motion.q[0, 0], motion.q[0, 1]], axis=1)
    slope = np.eye(6)[None] / reference[:, None, None]
    slope = slope - stacked[:, :, None] / reference[:, None, None] ** 2 * np.eye(6)[None, 3:4]
    scaled = slope @ joint[0] @ slope.conj().transpose(0, 2, 1)
    q = (stacked / reference[:, None]).reshape(200, 2, n).transpose(1, 0, 2)[None]
    per_reference = RigidMotion(
        ("1",), motion.bodies, DOF, FREQ, q, scaled[None], motion.chi2, motion.n_dof, reference="base:y"
    )
    plain, divided = fit_kd(motion, M), fit_kd(per_reference, M)
    sd = np.sqrt(np.diag(plain.covariance))
    gap = join(divided.stiffness, divided.damping) - join(plain.stiffness, plain.damping)
    assert np.abs(gap / sd).max() < 0.2
    assert np.sqrt(np.diag(divided.covariance)) == pytest.approx(sd, rel=0.05)


def test_six_degrees_of_freedom_from_three_directions() -> None:
    _, stiffness, damping = six_dof_matrices()
    fit = fit_kd(six_dof_motion(0.02, 3, "xyz"), six_dof_mass(), KDOptions(dof=DOF_NAMES))
    gap = (join(fit.stiffness, fit.damping) - join(stiffness, damping)) / np.sqrt(np.diag(fit.covariance))
    assert np.abs(gap).max() < 4.0
    assert np.mean(np.abs(gap) < 1.96) > 0.85
    assert fit.derived.principal is None
    assert len(fit.modes.pairs) + len(fit.modes.overdamped_roots_1_s) / 2 == 6


def test_weak_data_name_what_they_do_not_tell() -> None:
    fit = fit_kd(six_dof_motion(0.05, 0, "y", 60), six_dof_mass(), KDOptions(dof=DOF_NAMES))
    assert fit.identifiability.weak
    assert "weak_identifiability" in codes(fit)
    text = next(notice.text for notice in fit.notices if notice.code == "weak_identifiability")
    assert any(name in text for name in entry_names(6))
    strong = fit_kd(six_dof_motion(0.005, 0, "xyz"), six_dof_mass(), KDOptions(dof=DOF_NAMES))
    assert strong.identifiability.condition < fit.identifiability.condition
    assert strong.identifiability.worst < fit.identifiability.worst


def test_entries_that_the_data_do_not_see_get_enormous_intervals() -> None:
    """Exactly uncoupled gamma that never moves: its entries are unknown, the others are found."""
    mass, stiffness, damping = (np.diag(np.diag(part)) for part in (M, K, D))
    base = driven_base(FREQ, DOF, others=0.0)
    motion = simulated_motion(mass, stiffness, damping, DOF, FREQ, base, 0.02, None)
    fit = fit_kd(motion, mass)
    sd = dict(zip(fit.parameters, np.sqrt(np.diag(fit.covariance)), strict=True))
    assert "weak_identifiability" in codes(fit)
    assert sd["K33"] > 10.0 * K[2, 2]
    assert sd["K11"] < 0.05 * K[0, 0]
    assert fit.stiffness[0, 0] == pytest.approx(K[0, 0], rel=1e-6)


@pytest.mark.parametrize("rounding", [0.0, 1e-11])
@pytest.mark.parametrize("estimator", ["ml", "irls", "pinv", "constrained"])
def test_motion_as_one_body_is_refused_by_name(estimator: str, rounding: float) -> None:
    motion = paper_motion(seed=None)
    q = motion.q.copy()
    q[:, 0, :, 1:] = q[:, 1, :, 1:] * (1.0 + rounding)
    with pytest.raises(FittingError, match=r"got the same one in alpha, gamma.*Give --dof y, or excite"):
        fit_kd(replace(motion, q=q), M, KDOptions(estimator=estimator))


def test_deflection_that_is_mere_noise_is_told_as_weak() -> None:
    """Stapes and base move as one but for noise: K there could be anything."""
    motion = paper_motion(0.02, seed=1)
    q = motion.q.copy()
    rng = np.random.default_rng(4)
    sd = np.sqrt(np.einsum("lii->li", motion.covariance[0, 0]).real / 2.0)[:, 1:]
    noise = rng.standard_normal((2, *sd.shape))
    q[0, 0, :, 1:] = q[0, 1, :, 1:] + sd * (noise[0] + 1j * noise[1])
    fit = fit_kd(replace(motion, q=q), M)
    assert {"weak_identifiability", "not_converged", "constraint_active"} <= codes(fit)
    assert fit.identifiability.worst > 0.25
    assert fit.profile is None
    assert np.all(np.isfinite(fit.intervals))


def test_identifiability_tells_the_bound_that_fisher_gives() -> None:
    """Noise of the motion spreads an estimate a little more than the bound, the less the smaller it is."""
    fit = fit_kd(paper_motion(0.05, 2), M)
    excess = np.sqrt(np.diag(fit.noise_covariance) / fit.budget.widened) / fit.identifiability.bound_si
    assert np.all(excess >= 1.0)
    assert np.all(excess < 1.05)
    quiet = fit_kd(paper_motion(0.001, 2), M)
    deviation = np.sqrt(np.diag(quiet.noise_covariance) / quiet.budget.widened)
    assert quiet.identifiability.bound_si == pytest.approx(deviation, rel=1e-4)
    assert fit.identifiability.condition == pytest.approx(4.9, abs=0.4)
    assert not fit.identifiability.weak
    assert fit.identifiability.describe(0)[0] in "0-"


# --- warnings --------------------------------------------------------------------------------------------


def test_printed_damping_is_diagnosed_from_data() -> None:
    motion = simulated_motion(M, K, PAPER_DAMPING_PRINTED, DOF, FREQ, driven_base(FREQ, DOF), 0.01, None)
    fit = fit_kd(motion, M, KDOptions(estimator="pinv"))
    assert {"unstable", "not_passive"} <= codes(fit)
    assert not fit.modes.stable
    assert fit.passive == (True, False)
    assert fit.modes.max_real_1_s == pytest.approx(1.094e5, rel=1e-3)
    held = fit_kd(motion, M)
    assert held.modes.stable
    assert held.passive == (True, True)
    assert "constraint_active" in codes(held)
    assert held.estimate.active


def test_implausible_numbers_are_told() -> None:
    motion = simulated_motion(M, 4.0 * K, 2.0 * D, DOF, FREQ, driven_base(FREQ, DOF), 0.01, None)
    assert "implausible_stiffness" in codes(fit_kd(motion, M))
    change = np.diag([1.0, 10.0, 10.0])
    big = simulated_motion(
        change @ M @ change,
        change @ K @ change,
        change @ D @ change,
        DOF,
        FREQ,
        driven_base(FREQ, DOF),
        0.01,
        None,
    )
    assert "implausible_inertia" in codes(fit_kd(big, change @ M @ change))


@pytest.mark.parametrize(("factor", "told"), [(1.0, False), (1e6, True), (0.1, True), (3.0, False)])
def test_masses_that_no_stapes_has_are_told(factor: float, told: bool) -> None:
    fit = fit_kd(paper_motion(), factor * M)
    assert ("implausible_mass" in codes(fit)) == told


def test_other_bodies_than_stapes_may_weigh_anything() -> None:
    motion = paper_motion()
    fit = fit_kd(replace(motion, bodies=("cube", "base")), 1e6 * M, KDOptions(structure="cube"))
    assert "implausible_mass" not in codes(fit)


def test_mass_without_uncertainty_is_told() -> None:
    assert "mass_uncertainty_not_given" in codes(fit_kd(paper_motion(), M))
    contributions = {"levels": 1e-30 * np.eye(10)}
    assert "mass_uncertainty_not_given" not in codes(
        fit_kd(six_dof_motion(0.01, 0), six_dof_mass(contributions))
    )


def test_outliers_are_told() -> None:
    motion = paper_motion(0.05, 1)
    q = motion.q.copy()
    q[0, 0, 50:55] *= 1.5
    fit = fit_kd(replace(motion, q=q), M, KDOptions(robust="t4"))
    assert "outliers" in codes(fit)
    assert np.abs(relative(fit.stiffness, K)).max() < 0.03


# --- principal axes --------------------------------------------------------------------------------------


def test_principal_axes_undo_a_shift_and_a_rotation() -> None:
    from legacy.stapeskit.frames import rotation_from_vector
    from legacy.stapeskit.spatial import twist_transfer

    diagonal = np.zeros((6, 6))
    diagonal[1, 1], diagonal[3, 3], diagonal[5, 5] = 1500.0, 1.2e-3, 3.1e-3
    origin, angle = np.array([0.2e-3, 0.0, -0.35e-3]), 0.3
    rotation = rotation_from_vector([0.0, angle, 0.0])
    transfer = twist_transfer(rotation.T, origin)
    stiffness = (transfer.T @ diagonal @ transfer)[np.ix_([1, 3, 5], [1, 3, 5])]
    found = principal_axes(stiffness)
    assert (found.origin_x_m, found.origin_z_m) == pytest.approx((0.2e-3, -0.35e-3))
    assert found.angle_rad == pytest.approx(angle)
    assert found.stiffness == pytest.approx([1500.0, 1.2e-3, 3.1e-3])


def test_principal_axes_take_the_axis_nearest_to_x() -> None:
    assert principal_axes(np.diag([1.0, 5.0, 2.0])).angle_rad == pytest.approx(0.0)
    assert principal_axes(np.diag([1.0, 5.0, 2.0])).stiffness == pytest.approx([1.0, 5.0, 2.0])


def test_principal_axes_need_a_positive_piston_stiffness() -> None:
    with pytest.raises(FittingError, match="the stiffness for principal axes must be 3x3"):
        principal_axes(np.diag([-1.0, 1.0, 1.0]))


# --- small pieces ----------------------------------------------------------------------------------------


def test_parameter_vector_round_trip_and_names() -> None:
    assert entry_names(2) == ("K11", "K12", "K22", "D11", "D12", "D22")
    stiffness, damping = split(join(K, D), 3)
    assert np.array_equal(stiffness, K)
    assert np.array_equal(damping, D)
    assert entry_units(("y", "alpha")) == [["N/m", "N"], ["N", "N m/rad"]]
