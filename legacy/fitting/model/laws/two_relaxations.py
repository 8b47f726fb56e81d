"""Two Maxwell branches of equal damping parallel to the spring, their times T and c T, both estimated.

Data of one decade of frequencies hardly determine two free times, so that the logarithm of c has a prior
about each of two usual ratios: one branch a decade is the usual spacing of Prony series, half a decade
follows times that are closer. Fits from both may explain the data alike with D far apart, since half of D may
relax below the band. What the data leave open is part of the intervals.
"""

from __future__ import annotations

import numpy as np

from legacy.fitting.calibrated import calibrated
from legacy.fitting.model.laws.law import Law
from legacy.stapeskit.arrays import Array, ComplexArray

# Of w T: from next to viscous, where a T below zero is the noise of none, to branches that are springs.
_RANGE = (-0.05, 3.0)


def _branch(omega: Array, time: float) -> ComplexArray:
    return np.asarray(0.5j * omega / (1.0 + 1j * omega * time), dtype=complex)


def _slope(omega: Array, time: float) -> ComplexArray:
    return np.asarray(0.5 * (omega / (1.0 + 1j * omega * time)) ** 2, dtype=complex)


def _branch_at(value: complex, time: float) -> complex:
    return 0.5 * value / (1.0 + value * time)


LAW = Law(
    factor=lambda omega, time, ratio: _branch(omega, time) + _branch(omega, ratio * time),
    continued=lambda value, time, ratio: _branch_at(value, time) + _branch_at(value, ratio * time),
    formula=lambda time, ratio: (
        f"K + i w D / 2 (1 / (1 + i w {time:.3g} s) + 1 / (1 + i w {ratio * time:.3g} s))"
    ),
    exponent=0.0,
    search=_RANGE,
    slope=lambda omega, time, ratio: _slope(omega, time) + ratio * _slope(omega, ratio * time),
    time_power=1.0,
    valid=(-np.inf, np.inf),
    includes=("viscous",),
    ratios=(3.0, 10.0),
    ratio_sd=calibrated("laws.time_ratio_sd_log"),
    ratio_slope=lambda omega, time, ratio: ratio * time * _slope(omega, ratio * time),
)
