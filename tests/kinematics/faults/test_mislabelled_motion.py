"""Leaving out one group of channels after the other: weights of one course over the lines need one matrix."""

from __future__ import annotations

import numpy as np

from kinematics.faults.mislabelled.clean_motion import _Sums


def energy_left(basis, weight, value, kept):
    """Fit every line by itself, without normal equations."""
    total = 0.0
    for line in range(value.shape[1]):
        root = np.sqrt(weight[kept, line])
        left = root * value[kept, line]
        left = left - root * (basis[kept] @ np.linalg.lstsq(root[:, None] * basis[kept], left, rcond=None)[0])
        total += float(np.sum(np.abs(left) ** 2))
    return total


def test_what_groups_leave_is_that_of_a_fit_without_them():
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(24, 6)))[0]
    value = basis @ rng.normal(size=(6, 60)).view(complex) + 0.3 * rng.normal(size=(24, 60)).view(complex)
    course = rng.uniform(0.5, 2.0, (24, 1)) * rng.uniform(0.5, 2.0, (1, 30))
    gaps = course.copy()
    gaps[3, 4] = 0.0
    groups = [[0, 1, 2], [3, 4, 5], [7], [9, 10]]
    for weight in (course, gaps):
        held = np.where(weight > 0.0, value, 0.0)
        found = _Sums(basis, weight, held).left_without([20, 21], groups)
        for own, left in zip(groups, found, strict=True):
            kept = [c for c in range(24) if c not in {20, 21, *own}]
            np.testing.assert_allclose(left, energy_left(basis, weight, held, kept), rtol=1e-10)
