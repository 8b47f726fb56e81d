"""Two Maxwell branches of equal damping beside the spring, their times T and c T, T estimated, c 3 or 10.

Branches that lie apart follow a relaxation that no single time describes with one unknown more than viscous
damping has (one branch a decade is the usual spacing of Prony series; half a decade follows times that are
closer). Data of one decade of frequencies cannot determine two free times, nor, at 3 % noise, tell two
branches from one: what the other would change is part of the intervals then.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from fitting.model.laws.law import ComplexArray, Law
from stapeskit.arrays import Array

# The second time over the first: half a decade and a decade. With a decade alone, times of 10 and 30 us at
# 1 % noise left a misfit that a mass of fluid fitted (0.035 mg, 5 sd).
_RATIOS = (3.0, 10.0)
# Of w T: from next to viscous, where a T below zero is the noise of none, to branches that are springs.
_RANGE = (-0.05, 3.0)


def _branch(omega: Array, time: float) -> ComplexArray:
    return np.asarray(0.5j * omega / (1.0 + 1j * omega * time), dtype=complex)


def _slope(omega: Array, time: float) -> ComplexArray:
    return np.asarray(0.5 * (omega / (1.0 + 1j * omega * time)) ** 2, dtype=complex)


def _continued(value: complex, time: float) -> complex:
    return 0.5 * value / (1.0 + value * time)


@cache
def _law(ratio: float) -> Law:
    return Law(
        factor=lambda omega, time: _branch(omega, time) + _branch(omega, ratio * time),
        continued=lambda value, time: _continued(value, time) + _continued(value, ratio * time),
        formula=lambda time: (
            f"K + i w D / 2 (1 / (1 + i w {time:.3g} s) + 1 / (1 + i w {ratio * time:.3g} s))"
        ),
        exponent=0.0,
        search=_RANGE,
        slope=lambda omega, time: _slope(omega, time) + ratio * _slope(omega, ratio * time),
        time_power=1.0,
        valid=(-np.inf, np.inf),
        fixed=1,
        includes=("viscous",),
        ratios=_RATIOS,
        at_ratio=_law,
    )


LAW = _law(_RATIOS[-1])
