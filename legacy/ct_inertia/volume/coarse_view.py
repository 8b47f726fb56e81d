"""A subsample of the whole scan, and the grey levels of the materials in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.volume.grid_operations import dilated, gaussian
from legacy.ct_inertia.volume.interior_histogram import Interior, interior
from legacy.ct_inertia.volume.lazy_arrays import sampled
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array

# Squares of larger values, summed over a scan, overflow in single precision.
_LARGEST = 1e15
# A stapes is 3 mm high: 60 coarse voxels.
_TARGET_MM = 0.05
# Bounds the memory: 0.1 GB of float32.
_MOST_VOXELS = 24_000_000
# Fewer voxels inside a material give no level.
_LEAST_INTERIOR = 25
# Bins of the histogram within the least distance of two materials' levels.
_BINS = 16
# Layers and differences of neighbours that the noise is estimated from: its standard error is below 1 %.
_LAYERS = 12
# Share of a level that has one value where it is a constant, the rest being edges; noise of one step leaves
# 0.38 of it at one value.
_CONSTANT = 0.97
# Coarse voxels beside bone that are looked at: beyond the blur, which is one of them wide.
_BESIDE = 3
_SAMPLE = 200_000


@dataclass(frozen=True)
class CoarseScan:
    """Every ``step``-th voxel of a scan.

    Attributes
    ----------
    grey : ndarray of float32, [z, y, x]
    step : ndarray of int, (3,)
        Voxels of the scan per coarse voxel along x, y, z.
    spacing_mm : ndarray, (3,)
        Distance of coarse voxels along x, y, z.
    noise : float
        Standard deviation of the grey values within a material.
    """

    grey: NDArray[np.float32]
    step: NDArray[np.int64]
    spacing_mm: Array
    noise: float

    @property
    def voxel_mm3(self) -> float:
        """Volume of one coarse voxel, mm3."""
        return float(np.prod(self.spacing_mm))


def coarse_scan(volume: Volume, target_mm: float = _TARGET_MM) -> CoarseScan:
    """Take a subsample of about ``target_mm``, finer when the scan is small, coarser when it is huge."""
    size, spacing = volume.size, volume.spacing_mm
    wanted = np.maximum(np.round(target_mm / spacing), 1.0)
    limit = max(1, int(size.max()) // 100)
    step = np.clip(wanted, 1, limit).astype(np.int64)
    step = np.minimum(step, np.maximum(size // 8, 1))
    while np.prod(size // step) > _MOST_VOXELS:
        step = step + 1
    sx, sy, sz = (int(s) for s in step)
    part, averaged = sampled(volume.array, (sz, sy, sx))
    grey = replace_non_finite(part, volume)
    return CoarseScan(grey, step, spacing * step, _fine_noise(volume) if averaged else noise_of(grey))


def _fine_noise(volume: Volume) -> float:
    """Return the noise of single voxels, from the middle of the scan: a coarser level is calmer."""
    thirds = [slice(n // 3, n // 3 + max(2, min(96, n // 3))) for n in volume.array.shape]
    return noise_of(replace_non_finite(np.asarray(volume.array[thirds[0], thirds[1], thirds[2]]), volume))


@dataclass(frozen=True)
class CoarseOverview:
    """The coarse view and the grey levels of the materials in it."""

    scan: CoarseScan
    levels: Array


def coarse_overview(volume: Volume) -> CoarseOverview:
    """Take the coarse view and find the levels; numpy alone is used, so that other imports can go on.

    Raises
    ------
    CtInertiaError
        Voxels that are not finite where they are not allowed; only one material.
    """
    scan = coarse_scan(volume)
    levels = material_levels(scan)
    return CoarseOverview(scan, levels[1:] if _is_padding(scan, levels) else levels)


def replace_non_finite(part: NDArray[Any], volume: Volume) -> NDArray[np.float32]:
    """Return a part of the scan as float32, with air for voxels that are not finite when that is allowed.

    Raises
    ------
    CtInertiaError
        Voxels that are not finite where they are not allowed, or too large to be squared.
    """
    if part.dtype.kind != "f":
        return np.array(part, dtype=np.float32)
    with np.errstate(over="ignore"):
        grey = np.array(part, dtype=np.float32)
    bad = ~np.isfinite(grey)
    largest = float(np.max(np.abs(part), where=np.isfinite(part), initial=0.0))
    if largest > _LARGEST:
        raise CtInertiaError.of(
            "the grey values",
            f"smaller than {_LARGEST:g}",
            f"{largest:.3g}",
            next_step="Scale them where the volume is exported",
        )
    if not np.any(bad):
        return grey
    if not volume.nan_as_air:
        raise CtInertiaError.of(
            "the grey values",
            "finite",
            f"{int(bad.sum())} voxels of NaN or infinity",
            next_step="Replace them, or let them count as air with {nan_as_air}",
        )
    grey[bad] = np.median(grey[~bad][::7]) if np.any(~bad) else 0.0
    return grey


def is_noisy(noise_share: float) -> bool:
    """Return whether noise, as a share of the contrast, makes holes and specks when it is thresholded."""
    return bool(noise_share >= calibrated("coarse.loud_noise"))


def smooth_noise(grey: NDArray[np.float32], noise_share: float) -> NDArray[np.float32]:
    """Smooth grey values that are to be thresholded when noise would make holes and specks of them."""
    if not is_noisy(noise_share):
        return grey
    return gaussian(grey, 1.0, truncate=3.0)


def noise_of(grey: NDArray[np.float32]) -> float:
    """Estimate the noise from differences of neighbours, most of which lie in one material."""
    wanted = np.linspace(0, len(grey) - 2, _LAYERS).round().astype(np.int64)
    layers = np.array(sorted(set(wanted.tolist())), dtype=np.int64)
    some = grey[layers]
    steps = [np.abs(part).ravel() for part in (np.diff(some, axis=1), np.diff(some, axis=2))]
    steps.append(np.abs(grey[layers + 1] - some).ravel())
    values = np.concatenate([part[:: max(1, part.size // _SAMPLE)] for part in steps])
    low, high = np.percentile(some.ravel()[:: max(1, some.size // _SAMPLE)], [0.02, 99.98])
    floor = 2e-4 * float(high - low)
    # Air clipped at 0 gives many equal neighbours; they say nothing of the noise.
    moving = values[values > 0.0]
    if moving.size < 0.05 * values.size:
        return max(floor, 1e-12)
    return max(float(np.median(moving)) / (0.6745 * np.sqrt(2.0)), floor, 1e-12)


def material_levels(scan: CoarseScan) -> Array:
    """Return the grey levels of the materials, ascending: the modes of voxels inside a material.

    A global threshold moves with the field of view, for bone may be 0.15 % of it; here only voxels whose
    six neighbours agree with them are counted, so that blurred edges hardly count, and each
    material stands out however little of it there is. A level between the lowest and the highest must fill
    cubes of three voxels at one voxel of it in fifty: in a gap one or two voxels wide between two bones, and
    where the edges of thin bone run together, the blur has a level that belongs to no material.

    Raises
    ------
    CtInertiaError
        Only one material: nothing but noise.
    """
    noise = scan.noise
    apart = max(2.5 * noise, 0.04 * (float(scan.grey.max()) - float(scan.grey.min())))
    inside = interior(scan.grey, calibrated("coarse.flat_noise") * noise, apart / _BINS)
    top = _bright_rest(scan, inside)
    levels = _solid(_modes(inside), inside, noise)
    if top is not None and (levels.size == 0 or top > levels[-1] + 8.0 * noise):
        levels = np.append(levels, top)
    if levels.size < 2:
        raise CtInertiaError.of(
            "the scan",
            "a picture of bone in air",
            "one material only, and noise",
            next_step="Check that this is the reconstructed volume, or give {threshold}",
        )
    return levels


def _is_padding(scan: CoarseScan, levels: Array) -> bool:
    """Say whether the lowest level is a constant that fills the volume outside of what was scanned.

    It has no noise, and most of what lies beside bone is air; air that the export has clipped lies there too.
    """
    if levels.size < 3:
        return False
    few = scan.grey.ravel()[:: max(1, scan.grey.size // _SAMPLE) | 1]
    lowest = few[np.abs(few - np.float32(levels[0])) < np.float32(0.5 * (levels[1] - levels[0]))]
    if not lowest.size or np.count_nonzero(lowest == np.median(lowest)) < _CONSTANT * lowest.size:
        return False
    padding = scan.grey == np.median(lowest)
    bone = scan.grey > np.float32(0.5 * (levels[1] + levels[-1]))
    beside = dilated(bone, _BESIDE) & ~bone
    return bool(np.count_nonzero(padding & beside) < 0.5 * np.count_nonzero(beside))


def _modes(inside: Interior) -> Array:
    """Return the separate peaks of the histogram."""
    if inside.histogram.sum() < _LEAST_INTERIOR:
        return np.zeros(0)
    histogram = np.pad(inside.histogram.astype(float), _BINS)
    centres = inside.low + (np.arange(len(histogram)) - _BINS + 0.5) * inside.width
    bell = np.exp(-0.5 * (np.arange(-10, 11) / calibrated("coarse.smooth_bins")) ** 2)
    smooth = np.convolve(histogram, bell / bell.sum(), mode="same")
    peaks = np.flatnonzero((smooth[1:-1] >= smooth[:-2]) & (smooth[1:-1] > smooth[2:])) + 1
    peaks = peaks[np.argsort(-smooth[peaks])]
    kept = _find_distinct_peaks(peaks, histogram, smooth, [], calibrated("coarse.valley"))
    if len(kept) == 2:
        # Noise and wide blur fill the valley between air and a third material, less than half as bright.
        below = peaks[(peaks > min(kept)) & (peaks < 0.5 * (kept[0] + kept[1]))]
        kept = _find_distinct_peaks(below, histogram, smooth, kept, calibrated("coarse.shallow_valley"))
    levels = []
    for peak in sorted(kept):
        near = slice(max(0, peak - 6), peak + 7)
        levels.append(float(histogram[near] @ centres[near] / histogram[near].sum()))
    return np.array(levels)


def _find_distinct_peaks(
    peaks: NDArray[np.intp], histogram: Array, smooth: Array, kept: list[int], valley: float
) -> list[int]:
    """Return the bins kept, with peaks (n,) that are far from them, and behind a valley of that share."""
    kept = list(kept)
    for peak in peaks:
        mass = histogram[max(0, peak - 6) : peak + 7].sum()
        far = all(abs(peak - other) > _BINS for other in kept)
        deep = all(
            smooth[min(peak, other) : max(peak, other) + 1].min() < valley * smooth[peak] for other in kept
        )
        if mass >= _LEAST_INTERIOR and far and deep:
            kept.append(int(peak))
    return kept


def _solid(levels: Array, inside: Interior, noise: float) -> Array:
    """Leave out what lies between two materials and hardly fills a cube of three voxels anywhere."""
    kept = [
        level
        for k, level in enumerate(levels)
        if k in (0, len(levels) - 1)
        or _is_solid(inside.filled(level, calibrated("coarse.same_material_noise") * noise))
    ]
    return np.array(kept)


def _is_solid(counts: tuple[int, int]) -> bool:
    """Return whether voxels of a level fill more cubes of three than those of a blurred edge do."""
    voxels, cubes = counts
    return cubes >= max(_LEAST_INTERIOR, calibrated("coarse.least_solid_share") * voxels)


def _bright_rest(scan: CoarseScan, inside: Interior) -> float | None:
    """Return a level for what is brighter than every interior voxel: bone too thin to have an inside."""
    total = np.cumsum(inside.histogram)
    if total[-1]:
        base = float(inside.centres[np.searchsorted(total, 0.999 * total[-1])])
    else:
        base = float(np.median(scan.grey))
    bright = scan.grey[scan.grey > base + 8.0 * scan.noise]
    if bright.size * scan.voxel_mm3 < 0.05:
        return None
    return float(np.percentile(bright, 90))
