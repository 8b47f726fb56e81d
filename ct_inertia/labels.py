"""Bodies from a label volume made elsewhere, with or without the grey values it was drawn on.

They enter the measurement where those found in a scan do, as `Labelled`, and share everything behind it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import (
    OTHER_BONE,
    PLATE,
    STAPES,
    Box,
    Cells,
    Index,
    Labelled,
    Mask,
    PlateRegion,
    Separation,
)
from ct_inertia.find.distance import capped_distance, used_box
from ct_inertia.grey.fields import smooth
from ct_inertia.scan.label_file import body_numbers
from ct_inertia.scan.scan import Scan
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

_SAME_GRID = 0.05  # voxels between labels and scan up to which both have one grid: rounding of origins
_LEAST_VOXELS = 50  # of a body: stray strokes of a brush have fewer
_MOST_ISLANDS = 0.05  # of the stapes: islands up to there are slips of the brush
_FLAT_CUT = 0.8  # of the layer before it, from which the last layer is a cut and no crop that touches
_MARGIN_VOXELS, _MARGIN_MM = 20, 0.5  # around the stapes: its blur, air, and the wall of the window
_MOST_BLOCKS = 420  # of a box along an axis: finer voxels than that are averaged
_CELL_MM = 0.05  # of the labels of the whole scan, and of the plate
_BEYOND = 2  # layers beyond the last of the labels where the scan is asked whether bone goes on
_LEAST_END = 10  # voxels of bone there, beside half of the cut, from which it goes on
_FAR_VOXELS, _NEAR_VOXELS = 5.0, 3.0  # from every label: air; from the stapes: bone beyond is another


@dataclass(frozen=True)
class LabelVolume:
    """A label volume with the numbers of this package: 1 stapes, 2 plate, 3 other bone.

    Attributes
    ----------
    array : ndarray of uint8, [z, y, x]
    grid : Scan
        Its grid; its voxels are not read again.
    notices : tuple of Notice
    """

    array: NDArray[np.uint8]
    grid: Scan
    notices: tuple[Notice, ...]


def label_volume(
    labels: NDArray[np.integer[Any]], grid: Scan, stapes: int | None = None, plate: int | None = None
) -> LabelVolume:
    """Find out which number is which body, and leave out islands of the stapes.

    Parameters
    ----------
    labels : ndarray of int, [z, y, x]
    grid : Scan
    stapes, plate : int, optional
        Their numbers, where names and usual numbers do not say them.

    Raises
    ------
    StapeskitError
        No number is the stapes, it has hardly a voxel, or consists of several bodies.
    """
    present = [int(value) for value in np.unique(labels) if value]
    number, plate_number = body_numbers(grid.segment_names, present, stapes, plate, grid.name)
    array = np.where(labels != 0, np.uint8(OTHER_BONE), np.uint8(0))
    mask = np.asarray(labels == number)
    array[mask] = 0
    body, islands = _without_islands(mask, grid)
    array[body] = STAPES
    if plate_number is not None:
        array[labels == plate_number] = PLATE
    return LabelVolume(array, grid, (*grid.notices, *islands))


def _without_islands(mask: Mask, grid: Scan) -> tuple[Mask, list[Notice]]:
    import cc3d

    parts, count = cc3d.connected_components(mask, connectivity=26, return_N=True)
    sizes = np.bincount(parts.ravel(), minlength=count + 1)
    sizes[0] = 0
    main = int(np.argmax(sizes))
    if sizes[main] < _LEAST_VOXELS:
        step = "Name the stapes' number with --stapes-label"
        expected, got = f"one with at least {_LEAST_VOXELS} voxels of the stapes", f"{sizes[main]}"
        raise StapeskitError.of("the label volume", expected, got, grid.name, step)
    if count < 2:
        return mask, []
    rest, second = int(sizes.sum() - sizes[main]), int(np.argsort(-sizes)[1])
    index = np.argwhere(parts == second)[:, ::-1].mean(axis=0)
    where = ", ".join(f"{value:.2f}" for value in grid.scan_points(index))
    if rest > _MOST_ISLANDS * sizes[main]:
        got = f"{count} parts; the second largest, {sizes[second]} voxels, around {where} mm"
        step = "Remove the islands, or connect the parts"
        thing = "the stapes of the label volume"
        raise StapeskitError.of(thing, "one connected body", got, grid.name, step)
    text = (
        f"The label of the stapes has {count - 1} islands away from the body, {rest} voxels "
        f"({rest * grid.voxel_mm3:.4f} mm3), the largest around {where} mm: they were left out. Remove them "
        "from the "
        "label volume."
    )
    return np.asarray(parts == main), [Notice("label_islands_left_out", text)]


def labels_alone(volume: LabelVolume) -> Labelled:
    """Return the bodies of a label volume without grey values: the solids that its voxels fill."""
    array, grid = volume.array, volume.grid
    mask = array == STAPES
    first, block, shape = _extent(mask, np.zeros(3, dtype=np.int64), grid)
    local = _blocks(array, first, block, shape)
    stapes = local == STAPES
    flat = _flat_cuts(array)
    begins, ends = (np.array([flat[axis, end] for axis in range(3)]) for end in (0, 1))
    box = _box(stapes.astype(np.float32), first, block, grid, begins, ends, is_mask=True)
    text = (
        "The bodies come from labels alone: without grey values their surfaces are known to the voxel only, "
        "and a "
        "threshold's bias of some percent in volume stays unseen. Give the scan together with --labels."
    )
    return Labelled(
        box=box,
        stapes=stapes,
        other=local == OTHER_BONE,
        plate=local == PLATE,
        cells=_cells(array, np.zeros(3, dtype=np.int64), grid.spacing_mm),
        plate_region=labelled_plate(volume, np.zeros(3, dtype=np.int64)),
        air=0.0,
        bone=1.0,
        plastic=None,
        noise=0.0,
        separation=Separation("labels alone"),
        named=True,
        evidence={"separation": "labels alone"},
        notices=(*volume.notices, Notice("labels_alone", text)),
    )


def labels_on_scan(scan: Scan, volume: LabelVolume) -> Labelled:
    """Return the bodies of a label volume with the grey values of its scan.

    Bone more than three voxels away from the drawn stapes is other bone, labelled or not; bright voxels
    between go to the body whose flood of grey values reaches them first.

    Raises
    ------
    StapeskitError
        The labels do not lie on the scan, or the stapes is not brighter than the air around it.
    """
    offset = _offset(scan, volume.grid)
    array = volume.array
    first, block, shape = _extent(array == STAPES, offset, scan)
    last = first + block * np.array(shape[::-1])
    z, y, x = (slice(int(a), int(b)) for a, b in zip(first[::-1], last[::-1], strict=True))
    grey = _means(scan, (z, y, x), block)
    local = _blocks(array, first - offset, block, shape)
    drawn = local == STAPES
    spacing = scan.spacing_mm * block
    air, bone, noise = _levels(grey, drawn, local, spacing, scan.name)
    plate = local == PLATE
    bright = (grey > np.float32(0.5 * (air + bone))) & ~plate
    step = float(spacing.max())
    near = capped_distance(drawn, spacing, (_NEAR_VOXELS + 1.0) * step) <= _NEAR_VOXELS * step
    other = bright & ~drawn & (~near | (local == OTHER_BONE))
    markers = (drawn & bright).astype(np.int32) + 2 * other
    from skimage.segmentation import watershed

    parts = watershed(-grey, markers, mask=bright)
    begins, ends = first == 0, last >= scan.size
    single = None if np.all(block == 1) else scan.read((z, y, x))[:: block[2], :: block[1], :: block[0]]
    beyond = _goes_on(scan, volume, offset, 0.5 * (air + bone))
    return Labelled(
        box=_box(grey, first, block, scan, begins, ends, single=single),
        stapes=parts == 1,
        other=parts == 2,
        plate=plate,
        cells=_cells(array, offset, scan.spacing_mm),
        plate_region=labelled_plate(volume, offset),
        air=air,
        bone=bone,
        plastic=float(np.median(grey[plate])) if np.count_nonzero(plate) >= _LEAST_VOXELS else None,
        noise=noise,
        separation=Separation("labels made elsewhere"),
        named=True,
        evidence={"separation": "labels made elsewhere"},
        notices=(*scan.notices, *volume.notices, *beyond),
    )


def labelled_plate(volume: LabelVolume, offset: Index) -> PlateRegion | None:
    """Return the labelled plate on cells of about 50 um; None where hardly a voxel is labelled so."""
    mask = volume.array == PLATE
    used = used_box(mask)
    if used is None or np.count_nonzero(mask) < _LEAST_VOXELS:
        return None
    grid = volume.grid
    step = np.maximum(np.floor(_CELL_MM / grid.spacing_mm + 1e-6).astype(np.int64), 1)
    low = np.array([max(part.start - 4 * int(s), 0) for part, s in zip(used, step[::-1], strict=True)])
    high = np.array([part.stop + 4 * int(s) for part, s in zip(used, step[::-1], strict=True)])
    part = mask[tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))].astype(np.float32)
    share = _block_mean(part, step)
    transform = grid.scan_from_index.copy()
    first = low[::-1] + 0.5 * (step - 1)
    transform[:3, 3] = grid.scan_points(first)
    transform[:3, :3] = transform[:3, :3] * step
    begins, ends = low[::-1] == 0, (high[::-1] >= grid.size)
    field = smooth(share, np.full(3, 0.7)) - np.float32(0.5)
    first_index = low[::-1] + step // 2 + offset
    return PlateRegion(field > 0.0, field, transform, begins, ends, 0.0, 1.0, first_index, step)


def _extent(stapes: Mask, offset: Index, grid: Scan) -> tuple[Index, Index, tuple[int, int, int]]:
    """Return the first voxel x, y, z, voxels per block, and blocks z, y, x of a box around the stapes."""
    used = used_box(stapes) or (slice(0, 1),) * 3
    low = np.array([part.start for part in used[::-1]]) + offset
    high = np.array([part.stop for part in used[::-1]]) + offset
    margin = np.maximum(_MARGIN_VOXELS, np.ceil(_MARGIN_MM / grid.spacing_mm).astype(np.int64))
    low, high = np.maximum(low - margin, 0), np.minimum(high + margin, grid.size)
    block = np.maximum((high - low) // _MOST_BLOCKS, 1)
    x, y, z = (int(n) for n in (high - low) // block)
    return low, block, (z, y, x)


def _block_mean(values: NDArray[Any], block: Index) -> NDArray[np.float32]:
    """Return means over blocks x, y, z of an array [z, y, x]; what is left over at its ends is dropped."""
    if np.all(block == 1):
        return np.asarray(values, dtype=np.float32)
    z, y, x = (n // int(b) for n, b in zip(values.shape, block[::-1], strict=True))
    bx, by, bz = (int(b) for b in block)
    whole = values[: z * bz, : y * by, : x * bx].reshape(z, bz, y, by, x, bx)
    return np.asarray(whole.mean(axis=(1, 3, 5), dtype=np.float32))


def _means(scan: Scan, part: tuple[slice, slice, slice], block: Index) -> NDArray[np.float32]:
    """Return the means of the scan over blocks, read slab by slab."""
    layers = int(block[2])
    return np.concatenate([_block_mean(slab, block) for _, slab in scan.slabs(16 * layers, part)])


def _blocks(
    array: NDArray[np.uint8], first: Index, block: Index, shape: tuple[int, int, int]
) -> NDArray[np.uint8]:
    """Return the label in the middle of each block; 0 outside of the array."""
    local = np.zeros(shape, dtype=np.uint8)
    places, sources = [], []
    for axis in range(3):
        index = first[2 - axis] + block[2 - axis] // 2 + np.arange(shape[axis]) * block[2 - axis]
        inside = (index >= 0) & (index < array.shape[axis])
        places.append(np.flatnonzero(inside))
        sources.append(index[inside])
    local[np.ix_(*places)] = array[np.ix_(*sources)]
    return local


def _box(
    grey: NDArray[np.float32],
    first: Index,
    block: Index,
    grid: Scan,
    begins: Mask,
    ends: Mask,
    single: NDArray[Any] | None = None,
    is_mask: bool = False,
) -> Box:
    transform = grid.scan_from_index.copy()
    transform[:3, 3] = grid.scan_points(first + 0.5 * (block - 1))
    transform[:3, :3] = transform[:3, :3] * block
    spacing = np.asarray(grid.spacing_mm * block)
    return Box(grey, first, block, spacing, transform, begins, ends, single=single, is_mask=is_mask)


def _cells(array: NDArray[np.uint8], offset: Index, spacing_mm: Array) -> Cells:
    step = np.maximum(np.floor(_CELL_MM / spacing_mm + 1e-6).astype(np.int64), 1)
    sx, sy, sz = (int(s) for s in step)
    cells = array[sz // 2 :: sz, sy // 2 :: sy, sx // 2 :: sx]
    return Cells(np.ascontiguousarray(cells), offset.copy(), step)


def _levels(
    grey: NDArray[np.float32], stapes: Mask, local: NDArray[np.uint8], spacing_mm: Array, name: str
) -> tuple[float, float, float]:
    """Guess air far from every label, bone deep inside the stapes, and the noise of air."""
    step = float(spacing_mm.max())
    far = capped_distance(local != 0, spacing_mm, (_FAR_VOXELS + 1.0) * step) > _FAR_VOXELS * step
    depth = capped_distance(~stapes, spacing_mm, (_FAR_VOXELS + 1.0) * step)
    outside = grey[far] if np.any(far) else grey.ravel()
    low, air = (float(value) for value in np.percentile(outside, (5.0, 30.0)))
    noise = max((air - low) / 1.12, 0.0)  # the 5th and 30th percentile of normal values are 1.12 sd apart
    bone = float(np.median(grey[depth >= 0.9 * float(depth.max())]))
    if not bone - air > 4.0 * (air - low):
        got = f"grey values about {bone:.6g} inside and {air:.6g} outside"
        step_words = "Check that the labels belong to this scan and lie on it"
        expected = "brighter than the air around it"
        raise StapeskitError.of("the stapes of the label volume", expected, got, name, step_words)
    return air, bone, noise


def _flat_cuts(array: NDArray[np.uint8]) -> Mask:
    """Return where labels end in a flat cut, (x, y, z) by (first, last); a crop that touches is none."""
    flat = np.zeros((3, 2), dtype=bool)
    for axis in range(3):
        for end, (outer, inner) in enumerate(((0, 1), (-1, -2))):
            layers = [np.count_nonzero(np.take(array, k, axis=2 - axis) == STAPES) for k in (outer, inner)]
            flat[axis, end] = layers[0] > max(_LEAST_VOXELS, _FLAT_CUT * layers[1])
    return flat


def _goes_on(scan: Scan, volume: LabelVolume, offset: Index, middle: float) -> list[Notice]:
    """Warn when the label volume ends on the stapes while the scan shows that its bone goes on."""
    size = np.array(volume.array.shape[::-1])
    for axis in range(3):
        for end, layer, beyond in (
            ("first", 0, int(offset[axis]) - _BEYOND),
            ("last", int(size[axis]) - 1, int(offset[axis] + size[axis]) - 1 + _BEYOND),
        ):
            if not 0 <= beyond < scan.size[axis]:
                continue
            part = [slice(int(a), int(a + n)) for a, n in zip(offset, size, strict=True)]
            part[axis] = slice(beyond, beyond + 1)
            drawn = np.take(volume.array, layer, axis=2 - axis) == STAPES
            if not drawn.any():
                continue
            bright = scan.read((part[2], part[1], part[0])).squeeze(2 - axis) > middle
            if np.count_nonzero(drawn & bright) > max(_LEAST_END, 0.5 * np.count_nonzero(drawn)):
                text = (
                    f"The stapes touches the border of the label volume at its {end} layer along "
                    f"{'xyz'[axis]} while "
                    "its bone goes on in the scan: what lies beyond is missing from volume and mass, and the "
                    "uncertainty does not hold it. Draw the labels to its end."
                )
                return [Notice("touches_border", text)]
    return []


def _offset(scan: Scan, labels: Scan) -> Index:
    """Return the index x, y, z of the labels' first voxel in the scan."""
    spacing = np.max(np.abs(labels.spacing_mm / scan.spacing_mm - 1.0))
    turned = np.max(np.abs(labels.direction - scan.direction))
    place = scan.index_points(labels.origin_mm)
    offset = np.rint(place).astype(np.int64)
    inside = np.all(offset >= 0) and np.all(offset + labels.size <= scan.size)
    if spacing < 1e-3 and turned < 1e-3 and np.max(np.abs(place - offset)) < _SAME_GRID and inside:
        return offset
    if np.array_equal(labels.size, scan.size) and not labels.handedness_confirmed:
        return np.zeros(3, dtype=np.int64)
    step = "Resample it onto the scan, or give --labels alone"
    expected = f"on the voxels of the scan ({_in_words(scan)})"
    raise StapeskitError.of("the label volume", expected, _in_words(labels), labels.name, step)


def _in_words(grid: Scan) -> str:
    def listed(values: Iterable[float], between: str) -> str:
        return between.join(f"{value:.6g}" for value in values)

    spacing = listed(grid.spacing_mm, " x ")
    return (
        f"{listed(grid.size.astype(float), ' x ')} voxels of {spacing} mm from {listed(grid.origin_mm, ', ')}"
    )
