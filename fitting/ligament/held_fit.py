"""The joint fit within K', D' >= 0, where the free one leads outside."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fitting.estimators.interior import active_names, minimise
from fitting.ligament.equations import Equations
from fitting.ligament.joint_fit import JointFit, expand
from fitting.ligament.joint_lines import JointLines

Array = NDArray[np.float64]


def fit_held(lines: JointLines, equations: Equations, others: Array) -> tuple[JointFit, tuple[str, ...]]:
    """Minimise within K', D' >= 0; return the fit and the names of active constraints.

    Parameters
    ----------
    lines : JointLines
    equations : Equations
        Without further terms.
    others : ndarray, (p - 12 + k,)
        Where the unknowns after K' and D' and the shared errors start.
    """

    def value(parameters: Array) -> float:
        try:
            return expand(lines, equations, parameters, np.empty(0)).value
        except np.linalg.LinAlgError:
            return float("inf")

    def expansion(parameters: Array) -> tuple[float, Array, Array]:
        at = expand(lines, equations, parameters)
        return at.value, at.gradient, at.hessian

    parameters, converged, steps = minimise(expansion, value, others, equations.n)
    at = expand(lines, equations, parameters)
    n_dof = 2 * equations.n * lines.count - equations.prior.free
    fit = JointFit(parameters, 2.0 * at.value, n_dof, converged, steps, at)
    return fit, active_names(parameters[: equations.entries], equations.n)
