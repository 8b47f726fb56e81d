"""What makes K and D uncertain, source by source, and what follows for modes and principal axes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fitting import entries
from fitting.draws import standard_draws
from fitting.evidence import Alternative
from fitting.likelihood import Likelihood
from fitting.model import moved_eigenvalues, principal_axes
from fitting.plane import PISTON_DOF, in_plane, posterior
from fitting.solve import Fit, minimise
from stapeskit.arrays import Array

if TYPE_CHECKING:
    from fitting.result import KDFit

NOISE, MODEL_ERROR = "channel_noise", "model_error"
INPLANE_STIFFNESS, PLANE = "inplane_stiffness", "ligament_plane"

_LEAST_LINES, _FARTHEST_LINE = 24, 48  # of a run that show correlations; as far as these are looked for
_BY_CHANCE = 2.0  # standard deviations of a correlation below which it counts as none
_HIDDEN = 3.7  # of chi2 at MISFIT_P: a misfit of so many standard deviations is not seen in it
_CLUSTERS = 5  # parts of the lines whose residuals are taken as alike where no cause explains a misfit
# Relative sd of a diagonal entry from which chi2 is no parabola: 1 / K differs from normal by it.
_WEAK = 0.25
_FARTHEST = 20.0  # sd or values that a weak entry is followed
_CLOSE = 0.8  # of a point inside an interval to one outside, between which its end is taken
_LOSS_FACTOR = 1.0  # to which damping follows a weak stiffness: of soft tissue it is below


def alike_lines(found: Fit) -> float:
    """Return the noise over that stated, 1 at least, that counts as if that of each line were independent.

    Neighbouring lines of a spectrum have noise in common where its window is wider than a line (Hann: 0.67
    and 0.17 with the next two) or where it was smoothed. The variance of a mean is 1 + 2 (r_1 + r_2 + ...)
    times as large, r_k the correlation of lines k apart, up to the first that chance explains. What all far
    lines have in common is a misfit, and is subtracted. It is 1 where chi2 is larger than such noise
    makes it, and where the misfit that chi2 shows, or hides, could make r_1. Where chi2 is smaller than
    that, the noise is as small as residuals show.
    """
    white, run = found.likelihood.look(found.theta)[0], found.data.run
    longest = int(np.max(np.bincount(run), initial=0))
    if longest < _LEAST_LINES or found.weights is not None:
        return 1.0
    size, chance = np.mean(np.abs(white) ** 2), np.sqrt(0.5 / white.size)
    farthest = min(longest // 4, _FARTHEST_LINE)

    def alike(lag: int) -> float:
        pairs = run[lag:] == run[:-lag]
        return float(np.mean((white[lag:] * white[:-lag].conj()).real[pairs]) / size)

    every = np.array([alike(lag) for lag in range(1, farthest + 1)])
    excess = every - np.mean(every[2 * farthest // 3 :])
    near = excess[: int(np.argmax(np.append(excess, 0.0) < _BY_CHANCE * chance))]
    by_misfit = max(1.0 - 1.0 / found.level, 0.0) + _HIDDEN * chance * np.sqrt(2.0)
    by_noise = _HIDDEN * chance * np.sqrt(2.0 + 4.0 * np.sum(near**2))
    if excess[0] < by_misfit or found.level > 1.0 + by_noise:
        return 1.0
    stated = 1.0 if found.level > 1.0 - by_noise else found.level
    return max(stated * (1.0 + 2.0 * float(np.sum(near))), 1.0)


def budget_of(fit: KDFit) -> dict[str, Array]:
    """Return the covariance (p, p) by source; of a shared error what vanishes when it is known."""
    found, start = fit.found, fit.found.at["shared"].start
    whole = fit.about_centre(found.covariance)
    sources = {NOISE: fit.noise_covariance}
    names = np.array(found.data.sources)
    for source in dict.fromkeys(found.data.sources):
        keep = np.concatenate([np.arange(start), start + np.flatnonzero(names != source)])
        left = np.zeros_like(found.covariance)
        left[np.ix_(keep, keep)] = known_exactly(found, keep)
        sources[source] = whole - fit.about_centre(left)
    if fit.plane is not None:  # Y K_cc Y^T, with Y fixed
        turned, slopes = fit.coupling, []
        for unit in np.eye(len(fit.plane.entries)):
            parts = entries.split(unit, len(found.data.columns))
            slopes.append(np.concatenate([entries.vector(turned @ part @ turned.T) for part in parts]))
        inside = np.transpose(slopes) @ fit.plane.covariance @ np.array(slopes)
        off = fit.draws.draws - fit.draws.estimate
        sources[INPLANE_STIFFNESS] = inside
        sources[PLANE] = off.T @ off / len(off) - whole - inside
    if fit.model_error.shape[1]:
        sources[MODEL_ERROR] = fit.model_error @ fit.model_error.T
    return sources


def known_exactly(found: Fit, keep: NDArray[np.intp]) -> Array:
    """Return the covariance of some unknowns where all others are known: blocks of information and spread."""
    if len(keep) == len(found.theta):
        return found.covariance
    count = len(found.inverse)
    if count != len(found.theta):  # a textbook: noise alone is its own block
        own = np.zeros((len(keep), len(keep)))
        gain = found.covariance[:count][:, keep[keep >= found.at["shared"].start]]
        own[:count, :count] = found.inverse + gain @ gain.T
        return own
    size = np.sqrt(np.diag(found.inverse))
    information = np.linalg.inv(found.inverse / np.outer(size, size))
    spread = information @ (found.covariance / np.outer(size, size)) @ information
    inverse = np.linalg.inv(information[np.ix_(keep, keep)])
    return np.asarray(inverse @ spread[np.ix_(keep, keep)] @ inverse * np.outer(size[keep], size[keep]))


def effect_of(fit: KDFit, other: Alternative) -> Array:
    """Return how K and D would change if an alternative held, as columns (p, k)."""
    tried = other.found
    if tried.covariance.size == 0:  # only Y's is needed of it
        inverse: Array = np.asarray(np.linalg.inv(tried.likelihood.information(tried.theta)))
        tried = replace(tried, covariance=inverse, inverse=inverse)
    plane = in_plane(tried) if tried.likelihood.model.coupling is not None else None
    there = posterior(tried, plane, 4).estimate
    if other.unknown is None:  # D damps as g D of this law, g the ratio of what both lose
        omega = 2.0 * np.pi * tried.data.freq_hz
        ratio = tried.law.factor(omega).imag / fit.law.factor(omega).imag
        lossy = np.repeat([0.0, 1.0], len(there) // 2)
        moved = there * np.where(lossy, np.mean(ratio), 1.0) - fit.values
        return np.stack([moved, float(np.std(ratio)) * lossy * there], axis=1)
    effect = there - fit.values
    columns = [effect, other.sd / max(abs(other.value), 1e-300) * effect]
    if other.unknown.weights is not None:  # K and D change over the lines: 1.96 sd hold their range
        shape = 0.01 * other.value * other.unknown.weights(tried.data)
        columns.append(float(np.std(shape)) * there)
    return np.stack(columns, axis=1)


def unexplained(found: Fit) -> Array:
    """Return columns of the error of theta where nothing explains the misfit: sandwich over parts of lines.

    Residuals of neighbouring lines are alike in a misfit; how much the scores of parts of the band differ is
    how far the estimate moves when another part is measured (Liang and Zeger 1986,
    doi:10.1093/biomet/73.1.13).
    """
    likelihood = found.likelihood
    rows = 2 * likelihood.n * found.data.count
    jacobian, residual = likelihood.jacobian(found.theta)[:rows], likelihood.residuals(found.theta)[:rows]
    scores = (jacobian * residual[:, None]).reshape(2, found.data.count, likelihood.n, -1).sum(axis=0)
    sums = np.concatenate([part.sum(axis=0) for part in np.array_split(scores, _CLUSTERS)])
    return np.asarray(np.sqrt(len(sums) / (len(sums) - 1.0)) * found.inverse @ sums.T)


def weak_spread(found: Fit) -> Array:
    """Return columns E (p, k): by E E^T the mean square error of weak entries exceeds the covariance.

    Where the deflection drowns in the noise, a stiffness that is much too small lowers chi2 by no more than
    noise does, and its sd falls with it. Chi2 is followed over each such entry of the diagonal of K to where
    it has risen by that of a 95 % interval. All unknowns move along, each no farther than by one of these
    ways, or by its own; entries that are not weak keep their sd.
    """
    n = found.likelihood.n
    places = np.array(entries.diagonals(n))
    sd = np.sqrt(np.diag(found.covariance)[places])
    weak = sd >= _WEAK * np.abs(found.theta[places])
    columns = np.zeros((len(found.theta), n))
    for number in np.flatnonzero(weak[:n]) if found.weights is None else ():
        columns[:, number] = _reach(found, int(places[number]), float(sd[number]))
    size = np.linalg.norm(columns, axis=1)
    most = np.max(np.abs(columns), axis=1)
    own, lossy = places[:n], places[n:]
    most[own] = np.diag(columns[own])
    most[lossy] = np.minimum(most[lossy], _LOSS_FACTOR * (np.abs(found.theta[own]) + most[own]))
    share = most / np.where(size > 0.0, size, 1.0)
    roots = np.sqrt(np.where(weak, share[places], 0.0)).reshape(2, n)
    share[found.at["entries"]] = np.ravel([entries.vector(np.outer(root, root)) for root in roots])
    return share[:, None] * columns[:, np.any(columns, axis=0)]


def _reach(found: Fit, place: int, sd: float) -> Array:
    """Return the column (p,) of one entry; zeros where the interval of its sd holds as much.

    Chi2 has to rise by that of 95 % times what the information is overstated by, noise of the regressor,
    which grows with the entry.
    """
    model, overstated = found.likelihood.model, found.covariance[place, place] / found.inverse[place, place]
    value = float(np.sum(found.likelihood.residuals(found.theta) ** 2))
    farthest = _FARTHEST * max(sd, abs(found.theta[place]))
    way = found.covariance[:, place] / found.covariance[place, place]
    first = far = 1.96 * sd
    inside, outside = 0.0, np.inf
    while inside < farthest and far < _CLOSE * outside:
        held = replace(model, held=(*model.held, (place, found.theta[place] + far, 1e-2 * sd)))
        likelihood = Likelihood(found.data, held, found.noise)
        try:
            theta, risen, _, _ = minimise(likelihood, found.theta + far * way, 1e-4, 40)
            there, known = found.likelihood.covariance(theta)
            more = max(overstated, there[place, place] / known[place, place])
        except np.linalg.LinAlgError:
            risen, more = np.inf, overstated
        if risen - value < 1.96**2 * more:
            inside, way, overstated = far, (theta - found.theta) / far, more
        else:
            outside = far
        far = min(2.0 * far, farthest) if outside == np.inf else float(np.sqrt(max(inside, first) * outside))
    return np.sqrt(max((far / 1.96) ** 2 - sd**2, 0.0)) * way


@dataclass(frozen=True)
class Derived:
    """Standard deviations of the modes, and principal axes with theirs."""

    frequency_sd_hz: Array  # (modes,)
    undamped_sd_hz: Array  # (modes,)
    ratio_sd: Array  # (modes,)
    shape_sd: Array  # (modes, n): of the magnitudes of the shapes
    axes: Array | None = None  # (6,): as `fitting.model.principal_axes` has them, for y, alpha, gamma
    axes_sd: Array | None = None  # (6,): as `fitting.model.principal_axes` has them, for y, alpha, gamma


def derived_of(fit: KDFit) -> Derived:
    """Return modes and principal axes of draws of K, D and M."""
    data, pairs, drawn = fit.found.data, fit.modes.pairs, fit.draws.draws
    extra = standard_draws(len(drawn), max(fit.model_error.shape[1], 1), 1)[:, : fit.model_error.shape[1]]
    stiffness, damping = entries.split(drawn + extra @ fit.model_error.T, len(fit.dof))
    shared, root = fit.draws.spread[:, fit.found.at["shared"]], data.root_mass[data.rows]
    changes = np.tensordot(shared, data.mass_changes, 1)[:, data.rows][:, :, data.rows]
    values, shapes = moved_eigenvalues(
        fit.modes, fit.mass + changes * np.outer(root, root), stiffness, damping, fit.law
    )
    norm = np.linalg.norm(shapes, axis=2) * np.sqrt(1.0 + np.abs(values) ** 2)
    eigen = np.array([mode.eigenvalue for mode in pairs])
    usual = np.array([np.abs(mode.shape) for mode in pairs]).reshape(-1, len(fit.dof))

    def sd(drawn: Array, middle: Array) -> Array:
        return np.sqrt(np.mean((drawn - middle) ** 2, axis=0))

    found = Derived(
        sd(values.imag, eigen.imag) / (2.0 * np.pi),
        sd(np.abs(values), np.abs(eigen)) / (2.0 * np.pi),
        sd(-values.real / np.abs(values), -eigen.real / np.abs(eigen)),
        sd(np.abs(shapes) / norm[:, :, None], usual),
    )
    if fit.dof != PISTON_DOF or not fit.stiffness[0, 0] > 0.0:
        return found
    axes = principal_axes(fit.stiffness)
    off = principal_axes(stiffness[stiffness[:, 0, 0] > 0.05 * fit.stiffness[0, 0]]) - axes
    off[:, 2] = (off[:, 2] + 0.25 * np.pi) % (0.5 * np.pi) - 0.25 * np.pi
    return replace(found, axes=axes, axes_sd=sd(off, np.zeros(6)))
