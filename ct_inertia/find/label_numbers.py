"""Numbers of the stapes and the plate in a label volume: by option, by the segments' names, or 1 and 2."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from stapeskit.faults import StapeskitError

_STAPES, _PLATE = 1, 2  # of labels without names: as this package writes them
_AUTOMATIC = re.compile(r"(segment|label|region|object|mask|class|material|inside|exterior)?[\s_-]*\d*", re.I)
_STAPES_NAME = re.compile(r"stapes|stapedi", re.I)
_PLATE_NAME = re.compile(r"(?<!foot)(?<!foot[ _-])plate", re.I)
_PART = re.compile(
    r"stapes|stapedi|foot[\s_-]*plate|fu(ss|ß)platte|(anterior|posterior)[\s_-]*crus|"
    r"crus[\s_-]*(anterius|posterius)|crura|superstructure",
    re.I,
)
_SOFT = re.compile(r"stapedius|stapedial|tendon|muscle|nerve|artery|ligament|incus", re.I)


def body_numbers(
    names: Mapping[int, str], present: Sequence[int], stapes: int | None, plate: int | None, where: str
) -> tuple[int, int | None]:
    """Return the numbers of the stapes and of the plate (None: there is none) in a label volume.

    Parameters
    ----------
    names : mapping of int to str
        Names of its segments; they win over the usual numbers 1 and 2.
    present : sequence of int
        Numbers that occur in it, without 0.
    stapes, plate : int or None
        Numbers that the user gave; they win over names.
    where : str
        Name of the file.

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
        if not unnamed or not set(present) <= {1, 2, 3} or _STAPES not in present:
            listed = ", ".join(f"{number} {names.get(number, '')}".strip() for number in present)
            raise StapeskitError.of(
                "the label volume",
                "one with a segment named stapes, or with the stapes as number 1 and the plate as 2",
                listed or "no labels",
                where,
                "Rename the segment, or give its number with --stapes-label",
            )
        stapes = _STAPES
    if plate is None:
        plate = _number_by_name(names, _PLATE_NAME, where, stapes)
        unnamed = _AUTOMATIC.fullmatch(names.get(_PLATE, "").strip()) is not None
        if plate is None and stapes != _PLATE and unnamed and _PLATE in present:
            plate = _PLATE
    if plate == stapes:
        step = "Give both numbers"
        raise StapeskitError.of("--plate-label", "another number than the stapes'", plate, where, step)
    for option, number in (("--stapes-label", stapes), ("--plate-label", plate)):
        if number is not None and number not in present:
            listed = ", ".join(map(str, present))
            raise StapeskitError.of(option, f"a number in the label volume ({listed})", number, where)
    return stapes, plate


def _number_by_name(
    names: Mapping[int, str], pattern: re.Pattern[str], where: str, other: int | None = None
) -> int | None:
    """Return the number of the segment whose name contains a pattern; an exact match wins."""
    matching = [number for number, name in names.items() if number != other and pattern.search(name)]
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
