"""What an unknown of the fit is: a value that changes the equations of motion; the table is in causes.py.

A new unknown is one row of `fitting.causes.UNKNOWNS`. The likelihood, its derivatives, the
search for causes, ``--unknowns``, kd.json and the page follow from the row.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from stapeskit.arrays import Array, ComplexArray
from stapeskit.spatial import matrix_from_parameters, parameters_from_matrix

if TYPE_CHECKING:
    from fitting.data import Data


@dataclass
class Parts:
    """Parts of the equations, scaled, that unknowns change in place.

    Attributes
    ----------
    loss : ndarray, (lines,), complex
        s(w) of the damping law.
    mass : ndarray, (m, m)
    added : ndarray, (n, n)
        Mass on the deflection.
    factor : ndarray, (lines,)
        On K + s D.
    structure, base : ndarray, (lines,), complex
        On the motion of the bodies as measured.
    """

    loss: ComplexArray
    mass: Array
    added: Array
    factor: Array
    structure: ComplexArray
    base: ComplexArray


Change = Callable[[float, Parts, "Data"], None]


@dataclass(frozen=True)
class Unknown:
    """One unknown.

    Attributes
    ----------
    name : str
        In ``--unknowns`` and kd.json.
    title : str
        As written within a sentence.
    unit : str
        Of its value.
    sd : float
        How large it is where it is there, in its unit; its prior is normal about zero.
    change : callable
        Takes value, parts and data.
    chance : float
        Prior probability that it is there.
    positive : bool
        Whether it cannot be negative.
    family : str
        Unknowns of one family are one error at different places.
    adopt : bool
        Whether K and D are taken with it where it is the best explanation: an inherent part of some ears.
    starts : tuple of float
        Further sizes from which a fit starts, where it may be far from first order.
    companions : tuple of Unknown
        Unknowns that come with it, e.g. its place.
    weights : callable or None
        Data -> what it multiplies K and D by a unit, (lines,), where it makes K and D change over the lines.
    only : float or None
        The one value that it has where it is there.
    """

    name: str
    title: str
    unit: str
    sd: float
    change: Change
    chance: float = 0.02
    positive: bool = False
    family: str = ""
    adopt: bool = False
    starts: tuple[float, ...] = ()
    companions: tuple[Unknown, ...] = ()
    weights: Callable[[Data], Array] | None = None
    only: float | None = None

    def fixed(self, value: float) -> Unknown:
        """Return the unknown fixed at a value, with a narrow prior for its remainder."""

        def change(off: float, parts: Parts, data: Data) -> None:
            self.change(value + off, parts, data)

        return replace(self, change=change, sd=1e-6 * self.sd, companions=(), positive=False, only=None)


def on_structure(factor: Callable[[float, Array], ComplexArray]) -> Change:
    """Multiply the motion of the structure by factor(value, w in rad/s)."""

    def change(value: float, parts: Parts, data: Data) -> None:
        parts.structure = parts.structure * factor(value, data.omega * data.reference)

    return change


def on_mass(added: Callable[[float, Array], Array]) -> Change:
    """Add inertial parameters, SI: added(value, own ten parameters)."""

    def change(value: float, parts: Parts, data: Data) -> None:
        root = np.outer(data.root_mass, data.root_mass)
        own = parameters_from_matrix(data.mass * root)
        parts.mass = parts.mass + matrix_from_parameters(added(value, own)) / root

    return change


def on_ligament(shape: Callable[[Data], Array]) -> Change:
    """Multiply K and D by 1 + value % times shape(data)."""

    def change(value: float, parts: Parts, data: Data) -> None:
        parts.factor = parts.factor * (1.0 + 0.01 * value * shape(data))

    return change
