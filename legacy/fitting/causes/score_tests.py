"""Directed scores: the misfit that one further unknown would explain, to first order.

With the unknowns p of a fit and a further unknown t, the efficient score is S = g_t - A_tp A_pp^-1 g_p, of
variance J = [-A_tp A_pp^-1, 1] V [...]^T (information A, spread of the scores V): z = S / sqrt(J) is normal
with unit variance when nothing is wrong, -S / (A_tt - A_tp A_pp^-1 A_pt) estimates the unknown (Rao 1948;
Bera and Bilias 2001).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legacy.fitting.ligament.equations import Equations, Term
from legacy.fitting.ligament.inplane_stiffness import inverse_of
from legacy.fitting.ligament.joint_covariance import joint_covariance
from legacy.fitting.ligament.joint_fit import JointFit, expand
from legacy.fitting.ligament.joint_lines import JointLines
from legacy.stapeskit.arrays import Array


@dataclass(frozen=True)
class Scores:
    """Scores of further unknowns.

    Attributes
    ----------
    z : ndarray, (t,)
        Over their standard deviation.
    estimate, sd : ndarray, (t,)
        Of the unknowns, to first order.
    correlation : ndarray, (t, t)
        Of the scores: near one where two causes look alike.
    response : ndarray, (p, t)
        How the other parameters answer to an unknown that is there and left out.
    information : ndarray, (t, t)
        Of the unknowns, with the other parameters free: what a chi2 that lacks them rises by.
    """

    z: Array
    estimate: Array
    sd: Array
    correlation: Array
    response: Array
    information: Array

    @property
    def p_values(self) -> Array:
        """Probability of such a score, or a larger one, (t,)."""
        from scipy.special import erfc

        return np.asarray(erfc(np.abs(self.z) / np.sqrt(2.0)))


def scores(lines: JointLines, equations: Equations, fit: JointFit, terms: tuple[Term, ...]) -> Scores:
    """Return the scores of further unknowns at a fit."""
    extended = equations.with_terms(terms)
    count = len(terms)
    parameters = np.insert(fit.parameters, equations.unknowns, np.zeros(count))
    at = expand(lines, extended, parameters)
    there = replace(fit, parameters=parameters, at=at)
    known, spread = joint_covariance(lines, extended, there)
    new = np.zeros(len(parameters), dtype=bool)
    new[equations.unknowns : equations.unknowns + count] = True
    old = ~new
    inverse = inverse_of(known[np.ix_(old, old)])
    across = known[np.ix_(new, old)] @ inverse
    combine = np.zeros((count, len(parameters)))
    combine[:, new] = np.eye(count)
    combine[:, old] = -across
    score = combine @ at.gradient
    variance = max(1.0, fit.level) * combine @ spread @ combine.T
    deviation = np.sqrt(np.maximum(np.diag(variance), 1e-300))
    information = known[np.ix_(new, new)] - across @ known[np.ix_(old, new)]
    known_of_each = np.maximum(np.diag(information), 1e-300)
    correlation = variance / np.outer(deviation, deviation)
    return Scores(
        score / deviation,
        -score / known_of_each,
        deviation / known_of_each,
        correlation,
        across.T,
        0.5 * (information + information.T),
    )
