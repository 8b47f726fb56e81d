"""Covariates: coded alike for all ears, removed from laws, refused where an ear lacks one."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from legacy.pipeline.cohort.compare_ears import Ear
from legacy.pipeline.cohort.covariates import covariates_of
from legacy.pipeline.cohort.log_pairs import LogPairs
from legacy.pipeline.cohort.power_law import fit_law
from legacy.pipeline.cohort.prediction import Predictor, left_out
from legacy.pipeline.errors import PipelineError


def ears(**columns):
    n = len(next(iter(columns.values())))
    return [
        Ear(f"ear {k}", f"ear{k}", "left", {}, {}, {name: values[k] for name, values in columns.items()})
        for k in range(n)
    ]


def test_numbers_are_scaled_and_groups_have_columns():
    coded = covariates_of(ears(age=[20, 40, 60, 80], sex=["f", "m", "m", "f"]), ["age", "sex"])
    assert coded.columns.mean(axis=0) == pytest.approx([0.0, 0.0])
    assert np.std(coded.columns[:, 0], ddof=1) == pytest.approx(1.0)
    assert np.ptp(coded.columns[:, 1]) == 1.0
    assert coded.of_ear({"age": 50, "sex": "f"}) == pytest.approx([0.0, -0.5])


@pytest.mark.parametrize(
    ("columns", "names"),
    [
        ({"age": [20, None, 60, 80]}, ["age"]),
        ({"age": [20, "old", 60, 80]}, ["age"]),
        ({"age": [50, 50, 50, 50]}, ["age"]),
        ({"id": ["a", "b", "c", "d"]}, ["id"]),
        ({"age": [20, 40, 60, 81]}, ["side"]),
        ({"age": [20, 40, 60, 80], "days": [2, 4, 6, 8]}, ["age", "days"]),
    ],
)
def test_covariates_that_cannot_be_used_are_refused(columns, names):
    with pytest.raises(PipelineError) as refused:
        covariates_of(ears(**columns), names)
    assert "covariate" in refused.value.faults[0].thing


def test_a_further_ear_needs_known_covariates():
    coded = covariates_of(ears(sex=["f", "m", "m", "f"]), ["sex"])
    for about in ({}, {"sex": "x"}):
        with pytest.raises(PipelineError):
            coded.of_ear(about)


@pytest.fixture
def confounded():
    """Return ears whose ln x and ln y both follow a covariate: without it the exponent is another."""
    rng = np.random.default_rng(3)
    z = rng.standard_normal((30, 1))
    z -= z.mean()
    x = 0.2 * z[:, 0] + 0.1 * rng.standard_normal(30)
    y = 1.5 * x - 1.0 * z[:, 0] + 0.1 * rng.standard_normal(30)
    return LogPairs(x, y, np.zeros((30, 2, 2)), covariates=z)


def test_without_measurement_errors_a_law_with_covariates_is_multiple_regression(confounded):
    law = fit_law(confounded)
    design = np.column_stack([np.ones(30), confounded.x, confounded.covariates])
    effects, square, *_ = np.linalg.lstsq(design, confounded.y)
    se = np.sqrt(square[0] / 27 * np.linalg.inv(design.T @ design)[1, 1])
    reach = stats.t.ppf(0.975, 27) * se
    assert law.exponent == pytest.approx(effects[1], rel=1e-4)
    assert law.interval == pytest.approx((effects[1] - reach, effects[1] + reach), rel=1e-3)
    assert fit_law(replace(confounded, covariates=np.zeros((30, 0)))).interval[1] < 0.0


def test_predictions_follow_the_covariates_of_an_ear(confounded):
    predictor = Predictor(confounded)
    at = [predictor.predict(0.0, covariates=np.array([z])).median for z in (-1.0, 1.0)]
    assert at[1] - at[0] == pytest.approx(-2.0, abs=0.2)
    few = LogPairs(
        confounded.x[:12], confounded.y[:12], confounded.own[:12], covariates=confounded.covariates[:12]
    )
    assert np.std(left_out(few).errors) < 0.25


def test_leaving_out_many_knows_the_covariates(confounded, monkeypatch):
    refitted = left_out(confounded).errors
    monkeypatch.setattr("legacy.pipeline.cohort.prediction._REFITTED", 1)
    assert left_out(confounded).errors == pytest.approx(refitted, abs=0.05)
