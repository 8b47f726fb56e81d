"""Viscous damping: s = i w."""

from __future__ import annotations

from legacy.fitting.model.laws.law import Law

LAW = Law(
    factor=lambda omega, _: 1j * omega,
    continued=lambda eigenvalue, _: eigenvalue,
    formula=lambda _: "K + i w D",
    exponent=1.0,
    polynomial=True,
)
