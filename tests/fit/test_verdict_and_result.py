"""The one verdict, what a result says of itself, the plan's promise, repetitions that check intervals."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fitting import entries
from fitting.dof2kd import dof2kd
from fitting.montecarlo import scatter
from fitting.plan import Plan, expect, stated_mass
from fitting.planned_motion import planned_motion
from fitting.report.figures import footplate_figure, responses
from fitting.report.page import _modes
from fitting.verdict import judge, unused_codes
from stapeskit.records.mass_matrix import MassMatrix
from stapeskit.report.quantities import HERTZ, Quantity
from stapeskit.warnings import Notice
from tests.fit.fit_cases import DOF, D, M, codes, drawn, fit, paper_motion, ring_ear, with_outline


@pytest.fixture(scope="module")
def ear():
    made = ring_ear(21, lines=60)
    return made, fit(made.motion, made.mass)


def test_reasons_are_by_weight_and_causes_come_before_what_they_make():
    listed = [
        Notice(code, "") for code in ("misfit", "weak_identifiability", "cause_found", "frequency_dependent")
    ]
    verdict = judge(listed)
    assert verdict.level == "do not use"  # misfit and frequency_dependent together
    assert [reason.code for reason in verdict.reasons] == [
        "cause_found", "frequency_dependent", "misfit", "weak_identifiability",
    ]  # fmt: skip
    assert [reason.follows_from for reason in verdict.reasons] == [
        "",
        "cause_found",
        "cause_found",
        "cause_found",
    ]
    assert judge(listed, apart=["weak_identifiability"]).reasons[-1].follows_from == ""
    assert verdict.sentence == "do not use: cause_found"
    misread = judge([*listed, Notice("phase_convention", "")])
    assert misread.reasons[0].code == "phase_convention"
    assert all(reason.follows_from == "phase_convention" for reason in misread.reasons[1:])
    nothing = judge([notice for notice in listed if notice.code != "cause_found"])
    assert nothing.sentence == "do not use: frequency_dependent, misfit"
    channel = judge([Notice("misfit", ""), Notice("channel_sign", "")])
    assert [reason.follows_from for reason in channel.reasons] == ["", "channel_sign"]
    corrected = judge([Notice("misfit", ""), Notice("channel_sign", ""), Notice("corrected", "")])
    assert not any(reason.follows_from for reason in corrected.reasons)
    neglected = judge([*listed, Notice("inplane_neglected", "")])
    assert neglected.sentence == "do not use: inplane_neglected"
    assert all(reason.follows_from == "inplane_neglected" for reason in neglected.reasons[1:])
    alone = judge([Notice("misfit", ""), Notice("cause_found", "")])
    assert alone.level == "check"
    assert [reason.code for reason in alone.reasons] == ["cause_found", "misfit"]


def test_information_does_not_lower_a_verdict_and_nothing_is_believe():
    assert judge([]).level == judge([Notice("file_read", "")]).level == "believe"
    assert judge([Notice("some_new_code", "")]).level == "check"


def test_confirmed_warnings_are_listed_and_no_longer_count():
    notices = [Notice("handedness_unconfirmed", ""), Notice("misfit", "")]
    verdict = judge(notices, confirmed=["handedness"])
    assert verdict.confirmed == ("handedness_unconfirmed",)
    assert [reason.code for reason in verdict.reasons] == ["misfit"]
    assert judge(notices, confirmed=["handedness", "misfit"]).level == "believe"
    assert judge(notices, unused=["handedness_unconfirmed"]).confirmed == ()


def test_warnings_about_what_a_motion_does_not_use_do_not_count():
    notices = [Notice("handedness_unconfirmed", ""), Notice("plate_not_found", "")]
    for frames, level in ((["scan"], "believe"), (["plate"], "check"), (["plate", "scan"], "check")):
        assert judge(notices, unused=unused_codes({"registered_in": frames})).level == level


def test_json_summary_and_verdict_say_the_same(ear):
    _, result = ear
    content = result.content()
    assert content["verdict"]["sentence"] == dict(result.summary())["verdict"] == result.verdict.sentence
    assert result.verdict.sentence in repr(result)
    assert result.plot().axes
    text = json.dumps(content, allow_nan=False)
    assert json.loads(text)["schema"] == "stapeskit.kd/1"
    needed = (
        "dof", "model", "estimator", "stiffness_si", "stiffness_sd_si", "damping_si", "damping_sd_si",
        "noise_only_sd_si", "covariance_si", "parameters", "verdict", "budget", "stable",
        "max_real_eigenvalue_1_s",
        "passive", "modes", "overdamped_roots_1_s", "principal_axes", "fit", "identifiability", "warnings",
        "provenance",
    )  # fmt: skip
    assert not [key for key in needed if key not in content]


def test_json_has_intervals_and_what_was_left_out():
    result = fit(paper_motion(0.02, 1, 40)[0], M, exclude_hz=[[900.0, 1100.0]], monte_carlo=2)
    content = result.content()
    assert content["monte_carlo"]["refits"] == 2
    assert content["model"]["excluded_hz"] == [[900.0, 1100.0]]
    low, high = content["intervals_95_si"]["K11"]
    assert low < content["stiffness_si"][0][0] - content["stiffness_sd_si"][0][0]
    assert high > content["stiffness_si"][0][0] + content["stiffness_sd_si"][0][0]


def test_sources_and_bound_agree_with_the_whole(ear):
    _, result = ear
    variance = np.diag(result.covariance)
    assert np.all(np.diag(result.noise_covariance) < variance * (1.0 + 1e-6))
    assert np.all(result.bound**2 < variance * 1.02)
    assert np.all(result.bound > 0.3 * np.sqrt(variance))  # of this model: not that of a plane known exactly
    for source, part in result.budget.items():
        if source != "ligament_plane":
            assert np.all(np.diag(part) > -0.05 * variance), source
    relative = np.sqrt(np.diag(result.budget["mass.density"]))[0] / result.stiffness[0, 0]
    assert relative == pytest.approx(0.02, rel=0.1)


def test_density_sd_reaches_k_and_no_mode_and_no_response(ear):
    made, result = ear
    exact = fit(made.motion, MassMatrix(made.mass.parameters))
    grown = result.covariance[0, 0] - exact.covariance[0, 0]
    assert np.sqrt(grown) / result.stiffness[0, 0] == pytest.approx(0.02, rel=0.1)
    assert result.derived.frequency_sd_hz == pytest.approx(exact.derived.frequency_sd_hz, rel=0.1)
    bands = [responses(one).simulated_sd for one in (result, exact)]
    assert bands[0] == pytest.approx(bands[1], rel=0.1)


def test_repetitions_scatter_as_the_intervals_say(ear):
    _, result = ear
    reported = []
    found = scatter(result, 6, report=lambda text, _: reported.append(text))
    ratio = found.standard_deviation / np.sqrt(np.diag(result.covariance))
    assert found.failed == 0
    assert np.median(ratio) < 1.5
    assert np.median(ratio) > 0.55
    assert len(reported) == 1
    assert "6 repetitions, about" in reported[0]  # after the first of them


# What is stated of K22 scatters by a fifth from measurement to measurement, with how well the plane is found.
def test_the_plan_promises_what_a_fit_of_its_own_simulated_motion_states():
    plan = Plan.of(lines=40, cone_deg=20.0)
    fits = expect(plan)
    promised = fits["as planned"]
    source = stated_mass(plan)
    mass = source.matrix
    stated, modes = [], []
    for seed in range(16):  # the median of so many scatters by 5 %
        motion = drawn(planned_motion(plan, mass), np.random.default_rng(seed))
        result = fit(motion, source)
        own = np.diag(result.covariance - result.model_error @ result.model_error.T)
        stated.append(np.sqrt(own / np.diag(promised.covariance)))
        modes.append(result.derived.frequency_sd_hz / promised.derived.frequency_sd_hz)
    assert np.median(stated, axis=0) == pytest.approx(np.ones(12), abs=0.1)
    assert np.median(modes, axis=0) == pytest.approx(np.ones(3), abs=0.1)
    quiet = fits["half the noise (4 times the averages)"]
    assert np.all(quiet.relative_sd <= promised.relative_sd * 1.02)


def test_weak_data_are_called_undetermined():
    result = fit(paper_motion(1.5, 3, 20)[0], M)
    assert result.verdict.level == "do not use"
    assert "undetermined" in {reason.code for reason in result.verdict.reasons}
    assert any("undetermined" in text for _, text in result.summary())


def test_no_interval_of_a_mode_reaches_below_zero():
    low, high = Quantity(500.0, 300.0, HERTZ, positive=True).limits
    assert low > 0.0
    assert low * high == pytest.approx(500.0**2)
    assert Quantity(500.0, 900.0, HERTZ, positive=True).limits is None
    page_text = str(_modes(fit(paper_motion(1.5, 4, 20)[0], M))[0])
    assert "95 % interval -" not in page_text
    assert "undetermined" in page_text


def test_damping_below_its_standard_deviation_is_a_reason_to_check():
    result = fit(paper_motion(0.5, 3, 20, damping=0.03 * D)[0], M)
    sds = np.diag(result.standard_deviation[1])
    lost = [name for name, far in zip(DOF, sds > np.abs(np.diag(result.damping)), strict=True) if far]
    assert lost
    assert result.verdict.level == "check"
    reasons = [reason.text for reason in result.verdict.reasons if reason.text.startswith("Undetermined")]
    assert [all(f"D({name})" in text for name in lost) for text in reasons] == [True]


def test_warnings_travel_with_motion():
    motion, _ = paper_motion(0.02, 1, 40)
    told = replace(motion, notices=(Notice("conjugated_laser", "One laser."),))
    result = fit(told, M)
    assert "conjugated_laser" in codes(result)
    assert result.dof == DOF


def test_standard_deviations_of_modes_are_those_of_draws_of_k_and_d(ear):
    """The mass is exact: eigenvalues of 4000 normal draws, which know a standard deviation to 1 %."""
    made, _ = ear
    result = fit(made.motion, MassMatrix(made.mass.parameters))
    rng = np.random.default_rng(2)
    size = np.sqrt(np.diag(result.covariance))
    root = np.linalg.cholesky(result.covariance / np.outer(size, size))
    draws = result.values + size * (rng.standard_normal((4000, len(size))) @ root.T)
    stiffness, damping = entries.split(draws, 3)
    whole = np.zeros((4000, 6, 6))
    whole[:, :3, 3:] = np.eye(3)
    whole[:, 3:, :3] = -np.linalg.solve(result.mass, stiffness)
    whole[:, 3:, 3:] = -np.linalg.solve(result.mass, damping)
    values = np.linalg.eigvals(whole)
    frequencies = np.sort(np.where(values.imag > 0.0, values.imag, np.inf), axis=1)[:, :3] / (2.0 * np.pi)
    found = 0.7413 * np.subtract(*np.percentile(frequencies, [75, 25], axis=0))
    assert result.derived.frequency_sd_hz == pytest.approx(found, rel=0.07)


def test_principal_axes_are_drawn_with_and_without_an_outline(ear):
    """The mass matrix of a CSV file knows no footplate (paper, Fig. 6)."""
    result = ear[1]
    outline = np.array([[-1.4, -0.6], [1.4, -0.6], [1.4, 0.6], [-1.4, 0.6]])
    for shape in (None, outline):
        (axes,) = footplate_figure(with_outline(result, shape)).axes
        assert len([line for line in axes.lines if len(line.get_xdata()) == 2]) == 2


def test_a_result_of_points2dof_brings_its_mass():
    motion, _ = paper_motion(0.02, 1)
    brought = dof2kd(SimpleNamespace(motion=motion, mass=M), mass=None, unknowns="none")
    given = dof2kd(motion, mass=M, unknowns="none")
    assert np.array_equal(brought.stiffness, given.stiffness)
