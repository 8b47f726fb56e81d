"""Maximum likelihood of K, D, in-plane coupling and shared errors together.

The motions of both bodies are moved by the shared errors z, ``y (1 + sum z_k T_k)``, and the mass matrix is
``M + sum z_k dM_k``. Minimised is the sum of ``e^H Ce^-1 e``, Ce = B C B^H, of ``|z|^2 / 2`` and of the
priors: the functional likelihood of errors in variables (Pintelon and Schoukens 2012, System Identification,
ch. 9). Gauss-Newton with derivatives at the fitted motion ``yhat = y - C B^H Ce^-1 e`` has the exact
gradient.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from legacy.fitting.estimators.base import solve_symmetric
from legacy.fitting.ligament.equations import (
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
from legacy.fitting.ligament.joint_lines import DOFS, JointLines
from legacy.fitting.model.parameter_vector import split
from legacy.fitting.model.scaled_lines import regressor
from legacy.stapeskit.arrays import Array, ComplexArray

# Step, squared, in units of the parameters' uncertainty, that ends a fit; one without shared errors, which is
# a start; and one with more noise than stated, which finds how much there is.
TOLERANCE, _START_TOLERANCE, NOISY_TOLERANCE = 1e-5, 1e-2, 1e-3
# A Hessian is kept for the next step when the step is shorter (squared, in units of the parameters'
# uncertainty) than the first, and as long as the squares fall by the second.
_NEAR, _KEEP = 30.0, 0.05
# Share of chi2 by which minima of one valley differ.
_SAME = 1e-3


@dataclass(frozen=True)
class Expansion:
    """Objective with its gradient, and what Hessian and covariance need.

    Attributes
    ----------
    gradient : ndarray, (p,)
        With priors.
    hessian : ndarray, (p, p)
        Gauss-Newton, with priors; of an earlier point where it was not asked for.
    residual : ndarray, (lines, n), complex
        L^-1 e with Ce = L L^H.
    whitening : ndarray, (lines, n, n), complex
        L^-1.
    gain : ndarray, (lines, 12, n), complex
        C B^H, of the motion with the terms in it.
    operators : ndarray, (t, lines, n, 12), complex, or None
        Derivatives of the operator on the motion as measured by the terms.
    jacobian : ndarray, (lines * n, p), complex, or None
        Derivative of the residual; None where the Hessian was given.
    """

    value: float
    gradient: Array
    hessian: Array
    residual: ComplexArray
    whitening: ComplexArray
    gain: ComplexArray
    operators: ComplexArray | None = None
    jacobian: ComplexArray | None = None


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
    noise : float
        Variance of the noise with which it was fitted over the stated one.
    given_up : bool
        Whether chi2 will not come as low as asked.
    """

    parameters: Array
    chi2: float
    n_dof: int
    converged: bool
    iterations: int
    at: Expansion
    noise: float = 1.0
    given_up: bool = False

    @property
    def level(self) -> float:
        """Chi2 per degree of freedom."""
        return self.chi2 / max(self.n_dof, 1)


def expand(
    measured: JointLines, unknown: Equations, parameters: Array, hessian: Array | None = None
) -> Expansion:
    """Evaluate objective and gradient, and the Gauss-Newton Hessian unless one is given.

    Notes
    -----
    With the multiplier v = Ce^-1 e the gradient is 2 Re sum v^H B_q yhat: of the shared errors only sums over
    lines are formed, which costs little. Their columns are formed for the Hessian alone.
    """
    errors, p = parameters[unknown.unknowns :], unknown.unknowns
    lines, equations = unknown.applied(measured, parameters)
    bare = operator_of(lines, equations, parameters)
    turn = turned(lines, errors)
    operator = times_turn(bare, turn)
    gain = lines.noise @ operator.conj().swapaxes(1, 2)
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
    columns = [_structural_columns(lines, equations, parameters, moved)]
    operators = None
    if unknown.terms:
        operators = term_operators(measured, unknown, parameters)
        raw = fitted if lines.factors is None else fitted / lines.factors
        columns.append(np.moveaxis((operators @ raw[:, :, None])[..., 0], 0, 2))
    structural = np.concatenate(columns, axis=2).reshape(-1, p)
    gradient = np.empty(len(parameters))
    gradient[:p] = 2.0 * (multiplier.ravel().conj() @ structural).real
    rows = inertia_rows(equations, parameters)
    heavy = np.flatnonzero(np.any(lines.mass_changes, axis=(1, 2)))
    if lines.errors:
        gradient[p:] = 2.0 * _error_slopes(lines, bare, rows, multiplier, fitted, moved)
    prior = equations.prior
    off = prior.root @ (parameters[:p] - prior.mean)
    value = float(np.sum(np.abs(white) ** 2)) + 0.5 * float(off @ off) + 0.5 * float(errors @ errors)
    gradient[:p] += prior.root.T @ off
    gradient[p:] += errors
    jacobian = None
    if hessian is None:
        columns = [whitening @ structural.reshape(lines.count, equations.n, p)]
        if lines.errors:
            columns.append(_error_columns(lines, rows, whitening, bare, fitted, moved, heavy))
        jacobian = np.concatenate(columns, axis=2).reshape(lines.count * equations.n, -1)
        real = np.concatenate([jacobian.real, jacobian.imag])
        hessian = 2.0 * (real.T @ real)
        hessian[:p, :p] += prior.root.T @ prior.root
        hessian[np.arange(p, len(hessian)), np.arange(p, len(hessian))] += 1.0
    return Expansion(value, gradient, hessian, white, whitening, gain, operators, jacobian)


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
        columns.append(law.slopes(lines.omega).T[:, None] * (deflection @ damping)[:, :, None])
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


def _error_slopes(
    lines: JointLines,
    bare: ComplexArray,
    rows: Array,
    multiplier: ComplexArray,
    fitted: ComplexArray,
    moved: ComplexArray,
) -> Array:
    """Return Re sum over lines of v^H B_k yhat for the shared errors, (k,)."""
    pulled = (multiplier.conj()[:, None, :] @ bare)[:, 0]
    slopes = np.zeros(lines.errors)
    for body, place in enumerate((slice(0, DOFS), slice(DOFS, 2 * DOFS))):
        sums = (pulled[:, place].T @ fitted[:, place]).ravel()
        slopes += (sums @ lines.maps[body].reshape(DOFS * DOFS, -1)).real
    if lines.rests is not None:
        slopes += (pulled.ravel() @ lines.rests.reshape(-1, lines.errors)).real
    load = ((lines.omega**2)[:, None] * (multiplier.conj() @ rows)).T @ moved[:, :DOFS]
    return np.asarray(slopes - lines.mass_changes.reshape(-1, DOFS * DOFS) @ load.ravel().real)


def _error_columns(
    lines: JointLines,
    rows: Array,
    whitening: ComplexArray,
    bare: ComplexArray,
    fitted: ComplexArray,
    moved: ComplexArray,
    heavy: NDArray[np.int_],
) -> ComplexArray:
    """Return the derivatives of the whitened residual by the shared errors, (lines, n, k)."""
    n = len(rows)
    white = whitening @ bare
    halves = np.stack([white[:, :, :DOFS], white[:, :, DOFS:]], axis=2)
    motion = np.stack([fitted[:, :DOFS], fitted[:, DOFS:]], axis=1)
    products = halves[..., :, None] * motion[:, None, :, None, :]
    columns = products.reshape(lines.count * n, -1) @ lines.maps.reshape(-1, lines.errors)
    if lines.rests is not None:
        columns += (white @ lines.rests).reshape(lines.count * n, -1)
    if len(heavy):
        load = (whitening @ rows)[..., :, None] * ((lines.omega**2)[:, None] * moved[:, :DOFS])[:, None, None]
        changes = lines.mass_changes[heavy].reshape(len(heavy), -1).T
        columns[:, heavy] -= load.reshape(lines.count * n, -1) @ changes
    return np.asarray(columns.reshape(lines.count, n, -1))


def fit_joint(
    lines: JointLines,
    equations: Equations,
    start: Array,
    tolerance: float = TOLERANCE,
    most: int = 60,
    within: float = np.inf,
    known: Sequence[JointFit] = (),
) -> JointFit:
    """Minimise from a start (p,) or (p + k,), first without the shared errors when the start has none.

    Parameters
    ----------
    start : ndarray
    tolerance : float
        Squared step in units of the parameters' own uncertainty that ends it.
    most : int
        Steps after which it ends without convergence.
    within : float
        It also ends so where chi2 does not come below this in the steps that are left, at the pace it has.
    known : sequence of JointFit
        Minima of the same: it ends at one where it comes close to it.

    Raises
    ------
    LinAlgError
        The start has no likelihood.
    """
    count = 0
    if lines.errors and len(start) <= equations.unknowns:
        begun = _descend(lines.without_errors(), equations, start, max(tolerance, _START_TOLERANCE), most)
        start, count = (begun.parameters if begun.converged else start), begun.iterations
    joint = _descend(lines, equations, start, tolerance, most, within, known)
    return replace(joint, iterations=joint.iterations + count)


def same_valley(one: JointFit, other: JointFit) -> bool:
    """Return whether two minima of the same have one chi2."""
    return abs(one.chi2 - other.chi2) < _SAME * other.chi2


def _is_in_valley(value: float, parameters: Array, minimum: JointFit) -> bool:
    """Return whether a point lies in the valley of a minimum and hardly above it."""
    off = parameters - minimum.parameters
    limit = _SAME * minimum.at.value
    return bool(abs(value - minimum.at.value) < limit and 0.5 * off @ minimum.at.hessian @ off < limit)


def equation_error_start(lines: JointLines, equations: Equations, begin: Array, rounds: int = 3) -> Array:
    """Return weighted least squares of the equations of the motion as it is, (p,): a start of the likelihood.

    Terms and shared errors keep their values. The equations are linear in all but an exponent, so that it
    needs no start close by; each round weights by the noise at the last estimate. Noise of the deflection
    biases it.
    """
    lines, now = lines.without_errors(), begin[: equations.unknowns].copy()
    free = equations.term.start
    root, fixed = equations.prior.root[:, :free], equations.prior.root[:, free:]
    there, applied = equations.applied(lines, now)
    for _ in range(rounds):
        at = expand(lines, equations, now, np.empty(0))
        rows = (at.whitening @ _structural_columns(there, applied, now, there.y)).reshape(-1, free)
        right = rows @ now[:free] - at.residual.ravel()
        off = equations.prior.root @ equations.prior.mean - fixed @ now[free:]
        hessian = 2.0 * (rows.conj().T @ rows).real + root.T @ root
        now[:free] = solve_symmetric(hessian, 2.0 * (rows.conj().T @ right).real + root.T @ off)
    return np.concatenate([now, begin[equations.unknowns :]])


def _descend(
    lines: JointLines,
    equations: Equations,
    start: Array,
    tolerance: float,
    most: int,
    within: float = np.inf,
    known: Sequence[JointFit] = (),
) -> JointFit:
    """Take Gauss-Newton steps, damped after Levenberg where a step fails.

    A Hessian is kept while steps with it fall fast: the gradient, which is exact, costs a fraction of it.
    """
    now = np.concatenate([start, np.zeros(equations.unknowns + lines.errors - len(start))])
    at = expand(lines, equations, now)
    damping, converged, count, fresh, before = 0.0, False, 0, True, np.inf
    given_up = False
    n_dof = 2 * equations.n * lines.count - equations.prior.free
    while count < most and not converged:
        count += 1
        step = -solve_symmetric(at.hessian + damping * np.diag(np.diag(at.hessian)), at.gradient)
        decrement = float(-at.gradient @ step)
        if not fresh and decrement > _KEEP * before:
            at, fresh = expand(lines, equations, now), True
            before = np.inf
            continue
        before = decrement
        reached = next((minimum for minimum in known if _is_in_valley(at.value, now, minimum)), None)
        if reached is not None:
            return replace(reached, iterations=count)
        given_up = damping < 1.0 and 2.0 * at.value - (most - count + 1) * decrement > within
        if given_up:
            break
        near = tolerance * max(1.0, at.value / n_dof)  # a misfit is as uncertain as half of it is large
        converged = decrement < near and damping < 1.0
        if converged and decrement < 1e-3 * near:
            break
        keep = at.hessian if lines.errors and decrement < _NEAR else None
        try:
            trial = expand(lines, equations, now + step, keep)
        except np.linalg.LinAlgError:
            damping, converged = max(10.0 * damping, 1e-3), False
            continue
        if np.isfinite(trial.value) and trial.value <= at.value * (1.0 + 1e-12):
            now, at, fresh = now + step, trial, keep is None
            damping = damping / 10.0 if damping > 1e-6 else 0.0
        elif fresh:
            damping, converged = max(10.0 * damping, 1e-3), False
        else:
            at, fresh, converged, before = expand(lines, equations, now), True, False, np.inf
    if not fresh:
        at = expand(lines, equations, now)
    return JointFit(now, 2.0 * at.value, n_dof, converged, count, at, given_up=given_up)
