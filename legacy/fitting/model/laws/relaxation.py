"""A Maxwell branch parallel to the spring (standard linear solid): s = i w / (1 + i w T), T estimated."""

from __future__ import annotations

import numpy as np

from legacy.fitting.model.laws.law import Law

# Of w T: from next to viscous, where a T below zero is the noise of none, to a branch that is a spring.
_RANGE = (-0.5, 3.0)

LAW = Law(
    factor=lambda omega, time: 1j * omega / (1.0 + 1j * omega * time),
    continued=lambda eigenvalue, time: eigenvalue / (1.0 + eigenvalue * time),
    formula=lambda time: f"K + i w D / (1 + i w {time:.3g} s)",
    exponent=0.0,
    search=_RANGE,
    slope=lambda omega, time: np.asarray((omega / (1.0 + 1j * omega * time)) ** 2, dtype=complex),
    time_power=1.0,
    includes=("viscous",),
    valid=(-np.inf, np.inf),
)
