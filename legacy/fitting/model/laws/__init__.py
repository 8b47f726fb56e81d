"""Damping laws, one a file: the factor s(w) in the dynamic stiffness Z(w) = K + s(w) D.

A law is a module of this folder with a ``LAW`` (fitting.model.laws.law.Law), and one line in this table.
Where a cause of a misfit is called ``law_NAME`` (fitting/causes/catalogue.py), sentences take its title.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from legacy.fitting.model.laws.law import Law

LAWS: dict[str, str] = {
    "viscous": "K + i w D",
    "hysteretic": "K + i D, a loss factor",
    "fractional": "K + (i w)^a D, a estimated",
    "relaxation": "K + i w D / (1 + i w T), T estimated (standard linear solid)",
    "two_relaxations": "K + i w D / 2 (1 / (1 + i w T) + 1 / (1 + i w c T)), T and c estimated",
}


@cache
def law_of(name: str) -> Law:
    """Return the law of a name in the table; it is loaded on first use."""
    law: Law = import_module(f"legacy.fitting.model.laws.{name}").LAW
    return law
