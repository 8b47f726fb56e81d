"""How the mean edge of bone in air departs from a step that a Gaussian blurred."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.volume.normal_distribution import normal_cdf, normal_density
from legacy.stapeskit.arrays import Array

# Places across an edge, in widths, where the shape is compared; further in, the far side of a wall begins.
PLACES = np.arange(-4.4, 1.41, 0.4)
# Standard deviations of a significant departure: a normal variate exceeds 4 with a probability of 6e-5.
_SIGNIFICANT = 4.0
# Trials of the sharpening, as a share of the apparent variance of the point spread.
_TRIALS = np.arange(0.05, 1.51, 0.05)
_SHAPE_MODEL_SD = calibrated("edges.shape_model_sd")
_USUAL_SKEWNESS, _SKEWNESS_SD = calibrated("edges.skewness")
# The same of a skewness, which changes no value but the budget and a warning: a probability of 3e-3.
_SIGNIFICANT_SKEWNESS = 3.0


@dataclass(frozen=True)
class Profiles:
    """Shares of the contrast across clean edges.

    Attributes
    ----------
    values : ndarray, (n, places)
        At ``PLACES``, from air to bone.
    cells : ndarray of int, (n,)
        Edges of one cell share noise and curvature.
    points_mm : ndarray, (n, 3)
        Where the edges lie, along x, y, z from the first voxel of the box.
    shared_sd : float
        Standard deviation of an error that all edges share, independent between places.
    """

    values: Array
    cells: NDArray[np.int64]
    points_mm: Array
    shared_sd: float

    def between(self, now: tuple[float, float], air: float, bone: Array) -> Profiles:
        """Return shares between the levels ``now`` as those between air and the level of bone (n,)."""
        grey = now[0] + (now[1] - now[0]) * self.values
        return replace(self, values=(grey - air) / (bone - air)[:, None])


def sharpening(edges: Profiles) -> tuple[float, float]:
    """Return the sharpening over the apparent variance, and the overshoot; 0 and 0 where not significant.

    The sharpening is the f of the operator 1 - f Laplacian, see `edge_shape.edge_shape`.
    """
    profile = edges.values.mean(axis=0)
    overshoot = float(np.max(-profile[PLACES < -0.5]))
    if _cumulant(edges, 0.0) > -_SIGNIFICANT or overshoot <= 0.0:
        return 0.0, 0.0
    misfit = [_fit_edge(profile, trial)[1] for trial in _TRIALS]
    best = int(np.clip(np.argmin(misfit), 1, len(_TRIALS) - 2))
    second, first, _ = np.polyfit(_TRIALS[best - 1 : best + 2], misfit[best - 1 : best + 2], 2)
    strength = float(np.clip(-0.5 * first / second if second > 0.0 else _TRIALS[best], 0.0, _TRIALS[-1]))
    return strength, overshoot


def long_tails(edges: Profiles | None, level_sd: float) -> bool:
    """Return whether the mean edge has longer tails than a Gaussian; parameters as for `skewness`."""
    return edges is not None and _cumulant(edges, level_sd) > _SIGNIFICANT


def _cumulant(edges: Profiles, level_sd: float) -> float:
    """Return the fourth cumulant of the mean edge in its standard deviations."""
    u = _normalise(edges.values.mean(axis=0))
    factor, sd = _last_factor(-(u**3 - 3.0 * u) * normal_density(u), u, edges, (_SHAPE_MODEL_SD, level_sd))
    return factor / sd


def skewness(
    edges: Callable[[], Profiles | None], independent: Callable[[], Profiles | None], level_sd: float
) -> float:
    """Return the factor of He2(u) phi(u) in the mean edge; 0 where it is not significant.

    Parameters
    ----------
    edges : callable
        Returns the profiles that were found, None with too few.
    independent : callable
        Returns profiles whose noise is not that by which edges were found, where there is noise; asked where
        the first ones are skewed.
    level_sd : float
        Standard deviation of the level of bone, as a share of the contrast.

    Notes
    -----
    A third cumulant k of the point spread along the inward normal adds -k He2(u) phi(u) / 6 (Edgeworth). A
    coat of thickness t widths and grey value b has k = -b t^3. A scale that is not linear adds, to second
    order, a multiple of Phi (1 - Phi). Curved faces add little, which is known on average.
    """
    for seen in (edges, independent):
        found = seen()
        if found is None:
            return 0.0
        u = _normalise(found.values.mean(axis=0))
        factor, sd = _last_factor((u**2 - 1.0) * normal_density(u), u, found, (_SKEWNESS_SD, level_sd))
        factor -= _USUAL_SKEWNESS
        if abs(factor) < _SIGNIFICANT_SKEWNESS * sd:
            return 0.0
    return factor


def _last_factor(
    shape: Array, u: Array, edges: Profiles, model_and_level_sd: tuple[float, float]
) -> tuple[float, float]:
    """Fit a shape (places,) to what a blurred step leaves of the mean edge; return its factor and the sd.

    Shift and width of the step are free; a level of bone off by ``level_sd`` adds as much of the step.
    """
    model_sd, level_sd = model_and_level_sd
    row = np.linalg.pinv(np.column_stack([-normal_density(u), -u * normal_density(u), shape]))[-1]
    profile = edges.values.mean(axis=0)
    scores = sums(((edges.values - profile) @ row)[:, None], edges.cells) / len(edges.values)
    shared = edges.shared_sd**2 * float(np.sum(row**2))
    level = level_sd * float(row @ normal_cdf(u))
    variance = np.sum(scores**2) + model_sd**2 + shared + level**2
    return float(row @ (profile - normal_cdf(u))), float(np.sqrt(variance))


def _normalise(profile: Array) -> Array:
    """Return the places from the middle of the blurred step that fits a profile, in its widths."""
    (shift, width), _ = _fit_edge(profile, 0.0)
    return np.asarray((PLACES - shift) / width)


def _fit_edge(profile: Array, strength: float) -> tuple[Array, float]:
    """Fit shift and width of an edge of given sharpening to a profile; return them and the misfit."""
    shift, width = 0.0, np.sqrt(1.0 + 2.0 * strength)

    def model(shift: float, width: float) -> Array:
        u = (PLACES - shift) / width
        return normal_cdf(u) + strength / width**2 * u * normal_density(u)

    for _ in range(8):
        now = model(shift, width)
        design = np.column_stack([model(shift + 1e-4, width) - now, model(shift, width + 1e-4) - now]) / 1e-4
        step = np.linalg.lstsq(design, profile - now, rcond=None)[0]
        shift, width = shift + float(step[0]), float(np.clip(width + step[1], 0.3, 4.0))
    return np.array([shift, width]), float(np.sum((profile - model(shift, width)) ** 2))


def cells_of(points_mm: Array, size_mm: float | Array) -> NDArray[np.int64]:
    """Return the number (n,) of the cell of each point (n, 3); a cell may differ in size along each axis."""
    cell = np.floor((points_mm - points_mm.min(axis=0)) / size_mm).astype(np.int64)
    width = cell.max(axis=0) + 1
    return np.asarray((cell[:, 0] * width[1] + cell[:, 1]) * width[2] + cell[:, 2])


def sums(rows: Array, cells: NDArray[np.int64]) -> Array:
    """Return the sums (m, k) of rows (n, k) over each cell."""
    number = np.unique(cells, return_inverse=True)[1]
    return np.stack([np.bincount(number, column) for column in rows.T], axis=1)
