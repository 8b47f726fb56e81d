"""The meaning of the columns of a vibrometer table, and the faults of its header."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.tidy.points_csv import other_table
from legacy.stapeskit.faults import Fault, Place, list_some, raise_all
from legacy.stapeskit.option_names import named
from legacy.stapeskit.units import SUFFIXES, Unit, unit_of
from legacy.stapeskit.warnings import Notice

POSITION = ("x_mm", "y_mm", "z_mm")
DIRECTION = ("dir_x", "dir_y", "dir_z")
_EXTRA = ("n_avg", "coherence")
KNOWN = ("body", "point", *POSITION, "dir", *DIRECTION, "freq_hz", "run", "repeat", "level", *_EXTRA)
# Names that people give to columns, and what they are called here.
_OTHER_NAMES = {
    "direction": "dir",
    "beam": "dir",
    "frequency": "freq_hz",
    "frequency_hz": "freq_hz",
    "frequency_[hz]": "freq_hz",
    "freq": "freq_hz",
    "f_hz": "freq_hz",
    "node": "point",
    "part": "body",
    "bodies": "body",
    "x": "x_mm",
    "y": "y_mm",
    "z": "z_mm",
}
_HERTZ = re.compile(r"freq(?:uency)?_\[?hz\]?")
_WIDE = re.compile(r"(?:^|[_ ])(?:mag|magnitude|phase|amplitude|real|imag\w*)(?:[_ ]|$)")


@dataclass(frozen=True)
class Columns:
    """The columns of one table.

    Attributes
    ----------
    first, second : str
        Real and imaginary part, or amplitude and phase.
    unit : Unit
        Of the value.
    sd : str
        Name of the sd column, empty without one; ``sd_scale`` is its factor to SI.
    direction : tuple of str
        ``(dir,)`` or the three components.
    positions, run : bool
        Whether the table has them.
    extra : tuple of str
        Those of n_avg and coherence that are there.
    repeat : bool
        Whether the table names repeats of an excitation.
    level : str
        Name of the column with the strength of the excitation, empty without one; ``level_db`` holds
        decibels, ``level`` or ``level_UNIT`` an amplitude.
    ignored : tuple of str
        Columns that nothing is read from.
    """

    first: str
    second: str
    polar: bool
    unit: Unit
    sd: str
    sd_scale: float
    direction: tuple[str, ...]
    positions: bool
    run: bool
    extra: tuple[str, ...]
    repeat: bool = False
    level: str = ""
    ignored: tuple[str, ...] = ()

    @property
    def decibels(self) -> bool:
        """Whether the level of excitation is in decibels."""
        return self.level.startswith("level_db")

    @property
    def numbers(self) -> set[str]:
        """Names of the number columns to read."""
        names = {"freq_hz", self.first, self.second, *self.extra}
        names |= {name for name in (self.sd, self.level) if name}
        names |= set(self.direction) if len(self.direction) == 3 else set()
        return names | (set(POSITION) if self.positions else set())

    @property
    def texts(self) -> set[str]:
        """Names of the text columns to read."""
        names = {"body", "point"} | ({"run"} if self.run else set())
        names |= {"repeat"} if self.repeat else set()
        return names | ({"dir"} if self.direction == ("dir",) else set())


def columns_of(header: Sequence[str], file: str, points_given: bool) -> Columns:
    """Find the columns of a vibrometer table.

    Parameters
    ----------
    header : sequence of str
        Lower-case names.
    file : str
        For messages.
    points_given : bool
        A separate points file gives the positions.

    Raises
    ------
    KinematicsError
        A column is missing, has an unknown unit, or contradicts another one.
    """
    place = Place(file, "line", (1,))
    faults: list[Fault] = []
    units = _units(header, place, faults)
    other = other_table(header, ("freq_hz",))
    if other and not units and not {"dir", *DIRECTION} & set(header):
        raise KinematicsError.of("the table", "of vibrometer readings", "no column freq_hz", place, other)
    missing = [name for name in ("body", "point", "freq_hz") if name not in header]
    direction = ("dir",) if "dir" in header else DIRECTION
    missing += [name for name in direction if name not in header]
    has_position = any(name in header for name in POSITION)
    if has_position or not points_given:
        missing += [name for name in POSITION if name not in header]
    if missing:
        step = "Add the column, or correct its name in the header (points2dof --help lists them)"
        meant = _resembling(missing, header)
        if set(header).isdisjoint(KNOWN) and any(_WIDE.search(name) for name in header):
            step = (
                "It seems to have one column per channel. Write one row per point, beam and frequency: body, "
                "point, dir, freq_hz, amp_m_s, phase_deg"
            )
        elif meant:
            step = f"Did you mean {meant}?"
        elif POSITION[0] in missing:
            step = f"Give the positions in the table or with {named('points')}"
        faults.append(Fault("the table", "complete", f"no column {', '.join(missing)}", place, step))
    if "dir" in header and any(name in header for name in DIRECTION):
        faults.append(
            Fault("the direction", "given once", "dir and dir_x, dir_y, dir_z", place, "Remove one")
        )
    first, second, polar = _value_pair(units, header, place, faults)
    sd = _sd(units, first, place, faults)
    level = _level(header, place, faults)
    raise_all(KinematicsError, faults)
    columns = Columns(
        first,
        second,
        polar,
        units[first],
        sd,
        units[sd].scale if sd else 1.0,
        direction,
        has_position,
        "run" in header,
        tuple(name for name in _EXTRA if name in header),
        "repeat" in header,
        level,
    )
    used = columns.numbers | columns.texts | {""}
    return replace(columns, ignored=tuple(name for name in header if name not in used))


def _resembling(missing: Sequence[str], header: Sequence[str]) -> str:
    """Return the missing columns that seem to have another name in the header: ``dir for direction``."""
    resembling = []
    for name in header:
        wanted = _OTHER_NAMES.get(name.replace(" ", "_"))
        fixed = name in KNOWN or name.startswith("freq_")
        near = [] if fixed else get_close_matches(name, missing, 1, 0.75)
        if wanted == "dir" and DIRECTION[0] in missing:
            resembling.append(f"dir for {name}")
        elif wanted in missing:
            resembling.append(f"{wanted} for {name}")
        elif near:
            resembling.append(f"{near[0]} for {name}")
    return ", ".join(resembling)


def ignored_notice(columns: Columns, file: str) -> list[Notice]:
    """Report the columns that are not used, and the known names that they resemble."""
    if not columns.ignored:
        return []
    known = [*KNOWN, columns.first, columns.second, f"sd_{columns.first.split('_', 1)[1]}"]
    sentences = []
    for name in columns.ignored:
        free = [other for other in known if other not in columns.numbers | columns.texts]
        near = get_close_matches(name, free, 1, 0.75)
        sentences.append(name + (f" (did you mean {near[0]}?)" if near else ""))
    text = f"columns of {file} that are not used: {list_some(sentences, 6)}."
    return [Notice("columns_ignored", text)]


def _level(header: Sequence[str], place: Place, faults: list[Fault]) -> str:
    names = [name for name in header if name == "level" or name.startswith("level_")]
    if len(names) > 1:
        step = "Remove the others"
        faults.append(Fault("the level of excitation", "given once", ", ".join(names), place, step))
    return names[0] if names else ""


def _units(header: Sequence[str], place: Place, faults: list[Fault]) -> dict[str, Unit]:
    units: dict[str, Unit] = {}
    for name in header:
        unit = unit_of(name)
        if unit is not None:
            units[name] = unit
        elif name.startswith(("re_", "im_", "amp_", "sd_")) or name in ("re", "im", "amp", "sd"):
            step = "Convert the values, and name their unit in the header"
            thing = f"the unit of column {name}"
            faults.append(Fault(thing, f"one of {SUFFIXES}", "an unknown one", place, step))
        elif name.startswith("freq") and not _HERTZ.fullmatch(name):
            faults.append(
                Fault(f"the frequency column {name}", "freq_hz", "an unknown unit", place, "Give Hz")
            )
        elif name.startswith("phase") and name != "phase_deg":
            faults.append(
                Fault(f"the phase column {name}", "phase_deg", "an unknown unit", place, "Give degrees")
            )
    return units


def _value_pair(
    units: dict[str, Unit], header: Sequence[str], place: Place, faults: list[Fault]
) -> tuple[str, str, bool]:
    by_part = {
        part: [name for name, unit in units.items() if unit.part == part] for part in ("re", "im", "amp")
    }
    pairs = "re_m_s with im_m_s, or amp_m_s with phase_deg (or another unit)"
    if any(len(names) > 1 for names in by_part.values()) or (
        by_part["amp"] and (by_part["re"] or by_part["im"])
    ):
        got = ", ".join(name for names in by_part.values() for name in names)
        faults.append(Fault("the value", f"given once, as {pairs}", got, place, "Remove the others"))
    elif by_part["re"] and by_part["im"]:
        first, second = by_part["re"][0], by_part["im"][0]
        if units[first].scale == units[second].scale and units[first].order == units[second].order:
            return first, second, False
        got = f"{first} and {second}"
        faults.append(Fault("real and imaginary part", "in one unit", got, place, "Convert one of them"))
    elif by_part["amp"] and "phase_deg" in header:
        return by_part["amp"][0], "phase_deg", True
    elif not any(fault.thing.startswith("the unit of column") for fault in faults):
        alone = [name for names in by_part.values() for name in names]
        alone += ["phase_deg"] if "phase_deg" in header else []
        got = f"{', '.join(alone)} alone" if alone else "none of them"
        faults.append(Fault("the value columns", pairs, got, place, "Add the missing column"))
    return "", "", False


def _sd(units: dict[str, Unit], first: str, place: Place, faults: list[Fault]) -> str:
    names = [name for name, unit in units.items() if unit.part == "sd"]
    if not names or not first:
        return ""
    value = units[first]
    if len(names) > 1:
        faults.append(
            Fault("the standard deviation", "given once", ", ".join(names), place, "Remove the others")
        )
        return ""
    sd = units[names[0]]
    if sd.order != value.order or sd.rms != value.rms:
        want = f"sd_{first.split('_', 1)[1]}, in the unit of its value"
        faults.append(Fault("the standard deviation", want, names[0], place, "Convert it"))
        return ""
    return names[0]
