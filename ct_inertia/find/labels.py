"""Labels made elsewhere: which voxels are stapes and plate, with the scan or alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
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
from ct_inertia.find.box import read_box
from ct_inertia.find.choose import Reading, readings
from ct_inertia.find.distance import capped_distance, used_box
from ct_inertia.find.label_volume import LEAST_VOXELS, DrawnLabels, read_labels
from ct_inertia.find.overview import Overview, look_at, noise_of, scan_notices
from ct_inertia.find.pieces import describe
from ct_inertia.find.plate import find_plate, mask_region, plate_mask
from ct_inertia.scan.scan import Scan
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

_SAME_GRID = (
    0.05  # voxels between grids that are one: rounding of origins, but not half a voxel of conventions
)
_DRAWN_VOXELS = 3.0  # how far off the surface a label may be drawn


def label_stapes(
    labels: Scan,
    scan: Scan | None = None,
    stapes_label: int | None = None,
    plate_label: int | None = None,
    progress: Callable[[str], Any] | None = None,
) -> Labelled:
    """Take the bodies from a label volume; their surfaces from the grey values where there is a scan.

    Parameters
    ----------
    labels : Scan
        Whole numbers, one for each body.
    scan : Scan, optional
        The grey values that they were drawn on: the same grid, or a larger one.
    stapes_label, plate_label : int, optional
        Numbers of the bodies; None: by the names of the segments, else 1 and 2.
    progress : callable, optional
        Called with a few words at the beginning of each stage.

    Raises
    ------
    StapeskitError
        No voxel of the stapes' number, values that are no labels, islands, or labels whose grid is not a part
        of the scan's.
    """
    tell = progress or (lambda _: None)
    tell("reading the labels")
    drawn = read_labels(labels, stapes_label, plate_label)
    if scan is None:
        return _alone(drawn)
    tell("laying the labels on the scan")
    return _on_scan(drawn, scan)


def _alone(drawn: DrawnLabels) -> Labelled:
    """Return the solid that the labelled voxels fill."""
    used = used_box(drawn.labels == STAPES) or (slice(0, 1),) * 3
    part = tuple(
        slice(max(0, k.start - 8), min(n, k.stop + 8)) for k, n in zip(used, drawn.labels.shape, strict=True)
    )
    labels = drawn.labels[part]
    first = np.array([k.start for k in part[::-1]], dtype=np.int64)
    transform = drawn.scan.scan_from_index.copy()
    transform[:3, 3] = drawn.scan.scan_points(first)
    stapes = labels == STAPES
    box = Box(
        grey=stapes.astype(np.float32),
        first=first,
        block=np.ones(3, dtype=np.int64),
        spacing_mm=np.array(drawn.scan.spacing_mm),
        scan_from_index=transform,
        **_flat_ends(drawn.labels == STAPES),
        is_mask=True,
    )
    text = (
        "The bodies come from labels alone: without grey values their surfaces are known to the voxel "
        "only, and a threshold's bias of some percent in volume stays unseen. Give the scan together with "
        "--labels."
    )
    plate = drawn.labels == PLATE
    return Labelled(
        box=box,
        stapes=stapes,
        other=labels == OTHER_BONE,
        plate=labels == PLATE,
        cells=_cells(drawn.labels, np.zeros(3, dtype=np.int64)),
        plate_region=_drawn_plate(plate, np.zeros(3, dtype=np.int64), drawn.scan),
        air=0.0,
        bone=1.0,
        plastic=None,
        noise=0.0,
        separation=Separation("labels alone"),
        named=True,
        evidence={"bodies_from": "labels alone"},
        notices=(*drawn.notices, Notice("labels_alone", text)),
    )


def _flat_ends(stapes: Mask) -> dict[str, Mask]:
    """Return at which ends the labels are cut flat; a crop that only touches the body does not count."""
    begins, ends = np.zeros(3, dtype=bool), np.zeros(3, dtype=bool)
    for axis in range(3):
        for flags, outer, inner in ((begins, 0, 1), (ends, -1, -2)):
            count = np.count_nonzero(np.take(stapes, outer, axis=axis))
            flags[2 - axis] = count > max(
                LEAST_VOXELS, 0.8 * np.count_nonzero(np.take(stapes, inner, axis=axis))
            )
    return {"begins": begins, "ends": ends}


def _on_scan(drawn: DrawnLabels, scan: Scan) -> Labelled:
    """Lay labels on a scan: bodies by the labels, surfaces by the grey values where there are any."""
    offset = _offset(drawn, scan)
    overview = look_at(scan)
    if overview.is_mask:
        alone = _alone(drawn)
        return replace(alone, notices=(*scan_notices(overview), *alone.notices))
    used = used_box(drawn.labels == STAPES) or (slice(0, 1),) * 3
    low = np.array([k.start for k in used[::-1]]) + offset
    high = np.array([k.stop for k in used[::-1]]) + offset
    box = read_box(scan, low, high, float(scan.spacing_mm.min()), overview)
    local = np.zeros(box.shape, dtype=np.uint8)
    shape = np.array(box.shape[::-1])
    start, stop = np.maximum(box.first, offset), np.minimum(box.first + shape, offset + drawn.scan.size)
    target = tuple(
        slice(int(a), int(b))
        for a, b in zip((start - box.first)[::-1], (stop - box.first)[::-1], strict=True)
    )
    source = tuple(
        slice(int(a), int(b)) for a, b in zip((start - offset)[::-1], (stop - offset)[::-1], strict=True)
    )
    local[target] = drawn.labels[source]
    air, bone = _levels(box, local)
    plate = drawn.labels == PLATE
    region = _drawn_plate(plate, offset, scan)
    plastic_mask = local == PLATE
    plastic = float(np.median(box.grey[plastic_mask])) if plastic_mask.any() else None
    if not drawn.has_plate:
        region = _plate_in_scan(scan, overview, drawn, offset)
        if region is not None:
            quiet_bone = box.grey > np.float32(0.5 * (air + bone))
            plastic_mask, plastic = (
                plate_mask(region, box, box.grey, quiet_bone) & (local == 0),
                region.plastic,
            )
        if region is not None and region.immersing:
            region = None
    stapes, other = _by_grey_values(box, local, plastic_mask, 0.5 * (air + bone))
    cut = _cut_by_labels(drawn, scan, offset, 0.5 * (air + bone))
    notices = [*scan_notices(overview), *drawn.notices, *cut]
    return Labelled(
        box=box,
        stapes=stapes,
        other=other,
        plate=plastic_mask & ~stapes & ~other,
        cells=_cells(drawn.labels, offset),
        plate_region=region,
        air=air,
        bone=bone,
        plastic=plastic,
        noise=noise_of(box.grey),
        unmeasured_share=overview.unmeasured_share,
        separation=Separation("labels made elsewhere"),
        named=True,
        evidence={"bodies_from": "labels on the scan", "bone_above": 0.5 * (air + bone)},
        notices=tuple(notices),
    )


def _offset(drawn: DrawnLabels, scan: Scan) -> Index:
    """Return the index x, y, z of the labels' first voxel in the scan.

    Raises
    ------
    StapeskitError
        The labels do not lie on voxels of the scan.
    """
    labels = drawn.scan
    spacing = float(np.max(np.abs(labels.spacing_mm / scan.spacing_mm - 1.0)))
    turned = float(np.max(np.abs(labels.direction - scan.direction)))
    place = scan.index_points(labels.origin_mm)
    offset = np.rint(place).astype(np.int64)
    fits = np.all(offset >= 0) and np.all(offset + labels.size <= scan.size)
    if spacing < 1e-3 and turned < 1e-3 and np.max(np.abs(place - offset)) < _SAME_GRID and fits:
        return offset
    if np.array_equal(labels.size, scan.size) and not labels.handedness_confirmed:
        return np.zeros(3, dtype=np.int64)
    raise StapeskitError.of(
        "the label volume",
        f"on the voxels of the scan ({_grid(scan)})",
        _grid(labels),
        labels.name,
        "Resample it onto the scan, or give --labels alone",
    )


def _grid(scan: Scan) -> str:
    size = " x ".join(map(str, scan.size))
    spacing = " x ".join(f"{v:.6g}" for v in scan.spacing_mm)
    return f"{size} voxels of {spacing} mm from {', '.join(f'{v:.6g}' for v in scan.origin_mm)}"


def _levels(box: Box, local: NDArray[np.uint8]) -> tuple[float, float]:
    """Return first levels: air away from every label, bone deep inside the stapes.

    Raises
    ------
    StapeskitError
        The labelled stapes is no brighter than what is around it.
    """
    step = float(box.spacing_mm.max())
    far = capped_distance(local != 0, box.spacing_mm, 6.0 * step) > np.float32(5.0 * step)
    depth = capped_distance(local != STAPES, box.spacing_mm, 6.0 * step)
    outside = box.grey[far] if far.any() else box.grey.ravel()
    air = float(np.percentile(outside, 30.0))
    spread = air - float(np.percentile(outside, 5.0))
    bone = float(np.median(box.grey[depth >= np.float32(0.9 * float(depth.max()))]))
    if not bone - air > 4.0 * spread:
        raise StapeskitError.of(
            "the stapes of the label volume",
            "brighter than the air around it",
            f"grey values about {bone:.6g} inside and {air:.6g} outside",
            next_step="Check that the labels belong to this scan and lie on it",
        )
    return air, bone


def _by_grey_values(box: Box, local: NDArray[np.uint8], plastic: Mask, middle: float) -> tuple[Mask, Mask]:
    """Let the grey values place the surfaces where a label was drawn a voxel or two off them.

    Bone more than three voxels away from the drawn stapes is other bone, labelled or not; what lies between
    goes to the body whose flood of grey values reaches it first.
    """
    from ct_inertia.grey.start import flood

    bone = box.grey > np.float32(middle)
    drawn = local == STAPES
    step = float(box.spacing_mm.max())
    away = capped_distance(drawn, box.spacing_mm, (_DRAWN_VOXELS + 1.0) * step)
    near = away <= np.float32(_DRAWN_VOXELS * step)
    other = bone & ~drawn & (~near | (local == OTHER_BONE)) & ~plastic
    markers = (drawn & bone).astype(np.int32) + 2 * other.astype(np.int32)
    parts = flood(box.grey, markers, bone & ~plastic)
    return parts == 1, parts == 2


def _plate_in_scan(scan: Scan, overview: Overview, drawn: DrawnLabels, offset: Index) -> PlateRegion | None:
    """Seek the plate in the grey values where the labels hold none."""
    reading: Reading | None = next(
        (one for one in readings(overview.levels, None) if one.plastic is not None), None
    )
    if reading is None:
        return None
    cells = _sampled(drawn.labels == STAPES, overview.grey.shape, overview.step, offset)
    used = used_box(cells)
    if used is None:
        return None
    piece = describe(cells.astype(np.int32), 1, used, overview.spacing_mm)
    levels = (reading.air, reading.plastic, reading.bone)
    return find_plate(scan, overview, levels, reading.between, (cells, piece))


def _sampled(mask: Mask, shape: tuple[int, ...], step: Index, offset: Index) -> Mask:
    """Return a mask of labels at the coarse voxels of an overview."""
    result = np.zeros(shape, dtype=bool)
    places, kept = [], []
    for axis in range(3):
        k = 2 - axis
        index = np.arange(shape[axis]) * step[k] + step[k] // 2 - offset[k]
        inside = (index >= 0) & (index < mask.shape[axis])
        places.append(index[inside])
        kept.append(np.flatnonzero(inside))
    result[np.ix_(*kept)] = mask[np.ix_(*places)]
    return result


def _drawn_plate(plate: Mask, offset: Index, scan: Scan) -> PlateRegion | None:
    return mask_region(scan, plate, offset) if np.count_nonzero(plate) >= LEAST_VOXELS else None


def _cells(labels: NDArray[np.uint8], first: Index) -> Cells:
    used = used_box(labels > 0) or (slice(0, 1),) * 3
    start = first + np.array([k.start for k in used[::-1]])
    return Cells(labels[used], start, np.ones(3, dtype=np.int64))


def _cut_by_labels(drawn: DrawnLabels, scan: Scan, offset: Index, middle: float) -> list[Notice]:
    """Warn when the label volume ends on the stapes while the scan shows that its bone goes on."""
    beyond = 2  # layers: the first is its blur
    for axis in range(3):
        start, count = int(offset[2 - axis]), drawn.labels.shape[axis]
        for name, layer, place in (
            ("first", 0, start - beyond),
            ("last", count - 1, start + count - 1 + beyond),
        ):
            if not 0 <= place < scan.shape[axis]:
                continue
            end = np.take(drawn.labels, layer, axis=axis) == STAPES
            part = [slice(int(offset[2 - k]), int(offset[2 - k]) + drawn.labels.shape[k]) for k in range(3)]
            part[axis] = slice(place, place + 1)
            further = scan.read((part[0], part[1], part[2])).squeeze(axis) > middle
            if np.count_nonzero(end & further) > max(10, 0.5 * np.count_nonzero(end)):
                text = (
                    f"The stapes touches the border of the label volume at the {name} layer along "
                    f"{'zyx'[axis]} while its bone goes on in the scan: what lies beyond is missing from "
                    "volume and mass, and the uncertainty does not hold it. Draw the labels to its end."
                )
                return [Notice("touches_border", text)]
    return []
