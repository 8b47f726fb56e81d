"""Closed voids inside the bone: does air fill them, or fluid or marrow, and can the scan show it?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.grey.air_level import Air
from legacy.ct_inertia.grey.level_fit import blurred, fit_bodies, grow_mask
from legacy.ct_inertia.grey.partial_volume import voxel_effects
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.volume.grid_operations import dilated, labelled, used_box
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice

Grey = NDArray[np.float32]
Mask = NDArray[np.bool_]

_LEAST_VOXELS = calibrated("voids.least_voxels")
# Trial levels of the filling beside air, up to the densest tissue, and the step around the best.
_TRIALS, _STEP = (0.08, 0.16, 0.24, 0.32, 0.4, 0.48), 0.04
_MODEL_SD = calibrated("voids.filling_model_sd")
_LEAST_FILLING = calibrated("voids.least_filling")
_FILLING_SD = calibrated("voids.filling_sd")
_SIGNIFICANT = calibrated("voids.significant")
_REPORTED = calibrated("voids.reported_share")


@dataclass(frozen=True)
class Voids:
    """Closed voids.

    Attributes
    ----------
    image : ndarray of float32, [z, y, x]
        Share of a voxel's blurred value that is void.
    level : float
        Grey value of the filling above air, as a share of bone above air; 0 for air.
    sd : float
        Its standard deviation; 0 where air is certain.
    """

    image: Grey
    level: float
    sd: float

    @property
    def filled(self) -> bool:
        """Something brighter than air fills them."""
        return self.level > 0.0


def closed_voids(
    cut: Cut,
    spacing_mm: Array,
    levels: tuple[Air, float],
    blur_mm: tuple[float, float],
) -> Voids | None:
    """Find the voids that the stapes encloses, and the level of what fills them; None without voids.

    Parameters
    ----------
    cut : Cut
    spacing_mm : ndarray, (3,)
    levels : (Air, bone)
    blur_mm : (float, float)
        Standard deviation of the point spread, and its own.

    Notes
    -----
    A void of the level f in bone has the image m + f (1 - m), m the blurred share of bone. For trial levels
    the walls are fitted to (w - f) / (1 - f); the level that leaves least is taken, and its standard
    deviation comes from noise, from the width of the blur, and from trials.
    """
    air, bone = levels
    mask = _find_enclosed(cut.stapes)
    if mask is None:
        return None
    around = 1 + int(np.ceil(4.0 * blur_mm[0] / float(spacing_mm.min())))
    box = used_box(dilated(mask, around))
    if box is None:
        return None
    part, image = mask[box], np.zeros(mask.shape, dtype=np.float32)
    noise = air.noise / (bone - air.level)
    share = (cut.grey[box] - np.float32(air.level)) / np.float32(bone - air.level)
    scene = _Scene(share, part, spacing_mm, noise, air.correlation)
    level, random, by_blur = scene.level(*blur_mm)
    bone_seen = float(scene.model(level, blur_mm[0])[0][part].mean())
    model = _MODEL_SD * bone_seen / (1.0 - bone_seen)
    sd = float(np.sqrt(random**2 + by_blur**2 + model**2))
    if level < _SIGNIFICANT * sd:
        # Air for certain where tissue of the least level is excluded; else air is assumed.
        certain = level + _SIGNIFICANT * sd < _LEAST_FILLING
        level, sd = 0.0, 0.0 if certain else float(np.hypot(level, sd))
    image[box] = scene.model(level, blur_mm[0])[1]
    return Voids(image, level, sd)


def _find_enclosed(stapes: Mask) -> Mask | None:
    """Return the voxels that a body encloses, small pieces left out; None where there are none."""
    labels, count = labelled(~stapes)
    if count < 2:
        return None
    sizes = np.bincount(labels.ravel())
    for axis in range(3):
        for end in (0, -1):
            sizes[np.unique(np.take(labels, end, axis))] = 0
    sizes[0] = 0
    mask = (sizes > _LEAST_VOXELS)[labels]
    return mask if np.any(mask) else None


class _Scene:
    """Shares of bone [z, y, x] around voids, and how well a level of the filling explains them."""

    def __init__(self, share: Grey, voids: Mask, spacing_mm: Array, noise: float, correlation: float) -> None:
        self.share, self.spacing_mm = share, spacing_mm
        self.noise, self.correlation = noise, correlation
        self.compared = grow_mask(voids)
        self.near = grow_mask(self.compared)

    def model(self, level: float, sigma_mm: float) -> tuple[Grey, Grey]:
        """Return the blurred shares of bone and of the voids, walls fitted for a level of the filling."""
        bare = np.where(self.near, (self.share - level) / np.float32(1.0 - level), self.share)
        every = np.ones(bare.shape, dtype=bool)
        fit = fit_bodies(
            bare.astype(np.float32), every, self.spacing_mm, 1.0, sigma_mm, self.noise, fit_contrast=False
        )
        spacing = self.spacing_mm[::-1]
        inside = np.where(self.compared, 1 - fit.body, np.float32(0.0))
        return blurred(fit.body, sigma_mm, spacing), blurred(inside, sigma_mm, spacing)

    def misfit(self, level: float, sigma_mm: float) -> float:
        """Return the sum of squares that a level leaves in the voids and at their walls."""
        bone, voids = self.model(level, sigma_mm)
        rest = (self.share - bone - np.float32(level) * voids)[self.compared]
        return float(np.sum(rest.astype(float) ** 2))

    def level(self, sigma_mm: float, sigma_sd_mm: float) -> tuple[float, float, float]:
        """Return the level that leaves least, and its standard deviations from noise and from the blur."""
        known = {0.0: self.misfit(0.0, sigma_mm)}
        start = 0.0
        for trial in _TRIALS:
            known[trial] = self.misfit(trial, sigma_mm)
            if known[trial] > known[start]:
                break
            start = trial
        trials = [round(max(start, _STEP) + step, 9) for step in (-_STEP, 0.0, _STEP)]
        misfit = [known[t] if t in known else self.misfit(t, sigma_mm) for t in trials]
        best, second = _vertex(trials, misfit)
        wider = [self.misfit(t, sigma_mm + sigma_sd_mm) for t in trials]
        each = max(min(misfit) / np.count_nonzero(self.compared), self.noise**2)
        random = _FILLING_SD if second <= 0.0 else float(np.sqrt(each * self.correlation / second))
        return best, random, _vertex(trials, wider)[0] - best


def _vertex(x: list[float], y: list[float]) -> tuple[float, float]:
    """Return where a parabola through three points is least, and its second coefficient."""
    second, first, _ = np.polyfit(x, y, 2)
    if second <= 0.0:
        return x[int(np.argmin(y))], float(second)
    return float(np.clip(-0.5 * first / second, x[0] - _STEP, x[2] + _STEP)), float(second)


def empty_voids(cut: Cut, voids: Voids, contrast: float) -> Grey:
    """Return grey values [z, y, x] with air in the voids."""
    return cut.grey - np.float32(contrast * voids.level) * voids.image


def filling_covariance(voids: Voids, cut: Cut, volume: Volume, moments: Moments) -> Array:
    """Return the covariance (10, 10) of the level of the filling, common to all voids."""
    effects, _ = voxel_effects(voids.image, voids.image > 0.0, cut.first, volume, moments)
    step = voids.sd * effects.sum(axis=0)
    return np.outer(step, step)


def void_notices(voids: Voids, volume: Volume, moments: Moments) -> list[Notice]:
    """Report voids that are filled, and voids whose filling the scan does not show."""
    share = float(voids.image.sum(dtype=float)) * volume.voxel_mm3 / moments.volume_mm3
    if voids.filled:
        text = (
            f"Closed voids inside the stapes ({100.0 * share:.1f} % of its volume) are filled with something "
            f"{100.0 * voids.level:.0f} +- {100.0 * voids.sd:.0f} % as bright as bone (fluid or marrow). It "
            f"was subtracted, and the budget holds {100.0 * share * voids.sd:.2f} % for it (voids). Its mass "
            f"is left out: dry the sample, or add it as a point mass."
        )
        return [Notice("void_filled", text)]
    if share * voids.sd < _REPORTED:
        return []
    text = (
        f"Closed voids inside the stapes ({100.0 * share:.1f} % of its volume) are as narrow as the blur of "
        f"the scan: whether air or fluid fills them is not visible. Air is assumed, and the budget holds "
        f"{100.0 * share * voids.sd:.2f} % for it (voids). Scan with smaller voxels, or dry the sample."
    )
    return [Notice("void_filling_unknown", text)]
