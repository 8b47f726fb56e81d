"""Maximum likelihood of K, D, in-plane coupling and shared errors together.

Per line the equations are ``e = Z (E dq) - w^2 (P - Y Q) M q_s`` with the motions of both bodies moved by the
shared errors z, ``y (1 + sum z_k T_k)``, and ``M + sum z_k dM_k``. Minimised is the sum of ``e^H Ce^-1 e``,
Ce = B C B^H, of ``|z|^2 / 2`` and of the priors: the functional likelihood of errors in variables (Pintelon
and Schoukens 2012, System Identification, ch. 9). Gauss-Newton with derivatives at the fitted motion
``yhat = y - C B^H Ce^-1 e`` has the exact gradient.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.estimators.base import solve_symmetric
from fitting.estimators.regressor_noise import information
from fitting.ligament.joint_lines import DOFS, JointLines
from fitting.model.damping import DampingLaw
from fitting.model.lines import regressor
from fitting.model.symmetric import basis, split

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Equations:
    """Which equations of motion are fitted, and what is unknown in them.

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
    law : DampingLaw
    mean, precision_root : ndarray, (p,)
        Prior of the scaled parameters ahead of the shared errors: mean and 1 / sd, 0 for none.
    """

    difference: Array
    loaded: Array
    coupled: Array
    shapes: Array
    law: DampingLaw
    mean: Array
    precision_root: Array

    @property
    def n(self) -> int:
        """Number of equations a line."""
        return len(self.difference)

    @property
    def entries(self) -> int:
        """Number of entries of K and D."""
        return self.n * (self.n + 1)

    @property
    def coupling(self) -> slice:
        """Where Y, row by row, lies among the parameters."""
        start = self.entries + self.law.unknowns
        return slice(start, start + self.n * len(self.coupled))

    @property
    def unknowns(self) -> int:
        """Number of parameters ahead of the shared errors."""
        return self.shape.stop

    @property
    def shape(self) -> slice:
        """Where the factors of the shapes lie among the parameters."""
        return slice(self.coupling.stop, self.coupling.stop + len(self.shapes))

    def difference_at(self, parameters: Array) -> Array:
        """Return E with the shapes among the parameters, (n, 6)."""
        return self.difference + np.einsum("k,kij->ij", parameters[self.shape], self.shapes)

    def law_at(self, parameters: Array) -> DampingLaw:
        """Return the damping law with the exponent among the parameters."""
        if not self.law.estimated:
            return self.law
        return DampingLaw(self.law.name, float(np.clip(parameters[self.entries], 1e-3, 2.0 - 1e-3)))


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
    operator, bare : ndarray, (lines, n, 12), complex
        B, and B without the shared errors of the motion.
    gain : ndarray, (lines, 12, n), complex
        C B^H.
    """

    value: float
    gradient: Array
    hessian: Array
    residual: ComplexArray
    whitening: ComplexArray
    operator: ComplexArray
    bare: ComplexArray
    gain: ComplexArray


@dataclass(frozen=True)
class JointFit:
    """The minimum.

    Attributes
    ----------
    parameters : ndarray, (p + k,)
        Scaled K and D, exponent where it is estimated, Y, shared errors.
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


def expand(lines: JointLines, equations: Equations, parameters: Array) -> Expansion:
    """Evaluate objective, gradient and Gauss-Newton Hessian."""
    n, errors = equations.n, parameters[equations.unknowns :]
    bare, pulled, moved_mass = _operators(lines, equations, parameters)
    turn = np.eye(DOFS) + lines.maps @ errors
    operator = np.concatenate([bare[:, :, :DOFS] @ turn[0], bare[:, :, DOFS:] @ turn[1]], axis=2)
    gain = lines.covariance @ operator.conj().swapaxes(1, 2)
    noise = operator @ gain
    residual = (operator @ lines.y[:, :, None])[:, :, 0]
    shift = None if lines.rests is None else lines.rests @ errors
    if shift is not None:
        residual = residual + (bare @ shift[:, :, None])[:, :, 0]
    whitening = np.asarray(np.linalg.inv(np.linalg.cholesky(noise)), dtype=complex)
    white = (whitening @ residual[:, :, None])[:, :, 0]
    multiplier = (whitening.conj().swapaxes(1, 2) @ white[:, :, None])[:, :, 0]
    fitted = lines.y - (gain @ multiplier[:, :, None])[:, :, 0]
    moved = np.concatenate([fitted[:, :DOFS] @ turn[0].T, fitted[:, DOFS:] @ turn[1].T], axis=1)
    moved = moved if shift is None else moved + shift
    law = equations.law_at(parameters)
    deflection = (moved[:, :DOFS] - moved[:, DOFS:]) @ equations.difference_at(parameters).T
    columns = [np.moveaxis(regressor(np.ascontiguousarray(deflection.T), law.factor(lines.omega)), 0, 1)]
    if law.estimated:
        _, damping = split(parameters[: equations.entries], n)
        columns.append((law.slope(lines.omega)[:, None] * (deflection @ damping))[:, :, None])
    if len(equations.coupled):
        load = (lines.omega**2)[:, None] * (moved[:, :DOFS] @ (equations.coupled @ moved_mass).T)
        columns.append(np.einsum("rs,lc->lrsc", np.eye(n), load).reshape(lines.count, n, -1))
    if len(equations.shapes):
        bent = np.einsum("kij,lj->lik", equations.shapes, moved[:, :DOFS] - moved[:, DOFS:])
        columns.append(_dynamic(equations, parameters, lines.omega) @ bent)
    if lines.errors:
        columns.append(_error_columns(lines, bare, pulled, fitted, moved))
    jacobian = whitening @ np.concatenate(columns, axis=2)
    columns_white = jacobian.reshape(lines.count * n, -1)
    rows = np.concatenate([columns_white.real, columns_white.imag])
    flat = np.concatenate([white.real.ravel(), white.imag.ravel()])
    mean = np.concatenate([equations.mean, np.zeros(lines.errors)])
    root = np.concatenate([equations.precision_root, np.ones(lines.errors)])
    off = (parameters - mean) * root
    value = float(flat @ flat) + 0.5 * float(off @ off)
    gradient = 2.0 * (rows.T @ flat) + off * root
    hessian = 2.0 * (rows.T @ rows) + np.diag(root**2)
    return Expansion(value, gradient, hessian, white, whitening, operator, bare, gain)


def _operators(
    lines: JointLines, equations: Equations, parameters: Array
) -> tuple[ComplexArray, Array, Array]:
    """Return B (lines, n, 12) without errors of the motion, P - Y Q, and M with its errors."""
    n = equations.n
    elastic = _dynamic(equations, parameters, lines.omega) @ equations.difference_at(parameters)
    coupling = parameters[equations.coupling].reshape(n, len(equations.coupled))
    pulled = equations.loaded - coupling @ equations.coupled
    mass = lines.mass + np.einsum("k,kij->ij", parameters[equations.unknowns :], lines.mass_changes)
    inertia = pulled @ mass
    operator = np.empty((lines.count, n, 2 * DOFS), dtype=complex)
    operator[:, :, :DOFS] = elastic - (lines.omega**2)[:, None, None] * inertia
    operator[:, :, DOFS:] = -elastic
    return operator, pulled, mass


def _dynamic(equations: Equations, parameters: Array, omega: Array) -> ComplexArray:
    """Return Z = K + s D, (lines, n, n)."""
    stiffness, damping = split(parameters[: equations.entries], equations.n)
    factor = equations.law_at(parameters).factor(omega)
    return np.asarray(stiffness + factor[:, None, None] * damping)


def _error_columns(
    lines: JointLines, bare: ComplexArray, pulled: Array, fitted: ComplexArray, moved: ComplexArray
) -> ComplexArray:
    """Return the derivatives of the residual by the shared errors, (lines, n, k)."""
    k = lines.errors
    change = np.empty((lines.count, 2 * DOFS, k), dtype=complex)
    for body, place in enumerate((slice(0, DOFS), slice(DOFS, 2 * DOFS))):
        flat = lines.maps[body].transpose(1, 0, 2).reshape(DOFS, DOFS * k)
        change[:, place] = (fitted[:, place] @ flat).reshape(lines.count, DOFS, k)
    if lines.rests is not None:
        change = change + lines.rests
    columns = bare @ change
    heavy = pulled @ lines.mass_changes
    load = moved[:, :DOFS] @ heavy.transpose(2, 1, 0).reshape(DOFS, -1)
    return np.asarray(columns - (lines.omega**2)[:, None, None] * load.reshape(lines.count, -1, k))


def fit_joint(
    lines: JointLines, equations: Equations, start: Array, tolerance: float = 1e-6, most: int = 60
) -> JointFit:
    """Minimise from a start (p,) or (p + k,) by Gauss-Newton, damped after Levenberg where a step fails.

    It ends when a squared step in units of the parameters' own uncertainty is below ``tolerance``, or without
    convergence after ``most`` steps.
    """
    now = np.concatenate([start, np.zeros(equations.unknowns + lines.errors - len(start))])
    at = expand(lines, equations, now)
    damping, converged, count = 0.0, False, 0
    while count < most and not converged:
        count += 1
        step = -solve_symmetric(at.hessian + damping * np.diag(np.diag(at.hessian)), at.gradient)
        decrement = float(-at.gradient @ step)
        try:
            trial = expand(lines, equations, now + step)
        except np.linalg.LinAlgError:
            damping = max(10.0 * damping, 1e-3)
            continue
        converged = decrement < tolerance and damping < 1.0
        if np.isfinite(trial.value) and trial.value <= at.value * (1.0 + 1e-12):
            now, at = now + step, trial
            damping = damping / 10.0 if damping > 1e-6 else 0.0
        else:
            damping = max(10.0 * damping, 1e-3)
    free = int(np.sum(equations.precision_root == 0.0))
    n_dof = 2 * equations.n * lines.count - free
    return JointFit(now, 2.0 * at.value, n_dof, converged, count, at)


def joint_covariance(lines: JointLines, equations: Equations, fit: JointFit) -> tuple[Array, Array]:
    """Return information A (p + k, p + k) and spread V of the scores: the covariance is A^-1 V A^-1.

    What the noise of the fitted motion adds to the Gauss-Newton Hessian is no information
    (fitting.estimators.regressor_noise).
    """
    noise = _regressor_noise(lines, equations, fit)
    half, added = 0.5 * fit.at.hessian, 0.5 * noise
    known, spread = information(half, added, min(fit.level, 1.0))
    return 2.0 * known, 2.0 * spread


def _regressor_noise(lines: JointLines, equations: Equations, fit: JointFit) -> Array:
    """Return 2 sum of Re tr(T_k C' T_l^H) over lines: T the whitened operators, C' the noise of yhat."""
    n, at, parameters = equations.n, fit.at, fit.parameters
    errors = parameters[equations.unknowns :]
    _, pulled, mass = _operators(lines, equations, parameters)
    turn = np.eye(DOFS) + lines.maps @ errors
    law = equations.law_at(parameters)
    factor = law.factor(lines.omega)
    difference = equations.difference_at(parameters)
    both = np.concatenate([difference @ turn[0], -difference @ turn[1]], axis=1)
    elastic = basis(n) @ both
    operators = [
        np.broadcast_to(elastic[:, None], (len(elastic), lines.count, n, 2 * DOFS)),
        elastic[:, None] * factor[:, None, None],
    ]
    if law.estimated:
        _, damping = split(parameters[: equations.entries], n)
        operators.append((law.slope(lines.omega)[:, None, None] * (damping @ both))[None])
    square = (lines.omega**2)[:, None, None]
    if len(equations.coupled):
        rows = (equations.coupled @ mass) @ turn[0]
        units = np.zeros((n * len(rows), n, 2 * DOFS), dtype=complex)
        for place, (row, column) in enumerate(np.ndindex(n, len(rows))):
            units[place, row, :DOFS] = rows[column]
        operators.append(units[:, None] * square)
    if len(equations.shapes):
        bent = np.concatenate([equations.shapes @ turn[0], -equations.shapes @ turn[1]], axis=2)
        operators.append(_dynamic(equations, parameters, lines.omega) @ bent[:, None])
    if lines.errors:
        heavy = (pulled @ lines.mass_changes) @ turn[0]
        block = np.empty((lines.errors, lines.count, n, 2 * DOFS), dtype=complex)
        for body, half in enumerate((slice(0, DOFS), slice(DOFS, 2 * DOFS))):
            flat = lines.maps[body].transpose(0, 2, 1).reshape(DOFS, -1)
            product = (at.bare[:, :, half].reshape(-1, DOFS) @ flat).reshape(lines.count, n, -1, DOFS)
            block[:, :, :, half] = np.moveaxis(product, 2, 0)
        block[:, :, :, :DOFS] -= heavy[:, None] * square
        operators.append(block)
    stacked = np.concatenate(operators)
    stacked = at.whitening @ stacked
    explained = at.gain @ at.whitening.conj().swapaxes(1, 2)
    motion = lines.covariance - explained @ explained.conj().swapaxes(1, 2)
    values, vectors = np.linalg.eigh(motion)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    flat = (stacked @ root).reshape(len(stacked), -1)
    flat = np.ascontiguousarray(flat).view(np.float64)
    return np.asarray(2.0 * flat @ flat.T)
