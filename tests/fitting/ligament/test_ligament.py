"""The joint fit with the plane of the ligament, on rings of springs that other code simulates."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.ring_ears import PISTON, EarSettings, SimulatedEar, ear, frame_change
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.kd_fit import KDFit
from legacy.fitting.ligament.inplane_stiffness import INPLANE_DOF
from legacy.fitting.ligament.joint_covariance import joint_covariance
from legacy.fitting.ligament.joint_fit import equation_error_start, expand
from legacy.fitting.ligament.joint_lines import _maps, joint_lines
from legacy.fitting.model.observation import observe_both
from legacy.fitting.model.parameter_vector import join
from legacy.fitting.montecarlo import monte_carlo
from legacy.fitting.options import KDOptions
from legacy.fitting.report.kd_json import kd_json
from legacy.fitting.report.sections import kd_page
from legacy.stapeskit.records.mass_record import MassMatrix

BLOCK = np.ix_(PISTON, PISTON)
INPLANE = np.ix_((0, 2, 4), (0, 2, 4))
BARE = KDOptions(bands=0)
EXACT = EarSettings(height_mm=0.1, noise=1e-7, tilt_sd_deg=0.0, lines=60, shared=False)


def drawn(settings: EarSettings, seed: int = 0) -> SimulatedEar:
    return ear(settings, np.random.default_rng(seed))


def fitted(case: SimulatedEar, options: KDOptions = BARE) -> KDFit:
    fit = fit_kd(case.motion, case.mass, options)
    assert (fit.ligament is not None) == (options.inplane == "auto")
    return fit


def truth(case: SimulatedEar) -> np.ndarray:
    return join(case.stiffness[BLOCK], case.damping[BLOCK])


@pytest.mark.parametrize("height_mm", [0.0, 0.1, 0.3])
def test_exact_ring_gives_its_height_and_its_matrices_in_the_plane(height_mm: float) -> None:
    case = drawn(replace(EXACT, height_mm=height_mm, noise=1e-9))
    ligament = fitted(case).ligament
    assert ligament.height[0] == pytest.approx(1e-3 * height_mm, abs=1e-9)
    arm = frame_change(np.array([0.0, 1e-3 * height_mm, 0.0, 0.0, 0.0, 0.0]))
    back = np.linalg.inv(arm)
    for found, full in ((ligament.plane_stiffness, case.stiffness), (ligament.plane_damping, case.damping)):
        there = (back.T @ full @ back)[BLOCK]
        assert np.all(np.abs(found - there) < 1e-6 * np.sqrt(np.outer(np.diag(there), np.diag(there))))


def test_the_plane_of_a_tilted_ring_is_found() -> None:
    """Stiffness and damping of a tilted ring couple a little differently; the fit has one coupling."""
    case = drawn(replace(EXACT, tilt_sd_deg=2.0, noise=1e-6), 4)
    ligament = fitted(case).ligament
    exact = case.stiffness[np.ix_(PISTON, (0, 2, 4))] @ np.linalg.inv(case.stiffness[INPLANE])
    unit = np.array([[1.0, 1.0, 1e3], [1e-3, 1e-3, 1.0], [1e-3, 1e-3, 1.0]])
    assert np.all(np.abs(ligament.coupling - exact) < 0.002 * unit)


def test_matrices_about_the_footplate_centre_follow_through_the_stiffness_in_the_plane() -> None:
    case = drawn(replace(EXACT, noise=1e-4, lines=120), 2)
    fit = fitted(case)
    assert fit.ligament.inplane.determined
    sd = np.sqrt(np.diag(fit.covariance))
    assert np.all(np.abs(join(fit.stiffness, fit.damping) - truth(case)) < 4.0 * sd)
    added = fit.ligament.coupling @ fit.ligament.inplane.stiffness @ fit.ligament.coupling.T
    assert fit.stiffness == pytest.approx(fit.ligament.plane_stiffness + added)
    assert fit.ligament.inplane.stiffness[0, 0] == pytest.approx(case.stiffness[0, 0], rel=0.05)


def test_the_plane_does_not_depend_on_the_height_of_the_reference_point() -> None:
    """Motion and mass about a point 0.1 mm higher: the same K', and a plane 0.1 mm lower."""
    case = drawn(replace(EXACT, noise=1e-5), 1)
    lift = 1e-4
    change = frame_change(np.array([0.0, lift, 0.0, 0.0, 0.0, 0.0]))
    motion = replace(
        case.motion, q=case.motion.q @ change.T, covariance=change @ case.motion.covariance @ change.T
    )
    mass = case.mass.moved(np.eye(3), np.array([0.0, lift, 0.0]), "footplate_centre", "footplate")
    here, there = fitted(case).ligament, fitted(replace(case, motion=motion, mass=mass)).ligament
    assert there.height[0] == pytest.approx(here.height[0] - lift, abs=3e-8)
    size = np.sqrt(np.outer(np.diag(here.plane_stiffness), np.diag(here.plane_stiffness)))
    assert np.all(np.abs(there.plane_stiffness - here.plane_stiffness) < 1e-4 * size)


def test_a_mirrored_ear_gives_the_mirrored_matrices() -> None:
    """Mirror z: rotations about x and y turn round; K11, K22, K33 and the height stay."""
    case = drawn(EarSettings(noise=0.01, shared=False), 5)
    signs = np.array([1.0, 1.0, -1.0, -1.0, -1.0, 1.0])
    motion = replace(
        case.motion, q=case.motion.q * signs, covariance=case.motion.covariance * np.outer(signs, signs)
    )
    flip = np.array([1.0, 1.0, 1.0, -1.0, 1.0, 1.0, 1.0, 1.0, -1.0, -1.0])
    mass = MassMatrix("footplate_centre", "footplate", case.mass.parameters * flip)
    here, there = fitted(case), fitted(replace(case, motion=motion, mass=mass))
    turned = np.outer(signs[list(PISTON)], signs[list(PISTON)])
    sd = here.standard_deviation[0]
    assert np.all(np.abs(there.stiffness - here.stiffness * turned) < 1e-3 * sd)
    assert there.ligament.height[0] == pytest.approx(here.ligament.height[0], rel=1e-3)


def test_least_squares_of_the_equations_start_at_the_minimum_of_exact_data_from_anywhere() -> None:
    ligament = fitted(drawn(replace(EXACT, noise=1e-6))).ligament
    equations = ligament.equations
    wanted = ligament.joint.parameters[: equations.unknowns]
    far = np.concatenate([3.0 * wanted[: equations.entries], 0.0 * wanted[equations.entries :]])
    found = equation_error_start(ligament.lines, equations, far)
    assert np.abs(found - wanted).max() < 1e-3


def test_a_given_hessian_is_kept_and_the_rest_is_the_same() -> None:
    ligament = fitted(drawn(EarSettings(noise=0.02, lines=40), 3)).ligament
    lines, equations, at = ligament.lines, ligament.equations, ligament.joint.parameters
    whole = expand(lines, equations, 1.01 * at)
    cheap = expand(lines, equations, 1.01 * at, ligament.joint.at.hessian)
    assert cheap.hessian is ligament.joint.at.hessian
    assert cheap.value == whole.value
    assert np.array_equal(cheap.gradient, whole.gradient)


@pytest.mark.parametrize("law", ["viscous", "fractional"])
def test_gradient_and_hessian_are_derivatives_of_the_objective(law: str) -> None:
    case = drawn(EarSettings(noise=0.02, lines=40), 3)
    ligament = fitted(case, replace(BARE, damping=law)).ligament
    lines, equations, at = ligament.lines, ligament.equations, ligament.joint.parameters
    moved = at + 0.01 * np.random.default_rng(0).standard_normal(len(at))
    here = expand(lines, equations, moved)
    for place in [*range(equations.unknowns), equations.unknowns, len(at) - 1]:
        step = np.zeros(len(at))
        step[place] = 1e-6
        ends = [expand(lines, equations, moved + sign * step).value for sign in (1.0, -1.0)]
        slope = (ends[0] - ends[1]) / 2e-6
        assert slope == pytest.approx(
            here.gradient[place], rel=1e-4, abs=1e-3 * np.sqrt(here.hessian[place, place])
        )


def test_the_covariance_has_the_shared_errors_in_it_and_adds_up() -> None:
    case = drawn(EarSettings(noise=0.01), 6)
    fit = fitted(case)
    assert {"channel_noise", "position", "registration", "mass.density"} <= set(fit.budget.sources)
    assert sum(fit.budget.sources.values()) == pytest.approx(fit.covariance)
    known, spread = joint_covariance(fit.ligament.lines, fit.ligament.equations, fit.ligament.joint)
    assert np.linalg.eigvalsh(known / np.sqrt(np.outer(np.diag(known), np.diag(known))))[0] > 0.0
    assert np.all(np.diag(spread) >= np.diag(known) * (1.0 - 1e-9))
    scale = np.sqrt(np.diag(fit.budget.sources["mass.density"])[0]) / fit.stiffness[0, 0]
    assert scale == pytest.approx(0.02, rel=0.3)


def test_shared_errors_are_maps_of_the_motion() -> None:
    case = drawn(EarSettings(noise=0.01), 7)
    fit = fitted(case)
    both = observe_both(case.motion, "stapes", "base")
    lines = joint_lines(fit.problem, both)
    assert lines.rests is None
    assert lines.errors == both.shared_covariance.shape[0] + 4
    places = [place for place, name in enumerate(both.shared_names) if name.startswith("registration")]
    columns = [place for place, source in enumerate(lines.sources) if source == "registration"]
    unit = np.tile(lines.root_mass, 2) / fit.problem.scale.amplitude
    for place, column in zip(places, columns, strict=True):
        sd = np.sqrt(both.shared_covariance[place, place])
        wanted = both.shared_derivatives[place] * sd * unit
        moved = np.hstack(
            [lines.y[:, :6] @ lines.maps[0, :, :, column].T, lines.y[:, 6:] @ lines.maps[1, :, :, column].T]
        )
        assert np.abs(np.abs(moved) - np.abs(wanted)).max() < 1e-6 * np.abs(wanted).max()


def test_a_delay_is_not_laid_on_motion_that_is_noise() -> None:
    """Where bodies do not move in the plane, those columns are noise: a delay starts nothing there."""
    rng = np.random.default_rng(3)
    omega = np.linspace(0.3, 3.0, 120)
    y = np.zeros((120, 12), dtype=complex)
    y[:, 1::2] = 1.0 / (rng.uniform(0.5, 2.5, 6) + 0.1j - omega[:, None])
    y += 1e-3 * (rng.standard_normal((120, 12, 2)) @ [1.0, 1j])
    delays = 1e-2 * rng.standard_normal((12, 12)) * np.kron(np.eye(2), np.ones((6, 6)))
    gains = 1e-2 * rng.standard_normal((12, 12)) * np.kron(np.eye(2), np.ones((6, 6)))
    changes = np.array([y @ gains.T, -1j * omega[:, None] * (y @ delays.T)])
    maps, rests = _maps(y, omega, changes)
    for body, place in enumerate((slice(0, 6), slice(6, 12))):
        assert np.allclose(maps[body, :, :, 0], gains[place, place], atol=1e-9)
        assert np.allclose(maps[body, :, :, 1], -1j * omega.mean() * delays[place, place], atol=1e-9)
    away = omega - omega.mean()
    assert rests is not None
    assert not np.any(rests[:, :, 0])
    assert np.allclose(rests[:, :, 1], -1j * away[:, None] * (y @ delays.T), atol=1e-9)


def test_an_error_that_is_no_map_of_the_motion_is_kept_as_recorded() -> None:
    case = drawn(EarSettings(noise=0.01), 7)
    shared = case.motion.shared
    odd = shared.derivatives.copy()
    odd[0] *= np.exp(40.0 * np.linspace(0.0, 1.0, odd.shape[3]))[:, None] ** 0.2
    other = replace(case, motion=replace(case.motion, shared=replace(shared, derivatives=odd)))
    lines = joint_lines(fitted(case).problem, observe_both(other.motion, "stapes", "base"))
    assert lines.rests is not None
    assert np.any(lines.rests[:, :, 0])
    assert not np.any(lines.rests[:, :, 1:])


def test_other_models_stay_where_mass_motion_or_choice_ask_for_them() -> None:
    case = drawn(EarSettings(noise=0.01), 8)
    for options in ({"inplane": "load"}, {"inplane": "ignore"}):
        assert fitted(case, replace(BARE, **options)).ligament is None
    for options in ({"robust": "t4"}, {"estimator": "pinv"}, {"dof": ("y",)}):
        assert fit_kd(case.motion, case.mass, replace(BARE, **options)).ligament is None
    three = case.mass.matrix[BLOCK]
    assert fit_kd(case.motion, three, BARE).ligament is None


def test_the_result_holds_both_planes_and_what_the_plain_model_gives() -> None:
    case = drawn(EarSettings(noise=0.01), 9)
    fit = fitted(case)
    content = json.loads(json.dumps(kd_json(fit, {})))
    found = content["ligament"]
    assert found["height_interval_95_mm"][0] < found["height_mm"] < found["height_interval_95_mm"][1]
    assert found["coupling_columns"] == list(INPLANE_DOF)
    assert np.array(found["about_ligament_plane"]["stiffness_si"]) == pytest.approx(
        fit.ligament.plane_stiffness
    )
    alone = fit_kd(case.motion, case.mass, replace(BARE, inplane="ignore"))
    assert np.array(found["without_inplane_motion"]["stiffness_si"]) == pytest.approx(alone.stiffness)
    assert content["fit"]["chi2"] == pytest.approx(fit.ligament.chi2)
    headings = [section.heading for section in kd_page(fit, {}).sections]
    assert "Plane of the ligament" in headings


def test_laws_are_compared_with_the_plane_of_the_ligament() -> None:
    case = drawn(EarSettings(noise=0.01), 10)
    fit = fit_kd(case.motion, case.mass, replace(BARE, damping="compare"))
    assert fit.law.name == "viscous"
    assert fit.laws_alike == ()
    without = [one for one in fit.laws if one.ligament is None]  # a constant loss factor explains nothing
    assert [one.law.name for one in without] == ["hysteretic"]
    assert without[0].bic > 10.0 * fit.laws[0].bic


def test_monte_carlo_scatters_as_stated() -> None:
    fit = fitted(drawn(EarSettings(noise=0.01, lines=60), 11))
    found = monte_carlo(fit, 60, seed=1)
    assert found.failed == 0
    ratio = found.standard_deviation / np.sqrt(np.diag(fit.covariance))
    assert np.median(ratio) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize(("height_mm", "noise"), [(0.0, 0.01), (0.2, 0.01), (0.1, 0.03)])
def test_intervals_hold_on_a_few_ears_without_false_alarm(height_mm: float, noise: float) -> None:
    """Ten ears a case, all errors drawn: at most 12 % of 120 entries outside 95 % (p = 0.002), no misfit."""
    outside, alarms, off = [], 0, []
    for seed in range(10):
        case = drawn(EarSettings(height_mm=height_mm, noise=noise), 100 + seed)
        fit = fitted(case)
        deviation = (join(fit.stiffness, fit.damping) - truth(case)) / np.sqrt(np.diag(fit.covariance))
        outside.append(np.abs(deviation) > 1.96)
        off.append(deviation[5])
        alarms += "misfit" in [notice.code for notice in fit.notices]
    assert np.mean(outside) <= 0.12
    assert abs(np.mean(off)) < 1.0
    assert alarms == 0


def test_where_noise_leads_outside_the_plane_stays_in_the_model_and_k_and_d_are_held() -> None:
    """Two ears with 10 to 30 % noise: leaving the plane out made K22 wrong by 7.6 and 12.5 of its sd."""
    for number in (10, 74):
        rng = np.random.default_rng([1, 2, number])
        noise = float(np.exp(rng.uniform(*np.log((0.1, 0.3)))))
        case = ear(EarSettings(0.1, noise, lines=int(rng.integers(30, 120))), rng)
        fit = fitted(case)
        assert fit.estimate.active
        assert fit.estimate.converged
        assert fit.passive == (True, True)
        assert not fit.fluid.used
        assert np.all(
            np.abs(join(fit.stiffness, fit.damping) - truth(case)) < 3.5 * np.sqrt(np.diag(fit.covariance))
        )
        free = expand(fit.ligament.lines, fit.ligament.equations, fit.ligament.joint.parameters).gradient
        assert np.abs(free[12:]).max() < 1e-2
