"""Read a label volume: bodies by the numbers of the results, islands left out or refused."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import OTHER_BONE, PLATE, STAPES
from ct_inertia.find.label_numbers import body_numbers
from ct_inertia.scan.scan import Scan
from ct_inertia.voxels.masks import used_box
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

LEAST_VOXELS = 50
"""Of a label that is a body: stray strokes of a brush have fewer."""

_MOST_ISLANDS = 0.05  # of the stapes that are slips of the brush; beyond, a body may have been drawn in parts
_MOST_BODIES = 255  # numbers of a label volume: what a byte holds
_MOST_BYTES = 1 << 32  # of labels that are held in memory, one byte a voxel


@dataclass(frozen=True)
class DrawnLabels:
    """Labels as drawn.

    Attributes
    ----------
    scan : Scan
        Their grid.
    labels : ndarray of uint8, [z, y, x]
        Numbers of the results: 0 background, 1 stapes, 2 plate, 3 other bone.
    has_plate : bool
    notices : tuple of Notice
    """

    scan: Scan
    labels: NDArray[np.uint8]
    has_plate: bool
    notices: tuple[Notice, ...]


def read_labels(labels: Scan, stapes_label: int | None, plate_label: int | None) -> DrawnLabels:
    """Read labels with the numbers of the results; islands of the stapes are background.

    Raises
    ------
    StapeskitError
        Too large, no whole numbers, hardly a voxel of the stapes' number, or islands that are no slips of the
        brush.
    """
    if int(np.prod(labels.shape, dtype=np.int64)) > _MOST_BYTES:
        raise StapeskitError.of(
            "the label volume",
            "at most 4 GiB of voxels",
            f"{' x '.join(map(str, labels.size))} voxels",
            labels.name,
            "Crop it to what it labels",
        )
    result, codes = _read_codes(labels)
    number, plate = body_numbers(labels.segment_names, sorted(codes), stapes_label, plate_label, labels.name)
    body = np.full(256, OTHER_BONE, dtype=np.uint8)
    body[0] = 0
    body[codes[number]] = STAPES
    if plate is not None:
        body[codes[plate]] = PLATE
    for plane in result:
        plane[...] = body[plane]
    count = int(np.count_nonzero(result == STAPES))
    if count < LEAST_VOXELS:
        raise StapeskitError.of(
            "the label volume",
            f"one with a stapes (number {number})",
            f"{count} voxels of it; numbers present: {', '.join(map(str, sorted(codes)[:12]))}",
            labels.name,
            "Name the stapes' number with --stapes-label",
        )
    notices = _drop_islands(result, labels)
    return DrawnLabels(labels, result, bool(np.any(result == PLATE)), (*labels.notices, *notices))


def _read_codes(labels: Scan) -> tuple[NDArray[np.uint8], dict[int, int]]:
    """Read a label volume as bytes [z, y, x], 0 for background, and the byte of each number in it.

    Raises
    ------
    StapeskitError
        No whole numbers, or more of them than a label volume has.
    """
    result = np.zeros(labels.shape, dtype=np.uint8)
    codes: dict[int, int] = {}
    planes = max(1, (1 << 22) // (labels.shape[1] * labels.shape[2]))
    for first, slab in labels.slabs(planes):
        numbers = np.unique(slab[slab != 0])
        if np.any(numbers != np.rint(numbers)) or len(codes.keys() | set(numbers.astype(int))) > _MOST_BODIES:
            raise StapeskitError.of(
                "the label volume",
                f"whole numbers, one for each body, at most {_MOST_BODIES} of them",
                "grey values",
                labels.name,
                "Give the scan as the first argument and its segmentation with --labels",
            )
        part = result[first : first + len(slab)]
        for number in numbers:
            part[slab == number] = codes.setdefault(int(number), len(codes) + 1)
    return result, codes


def _drop_islands(result: NDArray[np.uint8], labels: Scan) -> list[Notice]:
    """Remove islands away from the stapes, in place; return a warning that lists them.

    Raises
    ------
    StapeskitError
        What lies apart is no slip of the brush: more than 5 % of the label.
    """
    import cc3d
    from scipy.ndimage import find_objects

    used = used_box(result == STAPES)
    if used is None:
        return []
    mask = result[used] == STAPES
    parts, count = cc3d.connected_components(mask, connectivity=26, return_N=True)
    if count < 2:
        return []
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    main, second = np.argsort(-sizes)[:2]
    rest = int(sizes.sum() - sizes[main])
    place = find_objects(parts)[second - 1]
    corner = np.array([0.5 * (s.start + s.stop - 1) + k.start for s, k in zip(place, used, strict=True)])
    where = ", ".join(f"{v:.2f}" for v in labels.scan_points(corner[::-1]))
    if rest > _MOST_ISLANDS * sizes[main]:
        raise StapeskitError.of(
            "the stapes of the label volume",
            "one connected body",
            f"{count} parts; the second largest, {sizes[second]} voxels, around {where} mm",
            labels.name,
            "Remove the islands, or connect the parts",
        )
    result[used][mask & (parts != main)] = 0
    text = (
        f"The label of the stapes has {count - 1} islands away from the body, {rest} voxels "
        f"({rest * labels.voxel_mm3:.4f} mm3), the largest around {where} mm: they were left out. Remove "
        "them from the label volume."
    )
    return [Notice("file_read", text)]
