"""Read a label volume: bodies by the numbers of the results, islands left out or refused."""

from __future__ import annotations

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
_MOST_BODIES = 255  # numbers of a label volume; grey values have more

Labels = NDArray[np.uint8]


def read_labels(
    labels: Scan, stapes_label: int | None, plate_label: int | None
) -> tuple[Labels, list[Notice]]:
    """Read labels with the numbers of the results; islands of the stapes are background.

    Returns
    -------
    ndarray of uint8, [z, y, x]
        0 background, 1 stapes, 2 plate, 3 other bone.
    list of Notice

    Raises
    ------
    StapeskitError
        No whole numbers, hardly a voxel of the stapes' number, or islands that are no slips of the brush.
    """
    values = labels.read()
    present = np.unique(values[values != 0])
    if np.any(present != np.rint(present)) or len(present) > _MOST_BODIES:
        raise StapeskitError.of(
            "the label volume",
            f"whole numbers, one for each body, at most {_MOST_BODIES} of them",
            "grey values",
            labels.name,
            "Give the scan as the first argument and its segmentation with --labels",
        )
    known = [int(number) for number in present]
    number, plate = body_numbers(labels.segment_names, known, stapes_label, plate_label, labels.name)
    result = np.where(values != 0, np.uint8(OTHER_BONE), np.uint8(0))
    if plate is not None:
        result[values == plate] = PLATE
    result[values == number] = STAPES
    count = int(np.count_nonzero(result == STAPES))
    if count < LEAST_VOXELS:
        raise StapeskitError.of(
            "the label volume",
            f"one with a stapes (number {number})",
            f"{count} voxels of it; numbers present: {', '.join(map(str, known[:12]))}",
            labels.name,
            "Name the stapes' number with --stapes-label",
        )
    return result, [*labels.notices, *_drop_islands(result, labels)]


def _drop_islands(result: Labels, labels: Scan) -> list[Notice]:
    """Remove islands away from the stapes, in place; return a warning that lists them.

    Raises
    ------
    StapeskitError
        What lies apart is no slip of the brush: more than 5 % of the label.
    """
    import cc3d

    used = used_box(result == STAPES) or (slice(0, 1),) * 3
    mask = result[used] == STAPES
    parts, count = cc3d.connected_components(mask, connectivity=26, return_N=True)
    if count < 2:
        return []
    found = cc3d.statistics(parts, no_slice_conversion=True)
    sizes = found["voxel_counts"].astype(int)
    sizes[0] = 0
    main, second = np.argsort(-sizes)[:2]
    rest = int(sizes.sum() - sizes[main])
    middle = found["centroids"][second] + [part.start for part in used]
    where = ", ".join(f"{v:.2f}" for v in labels.scan_points(middle[::-1]))
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
