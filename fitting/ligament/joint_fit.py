"""Maximum likelihood of K, D, in-plane coupling and shared errors together.

The motions of both bodies are moved by the shared errors z, ``y (1 + sum z_k T_k)``, and the mass matrix is
``M + sum z_k dM_k``. Minimised is the sum of ``e^H Ce^-1 e``, Ce = B C B^H, of ``|z|^2 / 2`` and of the
priors: the functional likelihood of errors in variables (Pintelon and Schoukens 2012, System Identification,
ch. 9). Gauss-Newton with derivatives at the fitted motion ``yhat = y - C B^H Ce^-1 e`` has the exact
gradient.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.estimators.base import solve_symmetric
from fitting.ligament.equations import (
    Equations,
    dynamic,
    inertia_rows,
    mass_at,
    moved_motion,
    operator_of,
    term_operators,
    times_turn,
    turned,
)
from fitting.ligament.joint_lines import DOFS, JointLines
from fitting.model.lines import regressor
from fitting.model.symmetric import split

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
# Step, squared, in units of the parameters' uncertainty, that ends the fit without shared errors, which is a
# start.
_START_TOLERANCE = 1e-2


@dataclass(frozen=True)
class Expansion:
    """Objective with slopes, and what the covariance needs.

    Attributes
    ----------
    value : float
    gradient, hessian : ndarray, (p,), (p, p)
        With priors.
    residual : ndarray, (lines, n), complex
        L^-1 e with Ce = L L^H.
    whitening : ndarray, (lines, n, n), complex
        L^-1.
    gain : ndarray, (lines, 12, n), complex
        C B^H, of the motion with the terms in it.
    fitted : ndarray, (lines, 12), complex
        yhat with the terms in it.
    operators : ndarray, (t, lines, n, 12), complex, or None
        Derivatives of the operator on the motion as measured by the terms.
    """

    value: float
    gradient: Array
    hessian: Array
    residual: ComplexArray
    whitening: ComplexArray
    gain: ComplexArray
    fitted: ComplexArray
    operators: ComplexArray | None = None


@dataclass(frozen=True)
class JointFit:
    """The minimum.

    Attributes
    ----------
    parameters : ndarray, (p + k,)
        Scaled K and D, exponent where it is estimated, Y, shapes, terms, shared errors.
    chi2 : float
        Twice the objective, priors included.
    n_dof : int
        2 n lines less the parameters without a prior.
    converged : bool
    iterations : int
    at : Expansion
    """

    parameters: Array
    chi2: float
    n_dof: int
    converged: bool
    iterations: int
    at: Expansion

    @property
    def level(self) -> float:
        """Chi2 per degree of freedom."""
        return self.chi2 / max(self.n_dof, 1)


def expand(measured: JointLines, unknown: Equations, parameters: Array) -> Expansion:
    """Evaluate objective, gradient and Gauss-Newton Hessian."""
    errors = parameters[unknown.unknowns :]
    lines, equations = unknown.applied(measured, parameters)
    bare = operator_of(lines, equations, parameters)
    turn = turned(lines, errors)
    operator = times_turn(bare, turn)
    gain = lines.covariance @ operator.conj().swapaxes(1, 2)
    residual = (operator @ lines.y[:, :, None])[:, :, 0]
    shift = None if lines.rests is None else lines.rests @ errors
    if shift is not None:
        residual = residual + (bare @ shift[:, :, None])[:, :, 0]
    with np.errstate(all="ignore"):
        noise = operator @ gain
    if not np.all(np.isfinite(noise)):
        raise np.linalg.LinAlgError("the noise of the equations is not finite")
    whitening = np.asarray(np.linalg.inv(np.linalg.cholesky(noise)), dtype=complex)
    white = (whitening @ residual[:, :, None])[:, :, 0]
    multiplier = (whitening.conj().swapaxes(1, 2) @ white[:, :, None])[:, :, 0]
    fitted = lines.y - (gain @ multiplier[:, :, None])[:, :, 0]
    moved = moved_motion(fitted, turn, shift)
    operators = term_operators(measured, unknown, parameters) if unknown.terms else None
    columns = [whitening @ _structural_columns(lines, equations, parameters, moved)]
    if operators is not None:
        raw = fitted if lines.factors is None else fitted / lines.factors
        columns.append(whitening @ np.moveaxis((operators @ raw[:, :, None])[..., 0], 0, 2))
    if lines.errors:
        columns.append(_error_columns(lines, equations, parameters, whitening, bare, fitted, moved))
    jacobian = np.concatenate(columns, axis=2).reshape(lines.count * equations.n, -1)
    rows = np.concatenate([jacobian.real, jacobian.imag])
    flat = np.concatenate([white.real.ravel(), white.imag.ravel()])
    prior, p = equations.prior, equations.unknowns
    off = prior.root @ (parameters[:p] - prior.mean)
    value = float(flat @ flat) + 0.5 * float(off @ off) + 0.5 * float(errors @ errors)
    gradient = 2.0 * (rows.T @ flat)
    gradient[:p] += prior.root.T @ off
    gradient[p:] += errors
    hessian = 2.0 * (rows.T @ rows)
    hessian[:p, :p] += prior.root.T @ prior.root
    hessian[np.arange(p, len(hessian)), np.arange(p, len(hessian))] += 1.0
    return Expansion(value, gradient, hessian, white, whitening, gain, fitted, operators)


def _structural_columns(
    lines: JointLines, equations: Equations, parameters: Array, moved: ComplexArray
) -> ComplexArray:
    """Return the derivatives of the residual by all but terms and shared errors, (lines, n, p)."""
    n, law = equations.n, equations.law_at(parameters)
    deflection = (moved[:, :DOFS] - moved[:, DOFS:]) @ equations.difference_at(parameters).T
    factor = None if equations.factor is None else equations.factor[:, None]
    lossy = equations.damping_factor(parameters, lines.omega)
    if factor is not None:
        deflection = deflection * factor
    columns = [np.moveaxis(regressor(np.ascontiguousarray(deflection.T), lossy), 0, 1)]
    if law.estimated:
        _, damping = split(parameters[: equations.entries], n)
        columns.append((law.slope(lines.omega)[:, None] * (deflection @ damping))[:, :, None])
    if len(equations.coupled):
        rows = equations.coupled @ mass_at(lines, parameters[equations.unknowns :])
        load = (lines.omega**2)[:, None] * (moved[:, :DOFS] @ rows.T)
        filled = np.zeros((lines.count, n, n, load.shape[1]), dtype=complex)
        filled[:, np.arange(n), np.arange(n)] = load[:, None]
        columns.append(filled.reshape(lines.count, n, -1))
    if len(equations.shapes):
        bent = np.tensordot(moved[:, :DOFS] - moved[:, DOFS:], equations.shapes, (1, 2)).swapaxes(1, 2)
        columns.append(dynamic(equations, parameters, lines.omega) @ bent)
    return np.concatenate(columns, axis=2)


def _error_columns(
    lines: JointLines,
    equations: Equations,
    parameters: Array,
    whitening: ComplexArray,
    bare: ComplexArray,
    fitted: ComplexArray,
    moved: ComplexArray,
) -> ComplexArray:
    """Return the derivatives of the whitened residual by the shared errors, (lines, n, k)."""
    k = lines.errors
    change = np.empty((lines.count, 2 * DOFS, k), dtype=complex)
    for body, place in enumerate((slice(0, DOFS), slice(DOFS, 2 * DOFS))):
        flat = lines.maps[body].transpose(1, 0, 2).reshape(DOFS, DOFS * k)
        change[:, place] = (fitted[:, place] @ flat).reshape(lines.count, DOFS, k)
    if lines.rests is not None:
        change += lines.rests
    columns = (whitening @ bare) @ change
    heavy = np.flatnonzero(np.any(lines.mass_changes, axis=(1, 2)))
    if len(heavy):
        rows = inertia_rows(equations, parameters) @ lines.mass_changes[heavy]
        load = moved[:, :DOFS] @ rows.transpose(2, 1, 0).reshape(DOFS, -1)
        load = (lines.omega**2)[:, None, None] * load.reshape(lines.count, -1, len(heavy))
        columns[:, :, heavy] -= whitening @ load
    return np.asarray(columns)


def fit_joint(
    lines: JointLines, equations: Equations, start: Array, tolerance: float = 1e-5, most: int = 60
) -> JointFit:
    """Minimise from a start (p,) or (p + k,), first without the shared errors when the start has none.

    Parameters
    ----------
    lines : JointLines
    equations : Equations
    start : ndarray
    tolerance : float
        Squared step in units of the parameters' own uncertainty that ends it.
    most : int
        Steps after which it ends without convergence.

    Raises
    ------
    LinAlgError
        The start has no likelihood.
    """
    count = 0
    if lines.errors and len(start) <= equations.unknowns:
        begun = _descend(lines.without_errors(), equations, start, max(tolerance, _START_TOLERANCE), most)
        start, count = (begun.parameters if begun.converged else start), begun.iterations
    joint = _descend(lines, equations, start, tolerance, most)
    return JointFit(
        joint.parameters, joint.chi2, joint.n_dof, joint.converged, joint.iterations + count, joint.at
    )


def _descend(lines: JointLines, equations: Equations, start: Array, tolerance: float, most: int) -> JointFit:
    """Take Gauss-Newton steps, damped after Levenberg where a step fails."""
    now = np.concatenate([start, np.zeros(equations.unknowns + lines.errors - len(start))])
    at = expand(lines, equations, now)
    damping, converged, count = 0.0, False, 0
    while count < most and not converged:
        count += 1
        step = -solve_symmetric(at.hessian + damping * np.diag(np.diag(at.hessian)), at.gradient)
        decrement = float(-at.gradient @ step)
        converged = decrement < tolerance and damping < 1.0
        if converged and decrement < 1e-3 * tolerance:
            break
        try:
            trial = expand(lines, equations, now + step)
        except np.linalg.LinAlgError:
            damping, converged = max(10.0 * damping, 1e-3), False
            continue
        if np.isfinite(trial.value) and trial.value <= at.value * (1.0 + 1e-12):
            now, at = now + step, trial
            damping = damping / 10.0 if damping > 1e-6 else 0.0
        else:
            damping = max(10.0 * damping, 1e-3)
    n_dof = 2 * equations.n * lines.count - equations.prior.free
    return JointFit(now, 2.0 * at.value, n_dof, converged, count, at)
