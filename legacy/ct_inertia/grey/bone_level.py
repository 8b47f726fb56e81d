"""The grey level of pure bone inside the stapes, and how evenly it fills it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.bodies import Levels
from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.grey.air_level import Air, Surroundings
from legacy.ct_inertia.grey.cupping import Cupping, deep_cupping_notice, find_cupping
from legacy.ct_inertia.grey.edge_departure import cells_of
from legacy.ct_inertia.volume.distance import capped_distance
from legacy.ct_inertia.volume.normal_distribution import normal_cdf
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice

_GOOD_BONE_SD = calibrated("bone_level.good_sd")
_DEEPER = calibrated("bone_level.deeper")
_DEPTHS = calibrated("bone_level.depths")
_BLUR_LEFT = calibrated("bone_level.blur_left")
_LEAST_DEEP = calibrated("bone_level.least_deep")
_CELL_VOXELS = calibrated("bone_level.cell_voxels")
_LEAST_CELL = calibrated("bone_level.least_cell")
_LEAST_CELLS = calibrated("bone_level.least_cells")
_SIGNIFICANT = calibrated("bone_level.significant")
_TILTED = calibrated("bone_level.tilted")
_SLOPING = calibrated("bone_level.sloping")
_UNEVEN = calibrated("bone_level.uneven")
# The rim of bone next to the surface is not seen: it may differ from the inside by as much as that varies.
_HIDDEN = calibrated("bone_level.hidden")


@dataclass(frozen=True)
class Bone:
    """Pure bone inside the stapes.

    Attributes
    ----------
    level, sd, noise : float
        Grey level, its standard uncertainty, noise of a voxel.
    found_by : str
    notices : tuple of Notice
    slope : ndarray, (3,)
        Change of the level per mm along x, y, z of the box; 0 where noise explains it.
    place_mm : ndarray, (3,)
        Where ``level`` holds, from the box's first voxel along x, y, z.
    cupping : Cupping or None
    seen : float
        Share of the bone's voxels that were looked at.
    """

    level: float
    sd: float
    noise: float
    found_by: str
    notices: tuple[Notice, ...] = ()
    slope: Array = field(default_factory=lambda: np.zeros(3))
    place_mm: Array = field(default_factory=lambda: np.zeros(3))
    cupping: Cupping | None = None
    seen: float = 1.0

    def level_at(self, places_mm: Array) -> Array:
        """Return the level (n,) at places (n, 3) from the box's first voxel along x, y, z."""
        level = self.level + (places_mm - self.place_mm) @ self.slope
        return np.asarray(level if self.cupping is None else level + self.cupping.at(places_mm))

    def moved_to(self, place_mm: Array) -> Bone:
        """Return the same bone with its level at another place (3,) of the box."""
        return replace(self, level=float(self.level + self.slope @ (place_mm - self.place_mm)))


def measure_bone(around: Surroundings, air: Air, sigma_mm: float) -> Bone | None:
    """Measure the bone level from voxels deeper than three widths of the blur.

    Returns None when the body has too few of them for a level within 0.1 %.

    Notes
    -----
    Depths are between voxel centres and the first centre outside; the surface lies half a voxel nearer.
    What blur is left at depth d under a plane surface, 1 - Phi(d / s), is added back. A level that changes
    linearly through the bone is described by its slope, further variation by the scatter between cells of a
    few voxels; both only as far as noise does not explain them.
    """
    box = _box_of(around.bone)
    inside = around.bone[box]
    grey = around.grey[box]
    half = 0.5 * float(np.mean(around.spacing_mm))
    cap = _DEEPER * sigma_mm + 2.0 * half
    depth = capped_distance(~inside, around.spacing_mm, cap)
    for least in _DEPTHS:
        index = np.flatnonzero(depth > np.float32(least * sigma_mm + half))
        if index.size < _LEAST_DEEP:
            continue
        share = normal_cdf((depth.ravel()[index].astype(float) - half) / sigma_mm)
        values = air.level + (grey.ravel()[index] - air.level) / share
        contrast = float(values.mean()) - air.level
        random = float(values.std()) / np.sqrt(values.size) * np.sqrt(air.correlation)
        if random < _GOOD_BONE_SD * contrast:
            rest = _BLUR_LEFT * float(np.mean(1.0 - share)) * contrast
            deeper = depth.ravel()[index] > np.float32(_DEEPER * sigma_mm + half)
            zyx = np.stack(np.unravel_index(index, depth.shape), axis=1)
            change = _change(values, deeper, zyx.astype(float), air)
            if change:
                values = values + change
                rest += abs(change)
            start = np.array([s.start for s in reversed(box)])
            bone = bone_of(values, (zyx[:, ::-1] + start) * around.spacing_mm, air, random, rest, around)
            notices = (*bone.notices, *deep_cupping_notice(change, contrast))
            seen = index.size / max(1, int(np.count_nonzero(inside)))
            return replace(bone, notices=notices, seen=seen)
    return None


def _change(values: Array, deeper: NDArray[np.bool_], places: Array, air: Air) -> float:
    """Return by how much the level of the deepest voxels differs from that of all; 0 where noise explains it.

    Where the point spread has longer tails than a Gaussian, or bone is denser inside, the level still rises
    deeper down. A level that slopes over the places (n, 3) is none of that.
    """
    count = np.count_nonzero(deeper)
    if count < _LEAST_DEEP:
        return 0.0
    change = float(values[deeper].mean() - values.mean())
    noise = float(values[deeper].std()) * np.sqrt(air.correlation * (1.0 / count - 1.0 / values.size))
    if abs(change) < _SIGNIFICANT * noise:
        return 0.0
    design = np.column_stack([np.ones(values.size), places - places.mean(axis=0), deeper])
    fitted = np.linalg.solve(design.T @ design, design.T @ (values - values.mean()))
    change = float(fitted[4]) * (1.0 - count / values.size)
    return change if abs(change) > _SIGNIFICANT * noise else 0.0


def _box_of(mask: NDArray[np.bool_]) -> tuple[slice, ...]:
    """Return the slices z, y, x of a mask, one voxel wider where there is room."""
    ranges = []
    for axis in range(3):
        used = np.flatnonzero(mask.any(axis=tuple(k for k in range(3) if k != axis)))
        ranges.append(slice(max(0, int(used[0]) - 1), int(used[-1]) + 2))
    return tuple(ranges)


def bone_of(
    values: Array,
    places_mm: Array,
    air: Air,
    random: float,
    rest: float,
    around: Surroundings,
) -> Bone:
    """Put together level, slope and uncertainty from deep voxels (n,) at places (n, 3)."""
    middle = places_mm.mean(axis=0)
    level, contrast = float(values.mean()), float(values.mean()) - air.level
    number = cells_of(places_mm, _CELL_VOXELS * around.spacing_mm)
    count = np.asarray(np.bincount(number), dtype=np.int64)
    used = count >= _LEAST_CELL
    if np.count_nonzero(used) < _LEAST_CELLS:
        sd = float(np.sqrt(random**2 + rest**2 + _scatter(values, places_mm) ** 2))
        return Bone(level, sd, float(values.std()), "interior", (), np.zeros(3), middle)
    weight = count[used].astype(float)
    means = np.bincount(number, values)[used] / weight
    sums = [np.bincount(number, p - m)[used] for p, m in zip(places_mm.T, middle, strict=True)]
    away = np.stack(sums, axis=1) / weight[:, None]
    noise = float(np.sqrt(np.maximum(values.var() - np.average((means - level) ** 2, weights=weight), 0.0)))
    design = np.column_stack([np.ones(len(means)), away])
    normal = (design * weight[:, None]).T @ design
    fitted = np.linalg.lstsq(normal, design.T @ (weight * means), rcond=None)[0]
    left = means - design @ fitted
    freedom = len(means) - 4.0
    excess = float(weight @ left**2) / (noise**2 * air.correlation + 1e-12 * contrast**2) - freedom
    significant = excess > _SIGNIFICANT * np.sqrt(2.0 * freedom)
    uneven = noise * float(np.sqrt(air.correlation * excess / weight.sum())) if significant else 0.0
    explained = float(fitted[1:] @ (normal[1:, 1:] @ fitted[1:]))
    tilt = float(np.sqrt(explained / weight.sum()))
    # Compared with the scatter that is left, over as many cells: F of three degrees of freedom.
    scatter = noise**2 * air.correlation + uneven**2 * float(weight.mean())
    sloping = tilt > _TILTED * contrast and explained > 3.0 * _SLOPING * scatter
    slope = fitted[1:] if sloping else np.zeros(3)
    spread = _scatter(values - (places_mm - middle) @ slope, places_mm)
    sd = float(np.sqrt(random**2 + rest**2 + spread**2))
    notices: tuple[Notice, ...] = ()
    if max(uneven, tilt if sloping else 0.0) > _UNEVEN * contrast:
        sd = float(np.hypot(sd, _HIDDEN * uneven))
        varies = 100.0 * float(np.hypot(uneven, tilt)) / contrast
        text = (
            f"The grey value of bone varies inside the stapes by {varies:.1f} % (standard deviation), more "
            f"than noise: its density is not uniform, or the scan is shaded. The mass matrix weights bone by "
            f"its grey value; without a calibration the budget holds what uniform density would change."
        )
        notices = (Notice("bone_inhomogeneous", text),)
    cupping = find_cupping(values, places_mm, contrast, air.correlation, bool(sloping))
    return Bone(level, sd, noise, "interior", notices, slope, middle, cupping)


def _scatter(values: Array, places_mm: Array) -> float:
    """Return the standard error of a level from its scatter over the eighths of the body."""
    octant = (places_mm > np.median(places_mm, axis=0)) @ np.array([1, 2, 4])
    count = np.bincount(octant, minlength=8)
    good = count > _LEAST_CELL
    if np.count_nonzero(good) < 3:
        return 0.0
    means = np.bincount(octant, values, minlength=8)[good] / count[good]
    weight = count[good] / count[good].sum()
    random = float(weight @ (values.var() / count[good]))
    spread = float(np.sqrt(max(0.0, weight @ (means - weight @ means) ** 2 - random)))
    return spread / np.sqrt(np.count_nonzero(good) - 1.0)


def as_levels(air: Air, bone: Bone, plastic: float | None) -> Levels:
    """Return all levels as one value."""
    return Levels(air.level, bone.level, plastic, air.noise, air.sd, bone.sd, bone.found_by)
