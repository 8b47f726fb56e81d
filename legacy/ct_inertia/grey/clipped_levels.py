"""Levels of air and bone where storing clipped grey values or took coarse steps, and the values corrected."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.grey.air_level import Air, Surroundings
from legacy.ct_inertia.grey.level_fit import blurred, body_share, grow_mask
from legacy.ct_inertia.grey.quantisation import Level, Quantisation, level_of, quantisation_of
from legacy.ct_inertia.volume.distance import capped_distance
from legacy.ct_inertia.volume.grid_operations import gaussian
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice

# A pile of voxels at an end of the range, as a share of those of a material, and the least of them.
_PILE, _LEAST = 0.01, 100
# Voxels of air that are looked at.
_SAMPLE = 200_000
# Steps larger than this share of the range are a thresholded scan, which has its own budget.
_MOST_STEP = 0.2
# Rounds in which the body and its blur show the true grey values.
_ROUNDS = 3
# Grey values at which storing is computed, from a contrast below air to one above bone: 0.0007 apart.
_POINTS = 4001


@dataclass(frozen=True)
class ClippedLevels:
    """How the scan was stored, and the levels from before.

    Attributes
    ----------
    store : Quantisation
    air, bone : Level
    coarse : bool
        Its steps are no smaller than the noise.
    moved : (float, float)
        By how much storing moved the means of air and bone.
    """

    store: Quantisation
    air: Level
    bone: Level
    coarse: bool
    moved: tuple[float, float]

    @property
    def within_step(self) -> float:
        """Standard deviation of a grey value between two coarse steps; 0 where steps are fine."""
        return calibrated("store.within_step") * self.store.step if self.coarse else 0.0

    def air_known(self, air: Air) -> Air:
        """Return the air with its level and noise from before storing."""
        model = calibrated("store.model_sd") * abs(self.moved[0])
        ratio = self.air.noise / max(air.single_noise or air.noise, 1e-12)
        return replace(
            air,
            level=self.air.level,
            noise=air.noise * min(ratio, 1.0) if self.coarse else air.noise * max(ratio, 1.0),
            sd=float(np.sqrt(air.sd**2 + self.air.sd**2 + model**2)),
            clipped=self.air.at_low if self.air.at_low > _PILE else 0.0,
            single_noise=self.air.noise,
        )

    def bone_sd(self, sd: float) -> float:
        """Return the standard uncertainty of the bone level with what storing adds to it."""
        return float(np.sqrt(sd**2 + self.bone.sd**2 + (calibrated("store.model_sd") * self.moved[1]) ** 2))

    def notices(self) -> list[Notice]:
        """Report clipped bone and coarse steps; clipped air is reported with the air."""
        notices = []
        if self.bone.at_high > _PILE:
            text = (
                f"{100.0 * self.bone.at_high:.0f} % of the voxels deep inside bone lie at the highest grey "
                f"value: the export has clipped them. That was corrected for, and the budget holds what "
                f"remains (levels). Export with a window that ends above bone and its noise."
            )
            notices.append(Notice("bone_clipped", text))
        if self.coarse:
            share = 100.0 * self.store.step / (self.bone.level - self.air.level)
            text = (
                f"The grey values have steps of {share:.1f} % of the contrast between air and bone, no "
                f"smaller than the noise: levels are known to a part of a step (budget: levels). "
                f"Export with 16 bits."
            )
            notices.append(Notice("grey_steps_coarse", text))
        return notices


def clipped_levels(
    around: Surroundings, air: Air, shell: NDArray[np.bool_], sigma_mm: float
) -> ClippedLevels | None:
    """Return the levels from before storing; None where storing changed no mean.

    Parameters
    ----------
    around : Surroundings
    air : Air
        As the mean of the stored values shows it.
    shell : ndarray of bool, [z, y, x]
        Voxels of air.
    sigma_mm : float
        Standard deviation of the point spread.

    Raises
    ------
    CtInertiaError
        Nearly all voxels of air or of bone lie at an end of the range.
    """
    ones = around.grey if around.single is None else around.single
    store = quantisation_of(ones)
    if store.step > _MOST_STEP * (store.high - store.low):
        return None
    outside, inside = ones[shell], ones[around.bone]
    low = outside[:: max(1, outside.size // _SAMPLE)].astype(float)
    if low.size < _LEAST or inside.size < _LEAST:
        return None
    piled = store.clips_low and _share_at(low, store.low) > _PILE
    piled |= store.clips_high and _share_at(inside, store.high) > _PILE * _PILE
    if not piled and store.step <= 0.5 * _noise(low):
        return None
    depth = capped_distance(~around.bone, around.spacing_mm, 3.5 * sigma_mm)
    high = ones[depth > np.float32(3.0 * sigma_mm)].astype(float)
    if high.size < _LEAST:
        return None
    piles = _share_at(low, store.low), _share_at(high, store.high)
    # The material with fewer voxels at its end shows the noise of the other, too.
    if piles[1] < piles[0]:
        bone = level_of(high, store, None, air.correlation)
        lower = level_of(low, store, bone.noise, air.correlation)
    else:
        lower = level_of(low, store, None, air.correlation)
        bone = level_of(high, store, lower.noise, air.correlation)
    coarse = store.step > calibrated("store.coarse_step") * min(lower.noise, bone.noise)
    if not (coarse or lower.at_low > _PILE or bone.at_high > _PILE):
        return None
    if coarse:
        off = calibrated("store.within_step") * store.step
        lower, bone = (replace(v, sd=float(np.hypot(v.sd, off))) for v in (lower, bone))
    _check(lower, bone)
    moved = float(low.mean()) - lower.level, float(high.mean()) - bone.level
    return ClippedLevels(store, lower, bone, coarse, moved)


def _check(air: Level, bone: Level) -> None:
    """Refuse levels that the piles at the ends of the range leave open."""
    most = calibrated("store.most_clipped")
    noisier = air.noise > calibrated("store.other_noise") * bone.noise
    unknown = calibrated("store.least_known") * (bone.level - air.level)
    for name, pile, open_, step in (
        ("air", air.at_low, (air.at_low > most and noisier) or air.sd > unknown, "begins below air"),
        ("bone", bone.at_high, bone.at_high > 1.0 - _PILE * _PILE or bone.sd > unknown, "ends above bone"),
    ):
        if open_ and pile > _PILE:
            raise CtInertiaError.of(
                f"the grey value of {name}",
                "within the range that was exported",
                f"{100.0 * pile:.1f} % of the voxels of {name} at the end of the range",
                next_step=f"Export with a window that {step} and its noise",
            )


def undo_storing(
    grey: NDArray[np.float32],
    around: Surroundings,
    own: NDArray[np.bool_],
    stored: ClippedLevels,
    sigma_mm: float,
) -> NDArray[np.float32]:
    """Return grey values [z, y, x] less what storing adds on average.

    Parameters
    ----------
    grey : ndarray of float32, [z, y, x]
    around : Surroundings
    own : ndarray of bool, [z, y, x]
        Voxels within reach of the stapes' blur.
    stored : ClippedLevels
    sigma_mm : float

    Notes
    -----
    The true values are those of a two-valued body with the scan's blur, whose surface is the half level of
    the corrected values, in turn.
    """
    air, bone = stored.air.level, stored.bone.level
    contrast = np.float32(bone - air)
    true: Array = np.linspace(air - contrast, bone + contrast, _POINTS, dtype=np.float64)
    added = stored.store.mean_between(true, stored.air, stored.bone) - true
    now = grey
    for k in range(_ROUNDS):
        share = gaussian((now - np.float32(air)) / contrast, 1.0 if k == 0 else 0.6, truncate=3.0)
        body = body_share(share, np.full(share.shape, 0.5, dtype=np.float32), own)
        expected = np.float32(air) + contrast * blurred(body, sigma_mm, around.spacing_mm[::-1])
        now = grey.copy()
        now[own] -= np.interp(expected[own], true, added).astype(np.float32)
    far = ~own & ~grow_mask(grow_mask(around.foreign))
    now[far] -= np.float32(np.interp(air, true, added))
    return now


def _share_at(values: NDArray[Any], end: float) -> float:
    return float(np.mean(values == end))


def _noise(values: Array) -> float:
    return float(np.subtract(*np.percentile(values, (75.0, 25.0)))) / 1.349
