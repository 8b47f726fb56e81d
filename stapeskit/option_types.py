"""The kinds of value that options have: how each is read from text or TOML, and what it must be.

A type is ``Annotated[VALUE, Kind(reader, ...)]``. A reader takes what a command line gives (text, or a list
of texts where an option may be repeated), what a TOML file gives, and its own values: command line, study
files and Python share one check. It raises ValueError without a message: the `Kind` has the words.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from stapeskit.dof import DOF_NAMES

_SPAN = re.compile(r"\s*([+\d.][\d.]*(?:[eE][+-]?\d+)?)\s*[-,]\s*(-?[\d.]+(?:[eE][+-]?\d+)?)\s*")


@dataclass(frozen=True)
class Kind:
    """How a value is read (ValueError where it cannot be), and what it must be: ``--box must be ...``."""

    reader: Callable[[Any], Any]
    expected: str
    metavar: str = "VALUE"  # placeholder in the help
    step: str = ""  # what to do about an unfit one; by default an example is shown
    is_path: bool = False  # names files that are read: relative ones start at the folder of a TOML file
    where: Callable[[Any], object] = lambda _: True  # what else must hold of the value that was read

    def read(self, value: Any) -> Any:
        """Return the value out of what was given."""
        found = self.reader(value)
        require(self.where(found))
        return found

    def fits(self, value: Any) -> bool:
        """Return whether a value can be read."""
        try:
            self.read(value)
        except (ValueError, TypeError, OverflowError):
            return False
        return True


@dataclass(frozen=True)
class WithSd:
    """A value and its standard deviation, None when it is not given; written ``VALUE+-SD``."""

    value: float
    sd: float | None = None

    def __str__(self) -> str:
        return f"{self.value:g}" if self.sd is None else f"{self.value:g}+-{self.sd:g}"


# ---- parts of readers


def require(condition: object) -> None:
    """Raise ValueError unless the condition holds."""
    if not condition:
        raise ValueError


def each(read: Callable[[Any], Any], split: Callable[[Any], list[Any]]) -> Callable[[Any], tuple[Any, ...]]:
    """Return the reader of several values, which `entries` or `rows` separates."""
    return lambda value: tuple(read(entry) for entry in split(value))


def entries(value: Any) -> list[Any]:
    """Return what was given as a list: one value alone, or several of an option that may be repeated."""
    return list(value) if isinstance(value, list | tuple) else [value]


def rows(value: Any) -> list[Any]:
    """Return rows of numbers as a list: one row alone, or several."""
    one = isinstance(value, list | tuple) and value and not isinstance(value[0], str | list | tuple)
    return [value] if one else entries(value)


def number(value: Any) -> float:
    """Read a finite number out of text or a number; a minus sign as pages print it is one."""
    value = value.item() if hasattr(value, "item") else value
    require(isinstance(value, int | float | str) and not isinstance(value, bool))
    result = float(value.replace("\N{MINUS SIGN}", "-") if isinstance(value, str) else value)
    require(math.isfinite(result))
    return result


def numbers(value: Any, *counts: int) -> tuple[float, ...]:
    """Read as many numbers as one of the counts says, from a comma list or a sequence."""
    parts = value.split(",") if isinstance(value, str) else value
    require(not isinstance(parts, Mapping) and hasattr(parts, "__len__") and len(parts) in counts)
    return tuple(number(part) for part in parts)


def one_of(choices: tuple[Any, ...]) -> Kind:
    """Return the kind of a word out of some."""
    expected, metavar = f"one of {', '.join(choices)}", "|".join(choices)
    return Kind(lambda value: value, expected, metavar, where=lambda value: value in choices)


def text(value: Any) -> str:
    """Read a text, blanks around it dropped."""
    require(isinstance(value, str))
    return str(value).strip()


def path(value: Any) -> Path:
    """Read a path; ``~`` is the home folder."""
    require(isinstance(value, Path) or (isinstance(value, str) and value.strip() and "\0" not in value))
    try:
        return Path(value).expanduser()
    except RuntimeError:  # no such user
        return Path(value)


def existing(value: Any) -> Path:
    """Read the path of a file or folder that exists."""
    found = path(value)
    try:
        require(found.is_file() or found.is_dir())  # a pipe or a device would be waited for without end
    except OSError as error:
        raise ValueError from error
    return found


def output_file(suffix: str) -> Kind:
    """Return the kind of a file that is written; ``ear1`` means ``ear1.csv``."""

    def read(value: Any) -> Path:
        found = path(value)
        return found if found.suffix.lower() == suffix else found.with_name(found.name + suffix)

    expected = f"a file name that ends with {suffix}"
    return Kind(read, expected, f"FILE{suffix}", where=lambda found: not found.is_dir())


# ---- readers of the kinds below


def _whole(value: Any) -> int:
    found = number(value)
    require(found == int(found))
    return int(found)


def _with_sd(value: Any) -> WithSd:
    """Read a value that is not negative, with or without its standard deviation."""
    if not isinstance(value, WithSd):
        parts = value.replace("±", "+-").split("+-") if isinstance(value, str) else entries(value)
        require(len(parts) in (1, 2))
        value = WithSd(*(number(part) for part in parts if part is not None))
    require(value.value >= 0.0 and (value.sd is None or value.sd >= 0.0))
    return WithSd(value.value, value.sd)


def _spacing(value: Any) -> tuple[float, ...]:
    found = numbers(value if isinstance(value, str) else entries(value), 1, 3)
    require(min(found) > 0.0)
    return found * 3 if len(found) == 1 else found


def _point(value: Any) -> tuple[float, ...]:
    return numbers(value, 3)


def _box(value: Any) -> tuple[float, ...]:
    found = numbers(value, 6)
    require(all(low < high for low, high in zip(found[:3], found[3:], strict=True)))
    return found


def _range(value: Any) -> tuple[float, float]:
    match = _SPAN.fullmatch(value) if isinstance(value, str) else None
    low, high = numbers(match.groups() if match else value, 2)
    require(0.0 <= low < high)
    return low, high


def _point_mass(value: Any) -> tuple[float, ...]:
    listed = value.replace("±", "+-").replace("+-", ",") if isinstance(value, str) else value
    found = (*numbers(listed, 4, 5), 0.0)[:5]
    require(found[3] > 0.0 and found[4] >= 0.0)
    return found


def _words(value: Any) -> tuple[str, ...]:
    parts = [part.strip() for entry in entries(value) for part in text(entry).split(",")]
    require(all(parts))
    return tuple(parts)


def _dof(value: Any) -> tuple[str, ...]:
    names = tuple(name.lower() for name in _words(value))
    if names == ("all",):
        return DOF_NAMES
    require(names and len(set(names)) == len(names) and set(names) <= set(DOF_NAMES))
    return tuple(name for name in DOF_NAMES if name in names)


def _table(value: Any) -> dict[str, Any]:
    require(isinstance(value, Mapping))
    require(all(isinstance(entry, str | bool | int | float) for entry in value.values()))
    return {str(name): entry for name, entry in value.items()}


_WITH_SD = "a positive number without its unit, or VALUE+-SD"
_SPAN_WORDS = "two frequencies in Hz, the lower first"
_FILE = "an existing file or folder"
_CHECK = "Check its name and folder"
_PERCENT = "a percentage from 0 to 50"
_SPACING = "a positive number, or three of them (x, y, z), mm"
_DIRECTION = "three numbers x, y, z that are not all zero"
_CORNERS = "six numbers x0, y0, z0, x1, y1, z1 in mm, the lower corner first"
_MASSES = "point masses x, y, z, mg or x, y, z, mg+-sd in mm and mg, the mass positive"
_DOF = f"all, or a list of different names out of {', '.join(DOF_NAMES)}"

Number = Annotated[float, Kind(number, "a number", "NUMBER")]
Positive = Annotated[float, Kind(number, "a positive number", "NUMBER", where=lambda found: found > 0.0)]
Percent = Annotated[float, Kind(number, _PERCENT, "PERCENT", where=lambda found: 0.0 <= found < 50.0)]
Count = Annotated[int, Kind(_whole, "a whole number, 1 or more", "N", where=lambda found: found >= 1)]
CountOrZero = Annotated[int, Kind(_whole, "a whole number, 0 or more", "N", where=lambda found: found >= 0)]
Flag = Annotated[
    bool, Kind(lambda value: value, "true or false", "", where=lambda value: isinstance(value, bool))
]
Text = Annotated[str, Kind(text, "text", "TEXT")]
Words = Annotated[tuple[str, ...], Kind(_words, "names separated by commas", "LIST")]
Table = Annotated[dict[str, Any], Kind(_table, "a table of numbers and texts", "TABLE")]
PositiveWithSd = Annotated[
    WithSd, Kind(_with_sd, _WITH_SD, "VALUE[+-SD]", where=lambda found: found.value > 0.0)
]
ZeroOrWithSd = Annotated[WithSd, Kind(_with_sd, f"0, {_WITH_SD}", "VALUE[+-SD]")]
Spacing = Annotated[tuple[float, ...], Kind(_spacing, _SPACING, "H|DX,DY,DZ")]
Point = Annotated[tuple[float, ...], Kind(_point, "three numbers x, y, z", "X,Y,Z")]
Direction = Annotated[tuple[float, ...], Kind(_point, _DIRECTION, "X,Y,Z", where=any)]
Box = Annotated[tuple[float, ...], Kind(_box, _CORNERS, "X0,Y0,Z0,X1,Y1,Z1")]
Range = Annotated[tuple[float, float], Kind(_range, _SPAN_WORDS, "F1,F2")]
Ranges = Annotated[
    tuple[tuple[float, float], ...], Kind(each(_range, rows), f"a range of {_SPAN_WORDS}", "F1-F2")
]
Masses = Annotated[tuple[tuple[float, ...], ...], Kind(each(_point_mass, rows), _MASSES, "X,Y,Z,MG[+-SD]")]
ReadFile = Annotated[Path, Kind(existing, _FILE, "FILE", _CHECK, is_path=True)]
ReadFiles = Annotated[
    tuple[Path, ...], Kind(each(existing, entries), _FILE, "FILE", _CHECK, is_path=True, where=any)
]
Folder = Annotated[Path, Kind(path, "a folder", "DIR")]
DofList = Annotated[tuple[str, ...], Kind(_dof, _DOF, "LIST", "Write for example y,alpha,gamma")]
