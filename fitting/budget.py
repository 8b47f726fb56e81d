"""Where the uncertainty of K and D comes from: the variance that vanishes when a source is known exactly."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fitting import entries
from fitting.solve import Fit
from stapeskit.arrays import Array

if TYPE_CHECKING:
    from fitting.result import KDFit

NOISE, MODEL_ERROR = "channel_noise", "model_error"
INPLANE_STIFFNESS, PLANE = "inplane_stiffness", "ligament_plane"


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
    if fit.solution.plane is not None:
        inside = _inplane_part(fit)
        off = fit.draws.draws - fit.draws.estimate
        sources[INPLANE_STIFFNESS] = inside
        sources[PLANE] = off.T @ off / len(off) - whole - inside
    if fit.model_error.shape[1]:
        sources[MODEL_ERROR] = fit.model_error @ fit.model_error.T
    return sources


def _inplane_part(fit: KDFit) -> Array:
    """Return the contribution of the stiffness in the plane, Y K_cc Y^T, with Y fixed."""
    plane, data = fit.solution.plane, fit.found.data
    assert plane is not None  # noqa: S101
    turned = fit.coupling
    slopes = []
    for unit in np.eye(len(plane.entries)):
        parts = entries.split(unit, len(data.columns))
        slopes.append(np.concatenate([entries.vector(turned @ part @ turned.T) for part in parts]))
    slope = np.array(slopes).T
    return np.asarray(slope @ plane.covariance @ slope.T)


def known_exactly(found: Fit, keep: NDArray[np.intp]) -> Array:
    """Return the covariance of some unknowns where all others are known: blocks of information and spread."""
    if len(keep) == len(found.theta):
        return found.covariance
    size = np.sqrt(np.diag(found.inverse)) if len(found.inverse) == len(found.theta) else None
    if size is None:  # a textbook: noise alone is its own block
        own = np.zeros((len(keep), len(keep)))
        own[: len(found.inverse), : len(found.inverse)] = found.inverse
        places = [place for place in keep if place >= found.at["shared"].start]
        gain = found.covariance[: len(found.inverse)][:, places]
        own[: len(found.inverse), : len(found.inverse)] += gain @ gain.T
        return own
    information = np.linalg.inv(found.inverse / np.outer(size, size))
    spread = information @ (found.covariance / np.outer(size, size)) @ information
    inverse = np.linalg.inv(information[np.ix_(keep, keep)])
    return np.asarray(inverse @ spread[np.ix_(keep, keep)] @ inverse * np.outer(size[keep], size[keep]))
