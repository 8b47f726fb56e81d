"""Bodies from a label volume made elsewhere, with or without the grey values it was drawn on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.bodies import OTHER_BONE, PLATE, STAPES, Bodies, LabelledVolume
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.frames.plate_surface import surface_with_planes
from legacy.ct_inertia.grey.air_level import Guess
from legacy.ct_inertia.grey.frame_surface import doubted_surface, frame_surface
from legacy.ct_inertia.grey.partial_volume import sensitivity, with_voxel_size
from legacy.ct_inertia.grey.scan_border import CODE, BorderCut, border_notices, cut_notice
from legacy.ct_inertia.grey.soft_coat import Coat, bare_bone_notice
from legacy.ct_inertia.labelling.label_numbers import body_numbers, without_islands
from legacy.ct_inertia.labelling.unlabelled_plate import plate_beside
from legacy.ct_inertia.segment.coarse_segmentation import SearchOptions
from legacy.ct_inertia.segment.extract_stapes import Cut, box_around
from legacy.ct_inertia.segment.touching_bones import flood_from_markers
from legacy.ct_inertia.surface.isosurface import iso_surface
from legacy.ct_inertia.surface.moment_matching import moment_matched
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.surface.surface import Surface
from legacy.ct_inertia.volume.distance import capped_distance
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

# Distance between the voxels of labels and scan, in voxels, up to which both have one grid: rounding of
# origins in files stays below, half a voxel between conventions of origins does not.
_SAME_GRID = 0.05
# Voxels from which a label is a body. Chosen by judgement: stray strokes of a brush have fewer.
_LEAST_VOXELS = 50
# Standard deviation, in voxels, of the smoothing of a label for its surface. Chosen by judgement: it rounds
# the stairs of voxels; volume and moments of the stapes are matched to those of its voxels afterwards.
_SURFACE_BLUR = 0.8
# Layers beyond the last of the labels where the scan is asked whether bone goes on: the first is its blur.
_BEYOND = 2
# Voxels of bone there, beside half of the cut, from which it goes on. Chosen by judgement against noise.
_LEAST_END = 10


def bodies_from_labels(volume: Volume | None, options: SearchOptions, coat: Coat | None = None) -> Bodies:
    """Take stapes and plate from a label volume; measure them by grey values where there are some.

    Raises
    ------
    CtInertiaError
        No label volume, no voxel of the stapes' number, values that are no labels, or labels whose grid
        is not a part of the scan's.
    """
    labels = options.labels
    if labels is None:
        raise CtInertiaError.of("the label volume", "given", "none", "", "Give it with {labels}")
    numbers = body_numbers(labels, options.stapes_label, options.plate_label)
    _check_labels(labels, numbers[0])
    stapes, islands = without_islands(labels, numbers[0])
    labels = _renumber(labels, stapes, numbers)
    bodies = _labels_alone(labels, options) if volume is None else _with_grey(volume, labels, options, coat)
    return replace(bodies, notices=(*bodies.notices, *islands))


def _renumber(labels: Volume, stapes: NDArray[np.bool_], numbers: tuple[int, int | None]) -> Volume:
    """Return labels with the numbers of the results: stapes, plate, other bone; islands are background."""
    array = np.where(labels.array != 0, np.uint8(OTHER_BONE), np.uint8(0))
    array[np.asarray(labels.array == numbers[0])] = 0
    array[stapes] = STAPES
    if numbers[1] is not None:
        array[np.asarray(labels.array == numbers[1])] = PLATE
    return replace(labels, array=array)


def _check_labels(labels: Volume, number: int) -> None:
    array = labels.array
    name = "the label volume" if labels.source is None else Path(labels.source).name
    if array.dtype.kind == "f" and any(np.any(piece != np.rint(piece)) for piece in array):
        raise CtInertiaError.of(
            "the label volume",
            "whole numbers, one for each body",
            "grey values",
            name,
            "Give the scan as the first argument and its segmentation with {labels}",
        )
    count = sum(int(np.count_nonzero(piece == number)) for piece in array)
    if count < _LEAST_VOXELS:
        present = sorted({int(v) for piece in array[:: max(1, len(array) // 64)] for v in np.unique(piece)})
        raise CtInertiaError.of(
            "the label volume",
            f"one with voxels of the stapes (number {number})",
            f"{count} of them; numbers present: {', '.join(map(str, present[:12]))}",
            name,
            "Name the stapes' number with {stapes_label}",
        )


def _labels_alone(labels: Volume, options: SearchOptions) -> Bodies:
    """Measure the solid that the labelled voxels fill."""
    stapes = np.asarray(labels.array == STAPES)
    moments = voxel_moments(stapes, labels)
    if options.voxel_size_sd is not None:
        moments = with_voxel_size(moments, options.voxel_size_sd, labels.origin_mm)
    surface = label_surface(stapes, labels, moments)
    plate = np.asarray(labels.array == PLATE)
    plate_mesh = label_surface(plate, labels, None) if np.count_nonzero(plate) >= _LEAST_VOXELS else None
    rest = np.asarray(labels.array != 0) & ~stapes & ~plate
    text = (
        "The bodies come from labels alone: without grey values their surfaces are known to the voxel only, "
        "and a threshold's bias of some percent in volume stays unseen. Give the scan together with "
        f"{named('labels')}."
    )
    return Bodies(
        volume=labels,
        labels=_label(stapes, plate, rest, labels),
        stapes=surface,
        frame_surface=surface,
        plate=plate_mesh,
        moments=moments,
        mesh_moments=surface.moments(),
        levels=None,
        psf_sigma_mm=0.0,
        evidence={"separation": "labels alone"},
        notices=(*labels.notices, Notice("labels_alone", text), *_cut_by_border(stapes, labels.spacing_mm)),
    )


def voxel_moments(mask: NDArray[np.bool_], grid: Volume) -> Moments:
    """Return the exact moments of the solid made of a mask's voxels.

    Its one contribution, ``separation``, is what a shift of the whole surface by a quarter of a voxel does:
    how far a drawn border may lie from the true one.

    Notes
    -----
    Each voxel is a brick: its own second moments, h^2 / 12 times its volume along each axis, are part of
    the sum.
    """
    from scipy.ndimage import binary_dilation, binary_erosion

    index = np.stack(np.nonzero(mask)[::-1], axis=1).astype(float)
    axes = grid.direction * grid.spacing_mm
    middle = index.mean(axis=0)
    points = (index - middle) @ axes.T
    volume = len(index) * grid.voxel_mm3
    brick = axes @ axes.T / 12.0
    second = grid.voxel_mm3 * points.T @ points + volume * brick
    padded = np.pad(mask, 1)
    rim = (binary_dilation(padded) & ~binary_erosion(padded))[1:-1, 1:-1, 1:-1]
    away = (np.stack(np.nonzero(rim)[::-1], axis=1) - middle) @ axes.T
    step = sensitivity(away, volume, 0.0).sum(axis=0) * grid.voxel_mm3 * 0.125
    contributions = {"separation": np.outer(step, step)}
    return Moments(volume, grid.scan_points(middle), 0.5 * (second + second.T), contributions)


def label_surface(mask: NDArray[np.bool_], grid: Volume, moments: Moments | None) -> Surface:
    """Return a closed surface of a mask, its steps smoothed by less than a voxel."""
    from scipy.ndimage import gaussian_filter

    index = np.nonzero(mask)
    low = np.array([max(0, int(k.min()) - 4) for k in index])
    high = np.array([int(k.max()) + 5 for k in index])
    part = mask[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    field = gaussian_filter(np.pad(part, 3).astype(np.float32), _SURFACE_BLUR)
    transform = grid.scan_from_index.copy()
    transform[:3, 3] = grid.scan_points(low[::-1] - 3)
    if moments is None:
        return iso_surface(field, 0.5, transform)
    return moment_matched(field, moments, transform)[0]


def _label(
    stapes: NDArray[np.bool_], plate: NDArray[np.bool_], rest: NDArray[np.bool_], grid: Volume
) -> LabelledVolume:
    index = np.nonzero(stapes | plate | rest)
    box = tuple(slice(int(k.min()), int(k.max()) + 1) for k in index)
    labels = np.zeros([s.stop - s.start for s in box], dtype=np.uint8)
    for mask, number in ((rest, OTHER_BONE), (plate, PLATE), (stapes, STAPES)):
        labels[mask[box]] = number
    first = np.array([s.start for s in reversed(box)], dtype=np.int64)
    return LabelledVolume.of_array(labels, first, grid)


def _cut_by_border(stapes: NDArray[np.bool_], spacing_mm: Array) -> list[Notice]:
    """Warn when the labels end in a flat cut at the border; a crop that only touches them does not count."""
    cuts = []
    for axis in range(3):
        layers = np.moveaxis(stapes, axis, 0)
        for end, outer, inner in (("first", layers[0], layers[1]), ("last", layers[-1], layers[-2])):
            count = int(np.count_nonzero(outer))
            if count > max(_LEAST_VOXELS, 0.8 * np.count_nonzero(inner)):
                cuts.append(_border_cut(axis, end, count, spacing_mm))
    return [cut_notice(cuts, "label volume")] if cuts else []


def _border_cut(axis: int, end: str, count: int, spacing_mm: Array) -> BorderCut:
    """Return the cut in a layer across an axis of an array [z, y, x]."""
    across = 2 - axis
    return BorderCut("xyz"[across], end, float(count * np.prod(np.delete(spacing_mm, across))))


def _cut_by_labels(volume: Volume, labels: Volume, offset: NDArray[np.int64], middle: float) -> list[Notice]:
    """Warn when the label volume ends on the stapes while the scan shows that its bone goes on."""
    from legacy.ct_inertia.volume.coarse_view import replace_non_finite

    for axis in range(3):
        start, count = int(offset[2 - axis]), labels.array.shape[axis]
        ends = (("first", 0, start - _BEYOND), ("last", count - 1, start + count - 1 + _BEYOND))
        for name, layer, beyond in ends:
            if not 0 <= beyond < volume.array.shape[axis]:
                continue
            end = np.take(labels.array, layer, axis=axis) == STAPES
            rest = [
                slice(int(offset[2 - k]), int(offset[2 - k]) + labels.array.shape[k])
                for k in range(3)
                if k != axis
            ]
            rest.insert(axis, slice(beyond, beyond + 1))
            further = replace_non_finite(np.asarray(volume.array[tuple(rest)]), volume).squeeze(axis) > middle
            if np.count_nonzero(end & further) > max(_LEAST_END, 0.5 * np.count_nonzero(end)):
                there = _border_cut(axis, name, int(np.count_nonzero(end)), labels.spacing_mm)
                text = (
                    f"The stapes touches the border of the label volume at {there.told} while its bone goes "
                    f"on in the scan: what lies beyond is missing from volume and mass, and the uncertainty "
                    f"does not hold it. Draw the labels to its end."
                )
                return [Notice(CODE, text)]
    return []


def _offset(volume: Volume, labels: Volume) -> NDArray[np.int64]:
    """Return the index x, y, z of the labels' first voxel in the scan."""
    spacing = np.max(np.abs(labels.spacing_mm / volume.spacing_mm - 1.0))
    turned = np.max(np.abs(labels.direction - volume.direction))
    place = volume.index_points(labels.origin_mm)
    offset = np.rint(place).astype(np.int64)
    fits = np.all(offset >= 0) and np.all(offset + labels.size <= volume.size)
    if spacing < 1e-3 and turned < 1e-3 and np.max(np.abs(place - offset)) < _SAME_GRID and fits:
        return offset
    if np.array_equal(labels.size, volume.size) and not labels.handedness_confirmed:
        return np.zeros(3, dtype=np.int64)
    raise CtInertiaError.of(
        "the label volume",
        f"on the voxels of the scan ({_grid(volume)})",
        _grid(labels),
        "" if labels.source is None else Path(labels.source).name,
        "Resample it onto the scan, or give {labels} alone",
    )


def _grid(volume: Volume) -> str:
    size = " x ".join(map(str, volume.size))
    spacing = " x ".join(f"{v:.6g}" for v in volume.spacing_mm)
    origin = ", ".join(f"{v:.6g}" for v in volume.origin_mm)
    return f"{size} voxels of {spacing} mm from {origin}"


def _with_grey(volume: Volume, labels: Volume, options: SearchOptions, coat: Coat | None) -> Bodies:
    """Take the bodies from the labels, and the share of bone in each voxel from its grey value."""
    from legacy.ct_inertia.grey.measure_stapes import measure_stapes
    from legacy.ct_inertia.volume.coarse_view import replace_non_finite

    offset = _offset(volume, labels)
    stapes_low, stapes_high = _reach(labels, STAPES)
    first, box = box_around(volume, stapes_low + offset, stapes_high + offset)
    grey = replace_non_finite(volume.array[box], volume)
    local = np.zeros(grey.shape, dtype=np.int64)
    low = np.maximum(first, offset)
    high = np.minimum(first + np.array(grey.shape[::-1]), offset + labels.size)
    source = tuple(
        slice(int(a), int(b)) for a, b in zip((low - offset)[::-1], (high - offset)[::-1], strict=True)
    )
    target = tuple(
        slice(int(a), int(b)) for a, b in zip((low - first)[::-1], (high - first)[::-1], strict=True)
    )
    local[target] = labels.array[source]
    stapes, plate = local == STAPES, local == PLATE
    rest = (local != 0) & ~stapes & ~plate
    guess = _guess(grey, stapes, local, volume.spacing_mm)
    every = np.asarray(labels.array)
    unlabelled = None if np.any(every == PLATE) else plate_beside(volume, every == STAPES, offset, guess)
    if unlabelled is not None:
        guess = replace(guess, plastic=unlabelled.sight.plastic)
        plate = unlabelled.mask(first, grey) & ~stapes & ~rest
    ends = _cut_by_labels(volume, labels, offset, 0.5 * (guess.air + guess.bone))
    cut = _cut_by_grey_values(
        Cut(first, grey, stapes, rest, plate, "labels made elsewhere"), guess, volume.spacing_mm
    )
    measured = measure_stapes(volume, cut, guess, coat)
    moments = measured.moments
    if options.voxel_size_sd is not None:
        moments = with_voxel_size(moments, options.voxel_size_sd, volume.origin_mm)
    surface, level = moment_matched(measured.share, moments, cut.scan_from_box(volume))
    coarse = frame_surface(measured.share, cut.scan_from_box(volume), measured.sigma_mm)
    plate_all = np.asarray(every == PLATE)
    plate_mesh: Surface | None = None
    placed = replace(
        labels, spacing_mm=volume.spacing_mm, origin_mm=volume.scan_points(offset), direction=volume.direction
    )
    if np.count_nonzero(plate_all) >= _LEAST_VOXELS:
        plate_mesh = label_surface(plate_all, placed, None)
    if unlabelled is not None:
        part = tuple(slice(int(o), int(o) + n) for o, n in zip(offset[::-1], every.shape, strict=True))
        plate_all = unlabelled.mask(offset, replace_non_finite(volume.array[part], volume)) & (every == 0)
        plate_mesh = surface_with_planes(volume, unlabelled.sight, unlabelled.region)
    mask = every == STAPES
    labelled = _label(mask, plate_all, (every != 0) & ~mask & ~plate_all, placed)
    bare = (
        () if coat is not None else (bare_bone_notice(coarse.surface, moments.volume_mm3, measured.sigma_mm),)
    )
    evidence: dict[str, Any] = {
        "separation": cut.method,
        "iso_level_share": float(level),
        "psf_sigma_mm": measured.sigma_mm,
        "psf_from": measured.sigma_from,
        **({} if measured.coat_share is None else {"coat_share_of_volume": measured.coat_share}),
    }
    return Bodies(
        volume=volume,
        labels=LabelledVolume.of_array(labelled.labels, labelled.first_index + offset, volume),
        stapes=surface,
        frame_surface=coarse.surface,
        frame_blur_mm=coarse.blur_mm,
        frame_doubt=doubted_surface(
            measured.share, measured.doubt, cut.scan_from_box(volume), measured.sigma_mm, coarse
        ),
        wall=measured.wall.result(),
        plate=plate_mesh,
        moments=moments,
        mesh_moments=surface.moments(),
        levels=measured.levels,
        psf_sigma_mm=measured.sigma_mm,
        plate_face=measured.plate_face,
        evidence=evidence,
        notices=(
            *volume.notices,
            *measured.notices,
            *border_notices(volume, cut),
            *ends,
            *bare,
        ),
    )


def _guess(
    grey: NDArray[np.float32], stapes: NDArray[np.bool_], local: NDArray[np.int64], spacing_mm: Array
) -> Guess:
    """Guess the levels: air away from every label, bone deep inside the stapes."""
    step = float(spacing_mm.max())
    far = capped_distance(local != 0, spacing_mm, 6.0 * step) > 5.0 * step
    depth = capped_distance(~stapes, spacing_mm, 6.0 * step)
    deep = depth >= 0.9 * float(depth.max())
    outside = grey[far] if np.any(far) else grey
    air = float(np.percentile(outside, 30.0))
    spread = air - float(np.percentile(outside, 5.0))
    bone = float(np.median(grey[deep]))
    if not bone - air > 4.0 * spread:
        raise CtInertiaError.of(
            "the stapes of the label volume",
            "brighter than the air around it",
            f"grey values about {bone:.6g} inside and {air:.6g} outside",
            next_step="Check that the labels belong to this scan and lie on it",
        )
    return Guess(air, bone)


def _cut_by_grey_values(drawn: Cut, guess: Guess, spacing_mm: Array) -> Cut:
    """Let the grey values place the surfaces where a label was drawn a voxel or two off them.

    Bone more than three voxels away from the drawn stapes is other bone, labelled or not; what lies between
    goes to the body whose flood of grey values reaches it first.
    """
    bone = drawn.grey > 0.5 * (guess.air + guess.bone)
    step = float(spacing_mm.max())
    near = capped_distance(drawn.stapes, spacing_mm, 4.0 * step) <= 3.0 * step
    other = bone & ~drawn.stapes & (~near | drawn.others) & ~drawn.plate
    markers = (drawn.stapes & bone).astype(np.int32) + 2 * other.astype(np.int32)
    parts = flood_from_markers(drawn.grey, markers, bone & ~drawn.plate)
    return replace(drawn, stapes=parts == 1, others=parts == 2)


def _reach(labels: Volume, number: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    index = np.nonzero(labels.array == number)[::-1]
    low = np.array([int(k.min()) for k in index], dtype=np.int64)
    return low, np.array([int(k.max()) + 1 for k in index], dtype=np.int64)
