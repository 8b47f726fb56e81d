"""Estimators of K and D, one a file.

An estimator is a module of this folder with a ``METHOD`` (fitting.estimators.base.Method), and one line in
this table; the command, its help and the contract test follow from it. Its name must also stand in
docs/schemas/kd.schema.json. Modules without a ``METHOD`` are what estimators share.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from legacy.fitting.estimators.base import Method

ESTIMATORS: dict[str, str] = {
    "ml": "errors in variables",
    "irls": "equation error weighted by its own noise",
    "pinv": "paper Eq. 5",
    "constrained": "the paper's bounded variant",
}
# Weights of the lines: equal, or those of Student's t with 4 degrees of freedom.
ROBUST = {"none": "all lines weigh alike", "t4": "outlying lines lose weight"}
CONSTRAINTS = {
    "eigenvalues": "the paper's stability",
    "psd": "K and D positive semidefinite",
}


def estimator(name: str) -> Method:
    """Return an estimator by its name; it is loaded on first use.

    Raises
    ------
    FittingError
        No estimator has that name.
    """
    if name not in ESTIMATORS:
        from legacy.fitting.errors import FittingError

        raise FittingError.of("the estimator", f"one of {', '.join(ESTIMATORS)}", name)
    method: Method = import_module(f"legacy.fitting.estimators.{name}").METHOD
    return method
