"""The small linear systems of the estimators."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.fitting.estimators.base import least_squares, solve_symmetric


def test_singular_systems_get_the_least_norm_answer() -> None:
    rows = np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]])
    right = np.array([2.0, 4.0, 6.0])
    assert least_squares(rows, right) == pytest.approx([1.0, 1.0])
    assert solve_symmetric(rows.T @ rows, rows.T @ right) == pytest.approx([1.0, 1.0])
