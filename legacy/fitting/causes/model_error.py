"""Errors of K and D where the model lacks a cause that the data support.

The error of an uncorrected fit is no noise: with the cause in the model K and D come out elsewhere, by d. The
mean square of the error is d d^T, larger by the variance of the size of the cause. Where the cause is a
ligament that changes over the measurement there is more than one K: c K with a factor c of each line, whose
variance over the lines is added; 1.96 standard deviations then hold the whole range of an even drift (JCGM
100:2008, 4.3.7).
"""

from __future__ import annotations

import numpy as np

from legacy.fitting.ligament.inplane_stiffness import inverse_of
from legacy.fitting.ligament.ligament_fit import LigamentFit
from legacy.fitting.model.damping import DampingLaw
from legacy.fitting.model.parameter_vector import join
from legacy.stapeskit.arrays import Array

# Parts of the lines, in their order, whose residuals are taken as alike: twenty lines in each of a hundred.
# Chosen by judgement.
_PARTS = 5


def cause_error(ligament: LigamentFit, change: Array, sd_share: float, factor: Array | None) -> Array:
    """Return columns (24, k) of the error that a cause makes when it is left out.

    Parameters
    ----------
    ligament : LigamentFit
        Without the cause.
    change : ndarray, (p,)
        Of its unknowns, scaled, when the cause is part of the model.
    sd_share : float
        Standard deviation of the size of the cause over that size.
    factor : ndarray, (lines,), or None
        What the cause multiplies K and D by.

    Returns
    -------
    ndarray
        About the footplate centre and, in the second half, about the plane of the ligament; SI.
    """
    effect = np.concatenate([ligament.change_about_centre(change), ligament.to_plane @ change])
    columns = [effect, sd_share * effect]
    if factor is not None:
        columns.append(float(np.std(factor)) * (_entries(ligament) + effect))
    return np.stack(columns, axis=1)


def law_error(ligament: LigamentFit, other: LigamentFit, omega: Array) -> Array:
    """Return columns (24, 2) of the error where the data support another damping law.

    Notes
    -----
    Its D damps as g D of the law of the fit, where g, the ratio of the imaginary parts of s, depends on the
    frequency: D is off by the mean over the lines and by the spread about it.
    """
    ratio = _loss(other.law, omega) / _loss(ligament.law, omega)
    there, damping = _entries(other), np.tile(np.repeat([0.0, 1.0], 6), 2)
    effect = there * np.where(damping, np.mean(ratio), 1.0) - _entries(ligament)
    return np.stack([effect, float(np.std(ratio)) * damping * there], axis=1)


def minimum_error(ligament: LigamentFit, other: LigamentFit) -> Array:
    """Return the error (24,) where another minimum of the same model is right."""
    return _entries(other) - _entries(ligament)


def _loss(law: DampingLaw, omega: Array) -> Array:
    return np.asarray(law.factor(omega).imag)


def _entries(ligament: LigamentFit) -> Array:
    """Return K and D about both points, (24,)."""
    about_plane = join(ligament.plane_stiffness, ligament.plane_damping)
    return np.concatenate([join(ligament.stiffness, ligament.damping), about_plane])


def unexplained_error(ligament: LigamentFit) -> Array:
    """Return columns (24, blocks) of the error where no cause explains the misfit.

    Notes
    -----
    Residuals of neighbouring lines are alike in a misfit. The scores of an equation are summed over parts of
    the band and runs; how much these sums differ is how far the estimate moves when another part of the band
    is measured (sandwich with clusters, Liang and Zeger 1986, doi:10.1093/biomet/73.1.13).
    """
    lines, equations, fit = ligament.lines, ligament.equations, ligament.joint
    p, n, level = equations.unknowns, equations.n, max(1.0, fit.level)
    assert fit.at.jacobian is not None  # noqa: S101
    scores = 2.0 * (fit.at.jacobian.conj() * fit.at.residual.reshape(-1, 1)).real
    parts = np.array_split(scores.reshape(lines.count, n, -1), _PARTS)
    sums = np.concatenate([part.sum(axis=0) for part in parts]) / level
    prior = np.eye(len(fit.parameters))
    prior[:p, :p] = equations.prior.root.T @ equations.prior.root
    known = (fit.at.hessian - prior) / level + prior
    moved = np.sqrt(len(sums) / (len(sums) - 1.0)) * (inverse_of(known) @ sums.T)[:p]
    return np.concatenate([ligament.to_centre @ moved, ligament.to_plane @ moved])
