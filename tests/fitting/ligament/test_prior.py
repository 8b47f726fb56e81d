"""The prior of a joint fit: a normal distribution, flat along parameters without a prior."""

from __future__ import annotations

import numpy as np

from legacy.fitting.ligament.prior import Prior


def test_parameters_without_a_prior_are_counted():
    prior = Prior.independent(np.array([1.0, 2.0, 3.0]), np.array([2.0, 0.0, 0.5]))
    assert prior.free == 1
    assert np.allclose(prior.root.T @ prior.root, np.diag([4.0, 0.0, 0.25]))


def test_further_parameters_are_independent_of_the_others():
    rng = np.random.default_rng(0)
    prior = Prior(np.array([1.0, 2.0]), rng.normal(size=(2, 2)))
    more = prior.extended(np.array([4.0]))
    precision = more.root.T @ more.root
    assert np.allclose(precision[:2, :2], prior.root.T @ prior.root)
    assert np.allclose(precision[2], [0.0, 0.0, 16.0])
    assert np.allclose(more.mean, [1.0, 2.0, 0.0])


def test_draws_have_the_stated_covariance():
    root = np.array([[2.0, 1.0], [0.0, 4.0]])
    prior = Prior(np.zeros(2), root)
    rng = np.random.default_rng(1)
    draws = np.array([prior.draw(np.array([5.0, -5.0]), rng).mean for _ in range(1000)])
    wanted = np.linalg.inv(root.T @ root)
    assert np.allclose(draws.mean(axis=0), [5.0, -5.0], atol=5.0 * np.sqrt(wanted.max() / 1000))
    assert np.allclose(np.cov(draws.T), wanted, atol=5.0 * wanted.max() * np.sqrt(2.0 / 1000))
