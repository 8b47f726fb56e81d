"""Which equations of motion a joint fit solves, and what is unknown in them.

Per line the residual is ``e = Z E dq - w^2 (P - Y Q) M q_s`` with ``Z = c (K + s D) - w^2 M_f``: c and M_f
are 1 and 0 unless a further term (a fluid on the deflection, a drift of the stiffness) changes them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from legacy.fitting.ligament.joint_lines import DOFS, JointLines
from legacy.fitting.ligament.prior import Prior
from legacy.fitting.model.damping import DampingLaw
from legacy.fitting.model.parameter_vector import split
from legacy.stapeskit.arrays import Array, ComplexArray

_STEP = 1e-4  # of a scaled parameter, for central differences: their error is its square


@dataclass(frozen=True)
class Term:
    """One further unknown of a joint fit: a fluid, a delay between the bodies, a mass at the head ...

    Attributes
    ----------
    apply : callable
        (value, lines, equations) -> (lines, equations) with the term in them; 0 changes nothing.
    unit : float
        SI over the unit of the fit's parameter, in which the term is of order one.
    sd : float
        What is known beforehand, in units of the parameter; 0: nothing.
    starts : tuple of float
        Where a fit starts besides 0, in units of the parameter.
    nuisances : tuple of str
        Sources of further shared errors of unit variance, whose changes of the mass matrix ``apply`` sets.
    """

    name: str
    apply: Callable[[float, JointLines, Equations], tuple[JointLines, Equations]]
    unit: float
    sd: float = 0.0
    starts: tuple[float, ...] = ()
    nuisances: tuple[str, ...] = ()


@dataclass(frozen=True)
class Equations:
    """Equations of motion and their unknowns: K, D, the law's, Y, shapes, terms, then shared errors.

    Attributes
    ----------
    difference : ndarray, (n, 6)
        E: deflections that K and D act on, of scaled dq.
    loaded : ndarray, (n, 6)
        P: rows of the mass matrix.
    coupled : ndarray, (c, 6)
        Q: rows of the mass matrix that Y multiplies; c = 0 without unknown coupling.
    shapes : ndarray, (s, n, 6)
        Changes of E by further unknowns.
    prior : Prior
        Of the parameters ahead of the shared errors, scaled.
    fluid : ndarray, (n, n), or None
        M_f, scaled.
    factor : ndarray, (lines,), or None
        c.
    lossy : ndarray, (lines,), complex, or None
        Added to s.
    """

    difference: Array
    loaded: Array
    coupled: Array
    shapes: Array
    law: DampingLaw
    prior: Prior
    terms: tuple[Term, ...] = ()
    fluid: Array | None = None
    factor: Array | None = None
    lossy: ComplexArray | None = None

    @property
    def n(self) -> int:
        """Number of equations a line."""
        return len(self.difference)

    @property
    def entries(self) -> int:
        """Number of entries of K and D."""
        return self.n * (self.n + 1)

    @cached_property
    def coupling(self) -> slice:
        """Where Y, row by row, lies among the parameters."""
        start = self.entries + len(self.law.unknowns)
        return slice(start, start + self.n * len(self.coupled))

    @cached_property
    def shape(self) -> slice:
        """Where the factors of the shapes lie among the parameters."""
        return slice(self.coupling.stop, self.coupling.stop + len(self.shapes))

    @cached_property
    def term(self) -> slice:
        """Where the terms lie among the parameters."""
        return slice(self.shape.stop, self.shape.stop + len(self.terms))

    @cached_property
    def unknowns(self) -> int:
        """Number of parameters ahead of the shared errors."""
        return self.term.stop

    def difference_at(self, parameters: Array) -> Array:
        """Return E with the shapes among the parameters, (n, 6)."""
        if not len(self.shapes):
            return self.difference
        return self.difference + np.einsum("k,kij->ij", parameters[self.shape], self.shapes)

    def law_at(self, parameters: Array) -> DampingLaw:
        """Return the damping law with its unknowns among the parameters."""
        return self.law.with_unknowns(parameters[self.entries : self.coupling.start])

    def damping_factor(self, parameters: Array, omega: Array) -> ComplexArray:
        """Return s, (lines,)."""
        factor = self.law_at(parameters).factor(omega)
        return factor if self.lossy is None else factor + self.lossy

    def with_terms(self, terms: tuple[Term, ...]) -> Equations:
        """Return the equations with further unknown terms."""
        precision = np.array([0.0 if term.sd == 0.0 else 1.0 / term.sd for term in terms])
        return replace(self, terms=(*self.terms, *terms), prior=self.prior.extended(precision))

    def applied(self, lines: JointLines, parameters: Array) -> tuple[JointLines, Equations]:
        """Return lines and equations with the terms among the parameters in them; one of 0 does nothing."""
        applied: tuple[JointLines, Equations] = (lines, self)
        for term, value in zip(self.terms, parameters[self.term], strict=True):
            if value:
                applied = term.apply(float(value), *applied)
        return applied


def dynamic(equations: Equations, parameters: Array, omega: Array) -> ComplexArray:
    """Return Z, (lines, n, n)."""
    stiffness, damping = split(parameters[: equations.entries], equations.n)
    factor = equations.damping_factor(parameters, omega)
    matrix: Any = stiffness + factor[:, None, None] * damping
    if equations.factor is not None:
        matrix = matrix * equations.factor[:, None, None]
    if equations.fluid is not None:
        matrix = matrix - (omega**2)[:, None, None] * equations.fluid
    return np.asarray(matrix)


def mass_at(lines: JointLines, errors: Array) -> Array:
    """Return the scaled mass matrix with its shared errors, (6, 6)."""
    if not lines.errors:
        return lines.mass
    return lines.mass + np.tensordot(errors, lines.mass_changes, 1)


def inertia_rows(equations: Equations, parameters: Array) -> Array:
    """Return P - Y Q, (n, 6)."""
    if not len(equations.coupled):
        return equations.loaded
    coupling = parameters[equations.coupling].reshape(equations.n, -1)
    return equations.loaded - coupling @ equations.coupled


def operator_of(lines: JointLines, equations: Equations, parameters: Array) -> ComplexArray:
    """Return B without errors of the motion, (lines, n, 12), of lines and equations that have their terms."""
    elastic = times(dynamic(equations, parameters, lines.omega), equations.difference_at(parameters))
    inertia = inertia_rows(equations, parameters) @ mass_at(lines, parameters[equations.unknowns :])
    operator = np.empty((lines.count, equations.n, 2 * DOFS), dtype=complex)
    operator[:, :, :DOFS] = elastic - (lines.omega**2)[:, None, None] * inertia
    operator[:, :, DOFS:] = -elastic
    return operator


def turned(lines: JointLines, errors: Array) -> ComplexArray | None:
    """Return the map (2, 6, 6) of the motions of both bodies by their shared errors; None without errors."""
    if not lines.errors:
        return None
    return np.asarray(np.eye(DOFS) + lines.maps @ errors)


def times_turn(rows: ComplexArray, turn: ComplexArray | None) -> ComplexArray:
    """Return rows (..., 12) of both bodies times the map of their motions."""
    if turn is None:
        return rows
    return np.concatenate([times(rows[..., :DOFS], turn[0]), times(rows[..., DOFS:], turn[1])], axis=-1)


def times(rows: ComplexArray, matrix: Any) -> ComplexArray:
    """Return rows (..., k) times one matrix (k, m), by one product, not one for each line."""
    return np.asarray((rows.reshape(-1, len(matrix)) @ matrix).reshape(*rows.shape[:-1], -1))


def moved_motion(motion: ComplexArray, turn: ComplexArray | None, shift: ComplexArray | None) -> ComplexArray:
    """Return motions (lines, 12) of both bodies with their shared errors."""
    if turn is not None:
        motion = np.concatenate([motion[:, :DOFS] @ turn[0].T, motion[:, DOFS:] @ turn[1].T], axis=1)
    return motion if shift is None else motion + shift


def term_operators(lines: JointLines, equations: Equations, parameters: Array) -> ComplexArray:
    """Return the derivatives of B, as it acts on the motion as measured, by the terms, (t, lines, n, 12)."""
    derivatives = []
    errors = parameters[equations.unknowns :]
    for place in range(equations.term.start, equations.term.stop):
        ends = []
        for sign in (1.0, -1.0):
            near = parameters.copy()
            near[place] += sign * _STEP
            there, changed = equations.applied(lines, near)
            operator = times_turn(operator_of(there, changed, near), turned(there, errors))
            ends.append(operator if there.factors is None else operator * there.factors[:, None, :])
        derivatives.append((ends[0] - ends[1]) / (2.0 * _STEP))
    return np.array(derivatives)
