"""Information and spread of the scores of a joint fit.

What the noise of the fitted motion adds to the Gauss-Newton Hessian is no information
(fitting.estimators.regressor_noise): N_qr = 2 sum over lines of Re tr(Ce^-1 B_r C' B_q^H), with the
derivatives B_q of the operator by the unknowns and the noise C' of yhat. Every B_q is u_0 O_q0 + u_1 O_q1 +
... with constant matrices O and the same few functions u of the frequency, so that the sums over lines are
formed once for all unknowns.
"""

from __future__ import annotations

import numpy as np

from legacy.fitting.estimators.regressor_noise import information
from legacy.fitting.ligament.equations import (
    Equations,
    inertia_rows,
    mass_at,
    times_turn,
    turned,
)
from legacy.fitting.ligament.joint_fit import JointFit
from legacy.fitting.ligament.joint_lines import DOFS, JointLines
from legacy.fitting.model.parameter_vector import basis, split
from legacy.stapeskit.arrays import Array, ComplexArray


def joint_covariance(lines: JointLines, equations: Equations, fit: JointFit) -> tuple[Array, Array]:
    """Return information A (p + k, p + k) and spread V of the scores: the covariance is A^-1 V A^-1."""
    half, added = 0.5 * fit.at.hessian, 0.5 * _regressor_noise(lines, equations, fit)
    known, spread = information(half, added, min(fit.level, 1.0))
    return 2.0 * known, 2.0 * spread


def _regressor_noise(measured: JointLines, unknown: Equations, fit: JointFit) -> Array:
    """Return N, (p + k, p + k)."""
    parameters, at, n = fit.parameters, fit.at, unknown.n
    lines, equations = unknown.applied(measured, parameters)
    precision = at.whitening.conj().swapaxes(1, 2) @ at.whitening
    explained = at.gain @ at.whitening.conj().swapaxes(1, 2)
    motion = lines.noise - explained @ explained.conj().swapaxes(1, 2)
    weights = _weights(lines, equations, parameters)
    constant = _constant_operators(lines, equations, parameters, len(weights))
    count = len(weights)
    pairs = (weights.conj()[:, None] * weights).reshape(count * count, 1, -1)
    weighted_precision = (pairs * precision.reshape(lines.count, -1).T).reshape(-1, lines.count)
    sums = weighted_precision @ motion.conj().reshape(lines.count, -1)
    sums = sums.reshape(count, count, n, n, 2 * DOFS, 2 * DOFS).transpose(0, 2, 4, 1, 3, 5)
    flat = constant.reshape(len(constant), -1)
    size = flat.shape[1]
    noise = 2.0 * (flat.conj() @ sums.reshape(size, size) @ flat.T).real
    place = equations.term
    if at.operators is not None:
        raw = 1.0 if lines.factors is None else 1.0 / lines.factors[:, None, :]
        own = at.operators * raw
        carried = precision @ own @ motion
        across = weights.conj() @ carried.transpose(1, 0, 2, 3).reshape(lines.count, -1)
        across = across.reshape(count, len(own), -1).transpose(1, 0, 2).reshape(len(own), -1)
        noise[place] = 2.0 * (across @ flat.conj().T).real
        noise[:, place] = noise[place].T
        noise[place, place] = 2.0 * (own.reshape(len(own), -1).conj() @ carried.reshape(len(own), -1).T).real
    return np.asarray(0.5 * (noise + noise.T))


def _weights(lines: JointLines, equations: Equations, parameters: Array) -> ComplexArray:
    """Return the functions u of the frequency, (m, lines): of K, D, masses, and of the law's unknowns."""
    law = equations.law_at(parameters)
    factor = np.ones(lines.count) if equations.factor is None else equations.factor
    weights = [factor, factor * equations.damping_factor(parameters, lines.omega), lines.omega**2]
    weights += list(factor * law.slopes(lines.omega))
    return np.array(weights, dtype=complex)


def _constant_operators(
    lines: JointLines, equations: Equations, parameters: Array, weights: int
) -> ComplexArray:
    """Return O (p + k, m, n, 12); the rows of the terms are left zero."""
    n, p = equations.n, equations.unknowns
    errors = parameters[p:]
    turn = turned(lines, errors)
    difference = equations.difference_at(parameters).astype(complex)
    both = times_turn(np.concatenate([difference, -difference], axis=1), turn)
    stiffness, damping = split(parameters[: equations.entries], n)
    fluid = np.zeros((n, n)) if equations.fluid is None else equations.fluid
    parts = np.array([stiffness, damping, -fluid])
    operators = np.zeros((p + lines.errors, weights, n, 2 * DOFS), dtype=complex)
    units, half = basis(n), equations.entries // 2
    operators[:half, 0] = operators[half : 2 * half, 1] = units @ both
    for place in range(weights - 3):
        operators[equations.entries + place, 3 + place] = damping @ both
    if len(equations.coupled):
        rows = (equations.coupled @ mass_at(lines, errors)).astype(complex)
        rows = rows if turn is None else rows @ turn[0]
        for place, (row, column) in enumerate(np.ndindex(n, len(rows))):
            operators[equations.coupling.start + place, 2, row, :DOFS] = rows[column]
    if len(equations.shapes):
        bent = times_turn(np.concatenate([equations.shapes, -equations.shapes], axis=2).astype(complex), turn)
        operators[equations.shape, :3] = (parts[:, None] @ bent).swapaxes(0, 1)
    if lines.errors:
        pulled = inertia_rows(equations, parameters)
        elastic = parts @ difference
        for body, half_of_motion in enumerate((slice(0, DOFS), slice(DOFS, 2 * DOFS))):
            sign = 1.0 - 2.0 * body
            maps = np.moveaxis(lines.maps[body], 2, 0)[:, None]
            operators[p:, :3, :, half_of_motion] = sign * elastic @ maps
        operators[p:, 2, :, :DOFS] -= pulled @ mass_at(lines, errors) @ np.moveaxis(lines.maps[0], 2, 0)
        heavy = (pulled @ lines.mass_changes).astype(complex)
        operators[p:, 2, :, :DOFS] -= heavy if turn is None else heavy @ turn[0]
    return operators
