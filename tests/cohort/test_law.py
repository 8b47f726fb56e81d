"""Exponents of laws: exact where least squares is, covering where both quantities have errors."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from pipeline.cohort.law import LogPairs, Profile, fit_law, scatter_interval
from pipeline.cohort.predict import left_out
from tests.cohort.simulated_pairs import cohort


def law_of(pairs):
    return fit_law(pairs)[0]


@pytest.mark.parametrize("n", [5, 8, 40])
def test_without_measurement_errors_it_is_least_squares(n):
    pairs, _ = cohort(np.random.default_rng(n), n, error=(0.0, 0.0, 0.0))
    law, line = law_of(pairs), stats.linregress(pairs.x, pairs.y)
    reach = stats.t.ppf(0.975, n - 2) * line.stderr
    assert law.exponent == pytest.approx(line.slope, rel=1e-5)
    assert law.interval == pytest.approx((line.slope - reach, line.slope + reach), rel=1e-4, abs=1e-4)
    assert law.p_value == pytest.approx(line.pvalue, rel=1e-4)
    assert law.intercept == pytest.approx(line.intercept, abs=1e-6)
    left = np.sum((pairs.y - line.intercept - line.slope * pairs.x) ** 2)
    ends = np.sqrt(left / stats.chi2.ppf([0.975, 0.025], n - 2))
    assert law.sigma_interval == pytest.approx(tuple(ends), rel=1e-3)
    assert law.tau == pytest.approx(np.std(pairs.x, ddof=1), rel=1e-5)


def test_errors_that_are_alike_in_all_ears_are_subtracted_from_the_sample_covariance():
    pairs, _ = cohort(np.random.default_rng(6), 30)
    law, own = law_of(pairs), pairs.own[0]
    true = np.cov(pairs.x, pairs.y) - own
    slope = true[0, 1] / true[0, 0]
    assert law.tau == pytest.approx(np.sqrt(true[0, 0]), rel=1e-4)
    assert law.exponent == pytest.approx(slope, rel=1e-4)
    assert law.sigma == pytest.approx(np.sqrt(true[1, 1] - slope**2 * true[0, 0]), rel=1e-4)
    assert law.reliability == pytest.approx(true[0, 0] / np.var(pairs.x, ddof=1), rel=1e-4)
    residual = pairs.y - law.exponent * pairs.x
    error = own[1, 1] - 2.0 * law.exponent * own[0, 1] + law.exponent**2 * own[0, 0]
    ends = 29 * np.var(residual, ddof=1) / stats.chi2.ppf([0.975, 0.025], 28) - error
    assert law.sigma_interval == pytest.approx(tuple(np.sqrt(ends)), rel=1e-3)


def test_scatter_that_ears_of_a_person_share_counts_by_sum_and_difference():
    """The sum of two ears with the correlation rho has 1 + rho, their difference 1 - rho of the variance."""
    pairs, _ = cohort(np.random.default_rng(8), 12, error=(0.0, 0.0, 0.0), pairs=0.5)
    rho, residual = 0.4, (pairs.y - 1.5 * pairs.x).reshape(-1, 2)
    total, apart = residual.sum(axis=1) / np.sqrt(2.0), np.diff(residual, axis=1) / np.sqrt(2.0)
    square = np.sum((total - total.mean()) ** 2) / (1.0 + rho) + np.sum(apart**2) / (1.0 - rho)
    ends = np.sqrt(square / stats.chi2.ppf([0.975, 0.025], pairs.degrees))
    assert scatter_interval(pairs, 1.5, rho=rho) == pytest.approx(tuple(ends), rel=1e-4)


def test_an_error_that_all_ears_share_changes_nothing():
    pairs, _ = cohort(np.random.default_rng(2), 12)
    factor = np.ones((12, 2, 1)) * [[0.4], [0.7]]
    plain = law_of(pairs)
    shared = law_of(replace(pairs, shared=factor))
    moved = law_of(pairs.shifted(-3.0, 2.0))
    for other in (shared, moved):
        assert other.exponent == pytest.approx(plain.exponent, abs=1e-6)
        assert other.interval == pytest.approx(plain.interval, abs=1e-5)
        assert other.p_value == pytest.approx(plain.p_value, abs=1e-6)
        assert other.sigma == pytest.approx(plain.sigma, rel=1e-4)


def test_units_and_orders_of_ears_do_not_matter():
    pairs, _ = cohort(np.random.default_rng(3), 10, pairs=0.5)
    order = np.random.default_rng(4).permutation(10)
    one, other = law_of(pairs), law_of(pairs.select(order))
    assert other.interval == pytest.approx(one.interval, rel=1e-5)
    assert other.rho == pytest.approx(one.rho, abs=1e-3)


def test_a_predictor_that_is_all_error_leaves_the_exponent_open():
    pairs, _ = cohort(np.random.default_rng(6), 10, tau=0.0, error=(0.1, 0.05, 0.0))
    law = law_of(pairs)
    assert law.unbounded
    assert law.reliability < 0.6


@pytest.mark.parametrize(
    ("count", "scene"),
    [(80, {"n": 8}), (50, {"batches": 0.1}), (30, {"pairs": 0.6})],
    ids=["8 ears", "scanners", "pairs"],
)
def test_intervals_cover(count, scene):
    """The p-value of the true exponent is uniform: an interval is where it exceeds 5 %."""
    rng = np.random.default_rng(7)
    p_values, covered = [], 0
    for _ in range(count):
        pairs, _ = cohort(rng, **scene)
        profile = Profile(pairs.shifted(pairs.x.mean(), pairs.y.mean()))
        p_values.append(profile.p_value(1.5))
        low, high = scatter_interval(pairs, float(profile.best[1]))
        covered += low <= 0.2 <= high
    assert stats.kstest(p_values, "uniform").pvalue > 0.01
    least = stats.binom.ppf(0.005, count, 0.95)
    assert np.sum(np.array(p_values) > 0.05) >= least
    assert covered >= least


def test_the_interval_is_where_the_p_value_exceeds_5_percent():
    pairs, _ = cohort(np.random.default_rng(8), 12)
    profile = Profile(pairs.shifted(pairs.x.mean(), pairs.y.mean()))
    for end in law_of(pairs).interval:
        assert profile.p_value(end) == pytest.approx(0.05, abs=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_a_second_ear_of_each_person_makes_no_ear_unlike_the_others(seed):
    """Ears of a person that are alike say nothing new of the scatter between persons."""
    rng, person = np.random.default_rng(seed), np.repeat(np.arange(7), 2)
    one, _ = cohort(rng, 7, error=(0.0, 0.0, 0.0))
    one = LogPairs(one.x, one.y, one.own + 1e-8 * np.eye(2), one.shared, one.subject)
    x, y = (values[person] + 0.01 * rng.normal(size=14) for values in (one.x, one.y))
    both = LogPairs(x, y, one.own[person], one.shared[person], person)
    alone, paired = (left_out(pairs, fit_law(pairs)[1])[1] for pairs in (one, both))
    assert np.all(paired[::2] > 0.3 * alone)
