"""Least squares over positive semidefinite K and D: a primal-dual interior point method.

Minimise p^T H p / 2 - g^T p subject to K(p) >= 0, D(p) >= 0 and bounds. The multipliers Z >= 0 of the two
matrices and those of the bounds fulfil Z S = mu 1 on the central path; steps solve the symmetrised equations
of Helmberg, Rendl, Vanderbei and Wolkowicz (1996, doi:10.1137/0806020) with a predictor and corrector
(Mehrotra 1992, doi:10.1137/0802028). At a dual feasible point sum <Z, S> is the duality gap: a certificate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.fitting.errors import FittingError
from legacy.fitting.model.parameter_vector import basis, split
from legacy.stapeskit.arrays import Array

# A fit that needs more steps is reported as not converged.
_MOST_STEPS = 60
# Share of the way to the border of the cone that a step takes (Nocedal and Wright 2006, 14.2).
_SHORTEN = 0.99
# Relative residual of the dual at which it counts as fulfilled.
_FEASIBLE = 1e-8


@dataclass(frozen=True)
class _Cone:
    """Slack S and multiplier Z of both matrices, (2, n, n), and of the bounds, (b,)."""

    slack: Array
    multiplier: Array
    bound_slack: Array
    bound_multiplier: Array

    @property
    def gap(self) -> float:
        """Return the complementarity <Z, S> over matrices and bounds."""
        return float(np.sum(self.slack * self.multiplier) + self.bound_slack @ self.bound_multiplier)


def nearest(
    hessian: Array,
    linear: Array,
    start: Array,
    n: int,
    gap: float,
    lower: Array | None = None,
    upper: Array | None = None,
) -> tuple[Array, float, int]:
    """Minimise p^T H p / 2 - g^T p with K >= 0, D >= 0 and bounds.

    Parameters
    ----------
    hessian : ndarray, (p, p)
        H, positive semidefinite.
    linear : ndarray, (p,)
        g.
    start : ndarray, (p,)
        Both matrices positive definite, strictly between the bounds.
    gap : float
        Duality gap to end with, in units of the objective.
    lower, upper : ndarray, (p,), optional
        Bounds, infinite where there is none.

    Returns
    -------
    parameters : ndarray, (p,)
    gap : float
        Upper bound of the distance of the objective from its minimum.
    steps : int

    Raises
    ------
    FittingError
        The equations are numerically singular.
    """
    signs, limits = _bounds(lower, upper, len(start))
    try:
        return _path(hessian, linear, start, n, gap, signs, limits)
    except np.linalg.LinAlgError as fault:
        raise FittingError.of(
            "the equations",
            "numerically solvable for K >= 0 and D >= 0",
            "equations that rounding makes singular",
            next_step="Measure more lines, or fit fewer degrees of freedom with {dof}",
        ) from fault


def _path(
    hessian: Array, linear: Array, start: Array, n: int, gap: float, signs: Array, limits: Array
) -> tuple[Array, float, int]:
    """Follow the central path until rounding dominates at the latest; return the last point and its gap."""
    now = np.array(start)
    slack = np.stack(split(now, n))
    bound_slack = signs @ now - limits
    order = 2 * n + len(limits)
    level = max(_excess(hessian, linear, now) / order, gap)
    cone = _Cone(slack, level * _inverse(slack), bound_slack, level / bound_slack)
    size = float(np.max(np.abs(linear))) + 1e-300
    for count in range(1, _MOST_STEPS + 1):
        dual = linear - hessian @ now + _adjoint(cone.multiplier, n) + signs.T @ cone.bound_multiplier
        if cone.gap <= gap and float(np.max(np.abs(dual))) <= _FEASIBLE * size:
            return now, cone.gap, count
        if count > 1 and _outside_cone(cone):
            return now, cone.gap, count
        inverse = _inverse(cone.slack)
        factor = _inverse(np.linalg.cholesky(_regular(hessian + _schur(cone, inverse, signs, n))))
        plain = linear - hessian @ now
        nothing = np.zeros_like(cone.slack)
        still = np.zeros(len(limits))
        move, ahead = _step(cone, inverse, factor, plain, signs, n, 0.0, nothing, still)
        reach, push = _lengths(cone, ahead)
        level = cone.gap / order
        reached = _move_cone(cone, ahead, reach, push).gap / order
        centre = min((reached / level) ** 3, 1.0) * level
        twist = ahead.multiplier @ ahead.slack @ inverse
        bend = ahead.bound_multiplier * ahead.bound_slack / cone.bound_slack
        move, ahead = _step(cone, inverse, factor, plain, signs, n, centre, twist, bend)
        reach, push = _lengths(cone, ahead)
        now = now + reach * move
        cone = _move_cone(cone, ahead, reach, push)
    return now, max(cone.gap, 0.0), _MOST_STEPS


def _outside_cone(cone: _Cone) -> bool:
    """Return whether rounding has moved a slack or a multiplier out of the cone."""
    both = np.concatenate([cone.slack, cone.multiplier])
    return bool(np.any(np.linalg.eigvalsh(both)[:, 0] <= 0.0))


def _excess(hessian: Array, linear: Array, start: Array) -> float:
    """Return how far the objective at the start lies above its unconstrained minimum."""
    slope = hessian @ start - linear
    free = np.linalg.lstsq(hessian, slope, rcond=1e-13)[0]
    return max(0.5 * float(slope @ free), 0.0)


def _bounds(lower: Array | None, upper: Array | None, count: int) -> tuple[Array, Array]:
    """Return bounds as rows: signs @ p >= limits."""
    rows, limits = [], []
    for bound, sign in ((lower, 1.0), (upper, -1.0)):
        if bound is not None:
            for place in np.flatnonzero(np.isfinite(bound)):
                row = np.zeros(count)
                row[place] = sign
                rows.append(row)
                limits.append(sign * bound[place])
    return np.array(rows).reshape(-1, count), np.array(limits)


def _adjoint(matrices: Array, n: int) -> Array:
    """Return <E_k, Z> for the entries of both matrices, (p,)."""
    flat = basis(n).reshape(-1, n * n)
    return (matrices.reshape(2, -1) @ flat.T).reshape(-1)


def _schur(cone: _Cone, inverse: Array, signs: Array, n: int) -> Array:
    """Return sum over the constraints of <E_k, Z E_l S^-1>, symmetrised."""
    units = basis(n)
    flat = units.reshape(-1, n * n)
    products = inverse[:, None] @ units @ cone.multiplier[:, None]
    blocks = products.reshape(2, -1, n * n) @ flat.T
    half = len(flat)
    filled = np.zeros((2 * half, 2 * half))
    filled[:half, :half] = blocks[0]
    filled[half:, half:] = blocks[1]
    if len(signs):
        filled += signs.T @ (signs * (cone.bound_multiplier / cone.bound_slack)[:, None])
    return 0.5 * (filled + filled.T)


def _regular(matrix: Array) -> Array:
    """Return the matrix with a diagonal that rounding cannot make singular."""
    regular = matrix.copy()
    regular[np.diag_indices_from(regular)] *= 1.0 + 1e-14
    return regular


def _step(
    cone: _Cone,
    inverse: Array,
    factor: Array,
    plain: Array,
    signs: Array,
    n: int,
    centre: float,
    twist: Array,
    bend: Array,
) -> tuple[Array, _Cone]:
    """Return the step of the parameters and those of slacks and multipliers."""
    wanted = centre * inverse - _symmetric(twist)
    wanted_bound = centre / cone.bound_slack - bend
    move = factor.T @ (factor @ (plain + _adjoint(wanted, n) + signs.T @ wanted_bound))
    slack = np.stack(split(move, n))
    multiplier = wanted - cone.multiplier - _symmetric(cone.multiplier @ slack @ inverse)
    bound_slack = signs @ move
    bound = wanted_bound - cone.bound_multiplier * (1.0 + bound_slack / cone.bound_slack)
    return move, _Cone(slack, multiplier, bound_slack, bound)


def _inverse(matrices: NDArray[np.floating]) -> Array:
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def _symmetric(matrices: Array) -> Array:
    return 0.5 * (matrices + matrices.transpose(0, 2, 1))


def _lengths(cone: _Cone, ahead: _Cone) -> tuple[float, float]:
    """Return how far slacks and multipliers may go, at most 1."""
    both = np.concatenate([cone.slack, cone.multiplier])
    moves = np.concatenate([ahead.slack, ahead.multiplier])
    roots = _inverse(np.linalg.cholesky(both))
    lowest = np.linalg.eigvalsh(roots @ moves @ roots.transpose(0, 2, 1))[:, 0]
    ends = np.array([lowest[:2].min(), lowest[2:].min()])
    if len(cone.bound_slack):
        ends[0] = min(ends[0], float(np.min(ahead.bound_slack / cone.bound_slack)))
        ends[1] = min(ends[1], float(np.min(ahead.bound_multiplier / cone.bound_multiplier)))
    reach, push = np.minimum(1.0, _SHORTEN / np.maximum(-ends, 1e-12))
    return float(reach), float(push)


def _move_cone(cone: _Cone, ahead: _Cone, reach: float, push: float) -> _Cone:
    return _Cone(
        cone.slack + reach * ahead.slack,
        cone.multiplier + push * ahead.multiplier,
        cone.bound_slack + reach * ahead.bound_slack,
        cone.bound_multiplier + push * ahead.bound_multiplier,
    )
