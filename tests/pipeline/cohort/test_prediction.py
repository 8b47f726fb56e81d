"""Predictions of further ears, and what leaving one person out costs."""

import numpy as np
import pytest
from scipy import stats

from legacy.pipeline.cohort.prediction import Predictor, left_out
from tests.pipeline.cohort.simulated import cohort


def test_with_many_exact_ears_it_is_the_law_and_its_scatter():
    rng = np.random.default_rng(1)
    pairs, _ = cohort(rng, 400, error=(0.0, 0.0, 0.0))
    line = stats.linregress(pairs.x, pairs.y)
    left = float(np.std(pairs.y - line.intercept - line.slope * pairs.x, ddof=2))
    found = Predictor(pairs).predict(0.1)
    middle = line.intercept + 0.1 * line.slope
    assert found.median == pytest.approx(middle, abs=0.01)
    assert np.diff(found.interval)[0] == pytest.approx(2 * 1.96 * left, rel=0.05)


def test_predictions_cover_further_ears():
    rng = np.random.default_rng(2)
    inside = 0
    for _ in range(30):
        pairs, (x, y) = cohort(rng, 10)
        low, high = Predictor(pairs).predict(x + 0.05 * rng.standard_normal(), 0.05**2).interval
        inside += low <= y <= high
    assert inside >= 25


def test_an_error_of_the_ear_widens_its_prediction():
    pairs, _ = cohort(np.random.default_rng(3), 20)
    predictor = Predictor(pairs)
    widths = [np.diff(predictor.predict(0.0, v, s).interval)[0] for v, s in ((0, 0), (0.01, 0), (0.01, 0.04))]
    assert widths[0] < widths[1] < widths[2]
    low, high = predictor.tolerance()
    assert high - low > widths[0]
    wide = predictor.tolerance(0.04)
    assert wide[0] < low < high < wide[1]


def test_leaving_out_many_and_few_agree(monkeypatch):
    pairs, _ = cohort(np.random.default_rng(4), 24)
    refitted = left_out(pairs).errors
    monkeypatch.setattr("legacy.pipeline.cohort.prediction._REFITTED", 1)
    assert left_out(pairs).errors == pytest.approx(refitted, abs=0.15)
    assert np.std(refitted) > 0.15
