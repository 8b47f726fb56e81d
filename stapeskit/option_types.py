"""The kinds of value that options have: how each is read from text or TOML, and what it must be.

A type is ``Annotated[VALUE, PlainValidator(reader), Says(...)]``. A reader takes what a command line gives
(text, or a list of texts where an option may be repeated), what a TOML file gives, and its own values:
command line, study files and Python share one check.
It raises ValueError without a message: `Says` has the words.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import PlainValidator, ValidationInfo

from stapeskit.dof import DOF_NAMES

_SPAN = re.compile(r"\s*([+\d.][\d.]*(?:[eE][+-]?\d+)?)\s*[-,]\s*(-?[\d.]+(?:[eE][+-]?\d+)?)\s*")


@dataclass(frozen=True)
class Says:
    """What a type must be, in words.

    Attributes
    ----------
    expected : str
        As in "--box must be ...".
    metavar : str
        Placeholder in the help.
    step : str
        What to do about an unfit value; empty: an example is shown.
    is_path : bool
        Whether the value names files that are read.
    """

    expected: str
    metavar: str = "VALUE"
    step: str = ""
    is_path: bool = False


@dataclass(frozen=True)
class WithSd:
    """A value and its standard deviation, None when it is not given; written ``VALUE+-SD``."""

    value: float
    sd: float | None = None

    def __str__(self) -> str:
        return f"{self.value:g}" if self.sd is None else f"{self.value:g}+-{self.sd:g}"


def number(value: Any) -> float:
    """Read a finite number out of text or a number."""
    value = value.item() if hasattr(value, "item") else value
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError
    result = float(value)
    if not math.isfinite(result):
        raise ValueError
    return result


def numbers(value: Any, *counts: int) -> tuple[float, ...]:
    """Read as many numbers as one of the counts says, from a comma list or a sequence."""
    parts = value.split(",") if isinstance(value, str) else value
    if isinstance(parts, Mapping) or not hasattr(parts, "__len__") or len(parts) not in counts:
        raise ValueError
    return tuple(number(part) for part in parts)


def require(condition: object) -> None:
    """Raise ValueError unless the condition holds."""
    if not condition:
        raise ValueError


def entries(value: Any) -> list[Any]:
    """Return what was given as a list: one value alone, or several of an option that may be repeated."""
    if isinstance(value, str) or not isinstance(value, list | tuple):
        return [value]
    return list(value)


def number_where(fits: Callable[[float], bool]) -> PlainValidator:
    """Return the reader of a number within limits."""

    def read(value: Any) -> float:
        result = number(value)
        require(fits(result))
        return result

    return PlainValidator(read)


def whole_where(fits: Callable[[int], bool]) -> PlainValidator:
    """Return the reader of a whole number within limits."""

    def read(value: Any) -> int:
        result = number(value)
        require(result == int(result) and fits(int(result)))
        return int(result)

    return PlainValidator(read)


def _with_sd(value: Any) -> WithSd:
    if isinstance(value, WithSd):
        return value
    parts = value.replace("±", "+-").split("+-") if isinstance(value, str) else value
    parts = [parts] if isinstance(parts, int | float) or hasattr(parts, "item") else parts
    require(isinstance(parts, list | tuple) and len(parts) in (1, 2))
    found = WithSd(*(number(part) for part in parts if part is not None))
    require(found.value >= 0.0 and (found.sd is None or found.sd >= 0.0))
    return found


def _positive_with_sd(value: Any) -> WithSd:
    found = _with_sd(value)
    require(found.value > 0.0)
    return found


def _spacing(value: Any) -> tuple[float, ...]:
    found = numbers(value, 1, 3) if isinstance(value, str | list | tuple) else (number(value),)
    require(min(found) > 0.0)
    return found * 3 if len(found) == 1 else found


def _direction(value: Any) -> tuple[float, ...]:
    found = numbers(value, 3)
    require(any(found))
    return found


def _box(value: Any) -> tuple[float, ...]:
    found = numbers(value, 6)
    require(all(low < high for low, high in zip(found[:3], found[3:], strict=True)))
    return found


def _range(value: Any) -> tuple[float, float]:
    match = _SPAN.fullmatch(value) if isinstance(value, str) else None
    low, high = numbers(match.groups() if match else value, 2)
    require(0.0 <= low < high)
    return low, high


def _ranges(value: Any) -> tuple[tuple[float, float], ...]:
    if isinstance(value, list | tuple) and value and isinstance(value[0], int | float):
        value = [value]
    return tuple(_range(entry) for entry in entries(value))


def _masses(value: Any) -> tuple[tuple[float, ...], ...]:
    def row(entry: Any) -> tuple[float, ...]:
        if isinstance(entry, str) and entry.count(",") == 3:
            place, _, last = entry.rpartition(",")
            mass = _positive_with_sd(last)
            return (*numbers(place, 3), mass.value, mass.sd or 0.0)
        found = (*numbers(entry, 4, 5), 0.0)[:5]
        require(found[3] > 0.0 and found[4] >= 0.0)
        return found

    if isinstance(value, list | tuple) and value and not isinstance(value[0], str | list | tuple):
        value = [value]
    return tuple(row(entry) for entry in entries(value))


def _path(value: Any) -> Path:
    require(isinstance(value, Path) or (isinstance(value, str) and value.strip() and "\0" not in value))
    try:
        return Path(value).expanduser()
    except RuntimeError:  # no such user
        return Path(value)


def _read_path(value: Any, info: ValidationInfo) -> Path:
    """Return the path of a file or folder that exists; paths in a study are relative to its folder."""
    path = Path((info.context or {}).get("folder", "")) / _path(value)
    try:
        require(path.is_file() or path.is_dir())  # a pipe or a device would be waited for without end
    except OSError as error:
        raise ValueError from error
    return path


def _read_paths(value: Any, info: ValidationInfo) -> tuple[Path, ...]:
    found = tuple(_read_path(entry, info) for entry in entries(value))
    require(found)
    return found


def _words(value: Any) -> tuple[str, ...]:
    given = entries(value)
    require(all(isinstance(entry, str) for entry in given))
    parts = [part.strip() for entry in given for part in entry.split(",")]
    require(all(parts))
    return tuple(parts)


def _dof(value: Any) -> tuple[str, ...]:
    names = tuple(name.lower() for name in _words(value))
    if names == ("all",):
        return DOF_NAMES
    require(names and len(set(names)) == len(names) and set(names) <= set(DOF_NAMES))
    return tuple(name for name in DOF_NAMES if name in names)


def _text(value: Any) -> str:
    require(isinstance(value, str))
    return str(value).strip()


def _flag(value: Any) -> bool:
    require(isinstance(value, bool))
    return bool(value)


def _table(value: Any) -> dict[str, Any]:
    require(isinstance(value, Mapping))
    require(all(isinstance(entry, str | bool | int | float) for entry in value.values()))
    return {str(name): entry for name, entry in value.items()}


def output_file(suffix: str) -> tuple[PlainValidator, Says]:
    """Return reader and words of a file that is written; ``ear1`` means ``ear1.csv``."""

    def read(value: Any) -> Path:
        path = _path(value)
        path = path if path.suffix.lower() == suffix else path.with_name(path.name + suffix)
        require(not path.is_dir())
        return path

    return PlainValidator(read), Says(f"a file name that ends with {suffix}", f"FILE{suffix}")


Number = Annotated[float, PlainValidator(number), Says("a number", "NUMBER")]
Positive = Annotated[float, number_where(lambda value: value > 0.0), Says("a positive number", "NUMBER")]
Percent = Annotated[
    float, number_where(lambda value: 0.0 <= value < 50.0), Says("a percentage from 0 to 50", "PERCENT")
]
Count = Annotated[int, whole_where(lambda value: value >= 1), Says("a whole number, 1 or more", "N")]
CountOrZero = Annotated[int, whole_where(lambda value: value >= 0), Says("a whole number, 0 or more", "N")]
Flag = Annotated[bool, PlainValidator(_flag), Says("true or false", "")]
Text = Annotated[str, PlainValidator(_text), Says("text", "TEXT")]
Table = Annotated[dict[str, Any], PlainValidator(_table), Says("a table of numbers and texts", "TABLE")]
PositiveWithSd = Annotated[
    WithSd,
    PlainValidator(_positive_with_sd),
    Says("a positive number without its unit, or VALUE+-SD", "VALUE[+-SD]"),
]
ZeroOrWithSd = Annotated[
    WithSd,
    PlainValidator(_with_sd),
    Says("0, a positive number without its unit, or VALUE+-SD", "VALUE[+-SD]"),
]
Spacing = Annotated[
    tuple[float, ...],
    PlainValidator(_spacing),
    Says("a positive number, or three of them (x, y, z), mm", "H|DX,DY,DZ"),
]
Point = Annotated[
    tuple[float, ...], PlainValidator(lambda value: numbers(value, 3)), Says("three numbers x, y, z", "X,Y,Z")
]
Direction = Annotated[
    tuple[float, ...],
    PlainValidator(_direction),
    Says("three numbers x, y, z that are not all zero", "X,Y,Z"),
]
Box = Annotated[
    tuple[float, ...],
    PlainValidator(_box),
    Says("six numbers x0, y0, z0, x1, y1, z1 in mm, the lower corner first", "X0,Y0,Z0,X1,Y1,Z1"),
]
Range = Annotated[
    tuple[float, float], PlainValidator(_range), Says("two frequencies in Hz, the lower first", "F1,F2")
]
Ranges = Annotated[
    tuple[tuple[float, float], ...],
    PlainValidator(_ranges),
    Says("a range of two frequencies in Hz, the lower first", "F1-F2"),
]
Masses = Annotated[
    tuple[tuple[float, ...], ...],
    PlainValidator(_masses),
    Says("point masses x, y, z, mg or x, y, z, mg+-sd in mm and mg, the mass positive", "X,Y,Z,MG[+-SD]"),
]
ReadFile = Annotated[
    Path,
    PlainValidator(_read_path),
    Says("an existing file or folder", "FILE", "Check its name and folder", is_path=True),
]
ReadFiles = Annotated[
    tuple[Path, ...],
    PlainValidator(_read_paths),
    Says("existing files", "FILE", "Check their names and folders", is_path=True),
]
Folder = Annotated[Path, PlainValidator(_path), Says("a folder", "DIR")]
Words = Annotated[tuple[str, ...], PlainValidator(_words), Says("names separated by commas", "LIST")]
DofList = Annotated[
    tuple[str, ...],
    PlainValidator(_dof),
    Says(
        f"all, or a list of different names out of {', '.join(DOF_NAMES)}",
        "LIST",
        "Write for example y,alpha,gamma",
    ),
]
