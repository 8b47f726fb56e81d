"""The contract that every entry of the tables of estimators and damping laws fulfils."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.fitting.cli import parser
from legacy.fitting.estimators import ESTIMATORS, estimator
from legacy.fitting.estimators.base import Method
from legacy.fitting.fit_kd import KDOptions, fit_kd
from legacy.fitting.model.damping import DampingLaw
from legacy.fitting.model.laws import LAWS, law_of
from tests.fitting.cases import K, M, damping_for, paper_motion


@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_estimator_recovers_exact_data_and_has_help(name: str) -> None:
    method = estimator(name)
    assert isinstance(method, Method)
    fit = fit_kd(paper_motion(1e-4, None, 60), M, KDOptions(estimator=name, bands=0))
    assert np.allclose(fit.stiffness, K, rtol=1e-6, atol=1e-6 * np.sqrt(np.outer(np.diag(K), np.diag(K))))
    assert f"{name}: {ESTIMATORS[name]}" in " ".join(parser().format_help().split())


@pytest.mark.parametrize("name", ESTIMATORS)
def test_scores_of_every_estimator_sum_to_its_gradient_and_vanish(name: str) -> None:
    fit = fit_kd(paper_motion(0.02, 3, 60), M, KDOptions(estimator=name, bands=0))
    problem, lines, at = fit.problem, fit.lines, fit.estimate.parameters
    scores = problem.method.scores(at, lines, problem.options)
    assert np.allclose(scores.sum(axis=0), problem.gradient(at, lines), atol=1e-6 * np.abs(scores).sum())
    typical = np.abs(scores).sum(axis=0)
    if name != "irls":
        assert np.all(np.abs(scores.sum(axis=0)) < 1e-3 * typical)


@pytest.mark.parametrize("name", [name for name in ESTIMATORS if estimator(name).bounded])
def test_an_estimator_that_takes_bounds_keeps_to_them(name: str) -> None:
    motion, lower = paper_motion(0.02, 3, 60), 1.1 * float(K[0, 0])
    fit = fit_kd(motion, M, KDOptions(estimator=name, bands=0, lower={"K11": lower}))
    assert fit.stiffness[0, 0] >= lower * (1.0 - 1e-9)
    assert "constraint_active" in [notice.code for notice in fit.notices]
    upper = -1e-3 * float(np.sqrt(K[0, 0] * K[1, 1]))
    off = KDOptions(estimator=name, bands=0, upper={"K11": 0.9 * float(K[0, 0]), "K12": upper})
    bound = fit_kd(motion, M, off).stiffness
    assert bound[0, 0] <= 0.9 * float(K[0, 0]) * (1.0 + 1e-9)
    assert bound[0, 1] <= upper * (1.0 - 1e-9)


@pytest.mark.parametrize("name", [name for name in ESTIMATORS if estimator(name).bounded])
def test_an_estimator_that_takes_bounds_keeps_to_its_constraint(name: str) -> None:
    few = paper_motion(0.6, 3, 8)
    free, kept = (
        fit_kd(few, M, KDOptions(estimator=one, bands=0, constraint=constraint))
        for one, constraint in (("pinv", "eigenvalues"), (name, "psd"))
    )
    assert not all(free.passive)
    assert all(kept.passive)


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("unknown", [1e-6, 6e-5, 0.3])
def test_unknowns_of_every_law_are_those_that_were_given(name: str, unknown: float) -> None:
    law = DampingLaw(name, unknown)
    if law_of(name).time_power is None and law.estimated and unknown < 1e-3:
        return  # an exponent keeps away from zero
    same = law.with_unknowns(law.unknowns)
    assert same.exponent == law.exponent
    assert same.ratio == pytest.approx(law.ratio, rel=1e-12)


@pytest.mark.parametrize("name", LAWS)
def test_every_law_is_recovered_from_exact_data_and_has_help(name: str) -> None:
    law = DampingLaw(name, 0.6).scaled(1.0 / (2.0 * np.pi * 2000.0))
    fit = fit_kd(paper_motion(1e-4, None, 60, law), M, KDOptions(damping=name, bands=0))
    scale = np.sqrt(np.outer(np.diag(K), np.diag(K)))
    assert np.all(np.abs(fit.stiffness - K) < 1e-5 * scale)
    assert np.allclose(np.diag(fit.damping), np.diag(damping_for(law)), rtol=1e-4)
    assert fit.law.name == name
    assert len(fit.law.unknowns) == bool(law_of(name).search) + bool(law_of(name).ratios)
    assert f"{name}: {LAWS[name]}" in " ".join(parser().format_help().split())


@pytest.mark.parametrize("name", LAWS)
def test_every_law_continues_its_factor_from_the_imaginary_axis(name: str) -> None:
    law = DampingLaw(name, 0.6)
    omega = np.array([0.3, 1.0, 7.0])
    assert np.allclose([law.at(1j * w) for w in omega], law.factor(omega), rtol=1e-12)
    assert len(law.slopes(omega)) == len(law.unknowns)
    for step, slope in zip(1e-6 * np.eye(len(law.unknowns)), law.slopes(omega), strict=True):
        ends = [law.with_unknowns(law.unknowns + sign * step).factor(omega) for sign in (1, -1)]
        assert np.allclose((ends[0] - ends[1]) / 2e-6, slope, rtol=1e-7)
