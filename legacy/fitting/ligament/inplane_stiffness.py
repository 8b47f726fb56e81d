"""Stiffness and damping in the plane of the ligament: x, z and beta, about its centre."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legacy.fitting.calibrated import calibrated
from legacy.fitting.estimators.problem import Problem
from legacy.fitting.ligament.equations import Equations
from legacy.fitting.ligament.joint_covariance import joint_covariance
from legacy.fitting.ligament.joint_fit import JointFit, fit_joint
from legacy.fitting.ligament.joint_lines import DOFS, JointLines
from legacy.fitting.ligament.prior import Prior
from legacy.fitting.model.damping import DampingLaw
from legacy.fitting.model.parameter_vector import join, pairs, split
from legacy.fitting.model.principal_axes import PRINCIPAL_DOF
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.spatial import dof_indices

INPLANE_DOF: tuple[str, ...] = ("x", "z", "beta")
ROWS, COLUMNS = dof_indices(PRINCIPAL_DOF), dof_indices(INPLANE_DOF)
_N = len(PRINCIPAL_DOF)
# The stiffness in the plane is needed to a tenth only: a step of a tenth of its uncertainty ends the fit.
_TOLERANCE, _STEPS = 1e-2, 25
# One over the sd of an unknown of the law that is not to move, since the piston equations determine it.
_FIXED = 1e6


@dataclass(frozen=True)
class InplaneStiffness:
    """Stiffness and damping in the plane of the ligament (x, z, beta), about its centre.

    Attributes
    ----------
    stiffness, damping : ndarray, (3, 3)
        SI.
    covariance : ndarray, (12, 12)
        Of their entries.
    determined : bool
        Whether the in-plane equations fit; otherwise the usual ratio to the piston stiffness is given.
    """

    stiffness: Array
    damping: Array
    covariance: Array
    determined: bool


def inplane_stiffness(
    problem: Problem,
    lines: JointLines,
    corrected: JointLines,
    coupling: Array,
    spread: Array,
    plane: tuple[Array, Array],
) -> InplaneStiffness:
    """Fit the rows of x, z and beta in the plane of the ligament, with weak priors from the piston's.

    Parameters
    ----------
    lines, corrected : JointLines
        With all shared errors, and with those of the piston fit removed; the former are needed only where the
        latter do not fit.
    coupling : ndarray, (3, 3)
        Y, scaled.
    spread : ndarray, (k, 3, 3)
        Along each of these Y is known with unit variance.
    plane : (ndarray, ndarray)
        K' and D', SI.

    Notes
    -----
    Without convergence or fit the usual ratio is taken; torsion, which hardly matters, is not believed where
    the matrices are not positive semidefinite.
    """
    from scipy.special import chdtrc

    rows, columns = np.eye(DOFS)[ROWS], np.eye(DOFS)[COLUMNS]
    units = _inplane_units(problem, lines)
    piston = np.array([plane[0][0, 0], max(plane[1][0, 0], 0.05 * plane[0][0, 0] / _time(problem))])
    ratio, ratio_sd = calibrated("ligament.inplane_stiffness"), calibrated("ligament.inplane_stiffness_sd")
    mean, sd = _inplane_prior(piston, ratio, ratio_sd)
    law = scaled_law(problem)
    spare = law.unknowns
    equations = Equations(
        columns + coupling.T @ rows,
        columns,
        np.zeros((0, DOFS)),
        spread.transpose(0, 2, 1) @ rows,
        law,
        Prior.independent(
            np.concatenate([mean / units, spare, np.zeros(len(spread))]),
            np.concatenate([units / sd, np.full(len(spare), _FIXED), np.ones(len(spread))]),
        ),
    )
    begin = np.concatenate([mean / units, spare])
    used = corrected
    fit = _solve(used, equations, begin)
    if fit is not None and chdtrc(fit.n_dof, fit.chi2) < calibrated("ligament.inplane_least_p"):
        used = lines
        fit = _solve(used, equations, fit.parameters)
    mean, sd = _inplane_prior(
        piston, calibrated("ligament.inplane_default"), calibrated("ligament.inplane_default_sd")
    )
    values, covariance = mean.copy(), np.diag(sd**2)
    if fit is None or chdtrc(fit.n_dof, fit.chi2) < calibrated("ligament.inplane_least_p"):
        return InplaneStiffness(*split(values, _N), covariance, False)
    known, spread = joint_covariance(used, equations, fit)
    inverse = inverse_of(known)
    fitted = fit.parameters[: len(units)] * units
    fitted_covariance = (inverse @ spread @ inverse)[: len(units), : len(units)] * np.outer(units, units)
    good = np.arange(len(units))
    if not semidefinite(fitted / units):
        good = good[[_N - 1 not in pair for pair in pairs(_N)] * 2]  # all that do not concern beta
    values[good] = fitted[good]
    covariance[np.ix_(good, good)] = fitted_covariance[np.ix_(good, good)]
    matrices = split(values, _N)
    determined = bool(min(np.linalg.eigvalsh(part[:2, :2])[0] for part in matrices) >= 0.0)
    if not determined:
        return InplaneStiffness(*split(mean, _N), np.diag(sd**2), False)
    return InplaneStiffness(*matrices, covariance, True)


def _solve(lines: JointLines, equations: Equations, begin: Array) -> JointFit | None:
    """Return a converged fit of the in-plane equations, or None."""
    for share in (1.0, 0.3):
        start = np.concatenate([share * begin[: equations.entries], begin[equations.entries :]])
        try:
            fit = fit_joint(lines, equations, start, _TOLERANCE, _STEPS)
        except np.linalg.LinAlgError:
            continue
        if fit.converged:
            return fit
    return None


def scaled_law(problem: Problem) -> DampingLaw:
    """Return the damping law of the scaled frequencies."""
    return problem.law.scaled(problem.scale.omega)


def semidefinite(parameters: Array) -> bool:
    """Return whether the matrices of a parameter vector (12,) are positive semidefinite."""
    return all(np.linalg.eigvalsh(part)[0] >= 0.0 for part in split(parameters, _N))


def inverse_of(matrix: Array) -> Array:
    """Invert a positive definite matrix of different units."""
    root = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return np.asarray(np.linalg.inv(matrix / np.outer(root, root)) / np.outer(root, root))


def coupling_root(covariance: Array) -> Array:
    """Return a root of the covariance (9, 9) of the scaled coupling, (9, 3, 3)."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))).T.reshape(-1, _N, _N))


def _time(problem: Problem) -> float:
    """Return K over D of a damping as strong as the stiffness, in SI, at the reference frequency."""
    return float(problem.scale.omega**problem.law.time_power)


def _inplane_units(problem: Problem, lines: JointLines) -> Array:
    """Return SI over scaled of the entries of K_cc and D_cc, (12,)."""
    root, omega = lines.root_mass[COLUMNS], problem.scale.omega
    product = np.outer(root, root)
    return join(product * omega**2, product * omega ** (2.0 - problem.law.time_power))


def _inplane_prior(piston: Array, ratio: float, ratio_sd: float) -> tuple[Array, Array]:
    """Return mean and sd of the entries of K_cc and D_cc for the piston's K and D, (12,), SI.

    Translations have ``ratio`` times the piston's; torsion that of a ring of 1 mm, known to its own size; the
    other entries are zero, known to the piston's (times 1 mm with torsion).
    """
    arm = 1e-3
    mean, sd = [], []
    for value in piston:
        size = np.diag([ratio, ratio, ratio * arm**2]) * value
        spread = np.array([[ratio_sd, 1.0, arm], [1.0, ratio_sd, arm], [arm, arm, ratio * arm**2]]) * value
        mean.append(size)
        sd.append(spread)
    return join(*mean), join(*sd)
