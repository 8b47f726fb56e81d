"""The kinds of value that options have: how each is read, what it must be, how it is written.

A kind reads what a command line gives (text), what a TOML file gives and its own values, so that the three
edges share one check.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_SPAN = re.compile(r"\s*([+\d.][\d.]*(?:[eE][+-]?\d+)?)\s*[-,]\s*(-?[\d.]+(?:[eE][+-]?\d+)?)\s*")
_AXES = ("x", "y", "z", "-x", "-y", "-z", "+x", "+y", "+z")
_DOF = ("x", "y", "z", "alpha", "beta", "gamma")


@dataclass(frozen=True)
class Kind:
    """One kind of value.

    Attributes
    ----------
    expected : str
        What the value must be, as in "<option> must be ...".
    metavar : str
        What stands for the value in the help.
    read : callable
        Takes text, a TOML value or a value of the kind, returns the value; ValueError when it is unfit.
    is_flag, is_file : bool
        Whether the option takes no value; whether the value is the path of a file or folder that is read.
    repeats : bool
        Whether the option may be given several times; ``read`` then takes the list of what was given.
    choices : tuple of str
        The values that are known, where they can be listed.
    advise : callable, optional
        Takes an unfit value, returns what a user can do about it.
    """

    expected: str
    metavar: str
    read: Callable[[Any], Any]
    is_flag: bool = False
    is_file: bool = False
    repeats: bool = False
    choices: tuple[str, ...] = ()
    advise: Callable[[Any], str] | None = None

    def words(self, value: Any) -> list[str]:
        """Write a value as on the command line: one text, or one for each time the option is given."""
        if self.repeats:
            entries = (
                [f"{name}={entry!r}" for name, entry in value.items()]
                if isinstance(value, Mapping)
                else value
            )
            return [_word(entry) for entry in entries]
        return [_word(value)]


def toml(value: Any) -> str:
    """Write a value as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, Mapping):
        rows = ", ".join(f"{_key(str(name))} = {toml(entry)}" for name, entry in value.items())
        return f"{{ {rows} }}" if rows else "{}"
    if isinstance(value, list | tuple):
        if _is_with_sd(value):
            return toml(value[0]) if value[1] is None else toml(_word(value))
        return f"[{', '.join(map(toml, value))}]"
    return json.dumps(str(value), ensure_ascii=False)


def _key(name: str) -> str:
    return name if _BARE_KEY.fullmatch(name) else json.dumps(name, ensure_ascii=False)


class WithSd(tuple[float, float | None]):
    """A value and its standard deviation, None when it is not given."""

    __slots__ = ()


def _is_with_sd(value: object) -> bool:
    return isinstance(value, WithSd)


def _word(value: Any) -> str:
    if _is_with_sd(value):
        return f"{value[0]!r}" if value[1] is None else f"{value[0]!r}+-{value[1]!r}"
    if isinstance(value, list | tuple):
        return ",".join(map(_word, value))
    return repr(value) if isinstance(value, float) else str(value)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _number(value: Any) -> float:
    """Return a finite number out of text or a number."""
    if not isinstance(value, str) and not _is_number(value):
        raise ValueError
    number = float(value)
    if not math.isfinite(number):
        raise ValueError
    return number


def _whole(value: Any) -> int:
    if isinstance(value, str):
        return int(value)
    if not _is_number(value) or value != int(value) or isinstance(value, float):
        raise ValueError
    return int(value)


def _numbers(value: Any, counts: tuple[int, ...]) -> tuple[float, ...]:
    entries = value.split(",") if isinstance(value, str) else value
    if isinstance(entries, Mapping) or not hasattr(entries, "__len__") or len(entries) not in counts:
        raise ValueError
    return tuple(_number(entry if isinstance(entry, str) else _plain(entry)) for entry in entries)


def _plain(value: Any) -> Any:
    """Return a number of an array as a number of Python."""
    return value.item() if hasattr(value, "item") else value


def _require(condition: bool) -> None:
    if not condition:
        raise ValueError


def _flag(value: Any) -> bool:
    _require(isinstance(value, bool))
    return bool(value)


def _text(value: Any) -> str:
    _require(isinstance(value, str))
    return str(value).strip()


def _path(value: Any) -> Path:
    _require(isinstance(value, Path) or (isinstance(value, str) and bool(value.strip())))
    return Path(value).expanduser()


def _paths(value: Any) -> tuple[Path, ...]:
    entries = value if isinstance(value, list | tuple) else [value]
    _require(len(entries) > 0 or isinstance(value, tuple))
    return tuple(_path(entry) for entry in entries)


def _entries(value: Any) -> list[Any]:
    """Return what a repeated option was given, one entry or several, as a list."""
    return list(value) if isinstance(value, list | tuple) else [value]


def _with_sd(value: Any) -> WithSd:
    if isinstance(value, str):
        value = [float(part) for part in value.replace("±", "+-").split("+-")]
    elif _is_number(value):
        value = [value]
    _require(isinstance(value, list | tuple) and len(value) in (1, 2) and _is_number(value[0]))
    sd = value[1] if len(value) == 2 else None
    _require(value[0] > 0.0 and (sd is None or (_is_number(sd) and sd >= 0.0)))
    return WithSd((float(value[0]), None if sd is None else float(sd)))


def _zero_or_with_sd(value: Any) -> WithSd:
    parts = tuple(value) if isinstance(value, list | tuple) else (_plain(value),)
    return WithSd((0.0, 0.0)) if parts in ((0,), (0, 0)) else _with_sd(value)


def _spacing(value: Any) -> tuple[float, ...]:
    values = _numbers([value] if _is_number(value) else value, (1, 3))
    _require(min(values) > 0.0)
    return values


def _box(value: Any) -> tuple[float, ...]:
    values = _numbers(value, (6,))
    _require(all(low < high for low, high in zip(values[:3], values[3:], strict=True)))
    return values


def _direction(value: Any) -> tuple[float, ...]:
    values = _numbers(value, (3,))
    _require(any(values))
    return values


def _beam(value: Any) -> str:
    if isinstance(value, str) and value.strip().lower() in _AXES:
        return value.strip().lower()
    values = _numbers(value, (3,))
    _require(abs(math.hypot(*values) - 1.0) < 1e-3)
    return ",".join(map(repr, values))


def _voxels(value: Any) -> tuple[int, ...]:
    values = _numbers(value, (3,))
    _require(min(values) >= 2 and all(number == int(number) for number in values))
    return tuple(int(number) for number in values)


def _range(value: Any) -> tuple[float, ...]:
    if isinstance(value, str):
        match = _SPAN.fullmatch(value)
        value = match.groups() if match else value
    values = _numbers(value, (2,))
    _require(0.0 <= values[0] < values[1])
    return values


def _range_advice(value: Any) -> str:
    """Return the range the right way round."""
    match = _SPAN.fullmatch(value) if isinstance(value, str) else None
    try:
        low, high = _numbers(match.groups() if match else value, (2,))
    except (ValueError, TypeError):
        return "Write it like 400-5000"
    if 0.0 <= high < low:
        return f"Write {high:g}-{low:g}"
    return "Give two different frequencies in Hz that are not negative"


def _ranges(value: Any) -> tuple[tuple[float, ...], ...]:
    if isinstance(value, list | tuple) and len(value) == 2 and all(map(_is_number, value)):
        value = [value]
    return tuple(_range(entry) for entry in _entries(value))


def _mass(value: Any) -> tuple[float, ...]:
    if isinstance(value, str) and value.count(",") == 4:
        value = [float(part) for part in value.split(",")]
    if isinstance(value, str):
        place, _, last = value.rpartition(",")
        mass, sd = _with_sd(last)
        return (*_numbers(place, (3,)), mass, sd or 0.0)
    row = (*_numbers(value, (4, 5)), 0.0)[:5]
    _require(row[3] > 0.0 and row[4] >= 0.0)
    return row


def _masses(value: Any) -> tuple[tuple[float, ...], ...]:
    if isinstance(value, list | tuple) and value and _is_number(value[0]):
        value = [value]
    _require(isinstance(value, list | tuple))
    return tuple(_mass(entry) for entry in value)


def _named(value: Any) -> tuple[str, ...]:
    """Read a table of names, or NAME=VALUE texts, to such texts."""
    if isinstance(value, Mapping):
        rows = [(name, entry if isinstance(entry, list) else [entry]) for name, entry in value.items()]
        _require(all(_is_item(part) for _, parts in rows for part in parts))
        return tuple(f"{name}={','.join(map(str, parts))}" for name, parts in rows)
    _require(isinstance(value, list | tuple) and all(isinstance(entry, str) for entry in value))
    for entry in value:
        name, mark, rest = entry.partition("=")
        _require(bool(mark and name.strip() and rest.strip()))
    return tuple(value)


def _is_item(value: object) -> bool:
    return isinstance(value, int | str) and not isinstance(value, bool) and str(value).strip() != ""


def _bounds(value: Any) -> dict[str, float]:
    if isinstance(value, Mapping):
        _require(all(_is_number(_plain(entry)) for entry in value.values()))
        return {str(name): float(entry) for name, entry in value.items()}
    bounds = {}
    for entry in _entries(value):
        _require(isinstance(entry, str))
        name, mark, number = entry.partition("=")
        _require(bool(mark and name.strip()))
        bounds[name.strip()] = _number(number)
    return bounds


class Dof(tuple[str, ...]):
    """Degrees of freedom in the fixed order.

    Attributes
    ----------
    reordered : bool
        Whether they were given in another order.
    """

    reordered: bool = False


def _covariates(value: Any) -> dict[str, Any]:
    _require(isinstance(value, Mapping))
    _require(all(isinstance(entry, str | bool) or _is_number(entry) for entry in value.values()))
    return {str(name): entry for name, entry in value.items()}


def _dof(value: Any) -> Dof:
    if isinstance(value, Dof):
        return value
    parts = value.split(",") if isinstance(value, str) else value
    _require(isinstance(parts, list | tuple) and all(isinstance(part, str) for part in parts))
    names = tuple(part.strip().lower() for part in parts if part.strip())
    if names == ("all",):
        return Dof(_DOF)
    _require(bool(names) and len(set(names)) == len(names) and set(names) <= set(_DOF))
    ordered = Dof(name for name in _DOF if name in names)
    ordered.reordered = names != ordered
    return ordered


FLAG = Kind("true or false", "", _flag, is_flag=True)
TEXT = Kind("text", "TEXT", _text)
NUMBER = Kind("a number", "NUMBER", _number)
VALUE_WITH_SD = Kind(
    'a positive number, or text with its standard deviation like "1900+-60"', "VALUE[+-SD]", _with_sd
)
VALUE_OR_ZERO_WITH_SD = Kind(
    '0, a positive number, or text with its standard deviation like "35+-12"',
    "VALUE[+-SD]",
    _zero_or_with_sd,
)
SPACING = Kind("a positive number, or three of them (x, y, z), mm", "H|DX,DY,DZ", _spacing)
BOX = Kind(
    "six numbers x0, y0, z0, x1, y1, z1 in mm with x0 < x1, y0 < y1, z0 < z1",
    "X0,Y0,Z0,X1,Y1,Z1",
    _box,
    advise=lambda _: "Give the lower corner first, then the upper one",
)
POINT = Kind("three numbers x, y, z", "X,Y,Z", lambda value: _numbers(value, (3,)))
DIRECTION = Kind("three numbers x, y, z that are not all zero", "X,Y,Z", _direction)
BEAM = Kind(
    "x, y, z, -x, -y, -z or three numbers of length 1 (within 1e-3)",
    "DIR",
    _beam,
    advise=lambda _: "It points from the sample towards the laser head",
)
VOXELS = Kind("three whole numbers of at least 2: voxels along x (runs fastest), y, z", "NX,NY,NZ", _voxels)
RANGE = Kind("two frequencies in Hz, the lower first", "F1,F2", _range, advise=_range_advice)
RANGES = Kind(
    "a range of two frequencies in Hz, the lower first",
    "F1-F2",
    _ranges,
    repeats=True,
    advise=_range_advice,
)
MASSES = Kind(
    "a list of point masses [x, y, z, mg] or [x, y, z, mg, sd], mm and mg, the mass positive",
    "X,Y,Z,MG[+-SD]",
    _masses,
    repeats=True,
)
BODIES = Kind(
    'NAME=POINTS, or a table like { stapes = "1-10", base = "11-19" }',
    "NAME=POINTS",
    _named,
    repeats=True,
    advise=lambda _: "Points are numbers, ranges, FILE or FILE:1-10: stapes=1-10,12 or base=base.uff",
)
RUNS = Kind('NAME=FILE, or a table like { push = "first.uff" }', "NAME=FILE", _named, repeats=True)
BOUNDS = Kind(
    "an entry and a number in SI as K11=100, or a table like { K11 = 100.0 }",
    "ENTRY=VALUE",
    _bounds,
    repeats=True,
)
COVARIATES = Kind("a table of numbers and texts, like { storage_days = 3 }", "TABLE", _covariates)
DOF = Kind(
    f"all, or a list of different names out of {', '.join(_DOF)}",
    "LIST",
    _dof,
    advise=lambda _: "Write for example y,alpha,gamma",
)


def file(what: str = "file", next_step: str = "Check its name and folder", metavar: str = "FILE") -> Kind:
    """Return the kind of a file that is read."""
    return Kind(f"an existing {what}", metavar, _path, is_file=True, advise=lambda _: next_step)


def files(what: str, next_step: str = "Check its name and folder") -> Kind:
    """Return the kind of one or several files that are read."""
    one = file(what, next_step)
    return replace(one, read=_paths, repeats=True)


def output(suffix: str) -> Kind:
    """Return the kind of a file that is written."""

    def read(value: Any) -> Path:
        path = _path(value)
        _require(path.suffix.lower() == suffix and not path.is_dir())
        return path

    def advise(value: Any) -> str:
        return f"Write {Path(str(value)).stem or 'result'}{suffix}"

    return Kind(f"a file name that ends with {suffix}", f"FILE{suffix}", read, advise=advise)


def _folder(value: Any) -> Path:
    path = _path(value)
    _require(not path.exists() or path.is_dir())
    return path


FOLDER = Kind("a folder", "DIR", _folder)
FILE = file()


def choice(*known: str) -> Kind:
    """Return the kind of one of several words."""

    def read(value: Any) -> str:
        _require(isinstance(value, str) and value in known)
        return str(value)

    return Kind(f"one of {', '.join(known)}", "|".join(known), read, choices=known)


def summaries(table: Mapping[str, str]) -> str:
    """Return the entries of a table with their summaries, as a help."""
    return "; ".join(f"{name}: {summary}" for name, summary in table.items())


def several(*known: str) -> Kind:
    """Return the kind of a list of words, or ``all``; the value is in the order of the words known."""

    def read(value: Any) -> tuple[str, ...]:
        parts = value.split(",") if isinstance(value, str) else value
        _require(isinstance(parts, list | tuple) and all(isinstance(part, str) for part in parts))
        names = {part.strip().lower() for part in parts if part.strip()}
        if names == {"all"}:
            return known
        _require(names <= set(known) and (bool(names) or not isinstance(value, str)))
        return tuple(name for name in known if name in names)

    return Kind(f"all, or a list out of {', '.join(known)}", "LIST|all", read, choices=known)


def _names(value: Any) -> tuple[str, ...]:
    parts = value.split(",") if isinstance(value, str) else value
    _require(isinstance(parts, list | tuple) and all(isinstance(part, str) for part in parts))
    names = tuple(part.strip() for part in parts)
    _require(all(names) and (bool(names) or not isinstance(value, str)))
    return names


NAMES = Kind("names separated by commas", "LIST", _names)


def number(expected: str, fits: Callable[[float], bool], step: str = "") -> Kind:
    """Return the kind of a finite number within limits that the words name."""

    def read(value: Any) -> float:
        result = _number(_plain(value))
        _require(fits(result))
        return result

    return Kind(expected, "NUMBER", read, advise=lambda _: step)


def whole(expected: str, fits: Callable[[int], bool]) -> Kind:
    """Return the kind of a whole number within limits that the words name."""

    def read(value: Any) -> int:
        result = _whole(_plain(value))
        _require(fits(result))
        return result

    return Kind(expected, "N", read)


def at_least(least: int) -> Kind:
    """Return the kind of a whole number from a least one on."""
    return whole(f"a whole number, {least} or more", lambda value: value >= least)


VOXEL_TYPE = choice("uint8", "int8", "uint16", "int16", "uint32", "int32", "float32", "float64")
