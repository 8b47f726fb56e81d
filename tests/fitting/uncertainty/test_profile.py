"""Profile likelihood intervals: those of Fisher where data are good, better ones where they are weak."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.model.parameter_vector import join
from legacy.fitting.options import KDOptions
from legacy.fitting.report.sections import kd_sections
from legacy.fitting.uncertainty.covariance import chi2, known_and_spread
from legacy.fitting.uncertainty.profile import QUANTILE_95, profile_intervals
from tests.fitting.cases import D, K, M, paper_motion

TRUTH = join(K, D)


def test_good_data_need_no_profile_and_would_have_the_same() -> None:
    fit = fit_kd(paper_motion(0.02, 0), M)
    assert fit.profile is None
    ends = profile_intervals(fit.lines, fit.estimate, fit.problem.options, fit.budget.widened)
    ends = ends * fit.problem.units[:, None]
    assert ends == pytest.approx(fit.intervals, rel=5e-3)


def test_ends_raise_chi2_by_the_quantile() -> None:
    """At an end no other choice of the remaining entries brings chi2 below its minimum plus the quantile.

    The quantile stands for the spread of an estimate whose regressor is noisy.
    """
    from scipy.optimize import minimize

    fit = fit_kd(paper_motion(0.30, 3, 30), M)
    assert fit.profile is not None
    lines, place = fit.lines, 7
    known, spread = known_and_spread(fit.estimate.parameters, lines, fit.chi2 / fit.n_dof)
    inverse = np.linalg.inv(known)
    feigned = (inverse @ spread @ inverse)[place, place] / inverse[place, place]
    assert 1.0 < feigned < 2.0
    for end in fit.profile[place] / fit.problem.units[place]:
        others = [index for index in range(12) if index != place]

        def level(values: np.ndarray, end: float = end, others: list[int] = others) -> float:
            parameters = np.empty(12)
            parameters[others], parameters[place] = values, end
            return chi2(parameters, lines)

        start = fit.estimate.parameters[others]
        found = minimize(level, start, method="BFGS")
        rise = (found.fun - fit.chi2) / fit.budget.widened
        assert rise == pytest.approx(QUANTILE_95 * feigned, rel=0.03)


def test_coverage_of_weak_data() -> None:
    hits = []
    for seed in range(25):
        fit = fit_kd(paper_motion(0.30, seed, 30), M)
        assert fit.profile is not None
        low, high = fit.intervals.T
        hits.append((low <= TRUTH) & (high >= TRUTH))
    assert 0.88 < np.mean(hits) < 0.985


def test_page_shows_the_intervals() -> None:
    fit = fit_kd(paper_motion(0.30, 0, 30), M)
    text = "".join(str(block) for section in kd_sections(fit) for block in section.blocks)
    assert "profile" in text
    assert fit_kd(paper_motion(0.30, 0, 30), M, KDOptions(estimator="irls")).profile is None
