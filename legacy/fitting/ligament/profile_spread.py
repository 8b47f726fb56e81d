"""How far K reaches where the data are weak and chi2 of the joint fit is no parabola.

In a band far from the poles the deflection drowns in the noise: a stiffness that is much too small then
lowers chi2 by no more than noise does, and its standard deviation falls with it. The profile of chi2 over an
entry on the diagonal of K' shows how far it reaches (fitting.uncertainty.profile); what lies beyond 1.96
standard deviations is added, with the other unknowns that follow it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legacy.fitting.ligament.equations import Equations
from legacy.fitting.ligament.inplane_stiffness import inverse_of
from legacy.fitting.ligament.joint_covariance import joint_covariance
from legacy.fitting.ligament.joint_fit import NOISY_TOLERANCE, JointFit, fit_joint
from legacy.fitting.ligament.joint_lines import JointLines
from legacy.fitting.ligament.ligament_fit import LigamentFit
from legacy.fitting.ligament.prior import Prior
from legacy.fitting.uncertainty.profile import QUANTILE_95
from legacy.stapeskit.arrays import Array

# Relative standard deviation of an entry on the diagonal of K' above which its profile is looked at: a normal
# distribution of 1 / K and one of K differ by that share of a standard deviation.
WEAK = 0.25
# Times its value, or its standard deviation where that is larger, that an entry is followed: beyond, its
# standard deviation is ten times as large.
_FARTHEST = 20.0
# Computation: steps of a fit with the entry held, and the sd of the entry over that of the hold.
_MOST, _SHARP = 15, 1e2


def profile_spread(ligament: LigamentFit) -> Array:
    """Return columns E (24, k): by E E^T the mean square error exceeds the covariance; SI.

    About the footplate centre and, in the second half, about the plane of the ligament; none where the data
    determine K well.
    """
    lines, equations, fit = ligament.lines, ligament.equations, ligament.joint
    known, spread = joint_covariance(lines, equations, fit)
    inverse = inverse_of(known)
    covariance = max(1.0, fit.level) * inverse @ spread @ inverse
    places = _diagonal(equations.n)
    value, sd = fit.parameters[places], np.sqrt(np.diag(covariance)[places])
    if np.all(sd < WEAK * np.abs(value)):
        return np.zeros((24, 0))
    columns = []
    for place in places:
        own = float(np.sqrt(covariance[place, place]))
        along = covariance[:, place] / covariance[place, place]
        target = float(np.sqrt(QUANTILE_95 * covariance[place, place] / inverse[place, place]))
        path = _Path(lines, equations, fit, along, place, own)
        distance = path.reach(target, _FARTHEST * max(own, abs(fit.parameters[place])))
        beyond = (distance / 1.96) ** 2 - own**2
        if beyond > 0.0:
            change = np.sqrt(beyond) * along[: equations.unknowns]
            columns.append(np.concatenate([ligament.to_centre @ change, ligament.to_plane @ change]))
    return np.stack(columns, axis=1) if columns else np.zeros((24, 0))


class _Path:
    """Fits with one entry larger by a distance, each begun at the one before."""

    def __init__(
        self, lines: JointLines, equations: Equations, fit: JointFit, along: Array, place: int, sd: float
    ) -> None:
        self._lines, self._equations, self._fit = lines, equations, fit
        self._along, self._place, self._sd = along, place, sd
        self._before, self._start = 0.0, fit.parameters

    def reach(self, target: float, farthest: float) -> float:
        """Return the distance at which the root of the rise of chi2 is ``target``, at most ``farthest``."""
        near, low, far = 0.0, 0.0, 1.96 * self._sd
        while True:
            high = self._rise(far)
            if high >= target:
                return near + (far - near) * (target - low) / (high - low)
            if far >= farthest:
                return farthest
            near, low, far = far, high, min(2.0 * far, farthest)

    def _rise(self, distance: float) -> float:
        """Return the root of the rise of chi2."""
        place, prior = self._place, self._equations.prior
        mean, root = prior.mean.copy(), np.vstack([prior.root, np.zeros(len(prior.mean))])
        mean[place], root[-1, place] = self._fit.parameters[place] + distance, _SHARP / self._sd
        equations = replace(self._equations, prior=Prior(mean, root))
        start = self._start + (distance - self._before) * self._along
        try:
            fit = fit_joint(self._lines, equations, start, NOISY_TOLERANCE, _MOST)
        except np.linalg.LinAlgError:
            return float("inf")
        self._before, self._start = distance, fit.parameters
        return float(np.sqrt(max(fit.chi2 - self._fit.chi2, 0.0)))


def _diagonal(n: int) -> list[int]:
    """Return the places of the diagonal of K among the parameters."""
    return [row * n - row * (row - 1) // 2 for row in range(n)]
