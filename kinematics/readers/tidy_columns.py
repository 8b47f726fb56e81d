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
    """The columns of one table: ``first`` and ``second`` are real and imaginary part, or polar.

    ``sd`` is empty without one, in the unit of the value but for its ``sd_scale``; ``ignored`` are not read.
    """

    first: str
    second: str
    unit: Unit
    sd: str
    sd_scale: float
    names: frozenset[str]
    ignored: tuple[str, ...] = ()

    @property
    def polar(self) -> bool:
        """Whether the value is given by amplitude and phase."""
        return self.unit.part == "amp"

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
    place, faults = Place(file, "line", (1,)), list[Fault]()

    def refuse(thing: str, expected: str, got: str, step: str) -> None:
        faults.append(Fault(thing, expected, got, place, step))

    units = {name: unit for name in header if (unit := unit_of(name)) is not None}
    other = other_table(header, ("freq_hz",))
    if other and not units:
        refuse("the table", "of vibrometer readings", "no column freq_hz", other)
        raise_all(faults)
    for name in header:
        match = _WITH_UNIT.fullmatch(name)
        if match and name not in units and name != _UNITS[match[1]]:
            step = "Convert the values, and name their unit in the header"
            refuse(f"the unit of column {name}", _UNITS[match[1]], "an unknown one", step)
    direction = ("dir",) if "dir" in header or set(DIRECTION).isdisjoint(header) else DIRECTION
    positions = POSITION if any(name in header for name in POSITION) else ()
    wanted = ("body", "point", "freq_hz", *direction, *positions)
    missing = [name for name in wanted if name not in header]
    if missing:
        near = [f"{one[0]} for {name}" for name in header if (one := get_close_matches(name, missing, 1))]
        step = "Add the column, or correct its name in the header (points2dof --help lists the layouts)"
        step = f"Did you mean {', '.join(near)}?" if near else step
        refuse("the table", "complete", f"no column {', '.join(missing)}", step)
    if "dir" in header and not set(DIRECTION).isdisjoint(header):
        refuse("the direction", "given once", "dir and dir_x ...", "Remove one")
    values = sorted((unit.part, name) for name, unit in units.items() if unit.part != "sd")
    parts, names = [part for part, _ in values], [name for _, name in values]
    if parts == ["amp"] and "phase_deg" in header:
        first, second = names[0], "phase_deg"
    elif parts == ["im", "re"]:
        second, first = names
    else:
        first, second = ", ".join(names), ""
    spreads = [name for name, unit in units.items() if unit.part == "sd"]
    if not second:
        want = "re_m_s with im_m_s, or amp_m_s with phase_deg (or another unit), once"
        step = "Add the missing column, or remove the others"
        refuse("the value", want, first or "none of them", step)
        raise_all(faults)
    kind = {name: (unit.order, unit.rms) for name, unit in units.items()}
    if second in units and (kind[first], units[first].scale) != (kind[second], units[second].scale):
        refuse("real and imaginary part", "in one unit", f"{first} and {second}", "Convert one of them")
    if len(spreads) > 1 or any(kind[name] != kind[first] for name in spreads):
        want = f"one column sd_{first.split('_', 1)[1]}"
        refuse("the standard deviation", want, ", ".join(spreads), "Convert it, or remove the others")
    raise_all(faults)
    sd = spreads[0] if spreads else ""
    used = frozenset([*wanted, first, second, *spreads, *({"run", "repeat", *EXTRA} & set(header))])
    ignored = tuple(name for name in header if name and name not in used)
    return Columns(first, second, units[first], sd, units[sd].scale if sd else 1.0, used, ignored)


def with_meant(name: str) -> str:
    """Return the name of a column, with the known name that it resembles."""
    near = get_close_matches(name, KNOWN, 1, 0.75)
    return f"{name} (did you mean {near[0]}?)" if near else name
