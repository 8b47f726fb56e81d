"""The labels of everything found, on a box of the scan, made layer by layer when asked for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.bodies import OTHER_BONE, PLATE, STAPES, LabelledVolume
from legacy.ct_inertia.grey.level_fit import grow_mask
from legacy.ct_inertia.grey.measure_stapes import Measured
from legacy.ct_inertia.native import compiled, shape_of
from legacy.ct_inertia.segment.coarse_segmentation import CoarseSegmentation
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.segment.plate_region import PlateRegion
from legacy.ct_inertia.volume.coarse_view import is_noisy, replace_non_finite, smooth_noise
from legacy.ct_inertia.volume.grid_operations import used_box
from legacy.ct_inertia.volume.volume import Volume

Index = NDArray[np.int64]
# Neighbouring layers that the smoothing of noisy scans uses.
_HALO = 3


@dataclass(frozen=True)
class _Region:
    """Voxels above a grey value, in the cells of a coarser grid.

    Attributes
    ----------
    number : int
        What the voxels are labelled.
    cells : ndarray of bool, [z, y, x]
        Where the body is, on the smallest box of cells that holds it.
    above : float or ndarray of float32, [z, y, x]
        Grey value that a voxel must exceed, for all or for each of the cells.
    first : ndarray of int, (3,)
        Index x, y, z in the scan of the first voxel of the first cell.
    step : ndarray of int, (3,)
        Voxels of the scan per cell.
    """

    number: int
    cells: NDArray[np.bool_]
    above: float | NDArray[np.float32]
    first: Index
    step: Index

    @property
    def end(self) -> Index:
        """One past the last voxel, x, y, z."""
        return np.asarray(self.first + self.step * np.array(self.cells.shape[::-1]))

    def layers(self, start: int, stop: int) -> Iterator[tuple[int, int, int]]:
        """Yield first and one past the last layer of the scan, and their layer of cells, inside a range."""
        first, step = int(self.first[2]), int(self.step[2])
        for cell in range(max((start - first) // step, 0), min(-(-(stop - first) // step), len(self.cells))):
            yield max(start, first + cell * step), min(stop, first + (cell + 1) * step), cell

    def cells_of(self, axis: int, start: int, stop: int) -> Index:
        """Return the cell of each voxel along x (0) or y (1); -1 before the first, their number behind."""
        place = (np.arange(start, stop) - self.first[axis]) // self.step[axis]
        return np.clip(place, -1, self.cells.shape[2 - axis])


def label_box(
    volume: Volume,
    sight: CoarseSegmentation,
    plate: PlateRegion | None,
    cut: Cut,
    measured: Measured,
    level: float,
) -> LabelledVolume:
    """Return the labels of stapes, plate and other bone on the scan's own grid.

    Parameters
    ----------
    volume : Volume
    sight : CoarseSegmentation
    plate : PlateRegion or None
    cut : Cut
    measured : Measured
    level : float
        Share of bone above which a voxel belongs to the stapes.
    """
    regions = []
    if plate is not None:
        box = used_box(plate.mask)
        if box is not None:
            regions.append(_make_region(PLATE, plate.mask, box, plate.middle, plate.step))
    if sight.others:
        low = np.min([piece.low for piece in sight.others], axis=0)
        high = np.max([piece.high for piece in sight.others], axis=0)
        box = tuple(slice(int(a), int(b)) for a, b in zip(low[::-1], high[::-1], strict=True))
        bone = np.zeros(sight.pieces.shape, dtype=bool)
        bone[box] = np.isin(sight.pieces[box], [piece.label for piece in sight.others])
        regions.append(_make_region(OTHER_BONE, bone, box, sight.between, sight.scan.step))
    regions.append(_stapes(cut, measured, level))
    first = np.maximum(np.min([region.first for region in regions], axis=0), 0)
    last = np.minimum(np.max([region.end for region in regions], axis=0), volume.size)
    noise_share = sight.scan.noise / (sight.bone - sight.air)

    def read(low: Index, high: Index) -> NDArray[np.uint8]:
        return _labels(volume, regions, noise_share, low, high)

    return LabelledVolume(first, last, volume, read)


def _make_region(
    number: int, mask: NDArray[np.bool_], box: tuple[slice, ...], above: float, step: Index
) -> _Region:
    """Make a region of a coarse mask in a box, grown by one voxel; coarse voxels are the middle of steps."""
    wide = tuple(slice(max(0, part.start - 1), part.stop + 1) for part in box)
    cells = grow_mask(mask[wide])
    # What the steps leave over at the end of the scan belongs to the last cell.
    ends = [part.stop >= n for part, n in zip(wide, mask.shape, strict=True)]
    cells = np.pad(cells, [(0, int(end)) for end in ends], mode="edge")
    first = np.array([part.start for part in reversed(wide)], dtype=np.int64) * step
    return _Region(number, cells, above, first, step)


def _stapes(cut: Cut, measured: Measured, level: float) -> _Region:
    """Make the stapes' region: on its rim a voxel must exceed the level as other bodies' blur lifts it."""
    cells = measured.share > level
    above: float | NDArray[np.float32] = -np.inf
    block = np.ones(3, dtype=np.int64) if cut.working is None else cut.working.block
    first = cut.first if cut.working is None else cut.working.first
    quiet = not is_noisy(measured.levels.noise / measured.levels.contrast)
    if np.any(block > 1) and quiet:
        cells = grow_mask(cells) & measured.own
    box = used_box(cells) or (slice(0, 1),) * 3
    if np.any(block > 1) and quiet:
        share = measured.share[box] - np.float32(level)
        above = cut.grey[box] - share * np.float32(measured.levels.contrast)
    low = np.array([part.start for part in reversed(box)], dtype=np.int64)
    return _Region(STAPES, cells[box], above, first + low * block, block)


def _labels(
    volume: Volume, regions: list[_Region], noise_share: float, low: Index, high: Index
) -> NDArray[np.uint8]:
    """Return the labels between two corners of the scan, [z, y, x]; later regions lie over earlier ones."""
    labels = np.zeros(tuple(int(n) for n in (high - low)[::-1]), dtype=np.uint8)
    whole = volume.array.dtype.kind in "ui" and not is_noisy(noise_share)
    kernel = _kernel(volume.array) if whole else None
    if kernel is not None:
        for region in regions:
            _mark(kernel, volume.array, region, low, labels)
        return labels
    for region in regions:
        places = [region.cells_of(axis, int(low[axis]), int(high[axis])) for axis in (1, 0)]
        for start, stop, cell in region.layers(int(low[2]), int(high[2])):
            window = _window(region.cells[cell], places)
            if window is None:
                continue
            y, x = window
            index = np.ix_(places[0][y], places[1][x])
            inside = region.cells[cell][index]
            rows = slice(int(low[1]) + y.start, int(low[1]) + y.stop)
            columns = slice(int(low[0]) + x.start, int(low[0]) + x.stop)
            above = region.above if isinstance(region.above, float) else region.above[cell][index]
            if whole:
                part = volume.array[start:stop, rows, columns]
                hit = part > _floor_to_type(above, part.dtype)
            else:
                begin = max(0, start - _HALO)
                part = replace_non_finite(volume.array[begin : stop + _HALO, rows, columns], volume)
                hit = smooth_noise(part, noise_share)[start - begin : stop - begin] > above
            hit &= inside
            target = labels[start - low[2] : stop - low[2], y, x]
            np.copyto(target, np.uint8(region.number), where=hit)
    return labels


def _kernel(array: Any) -> Any:
    """Return the kernel that marks voxels of an array; None where none is made for it."""
    kernels = compiled()
    if kernels is None or not isinstance(array, np.ndarray) or not array.dtype.isnative:
        return None
    whole = array.strides[2] == array.itemsize and all(s % array.itemsize == 0 for s in array.strides)
    return getattr(kernels, f"marked_{array.dtype.name}", None) if whole else None


def _mark(kernel: Any, array: NDArray[Any], region: _Region, low: Index, labels: NDArray[np.uint8]) -> None:
    """Label the voxels of a region in a part of the scan that begins at ``low`` (x, y, z)."""
    z0, y0, x0 = (int(v) for v in low[::-1])
    numbers = [
        np.array(array.strides[1::-1]) // array.itemsize,
        low,
        np.array(labels.shape[::-1]),
    ]
    stride, begin, size = (np.ascontiguousarray(v, dtype=np.int64) for v in numbers)
    first, step = (np.ascontiguousarray(v, dtype=np.int64) for v in (region.first, region.step))
    cells = np.ascontiguousarray(region.cells)
    single = isinstance(region.above, float)
    above = None if single else np.ascontiguousarray(region.above, dtype=np.float32)
    info = np.iinfo(array.dtype)
    part = array[z0:, y0:, x0:]
    kernel(
        *(part.ctypes.data, stride.ctypes.data, begin.ctypes.data, size.ctypes.data),
        *(cells.ctypes.data, shape_of(cells), first.ctypes.data, step.ctypes.data),
        region.above if single else 0.0,
        None if above is None else above.ctypes.data,
        *(float(info.min), float(info.max), region.number, labels.ctypes.data),
    )


def _window(cells: NDArray[np.bool_], places: list[Index]) -> tuple[slice, slice] | None:
    """Return the rows and columns of voxels whose cells are in use; None when there are none."""
    window = []
    for axis, place in enumerate(places):
        used = np.flatnonzero(cells.any(axis=1 - axis))
        if used.size == 0:
            return None
        start, stop = np.searchsorted(place, used[0]), np.searchsorted(place, used[-1], side="right")
        if start == stop:
            return None
        window.append(slice(int(start), int(stop)))
    return window[0], window[1]


def _floor_to_type(limit: float | NDArray[np.float32], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the largest whole numbers not above the limits, within the type of the grey values."""
    info = np.iinfo(dtype)
    floor = np.floor(np.asarray(limit, dtype=float))
    return np.clip(floor, info.min, min(info.max, 2.0**53)).astype(dtype.newbyteorder("="))
