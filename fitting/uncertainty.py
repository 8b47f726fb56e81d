"""What makes K and D uncertain, source by source, and what follows for modes and principal axes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fitting import entries
from fitting.draws import standard_draws
from fitting.evidence import Alternative
from fitting.model import moved_eigenvalues, principal_axes
from fitting.plane import PISTON_DOF, in_plane, posterior
from fitting.solve import Fit
from stapeskit.arrays import Array

if TYPE_CHECKING:
    from fitting.result import KDFit

NOISE, MODEL_ERROR = "channel_noise", "model_error"
INPLANE_STIFFNESS, PLANE = "inplane_stiffness", "ligament_plane"

_LEAST_LINES, _FARTHEST_LINE = 24, 48  # of a run that show correlations; as far as these are looked for
_BY_CHANCE = 2.0  # standard deviations of a correlation below which it counts as none
_HIDDEN = 3.7  # of chi2 at MISFIT_P: a misfit of so many standard deviations is not seen in it
_CLUSTERS = 5  # parts of the lines whose residuals are taken as alike where no cause explains a misfit


def alike_lines(found: Fit) -> float:
    """Return the noise over that stated, 1 at least, that counts as if that of each line were independent.

    Neighbouring lines of a spectrum have noise in common where its window is wider than a line (Hann: 0.67
    and 0.17 with the next two) or where it was smoothed. The variance of a mean is 1 + 2 (r_1 + r_2 + ...)
    times as large, r_k the correlation of lines k apart, up to the first that chance explains. What all far
    lines have in common is a misfit, and is subtracted. It is 1 where chi2 is larger than such noise
    makes it, and where the misfit that chi2 shows, or hides, could make r_1. Where chi2 is smaller than
    that, the noise is as small as residuals show.
    """
    white, run, level = found.likelihood.look(found.theta)[0], found.data.run, found.usual_level
    longest = int(np.max(np.bincount(run), initial=0))
    if longest < _LEAST_LINES:
        return 1.0
    if found.weights is not None:  # what a robust estimate sums up are weights times residuals
        white = white * np.sqrt(found.weights)[:, None]
    size, chance = np.mean(np.abs(white) ** 2), np.sqrt(0.5 / white.size)
    farthest = min(longest // 4, _FARTHEST_LINE)

    def alike(lag: int) -> float:
        pairs = run[lag:] == run[:-lag]
        return float(np.mean((white[lag:] * white[:-lag].conj()).real[pairs]) / size)

    every = np.array([alike(lag) for lag in range(1, farthest + 1)])
    excess = every - np.mean(every[2 * farthest // 3 :])
    near = excess[: int(np.argmax(np.append(excess, 0.0) < _BY_CHANCE * chance))]
    by_misfit = max(1.0 - 1.0 / level, 0.0) + _HIDDEN * chance * np.sqrt(2.0)
    by_noise = _HIDDEN * chance * np.sqrt(2.0 + 4.0 * np.sum(near**2))
    if excess[0] < by_misfit or level > 1.0 + by_noise:
        return 1.0
    stated = 1.0 if level > 1.0 - by_noise else level
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


@dataclass(frozen=True)
class Derived:
    """Standard deviations of the modes, and principal axes with theirs."""

    frequency_sd_hz: Array  # (modes,)
    undamped_sd_hz: Array  # (modes,)
    ratio_sd: Array  # (modes,)
    shape_sd: Array  # (modes, n): of the magnitudes of the shapes
    axes: Array | None = None  # (6,): as `fitting.model.principal_axes` has them, for y, alpha, gamma
    axes_sd: Array | None = None


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
