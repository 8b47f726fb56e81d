"""How the estimating equations move with the measured motion: exact derivatives, all parameters at once.

The score of parameter k is g_k = sum over lines of w Re(a_k^H c), with the multiplier c = V e (V = Ce^-1, or
the fixed weights of an equation-error estimate), a_k = s_k E_k y', and y' = dq - G c (ml) or dq (the others).
With the residual e = Z dq - f a change of the motion at fixed noise gives

    dg_k = Re[ v_k^H (Z ddq - df) + r_k^H ddq ],  r_k = conj(s_k) E_k c,  v_k = V (a_k - G^H r_k).

So the effect of any number of common errors is one contraction of this slope with their derivatives of q.
"""

from __future__ import annotations

import numpy as np

from legacy.fitting.estimators import ml
from legacy.fitting.estimators.problem import Problem
from legacy.fitting.model.parameter_vector import split
from legacy.fitting.model.scaled_lines import Lines, evaluate, motion_rows, regressor
from legacy.stapeskit.arrays import Array, ComplexArray


def slope_by_motion(problem: Problem, lines: Lines, parameters: Array) -> ComplexArray:
    """Return the derivative C of the estimating equations by the measured motion.

    Parameters
    ----------
    lines : Lines
        Its scaled equations.
    parameters : ndarray, (p,)
        Scaled.

    Returns
    -------
    ndarray, (lines, m, p), complex
        dg_k = Re sum over lines and motions of conj(C) dq, with dq in m and rad, noise left as it is.
    """
    by_difference, by_force = _slopes(problem, lines, parameters)
    difference, inertia = motion_rows(
        problem.observation, problem.mass_rows(), problem.scale, problem.mass_on_base
    )
    square = (lines.omega**2)[:, None, None]
    return np.asarray(difference.T @ by_difference + square * (inertia.T @ by_force))


def contract(slope: ComplexArray, changes: ComplexArray) -> Array:
    """Return the changes of the estimating equations (p, k) for changes of q (k, lines, m)."""
    flat = slope.reshape(-1, slope.shape[2])
    moved = changes.reshape(len(changes), -1)
    return np.asarray(flat.real.T @ moved.real.T + flat.imag.T @ moved.imag.T)


def _slopes(problem: Problem, lines: Lines, parameters: Array) -> tuple[ComplexArray, ComplexArray]:
    """Return the slopes by dq and by f, (lines, n, p) each."""
    state = evaluate(parameters, lines)
    stiffness, damping = split(parameters, lines.n)
    dynamic = stiffness + lines.factor[:, None, None] * damping
    corrected = problem.method.likelihood
    inverse = problem.method.precision(lines, state)
    multiplier = np.einsum("lij,jl->il", inverse, state.residual)
    pulled = _by_line(regressor(multiplier, lines.factor.conj()))
    motion = lines.dq
    if corrected:
        motion = motion - np.einsum("ijl,jl->il", state.gain, multiplier)
    columns = _by_line(regressor(motion, lines.factor))
    inner = columns
    if corrected:
        inner = columns - np.moveaxis(state.gain, 2, 0).conj().transpose(0, 2, 1) @ pulled
    through = inverse @ inner
    if corrected and problem.options.student:
        distance = np.sum((state.residual.conj() * multiplier).real, axis=0)
        terms = np.einsum("lip,il->lp", columns.conj(), multiplier).real
        weights, added = ml.robust_slope(distance, terms, lines)
        through = weights[:, None, None] * through
        pulled = weights[:, None, None] * pulled
        through = through + 2.0 * multiplier.T[:, :, None] * added[:, None, :]
    return dynamic.conj().transpose(0, 2, 1) @ through + pulled, -through


def _by_line(array: ComplexArray) -> ComplexArray:
    return np.ascontiguousarray(np.moveaxis(array, 1, 0))
