"""Numbers of the stapes and the plate in a label volume: by option, by the segments' names, or 1 and 2."""

from __future__ import annotations

import re
from collections.abc import Mapping

from ct_inertia.bodies import PLATE, STAPES
from stapeskit.faults import StapeskitError

_AUTOMATIC = re.compile(r"(segment|label|region|object|mask|class|material|inside)?[\s_-]*\d*", re.IGNORECASE)
"""Names that programs give by themselves say nothing."""
_PART = re.compile(
    r"stapes|stapedi|foot[\s_-]*plate|fu(ss|ß)platte|(anterior|posterior)[\s_-]*crus|"
    r"crus[\s_-]*(anterius|posterius)|crura|superstructure",
    re.IGNORECASE,
)
_SOFT = re.compile(r"stapedius|stapedial|tendon|muscle|nerve|artery|ligament|incus", re.IGNORECASE)
"""What hangs on the stapes and is no bone of it."""


def body_numbers(
    names: Mapping[int, str], stapes: int | None = None, plate: int | None = None, where: str = ""
) -> tuple[int, int | None]:
    """Return the numbers of the stapes and of the plate (None: there is none).

    Parameters
    ----------
    names : mapping of int to str
        Names of the segments; they win over the usual numbers 1 and 2.
    stapes, plate : int, optional
        Numbers that the user gave (--stapes-label, --plate-label); they win over names.
    where : str
        Name of the file for messages.

    Raises
    ------
    StapeskitError
        Several segments have such a name, or another one that of a part of the stapes; the stapes' usual
        number has a name that says something else; both bodies have the same number.
    """
    if stapes is None:
        stapes = _by_name(names, r"stapes|stapedi", where)
        _refuse_parts(names, stapes, where)
        if stapes is None and not _says_nothing(names.get(STAPES, "")):
            raise StapeskitError.of(
                "the label volume",
                "one with a segment named stapes",
                ", ".join(f"{number} {name}" for number, name in sorted(names.items())),
                where,
                "Rename the segment, or give its number with --stapes-label",
            )
        stapes = STAPES if stapes is None else stapes
    if plate is None:
        plate = _by_name(names, r"(?<!foot)(?<!foot[ _-])plate", where, stapes)
        if plate is None and stapes != PLATE and _says_nothing(names.get(PLATE, "")):
            plate = PLATE
    if plate == stapes:
        raise StapeskitError.of(
            "--plate-label", "another number than the stapes'", plate, where, "Give both numbers"
        )
    return stapes, plate


def _refuse_parts(names: Mapping[int, str], stapes: int | None, where: str) -> None:
    """Refuse a stapes that was drawn in several segments: one of them alone has no footplate, or no arch."""
    parts = [n for n, name in names.items() if n == stapes or (_PART.search(name) and not _SOFT.search(name))]
    if stapes is not None and len(parts) > 1:
        raise StapeskitError.of(
            "the label volume",
            "one with the whole stapes in one segment",
            ", ".join(f"{number} {names[number]}" for number in sorted(parts)),
            where,
            "Unite the parts in one segment, or give the number of the whole stapes with --stapes-label",
        )


def _says_nothing(name: str) -> bool:
    return _AUTOMATIC.fullmatch(name.strip()) is not None


def _by_name(names: Mapping[int, str], pattern: str, where: str, other: int | None = None) -> int | None:
    """Return the number of the segment whose name holds a pattern; an exact name wins over a longer one."""
    matching = [n for n, name in names.items() if n != other and re.search(pattern, name, re.IGNORECASE)]
    exact = [n for n in matching if re.fullmatch(pattern, names[n].strip(), re.IGNORECASE)]
    matching = exact if len(exact) == 1 else matching
    if len(matching) > 1:
        raise StapeskitError.of(
            "the label volume",
            "one with a single segment of that name",
            ", ".join(f"{number} {names[number]}" for number in matching),
            where,
            "Rename the others, or give --stapes-label and --plate-label",
        )
    return matching[0] if matching else None
