"""Read a label volume: bodies by option, by the segments' names, or 1 and 2; islands left out or refused."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import OTHER_BONE, PLATE, STAPES
from ct_inertia.scan.scan import Scan
from ct_inertia.voxels.masks import used_box
from stapeskit.faults import StapeskitError, list_some
from stapeskit.warnings import Notice

LEAST_VOXELS = 50
"""Of a label that is a body: stray strokes of a brush have fewer."""

_MOST_ISLANDS = 0.05  # of the stapes that are slips of the brush; beyond, a body may have been drawn in parts
_MOST_BODIES = 255  # numbers of a label volume; grey values have more

_AUTOMATIC = re.compile(r"(segment|label|region|object|mask|class|material|inside|exterior)?[\s_-]*\d*", re.I)
_STAPES_NAME = re.compile(r"stapes|stapedi", re.I)
_PLATE_NAME = re.compile(r"(?<!foot)(?<!foot[ _-])plate", re.I)
_PART = re.compile(
    r"stapes|stapedi|foot[\s_-]*plate|fu(ss|ß)platte|(anterior|posterior)[\s_-]*crus|"
    r"crus[\s_-]*(anterius|posterius)|crura|superstructure",
    re.I,
)
_SOFT = re.compile(r"stapedius|stapedial|tendon|muscle|nerve|artery|ligament|incus", re.I)

Labels = NDArray[np.uint8]


def read_labels(
    labels: Scan, stapes_label: int | None, plate_label: int | None
) -> tuple[Labels, list[Notice]]:
    """Read labels with the numbers of the results; islands of the stapes are background.

    Labels [z, y, x]: 0 background, 1 stapes, 2 plate, 3 other bone.

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
            f"{count} voxels of it; numbers present: {list_some(map(str, known), 12)}",
            labels.name,
            "Name the stapes' number with --stapes-label",
        )
    return result, [*labels.notices, *_drop_islands(result, labels)]


def _drop_islands(result: Labels, labels: Scan) -> list[Notice]:
    """Remove islands away from the stapes, in place; return a warning that lists them."""
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
        f"The label of the stapes has islands away from the body ({count - 1} of together {rest} voxels, "
        f"{rest * labels.voxel_mm3:.4f} mm3; the largest around {where} mm): they were left out. Remove "
        "them from the label volume."
    )
    return [Notice("file_read", text)]


def body_numbers(
    names: Mapping[int, str], present: Sequence[int], stapes: int | None, plate: int | None, where: str
) -> tuple[int, int | None]:
    """Return the numbers of the stapes and of the plate (None: there is none) in a label volume.

    Numbers that the user gave (``stapes``, ``plate``) win over names, and names over the usual numbers 1 and
    2. ``present``: numbers that occur, without 0; ``where``: the file.

    Raises
    ------
    StapeskitError
        Several segments have such a name, or one is a part of the stapes; neither names nor numbers say which
        body is the stapes; both bodies have the same number.
    """
    names = {number: name for number, name in names.items() if number in present}  # others are empty
    if stapes is None:
        stapes = _number_by_name(names, _STAPES_NAME, where)
        _refuse_parts(names, stapes, where)
    if stapes is None:
        unnamed = all(_AUTOMATIC.fullmatch(names.get(number, "").strip()) for number in present)
        if not unnamed or not set(present) <= {1, 2, 3} or STAPES not in present:
            listed = list_some((f"{number} {names.get(number, '')}".strip() for number in present), 12)
            raise StapeskitError.of(
                "the label volume",
                "one with a segment named stapes, or with the stapes as number 1 and the plate as 2",
                listed or "no labels",
                where,
                "Rename the segment, or give its number with --stapes-label",
            )
        stapes = STAPES  # of labels without names: as this package writes them
    if plate is None:
        plate = _number_by_name(names, _PLATE_NAME, where, stapes)
        unnamed = _AUTOMATIC.fullmatch(names.get(PLATE, "").strip()) is not None
        if plate is None and stapes != PLATE and unnamed and PLATE in present:
            plate = PLATE
    if plate == stapes:
        step = "Give both numbers"
        raise StapeskitError.of("--plate-label", "another number than the stapes'", plate, where, step)
    for option, number in (("--stapes-label", stapes), ("--plate-label", plate)):
        if number is not None and number not in present:
            listed = list_some(map(str, present), 12)
            raise StapeskitError.of(option, f"a number in the label volume ({listed})", number, where)
    return stapes, plate


def _number_by_name(
    names: Mapping[int, str], pattern: re.Pattern[str], where: str, other: int | None = None
) -> int | None:
    """Return the number of the segment whose name contains a pattern; an exact match wins."""
    matching = [number for number, name in names.items() if number != other and pattern.search(name)]
    matching = [number for number in matching if not _SOFT.search(names[number])] or matching
    exact = [number for number in matching if pattern.fullmatch(names[number].strip())]
    matching = exact if len(exact) == 1 else matching
    if len(matching) > 1:
        listed = ", ".join(f"{number} {names[number]}" for number in matching)
        step = "Rename the others, or give --stapes-label and --plate-label"
        raise StapeskitError.of(
            "the label volume", "one with a single segment of that name", listed, where, step
        )
    return matching[0] if matching else None


def _refuse_parts(names: Mapping[int, str], stapes: int | None, where: str) -> None:
    """Refuse a stapes that was drawn in several segments: one of them alone has no footplate, or no arch."""
    parts = [n for n, name in names.items() if n == stapes or (_PART.search(name) and not _SOFT.search(name))]
    if stapes is None or len(parts) < 2:
        return
    listed = ", ".join(f"{number} {names[number]}" for number in sorted(parts))
    step = "Unite the parts in one segment, or give the number of the whole stapes with --stapes-label"
    raise StapeskitError.of(
        "the label volume", "one with the whole stapes in one segment", listed, where, step
    )
