"""What the residual energy loses without some channels is what a fit without them shows."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.kinematics.faults.packed_readings import packed
from legacy.kinematics.faults.score_information import State
from tests.kinematics.faults.test_catalogue import data_of
from tests.kinematics.simulated import scene


def energy_of(data, kept):
    """Fit every group of lines by itself, without normal equations."""
    basis = data.rows(data.assumed.arms_m, data.assumed.directions)
    total = 0.0
    for weight, y in zip(data.weight, data.y, strict=True):
        rows = weight[kept, None] * basis[kept]
        left = y[kept] - rows @ np.linalg.lstsq(rows, y[kept], rcond=None)[0]
        total += float(np.sum(np.abs(left) ** 2))
    return total


@pytest.mark.parametrize("gaps", [False, True])
def test_energy_without_channels_is_that_of_a_fit_without_them(gaps):
    made = scene(1, lines=30)
    if gaps:
        made.value[3, 4] = made.value[7, ::3] = np.nan
    data = data_of(made)
    data = packed(data.source, data.assumed.without([20, 21]), fine=True)
    state = State.of(data)
    for groups in ([[0, 1, 2], [3, 4, 5]], [[7], [9]], [list(range(0, 9)), list(range(9, 18))]):
        fall = state.left_out(np.array(groups))
        for own, one in zip(groups, fall, strict=True):
            kept = [c for c in range(27) if c not in {20, 21, *own}]
            assert state.energy - one == pytest.approx(energy_of(data, kept), rel=1e-6)
