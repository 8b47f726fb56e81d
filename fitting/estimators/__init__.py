"""Estimators of K and D, one a file, behind one interface (fitting.estimators.base.Estimator)."""

from __future__ import annotations

from fitting.errors import FittingError
from fitting.estimators.base import Estimate, Estimator, EstimatorOptions
from stapeskit.faults import sentence

ESTIMATORS: tuple[str, ...] = ("ml", "irls", "pinv", "constrained")

__all__ = ["ESTIMATORS", "Estimate", "Estimator", "EstimatorOptions", "estimator"]


def estimator(name: str) -> Estimator:
    """Return an estimator by its name.

    Raises
    ------
    FittingError
        There is none of that name.
    """
    if name not in ESTIMATORS:
        raise FittingError(sentence("the estimator", f"one of {', '.join(ESTIMATORS)}", name))
    from fitting.estimators import constrained, irls, ml, pinv

    table: dict[str, Estimator] = {"ml": ml, "irls": irls, "pinv": pinv, "constrained": constrained}
    return table[name]
