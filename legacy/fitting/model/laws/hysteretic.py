"""Hysteretic (structural) damping: s = i for w > 0, the loss factor of finite element models."""

from __future__ import annotations

import numpy as np

from legacy.fitting.model.laws.law import Law

LAW = Law(
    factor=lambda omega, _: np.full(omega.shape, 1j),
    continued=lambda _, __: 1j,
    formula=lambda _: "K + i D",
    exponent=0.0,
    causal=False,
)
