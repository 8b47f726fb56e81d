"""A joint fit of data that noise and shared errors do not explain: their noise is taken as large as it is.

With the noise as stated a misfit outweighs every prior. The equations B y = 0 have a trivial solution, K, D
and the inertial load zero, which the plane of the ligament reaches where Y M_c q cancels M_r q, far outside
its prior; the larger the misfit, the less that costs. The noise is therefore widened until chi2 equals its
degrees of freedom and neither prior nor shared errors are improbable (the discrepancy principle of Morozov
1966). It comes down from that of the start, so that the fit stays in the valley of K and D.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from legacy.fitting.calibrated import calibrated
from legacy.fitting.ligament.equations import Equations
from legacy.fitting.ligament.joint_fit import NOISY_TOLERANCE, TOLERANCE, JointFit, expand, fit_joint
from legacy.fitting.ligament.joint_lines import JointLines
from legacy.stapeskit.arrays import Array

Descent = Callable[[JointLines, Array, float], JointFit]
# Fits with other noise, the share of it at which chi2 per degree of freedom agrees, and the factor within
# which the least noise is found; the factor by which it grows where it is too small.
_ROUNDS, _AGREES, _CLOSE, _GROWS = 10, 0.9, 1.5, 4.0


def is_explained(fit: JointFit) -> bool:
    """Return whether noise, shared errors and priors explain the data."""
    from scipy.special import chdtrc

    return bool(chdtrc(fit.n_dof, fit.chi2) > calibrated("causes.misfit_p"))


def explained_limit(equations: Equations, lines: int) -> float:
    """Return the chi2 below which noise, shared errors and priors explain the data."""
    from scipy.special import chdtri

    return float(chdtri(2 * equations.n * lines - equations.prior.free, calibrated("causes.misfit_p")))


def fit_any(lines: JointLines, equations: Equations, start: Array) -> JointFit:
    """Fit with the noise as stated or, where that does not explain the data, with as much as there is.

    Parameters and errors are those of `fit_with_noise`.
    """
    fit = fit_joint(lines, equations, start, within=explained_limit(equations, lines.count))
    if fit.converged and is_explained(fit):
        return fit
    return fit_with_noise(lines, equations, start, partial(descend, equations))


def descend(
    equations: Equations,
    lines: JointLines,
    start: Array,
    noise: float,
    most: int = 60,
    within: float = np.inf,
) -> JointFit:
    """Fit lines from a start; the minimum is found less closely where noise is larger than stated.

    It is given up where chi2 with the stated noise will not come ``within`` a limit; what is known beforehand
    and the shared errors may take up to twice their number of it.
    """
    known = len(equations.prior.mean) - equations.prior.free + lines.errors
    limit = within if noise == 1.0 else within / noise + 2.0 * known
    return fit_joint(lines, equations, start, TOLERANCE if noise == 1.0 else NOISY_TOLERANCE, most, limit)


def fit_with_noise(
    lines: JointLines,
    equations: Equations,
    start: Array,
    descent: Descent,
    before: JointFit | None = None,
    rounds: int = _ROUNDS,
) -> JointFit:
    """Fit while the noise is lowered until chi2 per degree of freedom agrees with it, or to the stated one.

    Parameters
    ----------
    start : ndarray, (p,) or (p + k,)
    descent : callable
        Fits lines from a start; its third argument is their noise over the stated one.
    before : JointFit, optional
        A fit without some of the unknowns: it begins with the noise of that fit, and where that was the
        stated one keeps to it. What explains hardly more than it did is left at its noise. When left out, it
        begins with chi2 per degree of freedom at the start.
    rounds : int
        Most fits.

    Returns
    -------
    JointFit
        Its chi2 is that with the stated noise.

    Raises
    ------
    LinAlgError
        The start has no likelihood.
    """
    if before is not None and before.noise == 1.0:
        return descent(lines, start, 1.0)
    free = 2 * equations.n * lines.count - equations.prior.free
    if before is not None:
        noise = before.noise
    else:
        whole = np.concatenate([start, np.zeros(equations.unknowns + lines.errors - len(start))])
        noise = 2.0 * expand(lines, equations, whole, np.empty(0)).value / free
    noise, low, best, best_noise = max(noise, 1.0), 1.0, None, 1.0
    for _ in range(rounds):
        fit = descent(replace(lines, covariance=noise * lines.covariance), start, noise)
        if fit.converged and _is_probable(equations, fit.parameters):
            best, start, best_noise = fit, fit.parameters, noise
            level = 2.0 * expand(lines, equations, start, np.empty(0)).value / free
            if noise <= _CLOSE * low or level > _AGREES * noise:
                break
            if before is not None and level > _AGREES * before.level:
                break
            noise = max(level, float(np.sqrt(low * noise)) if low > 1.0 else 1.0)
        elif fit.given_up:
            break
        elif best is None:
            low, noise = noise, _GROWS * noise
        else:
            low, noise = noise, float(np.sqrt(noise * best_noise))
            if best_noise <= _CLOSE * low:
                break
    best, best_noise = (best, best_noise) if best is not None else (fit, noise)
    at = expand(lines, equations, best.parameters)
    return JointFit(
        best.parameters, 2.0 * at.value, best.n_dof, best.converged, best.iterations, at, best_noise
    )


def _is_probable(equations: Equations, parameters: Array) -> bool:
    """Return whether what is known beforehand, and the shared errors, allow the parameters."""
    from scipy.special import chdtrc

    prior, errors = equations.prior, parameters[equations.unknowns :]
    off = prior.root @ (parameters[: equations.unknowns] - prior.mean)
    known = len(prior.mean) - prior.free
    least = calibrated("causes.misfit_p")
    return bool(chdtrc(known, off @ off) > least and chdtrc(max(len(errors), 1), errors @ errors) > least)
