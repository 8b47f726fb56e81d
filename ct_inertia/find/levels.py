"""Grey levels of the materials of a scan, and how they may be read: which is bone, what is brighter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ct_inertia.calibrated import calibrated
from ct_inertia.voxels.fields import Grey
from ct_inertia.voxels.masks import Mask
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError

_LEAST_INTERIOR = 25  # fewer voxels inside a material give no level
_BINS = 16  # of the histogram within the least distance of two levels
_FLAT_NOISE = 1.7  # scatter of seven voxels over the noise: more than all but 1 in 120 of one material
_SAME_NOISE = 2.5  # deviations of noise from the level of a material: all but 1 in 80 of its voxels
_ABOVE_PLASTIC = calibrated("choose.above_plastic")
_LEAST_SOLID = calibrated("overview.least_solid_share")
_VALLEY, _SHALLOW_VALLEY = calibrated("overview.valley"), calibrated("overview.shallow_valley")
_SMOOTH_BINS = 2.5  # smoothing of the histogram: a sixth of the distance of two levels


def material_levels(grey: Grey, noise: float, voxel_mm3: float, outside: Mask | None) -> Array:
    """Return the grey levels of the materials, ascending: the modes of voxels inside a material.

    A global threshold moves with the field of view, for bone may be 0.15 % of it; here only voxels whose six
    neighbours agree with them are counted, so that blurred edges hardly count and each material stands out
    however little of it there is. A level between the lowest and the highest must fill cubes of three voxels:
    in a gap one or two voxels wide, and where the edges of thin bone run together, the blur has a level that
    belongs to no material. Less than two levels: there is nothing but noise.
    """
    low, high = float(grey.min()), float(grey.max())
    apart = max(2.5 * noise, 0.04 * (high - low))
    mean, flat = _crosses(grey, _FLAT_NOISE * noise)
    if outside is not None:
        flat &= ~outside[1:-1, 1:-1, 1:-1]
    width = apart / _BINS
    low -= width
    histogram = np.zeros(int((high - low) / width) + 2, dtype=np.int64)
    for layer, used in zip(mean, flat, strict=True):
        bins = ((layer[used] - np.float32(low)) * np.float32(1.0 / width)).astype(np.int64)
        histogram += np.bincount(bins, minlength=len(histogram))
    top = _bright_rest(grey, histogram, low, width, noise, voxel_mm3)
    levels = _modes(histogram, low, width)
    same = _SAME_NOISE * noise
    kept = [
        level
        for k, level in enumerate(levels)
        if k in (0, len(levels) - 1)
        or _is_solid((mean > np.float32(level - same)) & (mean < np.float32(level + same)))
    ]
    if top is not None and (not kept or top > kept[-1] + 8.0 * noise):
        kept.append(top)
    return np.array(kept)


def _crosses(grey: Grey, scatter: float) -> tuple[Grey, Mask]:
    """Return the mean over each voxel's cross of seven but the outermost, and whether it scatters no more.

    With d the six differences to the middle voxel, the sum of squares about the mean of seven is
    sum(d^2) - sum(d)^2 / 7: small numbers, whatever the grey level.
    """
    shape = tuple(n - 2 for n in grey.shape)
    mean, flat = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=bool)
    limit = np.float32(6.0 * scatter**2)
    inner = (slice(1, -1), slice(1, -1))
    for k in range(shape[0]):
        middle = grey[k + 1][inner]
        around = [grey[k][inner], grey[k + 2][inner]]
        layer = grey[k + 1]
        around += [layer[:-2, 1:-1], layer[2:, 1:-1], layer[1:-1, :-2], layer[1:-1, 2:]]
        total, square = np.zeros_like(middle), np.zeros_like(middle)
        for other in around:
            step = other - middle
            total += step
            square += step * step
        mean[k] = middle + total * np.float32(1.0 / 7.0)
        flat[k] = square - total * total * np.float32(1.0 / 7.0) < limit
    return mean, flat


def _modes(histogram: NDArray[np.int64], low: float, width: float) -> list[float]:
    """Return the separate peaks of the histogram, ascending."""
    if histogram.sum() < _LEAST_INTERIOR:
        return []
    padded = np.pad(histogram.astype(float), _BINS)
    centres = low + (np.arange(len(padded)) - _BINS + 0.5) * width
    bell = np.exp(-0.5 * (np.arange(-10, 11) / _SMOOTH_BINS) ** 2)
    smoothed = np.convolve(padded, bell / bell.sum(), mode="same")
    peaks = np.flatnonzero((smoothed[1:-1] >= smoothed[:-2]) & (smoothed[1:-1] > smoothed[2:])) + 1
    kept: list[int] = []

    def keep(some: NDArray[np.intp], valley: float) -> None:
        """Keep peaks that are far from those kept, and behind a valley that is lower than they by a share."""
        for peak in some[np.argsort(-smoothed[some])].tolist():
            lows = [smoothed[min(peak, other) : max(peak, other) + 1].min() for other in kept]
            deep = max(lows, default=0.0) < valley * smoothed[peak]
            far = all(abs(peak - other) > _BINS for other in kept)
            if deep and far and padded[max(0, peak - 6) : peak + 7].sum() >= _LEAST_INTERIOR:
                kept.append(peak)

    keep(peaks, _VALLEY)
    if len(kept) == 2:
        # Noise and wide blur fill the valley between air and a third material, less than half as bright.
        keep(peaks[(peaks > min(kept)) & (peaks < 0.5 * sum(kept))], _SHALLOW_VALLEY)
    near = [slice(max(0, peak - 6), peak + 7) for peak in sorted(kept)]
    return [float(padded[part] @ centres[part] / padded[part].sum()) for part in near]


def _is_solid(mask: Mask) -> bool:
    """Return whether voxels of a level fill more cubes of three than those of a blurred edge do."""
    inner = mask[2:] & mask[1:-1] & mask[:-2]
    inner = inner[:, 2:] & inner[:, 1:-1] & inner[:, :-2]
    cubes = int(np.count_nonzero(inner[:, :, 2:] & inner[:, :, 1:-1] & inner[:, :, :-2]))
    return cubes >= max(_LEAST_INTERIOR, _LEAST_SOLID * np.count_nonzero(mask))


def _bright_rest(
    grey: Grey, histogram: NDArray[np.int64], low: float, width: float, noise: float, voxel_mm3: float
) -> float | None:
    """Return the level of bone that is too thin to have interior voxels, from the brightest voxels."""
    total = np.cumsum(histogram)
    if total.size and total[-1]:
        base = low + (float(np.searchsorted(total, 0.999 * total[-1])) + 0.5) * width
    else:
        base = float(np.median(grey))
    bright = grey[grey > np.float32(base + 8.0 * noise)]
    return float(np.percentile(bright, 90)) if bright.size * voxel_mm3 >= 0.05 else None


@dataclass(frozen=True)
class Reading:
    """Grey levels of air, plastic (None: there is none) and bone, and the one above which a voxel is bone."""

    air: float
    plastic: float | None
    bone: float
    between: float

    @classmethod
    def of(cls, air: float, plastic: float | None, bone: float) -> Reading:
        """Choose the level between bone and what is darker: half way from air, but well above plastic."""
        middle = 0.5 * (air + bone)
        between = middle if plastic is None else max(middle, plastic + _ABOVE_PLASTIC * (bone - plastic))
        return cls(air, plastic, bone, between)

    @property
    def contrast(self) -> float:
        """Of bone over air."""
        return self.bone - self.air


def readings(levels: Array, threshold: float | None = None) -> list[Reading]:
    """Return the possible readings of the materials' levels, the brightest material as bone first.

    A material above half way from air to bone is bone of another density, or else a dense plate.

    Raises
    ------
    StapeskitError
        A threshold that lies beyond all levels.
    """
    air = float(levels[0])
    if threshold is not None:
        below, above = levels[levels < threshold], levels[levels >= threshold]
        if below.size == 0 or above.size == 0:
            raise StapeskitError.of(
                "--threshold",
                f"between the grey levels of air and bone ({levels[0]:.6g} and {levels[-1]:.6g})",
                f"{threshold:g}",
                next_step="Read the two levels off the viewer, or leave --threshold out",
            )
        plastic = float(below[-1]) if below.size > 1 else None
        return [Reading(float(below[0]), plastic, float(above[-1]), threshold)]
    tried = []
    for k in range(len(levels) - 1, 0, -1):
        bone, between = float(levels[k]), levels[1:k]
        light, dense = between[between <= 0.5 * (air + bone)], between[between > 0.5 * (air + bone)]
        plastics = [float(light[-1]) if light.size else None, *map(float, dense)]
        tried += [Reading.of(air, plastic, bone) for plastic in plastics]
    return tried
