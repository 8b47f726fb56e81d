"""The joint fit within K', D' >= 0, where the free one leads outside."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from legacy.fitting.estimators.semidefinite_roots import (
    Expansion,
    Objective,
    active_names,
    minimise,
    minimise_near,
)
from legacy.fitting.ligament.equations import Equations
from legacy.fitting.ligament.joint_fit import JointFit, expand
from legacy.fitting.ligament.joint_lines import JointLines
from legacy.fitting.ligament.misfit import fit_with_noise, is_explained
from legacy.stapeskit.arrays import Array

Search = Callable[[Expansion, Objective, Array, int], tuple[Array, bool, int]]


def fit_held(
    lines: JointLines, equations: Equations, near: Array, others: Array
) -> tuple[JointFit, tuple[str, ...]]:
    """Minimise within K', D' >= 0; return the fit and the names of active constraints.

    The path from the usual size can end where K' and D' vanish together (fitting.ligament.misfit); the
    descent from the plain model's estimate seldom does. The lower of both ends is returned.

    Parameters
    ----------
    equations : Equations
        Without further terms.
    near : ndarray, (12,)
        K and D of the plain model.
    others : ndarray, (p - 12 + k,)
        Where the unknowns after K' and D' and the shared errors start.
    """

    def descent(wide: JointLines, start: Array, _: float = 1.0) -> JointFit:
        return _hold_within_limits(wide, equations, start, minimise_near)

    begin = np.concatenate([near, others])
    ends = (_hold_within_limits(lines, equations, others, minimise), descent(lines, begin))
    fit = min(ends, key=lambda end: end.chi2)
    if not is_explained(fit):
        fit = fit_with_noise(lines, equations, begin, descent)
    return fit, active_names(fit.parameters[: equations.entries], equations.n)


def _hold_within_limits(lines: JointLines, equations: Equations, start: Array, search: Search) -> JointFit:
    """Return where a search within the limits ends."""

    def value(parameters: Array) -> float:
        try:
            return expand(lines, equations, parameters, np.empty(0)).value
        except np.linalg.LinAlgError:
            return float("inf")

    def expansion(parameters: Array) -> tuple[float, Array, Array]:
        at = expand(lines, equations, parameters)
        return at.value, at.gradient, at.hessian

    parameters, converged, steps = search(expansion, value, start, equations.n)
    at = expand(lines, equations, parameters)
    n_dof = 2 * equations.n * lines.count - equations.prior.free
    return JointFit(parameters, 2.0 * at.value, n_dof, converged, steps, at)
