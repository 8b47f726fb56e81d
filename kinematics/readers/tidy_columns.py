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
KNOWN = (*TEXTS, *POSITION, *DIRECTION, "freq_hz", *EXTRA)
_WITH_UNIT = re.compile(r"(?:re|im|amp|sd)(?:_.*)?|(freq|phase).*")
_UNITS = {"freq": "freq_hz", "phase": "phase_deg", None: f"one of {SUFFIXES}"}


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
    if other and not units:
        raise_all([Fault("the table", "of vibrometer readings", "no column freq_hz", place, other)])
    faults = []
    for name in header:
        match = _WITH_UNIT.fullmatch(name)
        if match and name not in units and name != _UNITS[match[1]]:
            step = "Convert the values, and name their unit in the header"
            thing = f"the unit of column {name}"
            faults.append(Fault(thing, _UNITS[match[1]], "an unknown one", place, step))
    direction = ("dir",) if "dir" in header or set(DIRECTION).isdisjoint(header) else DIRECTION
    positions = POSITION if any(name in header for name in POSITION) else ()
    wanted = ("body", "point", "freq_hz", *direction, *positions)
    missing = [name for name in wanted if name not in header]
    if missing:
        near = [f"{one[0]} for {name}" for name in header if (one := get_close_matches(name, missing, 1))]
        step = "Add the column, or correct its name in the header (points2dof --help lists the layouts)"
        step = f"Did you mean {', '.join(near)}?" if near else step
        faults.append(Fault("the table", "complete", f"no column {', '.join(missing)}", place, step))
    if "dir" in header and not set(DIRECTION).isdisjoint(header):
        faults.append(Fault("the direction", "given once", "dir and dir_x ...", place, "Remove one"))
    values = {unit.part: name for name, unit in units.items() if unit.part != "sd"}
    if set(values) == {"amp"} and "phase_deg" in header:
        values["phase"] = "phase_deg"
    count = sum(unit.part != "sd" for unit in units.values()) + ("phase" in values)
    polar = "phase" in values
    first, second = (values.get(part, "") for part in (("amp", "phase") if polar else ("re", "im")))
    if count != 2 or not (first and second):
        got = ", ".join(values.values()) or "none of them"
        want = "re_m_s with im_m_s, or amp_m_s with phase_deg (or another unit), once"
        faults.append(Fault("the value", want, got, place, "Add the missing column, or remove the others"))
        raise_all(faults)
    kinds = {name: (unit.order, unit.rms) for name, unit in units.items()}
    if not polar and (kinds[first], units[first].scale) != (kinds[second], units[second].scale):
        got = f"{first} and {second}"
        faults.append(Fault("real and imaginary part", "in one unit", got, place, "Convert one of them"))
    spreads = [name for name, unit in units.items() if unit.part == "sd"]
    if len(spreads) > 1 or any(kinds[name] != kinds[first] for name in spreads):
        want, got = f"one column sd_{first.split('_', 1)[1]}", ", ".join(spreads)
        faults.append(Fault("the standard deviation", want, got, place, "Convert it, or remove the others"))
    raise_all(faults)
    sd = spreads[0] if spreads else ""
    optional = {"run", "repeat", *EXTRA} & set(header)
    names = frozenset([*wanted, first, second, *optional, *spreads])
    ignored = tuple(name for name in header if name and name not in names)
    return Columns(first, second, polar, units[first], sd, units[sd].scale if sd else 1.0, names, ignored)


def with_meant(name: str) -> str:
    """Return the name of a column, with the known name that it resembles."""
    near = get_close_matches(name, KNOWN, 1, 0.75)
    return f"{name} (did you mean {near[0]}?)" if near else name
