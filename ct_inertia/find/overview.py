"""A first look at the whole scan: every n-th voxel, levels of materials, the region not scanned."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.calibrated import calibrated
from ct_inertia.find.levels import material_levels
from ct_inertia.scan.scan import Scan
from ct_inertia.voxels.fields import Grey, smooth
from ct_inertia.voxels.grid import Grid, Index
from ct_inertia.voxels.masks import Mask, eroded, grown
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

_TARGET_MM = 0.05  # a stapes is 3 mm high: 60 coarse voxels
_MOST_VOXELS = 24_000_000  # bounds the memory: 0.1 GB
_LAYERS, _SAMPLE = 12, 200_000  # layers and differences that the noise follows from, to 1 %
_FEW_VALUES = 4  # most grey values of a scan that somebody has thresholded
_LEAST_PADDING = 0.01  # share of the voxels from which a constant outside is reported
_LEAST_CORNERS = 4  # of 27 corners, edges and middles that a constant outside fills
_LEAST_BOX = 4  # sides in coarse voxels of a box of one value, which noise never makes
_EDGE_VOXELS = 8  # edge of padding that was smoothed or resampled with the picture
_AIR_BEHIND = 0.8  # share of air behind it; behind the edges of bodies it is bone and plastic
_AS_AIR = 3.0  # deviations of noise from the level of air within which a constant is air
_ENOUGH = 1_000_000  # grey values from which the shares of single ones follow
_PILED, _BESIDE = 5.0, 3  # a value is piled up by so many times the mean of so many next ones on either side
_NEAR, _TAIL = 0.01, 0.1  # of the contrast, from a constant: the last and the whole of what fades into it
_FADING, _CLIPPED = 0.2, 0.02  # voxels near it over those in its tail: 0.5 where blur fades, 0.1 at random
_LEAST_NOISY, _STILL = 0.02, 1e-3  # of a scan: air with noise; of the contrast: steps that are none
_LOUD = calibrated("overview.loud_noise")


@dataclass(frozen=True)
class Overview:
    """Every ``block``-th voxel of a scan and its grey levels.

    Attributes
    ----------
    grey : ndarray of float32, [z, y, x]
        What was not measured counts as air.
    grid : Grid
        Blocks of which one voxel near the middle is looked at.
    noise : float
        Standard deviation of the grey values within a material.
    levels : ndarray, (n,)
        Of the materials, ascending; the outside of the field of view is none.
    padding : float or None
        Grey value of a constant that fills the outside of the field of view.
    unmeasured : ndarray of bool, [z, y, x], or None
        Coarse voxels that it fills.
    is_mask : bool
        A few grey values only: the scan was thresholded, or is a label volume.
    """

    grey: Grey
    grid: Grid
    noise: float
    levels: Array
    padding: float | None = None
    unmeasured: Mask | None = None
    is_mask: bool = False

    def above(self, level: float, contrast: float) -> Mask:
        """Return what was measured and is brighter than a level; ``contrast`` of bone over air, for noise."""
        mask = smooth_noise(self.grey, self.noise / contrast) > np.float32(level)
        return mask if self.unmeasured is None else mask & ~self.unmeasured


def look_at(scan: Scan) -> Overview:
    """Take every n-th voxel of a scan and find the grey levels of its materials.

    Raises
    ------
    StapeskitError
        One material only, or voxels that the scan refuses.
    """
    step = _step(scan)
    count = scan.size // step  # leftover voxels at the end of the scan belong to no block
    z, y, x = (slice(int(s // 2), int(n * s), int(s)) for s, n in zip(step[::-1], count[::-1], strict=True))
    grey = np.ascontiguousarray(scan.read((z, y, x)), dtype=np.float32)
    grid = Grid.of(scan, grey.shape, np.zeros(3, dtype=np.int64), step, step // 2)
    few = np.unique(grey.ravel()[:: max(1, grey.size // 50_000) | 1])
    if few.size <= _FEW_VALUES and np.unique(grey).size <= _FEW_VALUES:
        noise = max(0.01 * float(np.ptp(few)) / _FEW_VALUES, 1e-12)
        found = Overview(grey, grid, noise, np.unique(grey).astype(float), is_mask=True)
    else:
        noise, padding, outside = noise_of(grey), None, None
        most, levels = -1.0, None
        for value, mask in _constants(grey):
            others = material_levels(grey, noise, grid.voxel_mm3, mask)
            if len(others) > 1 and _is_padding(grey, value, mask, others, _AS_AIR * noise):
                around = np.abs(grey[grown(mask) & ~mask][:, None] - others.astype(np.float32))
                beside = np.argmin(around, axis=1) == 0
                # of two constants, padding is the one beside air; beside air without noise lies bone too
                if beside.mean() > most:
                    most, levels, padding, outside = float(beside.mean()), others, value, mask
        if outside is None or levels is None:
            levels = material_levels(grey, noise, grid.voxel_mm3, None)
        else:
            grey[outside] = np.float32(levels[0])
        found = Overview(grey, grid, noise, levels, padding, outside)
    if len(found.levels) < 2:
        size, voxel = (
            " x ".join(f"{v:.4g}" for v in lengths)
            for lengths in (scan.size * scan.spacing_mm, scan.spacing_mm)
        )
        raise StapeskitError.of(
            "the scan",
            "a picture of bone in air",
            f"one material only, and noise, in a picture of {size} mm with voxels of {voxel} mm",
            next_step="Check the voxel size (--spacing), that this is the reconstructed volume, or give "
            "--threshold",
        )
    return found


def scan_notices(overview: Overview) -> list[Notice]:
    """Report a thresholded scan, and a constant outside of the field of view."""
    notices = []
    if overview.is_mask:
        text = (
            f"The scan holds {overview.levels.size} grey values: it was thresholded, or is a label volume "
            "(then give it with --labels). It is measured as the solid that its voxels fill; where its "
            "surface lies within a voxel is lost (budget: voxels). Give the grey values as they were "
            "reconstructed."
        )
        notices.append(Notice("grey_values_missing", text))
    if overview.unmeasured is not None:
        share = 100.0 * float(np.mean(overview.unmeasured))
        text = (
            f"A constant grey value ({overview.padding:g}) fills {share:.2g} % of the scan, outside of its "
            "field of view or in blocks that were lost: it was not measured and takes no part in levels, "
            "noise and surroundings."
        )
        notices.append(Notice("file_read", text))
    return notices


def _step(scan: Scan) -> Index:
    """Return voxels per coarse voxel: about 0.05 mm, finer in a small scan, coarser in a huge one."""
    size = scan.size
    step = np.clip(np.round(_TARGET_MM / scan.spacing_mm), 1, max(1, int(size.max()) // 100))
    step = np.minimum(step.astype(np.int64), np.maximum(size // 8, 1))
    while np.prod(size // step) > _MOST_VOXELS:
        step = step + 1
    return np.asarray(step, dtype=np.int64)


def smooth_noise(grey: Grey, noise_share: float) -> Grey:
    """Smooth grey values that are to be thresholded when noise would make holes and specks of them."""
    return grey if noise_share < _LOUD else smooth(np.ascontiguousarray(grey), np.ones(3))


def noise_of(grey: Grey) -> float:
    """Estimate the noise from differences of neighbours, most of which lie in one material."""
    layers = np.unique(np.linspace(0, len(grey) - 2, _LAYERS).round().astype(np.int64))
    some = grey[layers]
    steps = [np.abs(np.diff(some, axis=axis)).ravel() for axis in (1, 2)]
    steps.append(np.abs(grey[layers + 1] - some).ravel())
    values = np.concatenate([part[:: max(1, part.size // _SAMPLE)] for part in steps])
    low, high = np.percentile(some.ravel()[:: max(1, some.size // _SAMPLE)], [0.02, 99.98])
    floor = max(2e-4 * float(high - low), 1e-12)
    moving = values[values > 0.0]  # constants and clipped air give equal neighbours, which say nothing
    if moving.size < 0.05 * values.size:
        return floor
    return max(float(np.median(moving)) / (0.6745 * np.sqrt(2.0)), floor)


def _is_padding(grey: Grey, value: float, outside: Mask, levels: Array, near: float) -> bool:
    """Return whether a constant is no material: it is not air, and ends at materials.

    Air that the export has clipped, or that has no noise, is a constant too. It ends at the blurred edges of
    bodies, or fades into them. So does padding that was smoothed or resampled with the picture: behind its
    edge lies air nearly everywhere, and bodies where a constant is air.
    """
    if abs(value - levels[0]) < near:
        if not _air_is_noisy(grey, levels):
            return False
        dark = grey[grey < 0.5 * (levels[0] + levels[-1])]
        return is_set(dark, float(levels[-1] - levels[0]), value) is not None
    around = grey[grown(outside) & ~outside][:, None]
    at_material = np.min(np.abs(around - levels.astype(np.float32)), axis=1) < near
    at_itself = np.abs(around[:, 0] - np.float32(value)) < near
    if np.mean(at_material & ~at_itself) > 0.5:
        return True
    wide = outside
    for _ in range(_EDGE_VOXELS):
        wide = grown(wide)
    behind = grey[grown(wide) & ~wide]
    values = np.array([*levels, value], dtype=np.float32)
    nearest = np.argmin(np.abs(behind[:, None] - values), axis=1)  # noise that was smoothed has no known size
    return bool(np.mean(nearest == 0) > _AIR_BEHIND) if behind.size else False


def _air_is_noisy(grey: Grey, levels: Array) -> bool:
    """Return whether there is air that goes up and down from voxel to voxel; edges rise or fall."""
    contrast = float(levels[-1] - levels[0])
    steps = np.diff(grey)
    turning = np.sign(steps[..., 1:]) * np.sign(steps[..., :-1]) < 0
    turning &= np.minimum(np.abs(steps[..., 1:]), np.abs(steps[..., :-1])) > np.float32(_STILL * contrast)
    turning &= grey[..., 1:-1] < np.float32(0.5 * (levels[0] + levels[-1]))
    return bool(np.mean(turning) > _LEAST_NOISY)


def is_set(dark: Grey, contrast: float, value: float | None = None) -> tuple[float, float] | None:
    """Return a grey value of air, the commonest if none is given, and its share; None where it was measured.

    Air with noise has no value that stands out of its neighbours. One that does is clipped where it is the
    lowest and others lie next to it, and without noise where edges fade into it; else it was set.
    """
    values, counts = np.unique(dark[:: max(1, dark.size // _ENOUGH) | 1], return_counts=True)
    if values.size < 2 * _BESIDE + 1:
        return None
    place = int(np.argmax(counts)) if value is None else int(np.argmin(np.abs(values - value)))
    beside = np.delete(counts[max(0, place - _BESIDE) : place + _BESIDE + 1], min(place, _BESIDE))
    above, step = values - values[place], float(np.diff(values).min())
    near = max(_NEAR * contrast, 1.5 * step)
    # of what lies around it: another constant may be lower
    lowest = not np.any((above < 0.0) & (above > -near))
    if lowest:
        near = max(near + 0.5 * step, 2.5 * step)
    away = above if lowest else np.abs(above)
    at_it, in_tail = (int(counts[(away > 0.0) & (away < end)].sum()) for end in (near, _TAIL * contrast))
    natural = at_it > (_CLIPPED if lowest else _FADING) * (in_tail - at_it)
    if natural or counts[place] < _PILED * beside.mean():
        return None
    return float(values[place]), float(counts[place] / counts.sum())


def _constants(grey: Grey) -> Iterator[tuple[float, Mask]]:
    """Find constant grey values of voxels that may not have been measured, with their masks.

    A round field of view leaves the corners, a box-shaped one some of the faces: the value is looked for in
    the corners and edges, and must fill whole neighbourhoods, which noise never does. Where there is none,
    the lowest value counts where it fills boxes, as blocks that a copy has lost do and nothing grown does.
    """
    values, count = np.unique(grey[np.ix_(*[(0, n // 2, n - 1) for n in grey.shape])], return_counts=True)
    often = [float(value) for value in values[np.argsort(-count)] if count[values == value] >= _LEAST_CORNERS]
    for value in often or [float(grey.min())]:
        mask = _outside(grey, value, from_corners=bool(often))
        if mask is not None:
            yield value, mask


def _outside(grey: Grey, value: float, from_corners: bool) -> Mask | None:
    """Return where a constant fills the outside of a field of view, or lost blocks; None where neither."""
    import cc3d

    same = grey == np.float32(value)
    if np.count_nonzero(same) < (_LEAST_PADDING * grey.size if from_corners else _LEAST_BOX**3):
        return None
    reached = np.zeros_like(same)
    if from_corners:
        solid = eroded(np.pad(same, 1, constant_values=True))[1:-1, 1:-1, 1:-1]
        labels = cc3d.connected_components(solid, connectivity=6)
        faces = [np.unique(np.take(labels, end, axis=axis)) for axis in range(3) for end in (0, -1)]
        touching = np.zeros(int(labels.max()) + 1, dtype=bool)
        touching[np.concatenate(faces)] = True
        touching[0] = False
        reached = grown(_looked_up(touching, labels)) & same
        del solid, labels
    joined = cc3d.connected_components(same, connectivity=6)  # also slivers that are thinner than two voxels
    facts = cc3d.statistics(joined, no_slice_conversion=True)
    low, high = facts["bounding_boxes"][:, ::2].astype(int), facts["bounding_boxes"][:, 1::2].astype(int)
    sides = high - low + 1
    chosen = (np.prod(sides, axis=1) == facts["voxel_counts"]) & (sides.min(axis=1) >= _LEAST_BOX)
    for layer, near in zip(joined, reached, strict=True):
        chosen[layer[near]] = True
    chosen[0] = False
    outside = _looked_up(chosen, joined)
    enough = outside.any() and (not from_corners or np.mean(outside) >= _LEAST_PADDING)
    return outside if enough else None


def _looked_up(chosen: Mask, labels: NDArray[Any]) -> Mask:
    """Return ``chosen[labels]``, whose index as a whole would take eight bytes a voxel."""
    return np.stack([chosen[layer] for layer in labels])
