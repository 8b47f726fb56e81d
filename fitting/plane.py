"""The plane of the ligament: its prior, the stiffness in it, K and D about the footplate centre.

A ligament in a plane of its own couples piston and rocking to the motion in that plane: Z_rc = Y Z_cc with a
real Y, for a ring at the height h above the footplate centre Y[alpha, z] = h = -Y[gamma, x]. The piston
equations determine Y and Z' = Z_rr - Y Z_cc Y^T (K', D' about the ligament's own plane); the equations of x,
z and beta give Z_cc, and K = K' + Y K_cc Y^T follows by draws, since the height enters squared.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from fitting.calibrated import calibrated
from fitting.data import Data
from fitting.draws import root_of, standard_draws
from fitting.entries import diagonal, split, vector
from fitting.likelihood import INPLANE, PLANE, Likelihood, Model, Prior
from fitting.solve import Fit, entry_scale, minimise, start_of
from stapeskit.arrays import Array
from stapeskit.spatial import DOF_NAMES

PISTON_DOF = ("y", "alpha", "gamma")
INPLANE_DOF = ("x", "z", "beta")
_MM = 1e-3
_INFORMED = 0.9  # sd over that before, from which on a stiffness counts as told


def applies(data: Data) -> bool:
    """Return whether the plane of the ligament can be estimated: motion and mass have six degrees."""
    return data.dof == PISTON_DOF and data.measured == DOF_NAMES and data.mass_known == DOF_NAMES


def coupling_scale(data: Data) -> Array:
    """Return SI over scaled of Y, (3, 3)."""
    return np.asarray(data.root_mass[data.rows][:, None] / data.root_mass[data.columns][None, :])


def coupling_prior(data: Data) -> Prior:
    """Return what is known of Y: a plane at .15 +- .15 mm, tilted by 3 degrees, of an uneven ring."""
    height, spread = calibrated("ligament.height_mm"), calibrated("ligament.height_sd_mm")
    apart = calibrated("ligament.height_difference_sd_mm")
    tilt, turned = calibrated("ligament.tilt_sd"), calibrated("ligament.torsion_sd")
    second = calibrated("ligament.second_order_sd")
    mean = np.array([[0.0, 0.0, 0.0], [0.0, height, 0.0], [-height, 0.0, 0.0]])
    sd = np.array([[tilt, tilt, second], [second, spread, turned], [spread, second, turned]])
    covariance = np.diag(sd.ravel() ** 2)
    # Both heights of uneven rings differ little.
    covariance[[4, 6], [4, 6]] = spread**2 + 0.25 * apart**2
    covariance[4, 6] = covariance[6, 4] = -(spread**2 - 0.25 * apart**2)
    si = np.array([[1.0, 1.0, 1.0 / _MM], [_MM, _MM, 1.0], [_MM, _MM, 1.0]])
    scale = (si / coupling_scale(data)).ravel()
    return Prior(mean.ravel() * scale, covariance * np.outer(scale, scale))


def plane_model(data: Data, law: str = "viscous", **more: object) -> Model:
    """Return the model with the plane of the ligament."""
    return Model(law, PLANE, coupling_prior(data), **more)  # type: ignore[arg-type]


@dataclass(frozen=True)
class InPlane:
    """Stiffness and damping in the plane of the ligament (x, z, beta), about its centre.

    Attributes
    ----------
    entries : ndarray, (12,)
        Of K_cc and D_cc, SI.
    covariance : ndarray, (12, 12)
    determined : bool
        Whether the in-plane equations fit and tell the stiffness along x and z; of what they do not tell, the
        usual ratio to the piston's is given.
    p_value : float or None
        Of their chi2.
    """

    entries: Array
    covariance: Array
    determined: bool
    p_value: float | None


def in_plane(found: Fit) -> InPlane:
    """Fit the equations of x, z and beta, with weak priors from the piston's stiffness.

    They are a second fit with Y as the first left it: a misfit in the plane does not reach K' and D'.
    """
    from scipy.special import chdtrc

    data, at = found.data, found.at
    parts = found.likelihood.parts(found.theta)
    lines = data.corrected(found.theta[at["shared"]], (parts.structure, parts.base), parts.mass)
    coupling = Prior(found.theta[at["coupling"]], found.covariance[at["coupling"], at["coupling"]])
    law = found.theta[at["law"]]
    value = float(law[0]) if len(law) else None
    model = Model(found.likelihood.model.law, INPLANE, coupling, law_value=value)
    scale = entry_scale(found, data.columns)
    usual = _usual(
        found, calibrated("ligament.inplane_stiffness"), calibrated("ligament.inplane_stiffness_sd")
    )
    weak = Prior(usual.mean / scale, usual.covariance / np.outer(scale, scale))
    model = replace(model, entries=weak)
    likelihood = Likelihood(lines, model, weights=found.weights)
    p_value = None
    for share in (None, 1.0, 0.3):
        start = likelihood.mean.copy()
        try:
            if share is None:
                start = start_of(likelihood, start)
            else:
                start[:12] *= share
            theta, chi2, _, converged = minimise(likelihood, start, 1e-5, 40)
            covariance, _ = likelihood.covariance(theta, chi2 / (6 * lines.count))
        except np.linalg.LinAlgError:
            continue
        p_value = float(chdtrc(6 * lines.count, chi2))
        if converged and p_value > calibrated("ligament.inplane_least_p"):
            return replace(_told(found, likelihood, weak, theta, covariance, scale), p_value=p_value)
    usual = _usual(found, calibrated("ligament.inplane_default"), calibrated("ligament.inplane_default_sd"))
    return InPlane(usual.mean, usual.covariance, False, p_value)


def _told(
    found: Fit, likelihood: Likelihood, weak: Prior, theta: Array, covariance: Array, scale: Array
) -> InPlane:
    """Return K_cc and D_cc, SI, as a fit tells them with the usual ratio for a prior.

    Where the deflection in the plane drowns in the noise, a stiffness that is much too small fits as well,
    and its sd falls with its square. What noise leaves alike is the compliance: each stiffness is the mean of
    its posterior, for a normal compliance as precise as at this stiffness. The sd of the other entries grows
    with the square of the stiffness, at most to that of the usual ratio.
    """
    usual = _usual(found, calibrated("ligament.inplane_default"), calibrated("ligament.inplane_default_sd"))
    count, stiffnesses = len(usual.mean), diagonal(3)
    beforehand = np.diag(weak.covariance)
    there, _ = likelihood.covariance(np.concatenate([usual.mean / scale, theta[count:]]))
    entries, sd = theta[:count] * scale, np.sqrt(np.maximum(np.diag(covariance)[:count], 1e-300)) * scale
    precision = [
        np.sqrt(np.maximum(1.0 / np.diag(spread)[:count] - 1.0 / beforehand, 0.0)) / scale * at**2
        for spread, at in ((covariance, entries), (there, usual.mean))
    ]
    grown, own, told = np.ones(3), sd.copy(), np.ones(3, dtype=bool)
    for number, place in enumerate(stiffnesses):
        expected, spread = float(usual.mean[place]), float(np.sqrt(usual.covariance[place, place]))
        seen = float(precision[0][place]), float(precision[1][place])
        mean, after = _posterior_of_stiffness(float(entries[place]), seen, expected, spread)
        _, unseen = _posterior_of_stiffness(expected, (0.0, 0.0), expected, spread)
        told[number] = after < _INFORMED * unseen
        grown[number] = max(np.hypot(mean, after) / max(entries[place], sd[place]), 1.0)
        entries[place], own[place] = mean, after
    most = np.maximum(np.sqrt(np.diag(usual.covariance)), sd)
    others = np.minimum(sd * np.tile(vector(np.outer(grown, grown)), 2), most)
    factor = np.where(np.isin(np.arange(count), stiffnesses), own, others) / sd
    joint = covariance[:count, :count] * np.outer(scale * factor, scale * factor)
    return InPlane(entries, joint, bool(np.all(told[:2])), None)


def _posterior_of_stiffness(
    fitted: float, precision: tuple[float, float], usual: float, usual_sd: float
) -> tuple[float, float]:
    """Return mean and sd of a stiffness whose compliance was observed.

    Its precision (1 / sd) is known at the fitted and at the usual stiffness; between, by the logarithms.
    """
    most = usual + 4.0 * usual_sd
    fitted = max(fitted, 0.01 * most)
    near = 1.0 / fitted + np.linspace(-8.0, 8.0, 321) / max(precision[0], 1e-300)
    near = near[(near > 1.0 / most) & (near < 100.0 / most)]
    stiffness = np.unique(np.concatenate([np.linspace(0.01, 1.0, 400) * most, 1.0 / near]))
    way = np.log(stiffness / fitted) / np.log(usual / fitted) if usual != fitted else np.zeros(len(stiffness))
    way = np.clip(way, 0.0, 1.0)
    between = max(precision[0], 1e-300) ** (1.0 - way) * max(precision[1], 1e-300) ** way
    cost = 0.5 * ((between * (1.0 / stiffness - 1.0 / fitted)) ** 2 + ((stiffness - usual) / usual_sd) ** 2)
    weight = np.exp(cost.min() - cost) * np.gradient(stiffness)
    weight /= weight.sum()
    mean = float(weight @ stiffness)
    return mean, float(np.sqrt(weight @ (stiffness - mean) ** 2))


def _usual(found: Fit, ratio: float, ratio_sd: float) -> Prior:
    """Return mean and covariance of K_cc and D_cc, SI, by the piston's: torsion that of a ring of 1 mm."""
    scale = entry_scale(found)
    stiffness = found.theta[0] * scale[0]
    least = 0.05 * stiffness / found.data.reference**found.law.time_power
    means, spreads = [], []
    for value in (stiffness, max(found.theta[6] * scale[6], least)):
        means.append(vector(np.diag([ratio, ratio, ratio * _MM**2])) * value)
        sd = np.array([[ratio_sd, 1.0, _MM], [1.0, ratio_sd, _MM], [_MM, _MM, ratio * _MM**2]])
        spreads.append(vector(sd) * value)
    return Prior(np.concatenate(means), np.diag(np.concatenate(spreads) ** 2))


@dataclass(frozen=True)
class Posterior:
    """What a fit says of K and D about the footplate centre, SI, as draws.

    Attributes
    ----------
    estimate, draws : ndarray, (12,) or (n (n + 1),), and (draws, ...)
        K and D.
    spread : ndarray, (draws, p)
        Draws of theta that they belong to, less the estimate.
    plane_estimate, plane_draws
        K' and D' about the plane of the ligament; the same where it is not estimated.
    plane : InPlane or None
    """

    estimate: Array
    draws: Array = field(repr=False)
    spread: Array = field(repr=False)
    plane_estimate: Array
    plane_draws: Array = field(repr=False)
    plane: InPlane | None


def posterior(
    found: Fit, plane: InPlane | None, draws: int = 2000, seed: int = 0, bent: Array | None = None
) -> Posterior:
    """Draw K and D about the footplate centre: K = K' + Y K_cc Y^T.

    Parameters
    ----------
    bent : ndarray, (k, p, t), optional
        Second order of K and D in the shared errors (`fitting.solve.bend`).
    """
    size, n = len(found.theta), found.likelihood.n
    normal = standard_draws(draws, size + (0 if plane is None else len(plane.entries)), seed)
    spread = normal[:, :size] @ root_of(found.covariance).T
    scale, count = entry_scale(found), found.at["entries"].stop
    first = spread[:, :count]
    for error, second in zip(spread.T[found.at["shared"]], () if bent is None else bent, strict=False):
        first = first - error[:, None] * (spread @ second.T)
    own_estimate, own = found.theta[:count] * scale, (found.theta[:count] + first) * scale
    if found.likelihood.model.law == "fractional" and found.law.free:  # D's unit depends on the exponent
        change = found.data.reference ** -spread[:, found.at["law"]]
        own[:, count // 2 :] *= change
    if plane is None or not found.likelihood.column_units.size or found.likelihood.model.motion != PLANE:
        return Posterior(own_estimate, own, spread, own_estimate, own, None)
    coupling_si = coupling_scale(found.data).ravel()
    couplings = (found.theta + spread)[:, found.at["coupling"]] * coupling_si
    inside = plane.entries + normal[:, size:] @ root_of(plane.covariance).T
    whole = own + _lifted(couplings, inside, n)
    estimate = (
        own_estimate
        + _lifted(found.theta[found.at["coupling"]][None] * coupling_si, plane.entries[None], n)[0]
    )
    return Posterior(estimate, whole, spread, own_estimate, own, plane)


def _lifted(couplings: Array, inside: Array, n: int) -> Array:
    """Return the entries of Y K_cc Y^T and Y D_cc Y^T for draws of Y and of K_cc, D_cc."""
    turned = couplings.reshape(len(couplings), n, -1)
    parts = [vector(turned @ part @ turned.swapaxes(1, 2)) for part in split(inside, 3)]
    return np.concatenate(parts, axis=1)


def heights(coupling: Array, covariance: Array) -> tuple[float, float]:
    """Return the weighted mean height of the plane above the footplate centre and its sd, m.

    Parameters
    ----------
    coupling : ndarray, (3, 3)
        Y, SI.
    covariance : ndarray, (9, 9)
    """
    places, signs = [4, 6], np.array([1.0, -1.0])
    own = covariance[np.ix_(places, places)] * np.outer(signs, signs)
    weights = np.linalg.solve(own, np.ones(2))
    values = np.array([coupling[1, 1], -coupling[2, 0]])
    return float(weights @ values / weights.sum()), float(1.0 / np.sqrt(weights.sum()))
