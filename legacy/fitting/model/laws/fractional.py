"""Fractional damping (a spring-pot): s = (i w)^a with one exponent for all entries, 0 < a < 2."""

from __future__ import annotations

import numpy as np

from legacy.fitting.model.laws.law import Law

LAW = Law(
    factor=lambda omega, exponent: (1j * omega) ** exponent,
    continued=lambda eigenvalue, exponent: complex(eigenvalue**exponent),
    formula=lambda exponent: f"K + (i w)^{exponent:.4g} D",
    exponent=1.0,
    search=(0.05, 1.6),
    includes=("viscous", "hysteretic"),
    slope=lambda omega, exponent: np.log(1j * omega) * (1j * omega) ** exponent,
)
