"""Numbers of the stapes and the plate in a label volume: by option, by the segments' names, or 1 and 2."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.volume.grid_operations import boxes_and_sizes, labelled
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.warnings import Notice

# Of labels without names and without options: as this package writes them.
STAPES_NUMBER, PLATE_NUMBER = 1, 2
# Names that programs give by themselves say nothing.
_AUTOMATIC = re.compile(r"(segment|label|region|object|mask|class|material|inside)?[\s_-]*\d*", re.IGNORECASE)
# Parts of the stapes, and what hangs on it and is no bone.
_PART = re.compile(
    r"stapes|stapedi|foot[\s_-]*plate|fu(ss|ß)platte|(anterior|posterior)[\s_-]*crus|"
    r"crus[\s_-]*(anterius|posterius)|crura|superstructure",
    re.IGNORECASE,
)
_SOFT = re.compile(r"stapedius|stapedial|tendon|muscle|nerve|artery|ligament|incus", re.IGNORECASE)
# Islands up to this share of the stapes are slips of the brush; beyond, a body may have been drawn in parts.
_MOST_ISLANDS = 0.05


def body_numbers(labels: Volume, stapes: int | None, plate: int | None) -> tuple[int, int | None]:
    """Return the numbers of the stapes and of the plate (None: there is none).

    Parameters
    ----------
    labels : Volume
        Its ``segment_names`` win over the usual numbers 1 and 2.
    stapes, plate : int or None
        Numbers that the user gave; they win over names.

    Raises
    ------
    CtInertiaError
        Several segments have such a name, or another one that of a part of the stapes; the stapes' usual
        number has a name that says something else; both bodies have the same number.
    """
    names = labels.segment_names
    where = "" if labels.source is None else Path(labels.source).name
    if stapes is None:
        stapes = _number_by_name(names, r"stapes|stapedi", where)
        _refuse_parts(names, stapes, where)
        if stapes is None and not _says_nothing(names.get(STAPES_NUMBER, "")):
            listed = ", ".join(f"{number} {name}" for number, name in sorted(names.items()))
            raise CtInertiaError.of(
                "the label volume",
                "one with a segment named stapes",
                listed,
                where,
                "Rename the segment, or give its number with {stapes_label}",
            )
        stapes = STAPES_NUMBER if stapes is None else stapes
    if plate is None:
        plate = _number_by_name(names, r"(?<!foot)(?<!foot[ _-])plate", where, stapes)
        if plate is None and stapes != PLATE_NUMBER and _says_nothing(names.get(PLATE_NUMBER, "")):
            plate = PLATE_NUMBER
    if plate == stapes:
        raise CtInertiaError.of(
            "{plate_label}", "another number than the stapes'", plate, where, "Give both numbers"
        )
    return stapes, plate


def _refuse_parts(names: Mapping[int, str], stapes: int | None, where: str) -> None:
    """Refuse a stapes that was drawn in several segments: one of them alone has no footplate, or no arch."""
    parts = [n for n, name in names.items() if n == stapes or (_PART.search(name) and not _SOFT.search(name))]
    if stapes is not None and len(parts) > 1:
        raise CtInertiaError.of(
            "the label volume",
            "one with the whole stapes in one segment",
            ", ".join(f"{number} {names[number]}" for number in sorted(parts)),
            where,
            "Unite the parts in one segment, or give the number of the whole stapes with {stapes_label}",
        )


def _says_nothing(name: str) -> bool:
    return _AUTOMATIC.fullmatch(name.strip()) is not None


def _number_by_name(
    names: Mapping[int, str], pattern: str, where: str, other: int | None = None
) -> int | None:
    """Return the number of the segment whose name holds a pattern."""
    matching = [n for n, name in names.items() if n != other and re.search(pattern, name, re.IGNORECASE)]
    exact = [n for n in matching if re.fullmatch(pattern, names[n].strip(), re.IGNORECASE)]
    matching = exact if len(exact) == 1 else matching
    if len(matching) > 1:
        raise CtInertiaError.of(
            "the label volume",
            "one with a single segment of that name",
            ", ".join(f"{number} {names[number]}" for number in matching),
            where,
            "Rename the others, or give {stapes_label} and {plate_label}",
        )
    return matching[0] if matching else None


def without_islands(labels: Volume, number: int) -> tuple[NDArray[np.bool_], list[Notice]]:
    """Return the largest connected part [z, y, x] of a label, and a warning that names what was left out.

    Raises
    ------
    CtInertiaError
        What lies apart is no slip of the brush: more than 5 % of the label.
    """
    mask = np.asarray(labels.array == number)
    parts, count = labelled(mask, corners=True)
    if count < 2:
        return mask, []
    boxes, sizes = boxes_and_sizes(parts, count)
    sizes = sizes.copy()
    sizes[0] = 0
    main = int(np.argmax(sizes))
    rest = int(sizes.sum() - sizes[main])
    second = int(np.argsort(-sizes)[1])
    place = boxes[second - 1] or ()
    middle = labels.scan_points(np.array([0.5 * (s.start + s.stop - 1) for s in reversed(place)]))
    where = ", ".join(f"{v:.2f}" for v in middle)
    if rest > _MOST_ISLANDS * sizes[main]:
        raise CtInertiaError.of(
            "the stapes of the label volume",
            "one connected body",
            f"{count} parts; the second largest, {sizes[second]} voxels, around {where} mm",
            "" if labels.source is None else Path(labels.source).name,
            "Remove the islands, or connect the parts",
        )
    text = (
        f"The label of the stapes has {count - 1} islands away from the body, {rest} voxels "
        f"({rest * labels.voxel_mm3:.4f} mm3), the largest around {where} mm: they were left out. Remove "
        f"them from the label volume."
    )
    return parts == main, [Notice("label_islands_left_out", text)]
