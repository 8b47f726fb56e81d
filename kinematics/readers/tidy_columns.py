"""The columns of the tidy vibrometer table: which are there, in which unit, and the faults of its header."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches

from kinematics.readers.points import POSITION, other_table
from stapeskit.faults import Fault, Place, raise_all
from stapeskit.units import SUFFIXES, Unit, unit_of

DIRECTION = ("dir_x", "dir_y", "dir_z")
TEXTS = ("body", "point", "run", "repeat", "dir")
EXTRA = ("n_avg", "coherence")
KNOWN = ("body", "point", *POSITION, "dir", *DIRECTION, "freq_hz", "run", "repeat", *EXTRA)
_HERTZ = re.compile(r"freq(?:uency)?_hz")
_WIDE = re.compile(r"(?:^|_)(?:mag|magnitude|phase|amplitude|real|imag\w*)(?:_|$)")
_OTHER_NAMES = {
    "direction": "dir", "beam": "dir", "frequency": "freq_hz", "frequency_hz": "freq_hz", "freq": "freq_hz",
    "f_hz": "freq_hz", "node": "point", "part": "body", "bodies": "body",
    "x": "x_mm", "y": "y_mm", "z": "z_mm",
}  # fmt: skip


@dataclass(frozen=True)
class Columns:
    """The columns of one table.

    Attributes
    ----------
    first, second : str
        Real and imaginary part, or with ``polar`` amplitude and phase.
    unit : Unit
        Of the value.
    sd : str
        Name of the sd column, empty without one; ``sd_scale`` is its factor to SI.
    names : frozenset of str
        All that are read.
    ignored : tuple of str
    """

    first: str
    second: str
    polar: bool
    unit: Unit
    sd: str
    sd_scale: float
    names: frozenset[str]
    ignored: tuple[str, ...] = ()

    @property
    def texts(self) -> set[str]:
        """Names of the text columns."""
        return {name for name in self.names if name in TEXTS}

    @property
    def numbers(self) -> set[str]:
        """Names of the number columns."""
        return set(self.names) - self.texts


def columns_of(header: Sequence[str], file: str) -> Columns:
    """Find the columns of a tidy table by their names in lower case.

    Raises
    ------
    StapeskitError
        A column is missing, has an unknown unit, or contradicts another one.
    """
    place = Place(file, "line", (1,))
    units = {name: unit for name in header if (unit := unit_of(name)) is not None}
    other = other_table(header, ("freq_hz",))
    if other and not units and not {"dir", *DIRECTION} & set(header):
        raise_all([Fault("the table", "of vibrometer readings", "no column freq_hz", place, other)])
    faults = _unit_faults(header, place)
    direction = ("dir",) if "dir" in header else DIRECTION
    wanted = ["body", "point", "freq_hz", *direction]
    positions = POSITION if any(name in header for name in POSITION) else ()
    missing = [name for name in (*wanted, *positions) if name not in header]
    if missing:
        step = "Add the column, or correct its name in the header (points2dof --help lists them)"
        meant = _meant(missing, header)
        if set(header).isdisjoint(KNOWN) and any(_WIDE.search(name) for name in header):
            step = (
                "It seems to have one column per channel: name them like P1 Vx Mag [mm/s], P1 Vx Phase [deg]"
            )
        elif meant:
            step = f"Did you mean {meant}?"
        faults.append(Fault("the table", "complete", f"no column {', '.join(missing)}", place, step))
    if "dir" in header and any(name in header for name in DIRECTION):
        faults.append(
            Fault("the direction", "given once", "dir and dir_x, dir_y, dir_z", place, "Remove one")
        )
    first, second, polar = _value_pair(units, header, place, faults)
    sd = _sd_column(units, first, place, faults)
    raise_all(faults)
    optional = [name for name in ("run", "repeat", *EXTRA) if name in header]
    names = frozenset([*wanted, *positions, first, second, *optional, *([sd] if sd else [])])
    ignored = tuple(name for name in header if name and name not in names)
    return Columns(first, second, polar, units[first], sd, units[sd].scale if sd else 1.0, names, ignored)


def _unit_faults(header: Sequence[str], place: Place) -> list[Fault]:
    faults = []
    for name in header:
        if unit_of(name) is not None:
            continue
        if name.startswith(("re_", "im_", "amp_", "sd_")) or name in ("re", "im", "amp", "sd"):
            step = "Convert the values, and name their unit in the header"
            got = "an unknown one"
            faults.append(Fault(f"the unit of column {name}", f"one of {SUFFIXES}", got, place, step))
        elif name.startswith("freq") and not _HERTZ.fullmatch(name):
            faults.append(
                Fault(f"the frequency column {name}", "freq_hz", "an unknown unit", place, "Give Hz")
            )
        elif name.startswith("phase") and name != "phase_deg":
            got = "an unknown unit"
            faults.append(Fault(f"the phase column {name}", "phase_deg", got, place, "Give degrees"))
    return faults


def _meant(missing: Sequence[str], header: Sequence[str]) -> str:
    """Return the missing columns that seem to have another name in the header: ``dir for direction``."""
    meant = []
    for name in header:
        wanted = _OTHER_NAMES.get(name, "")
        near = [] if name in KNOWN or name.startswith("freq_") else get_close_matches(name, missing, 1, 0.75)
        if wanted == "dir" and DIRECTION[0] in missing:
            meant.append(f"dir for {name}")
        elif wanted in missing:
            meant.append(f"{wanted} for {name}")
        elif near:
            meant.append(f"{near[0]} for {name}")
    return ", ".join(meant)


def _value_pair(
    units: dict[str, Unit], header: Sequence[str], place: Place, faults: list[Fault]
) -> tuple[str, str, bool]:
    """Return the two columns of the value and whether they are amplitude and phase."""
    by_part = {
        part: [name for name, unit in units.items() if unit.part == part] for part in ("re", "im", "amp")
    }
    pairs = "re_m_s with im_m_s, or amp_m_s with phase_deg (or another unit)"
    listed = [name for names in by_part.values() for name in names]
    if any(len(names) > 1 for names in by_part.values()) or (by_part["amp"] and len(listed) > 1):
        got = ", ".join(listed)
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
        alone = [*listed, *(["phase_deg"] if "phase_deg" in header else [])]
        got = f"{', '.join(alone)} alone" if alone else "none of them"
        faults.append(Fault("the value columns", pairs, got, place, "Add the missing column"))
    return "", "", False


def _sd_column(units: dict[str, Unit], first: str, place: Place, faults: list[Fault]) -> str:
    names = [name for name, unit in units.items() if unit.part == "sd"]
    if not names or not first:
        return ""
    value, sd = units[first], units[names[0]]
    if len(names) > 1:
        got = ", ".join(names)
        faults.append(Fault("the standard deviation", "given once", got, place, "Remove the others"))
    elif sd.order != value.order or sd.rms != value.rms:
        want = f"sd_{first.split('_', 1)[1]}, in the unit of its value"
        faults.append(Fault("the standard deviation", want, names[0], place, "Convert it"))
    return names[0]


def with_meant(name: str) -> str:
    """Return the name of a column, with the known name that it resembles."""
    near = get_close_matches(name, KNOWN, 1, 0.75)
    return f"{name} (did you mean {near[0]}?)" if near else name
