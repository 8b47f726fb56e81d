"""The plane of the ligament: its prior, the stiffness in it, K and D about the footplate centre.

A ligament in a plane of its own couples piston and rocking to the motion in that plane: Z_rc = Y Z_cc with a
real Y, for a ring at the height h above the footplate centre Y[alpha, z] = h = -Y[gamma, x]. The piston
equations determine Y and Z' = Z_rr - Y Z_cc Y^T (K', D' about the ligament's own plane); the equations of x,
z and beta give Z_cc, and K = K' + Y K_cc Y^T follows by draws, since the height enters squared.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

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
_INFORMED = 0.9  # sd over that without data, below which the data determine a stiffness
# The grid of the posterior of a stiffness: up to 4 sd of the prior, down to a hundredth of that (stiffer than
# nothing), and 8 sd of the data about the estimate in steps of a twentieth.
_PRIOR_SD, _LEAST, _PRIOR_STEPS = 4.0, 0.01, 400
_DATA_SD, _DATA_STEPS = 8.0, 321


@cache
def _calibrated() -> dict[str, float]:
    """Return the numbers of the ligament that were calibrated on simulated ears, by name."""
    table = tomllib.loads(Path(__file__).with_name("calibrated.toml").read_text(encoding="utf-8"))
    return {name: float(entry["value"]) for name, entry in table["ligament"].items()}


def applies(data: Data) -> bool:
    """Return whether the plane of the ligament can be estimated: motion and mass have six degrees."""
    return data.dof == PISTON_DOF and data.measured == DOF_NAMES and data.mass_known == DOF_NAMES


def coupling_scale(data: Data) -> Array:
    """Return SI over scaled of Y, (3, 3)."""
    return np.asarray(data.root_mass[data.rows][:, None] / data.root_mass[data.columns][None, :])


def coupling_prior(data: Data) -> Prior:
    """Return what is known of Y: a plane at .15 +- .15 mm, tilted by 3 degrees, of an uneven ring."""
    known = _calibrated()
    height, spread, apart = (known[f"height{name}_mm"] for name in ("", "_sd", "_difference_sd"))
    tilt, turned, second = (known[f"{name}_sd"] for name in ("tilt", "torsion", "second_order"))
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
    """Stiffness and damping in the plane of the ligament (x, z, beta), about its centre."""

    entries: Array  # (12,): of K_cc and D_cc, SI
    covariance: Array  # (12, 12)
    # whether the in-plane equations fit and determine the stiffness along x and z; where they leave one open,
    # the usual ratio to the piston's is given
    determined: bool
    p_value: float | None  # of their chi2


def in_plane(found: Fit) -> InPlane:
    """Fit the equations of x, z and beta, with weak priors from the piston's stiffness.

    They are a second fit with Y as the first left it: a misfit in the plane does not reach K' and D'.
    """
    from scipy.special import chdtrc

    data, at, p_value = found.data, found.at, None
    parts = found.likelihood.parts(found.theta)
    lines = data.corrected(found.theta[at["shared"]], (parts.structure, parts.base), parts.mass)
    scale, usual = entry_scale(found, data.columns), _by_ratio(found, "inplane_stiffness")
    weak = Prior(usual.mean / scale, usual.covariance / np.outer(scale, scale))
    model = Model(
        found.likelihood.model.law,
        INPLANE,
        Prior(found.theta[at["coupling"]], found.covariance[at["coupling"], at["coupling"]]),
        entries=weak,
        law_value=next(iter(found.theta[at["law"]].tolist()), None),
    )
    likelihood = Likelihood(lines, model, weights=found.weights)
    for share in (None, 1.0, 0.3):
        theta = likelihood.mean.copy()
        try:
            if share is None:
                theta = start_of(likelihood, theta)
            else:
                theta[: len(scale)] *= share
            theta, chi2, _, converged = minimise(likelihood, theta, 1e-5, 40)
            covariance, _ = likelihood.covariance(theta, chi2 / (6 * lines.count))
        except np.linalg.LinAlgError:
            continue
        p_value = float(chdtrc(6 * lines.count, chi2))
        if converged and p_value > _calibrated()["inplane_least_p"]:
            return _with_usual_ratio(found, likelihood, weak, theta, covariance, p_value)
    usual = _by_ratio(found, "inplane_default")
    return InPlane(usual.mean, usual.covariance, False, p_value)


def _with_usual_ratio(
    found: Fit, likelihood: Likelihood, weak: Prior, theta: Array, covariance: Array, p_value: float
) -> InPlane:
    """Combine the fitted K_cc and D_cc, SI, with the usual ratio as their prior.

    Where the deflection in the plane drowns in the noise, a stiffness that is much too small fits as well,
    and its sd falls with its square. What noise leaves alike is the compliance: each stiffness is the mean of
    its posterior, for a normal compliance as precise as at this stiffness. The sd of the other entries grows
    with the square of the stiffness, at most to that of the usual ratio.
    """
    usual, scale = _by_ratio(found, "inplane_default"), entry_scale(found, found.data.columns)
    count, usual_sd = len(scale), np.sqrt(np.diag(usual.covariance))
    entries, sd = theta[:count] * scale, np.sqrt(np.maximum(np.diag(covariance)[:count], 1e-300)) * scale
    there, _ = likelihood.covariance(np.concatenate([usual.mean / scale, theta[count:]]))
    beforehand = np.diag(weak.covariance)
    precision = [
        np.sqrt(np.maximum(1.0 / np.diag(spread)[:count] - 1.0 / beforehand, 0.0)) / scale * at**2
        for spread, at in ((covariance, entries), (there, usual.mean))
    ]
    places = diagonal(3)
    means, after, determined = _posterior_stiffnesses(
        entries[places], np.transpose(precision)[places], usual.mean[places], usual_sd[places]
    )
    grown = np.maximum(np.hypot(means, after) / np.maximum(entries[places], sd[places]), 1.0)
    widened = sd * np.tile(vector(np.outer(grown, grown)), 2)
    widened = np.minimum(widened, np.maximum(usual_sd, sd))
    entries[places], widened[places] = means, after
    factor = scale * widened / sd
    return InPlane(entries, covariance[:count, :count] * np.outer(factor, factor), determined, p_value)


def _posterior_stiffnesses(
    fitted: Array, precisions: Array, usual: Array, usual_sd: Array
) -> tuple[Array, Array, bool]:
    """Return means and sd of the stiffnesses of x, z, beta, and whether data determine those of x and z."""
    means, sds, determined = np.zeros(3), np.zeros(3), list[bool]()
    for place in range(3):
        expected = float(usual[place]), float(usual_sd[place])
        near, far = precisions[place].tolist()
        means[place], sds[place] = _posterior_of_stiffness(float(fitted[place]), (near, far), *expected)
        _, unseen = _posterior_of_stiffness(expected[0], (0.0, 0.0), *expected)
        determined.append(bool(sds[place] < _INFORMED * unseen))
    return means, sds, all(determined[:2])


def _posterior_of_stiffness(
    fitted: float, precision: tuple[float, float], usual: float, usual_sd: float
) -> tuple[float, float]:
    """Return mean and sd of a stiffness whose compliance was observed.

    Its precision (1 / sd) is known at the fitted and at the usual stiffness; between, by the logarithms.
    """
    most = usual + _PRIOR_SD * usual_sd
    fitted = max(fitted, _LEAST * most)
    steps = np.linspace(-_DATA_SD, _DATA_SD, _DATA_STEPS)
    near = 1.0 / fitted + steps / max(precision[0], 1e-300)
    near = near[(near > 1.0 / most) & (near < 1.0 / (_LEAST * most))]
    stiffness = np.unique(np.concatenate([np.linspace(_LEAST, 1.0, _PRIOR_STEPS) * most, 1.0 / near]))
    way = np.log(stiffness / fitted) / np.log(usual / fitted) if usual != fitted else np.zeros(len(stiffness))
    way = np.clip(way, 0.0, 1.0)
    between = max(precision[0], 1e-300) ** (1.0 - way) * max(precision[1], 1e-300) ** way
    cost = 0.5 * ((between * (1.0 / stiffness - 1.0 / fitted)) ** 2 + ((stiffness - usual) / usual_sd) ** 2)
    weight = np.exp(cost.min() - cost) * np.gradient(stiffness)
    weight /= weight.sum()
    mean = float(weight @ stiffness)
    return mean, float(np.sqrt(weight @ (stiffness - mean) ** 2))


def usual_ratio() -> str:
    """Return the stiffness in the plane over the piston's that is assumed, with its sd, in words."""
    known = _calibrated()
    return f"{known['inplane_default']:g} ± {known['inplane_default_sd']:g}"


def _by_ratio(found: Fit, name: str) -> Prior:
    """Return K_cc and D_cc, SI, by a calibrated ratio to the piston's: torsion that of a ring of 1 mm."""
    ratio, ratio_sd = (_calibrated()[name + ending] for ending in ("", "_sd"))
    scale = entry_scale(found)
    stiffness = found.theta[0] * scale[0]
    least = 0.05 * stiffness / found.data.reference**found.law.time_power
    sd = np.array([[ratio_sd, 1.0, _MM], [1.0, ratio_sd, _MM], [_MM, _MM, ratio * _MM**2]])
    both = stiffness, max(found.theta[6] * scale[6], least)
    mean = [vector(np.diag([ratio, ratio, ratio * _MM**2])) * value for value in both]
    spread = [vector(sd) * value for value in both]
    return Prior(np.concatenate(mean), np.diag(np.concatenate(spread) ** 2))


@dataclass(frozen=True)
class Posterior:
    """What a fit says of K and D about the footplate centre, SI, as draws."""

    estimate: Array  # (n (n + 1),): K and D
    draws: Array = field(repr=False)  # (draws, n (n + 1))
    spread: Array = field(repr=False)  # (draws, p): draws of theta that they belong to, less the estimate
    plane_estimate: Array  # K' and D' about the plane of the ligament; the same where it is not estimated
    plane_draws: Array = field(repr=False)


def posterior(
    found: Fit, plane: InPlane | None, draws: int = 2000, seed: int = 0, bent: Array | None = None
) -> Posterior:
    """Draw K and D about the footplate centre: K = K' + Y K_cc Y^T.

    ``bent`` (k, p, t) is the second order of K and D in the shared errors (`fitting.solve.bend`).
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
    if plane is None:
        return Posterior(own_estimate, own, spread, own_estimate, own)
    coupling, scale = found.theta[found.at["coupling"]], coupling_scale(found.data).ravel()
    inside = plane.entries + normal[:, size:] @ root_of(plane.covariance).T
    estimate = own_estimate + _lifted(coupling[None] * scale, plane.entries[None], n)[0]
    whole = own + _lifted((coupling + spread[:, found.at["coupling"]]) * scale, inside, n)
    return Posterior(estimate, whole, spread, own_estimate, own)


def _lifted(couplings: Array, inside: Array, n: int) -> Array:
    """Return the entries of Y K_cc Y^T and Y D_cc Y^T for draws of Y and of K_cc, D_cc."""
    turned = couplings.reshape(len(couplings), n, -1)
    parts = [vector(turned @ part @ turned.swapaxes(1, 2)) for part in split(inside, 3)]
    return np.concatenate(parts, axis=1)


def heights(coupling: Array, covariance: Array) -> tuple[float, float]:
    """Return the weighted mean height of the plane above the footplate centre and its sd, m, of Y in SI."""
    places, signs = [4, 6], np.array([1.0, -1.0])
    own = covariance[np.ix_(places, places)] * np.outer(signs, signs)
    weights = np.linalg.solve(own, np.ones(2))
    values = np.array([coupling[1, 1], -coupling[2, 0]])
    return float(weights @ values / weights.sum()), float(1.0 / np.sqrt(weights.sum()))
