"""Read values of options from text or TOML, and write them back."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from legacy.stapeskit.json_toml import is_finite_number

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_SPAN = re.compile(r"\s*([+\d.][\d.]*(?:[eE][+-]?\d+)?)\s*[-,]\s*(-?[\d.]+(?:[eE][+-]?\d+)?)\s*")
_AXES = ("x", "y", "z", "-x", "-y", "-z", "+x", "+y", "+z")
DOF_NAMES = ("x", "y", "z", "alpha", "beta", "gamma")


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
        if is_with_sd(value):
            return toml(value[0]) if value[1] is None else toml(command_word(value))
        return f"[{', '.join(map(toml, value))}]"
    return json.dumps(str(value), ensure_ascii=False)


def _key(name: str) -> str:
    return name if _BARE_KEY.fullmatch(name) else json.dumps(name, ensure_ascii=False)


class WithSd(tuple[float, float | None]):
    """A value and its standard deviation, None when it is not given."""

    __slots__ = ()


def is_with_sd(value: object) -> bool:
    """Return whether a value carries its standard deviation."""
    return isinstance(value, WithSd)


def command_word(value: Any) -> str:
    """Write one value as a word of a command line."""
    if is_with_sd(value):
        return f"{value[0]!r}" if value[1] is None else f"{value[0]!r}+-{value[1]!r}"
    if isinstance(value, list | tuple):
        return ",".join(map(command_word, value))
    return repr(value) if isinstance(value, float) else str(value)


def shorten_value(value: Any) -> str:
    """Show a value in a message, shortened."""
    if is_with_sd(value):
        text = command_word(value)
    elif isinstance(value, list | tuple):
        text = ",".join(shorten_value(entry) for entry in value if entry is not None)
    else:
        text = str(value).lower() if isinstance(value, bool) else str(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def read_number(value: Any) -> float:
    """Return a finite number out of text or a number."""
    if not isinstance(value, str) and not is_finite_number(value):
        raise ValueError
    number = float(value)
    if not math.isfinite(number):
        raise ValueError
    return number


def read_whole(value: Any) -> int:
    """Read a whole number."""
    if isinstance(value, str):
        return int(value)
    if not is_finite_number(value) or value != int(value) or isinstance(value, float):
        raise ValueError
    return int(value)


def read_numbers(value: Any, counts: tuple[int, ...]) -> tuple[float, ...]:
    """Read as many numbers as one of the counts says."""
    entries = value.split(",") if isinstance(value, str) else value
    if isinstance(entries, Mapping) or not hasattr(entries, "__len__") or len(entries) not in counts:
        raise ValueError
    return tuple(read_number(entry if isinstance(entry, str) else plain_number(entry)) for entry in entries)


def plain_number(value: Any) -> Any:
    """Return a number of an array as a number of Python."""
    return value.item() if hasattr(value, "item") else value


def require(condition: bool) -> None:
    """Raise ValueError unless the condition holds."""
    if not condition:
        raise ValueError


def read_flag(value: Any) -> bool:
    """Read true or false."""
    require(isinstance(value, bool))
    return bool(value)


def read_text(value: Any) -> str:
    """Read text without spaces around it."""
    require(isinstance(value, str))
    return str(value).strip()


def read_path(value: Any) -> Path:
    """Return a path out of text; ~ is the user's home."""
    require(isinstance(value, Path) or (isinstance(value, str) and bool(value.strip())))
    require("\x00" not in str(value))
    try:
        return Path(value).expanduser()
    except RuntimeError:  # no such user
        return Path(value)


def is_known(path: Path, look: Callable[[Path], bool]) -> bool:
    """Return the answer of the system about a path; a name that it cannot look up is unfit."""
    try:
        return look(path)
    except OSError as fault:
        raise ValueError(fault.strerror) from fault


def read_paths(value: Any) -> tuple[Path, ...]:
    """Read one path or several."""
    entries = value if isinstance(value, list | tuple) else [value]
    require(len(entries) > 0 or isinstance(value, tuple))
    return tuple(read_path(entry) for entry in entries)


def read_words(value: Any) -> tuple[str, ...]:
    """Read words separated by commas, or a list of them, without spaces around them."""
    parts = value.split(",") if isinstance(value, str) else value
    require(isinstance(parts, list | tuple) and all(isinstance(part, str) for part in parts))
    return tuple(part.strip() for part in parts)


def entries_of(value: Any) -> list[Any]:
    """Return what a repeated option was given as a list: several entries, or one, also a row of numbers."""
    several = isinstance(value, list | tuple) and not (value and is_finite_number(value[0]))
    return list(value) if several else [value]


def read_with_sd(value: Any) -> WithSd:
    """Read a positive value with or without its standard deviation."""
    if isinstance(value, str):
        value = [float(part) for part in value.replace("±", "+-").split("+-")]
    elif is_finite_number(value):
        value = [value]
    require(isinstance(value, list | tuple) and len(value) in (1, 2) and is_finite_number(value[0]))
    sd = value[1] if len(value) == 2 else None
    require(value[0] > 0.0 and (sd is None or (is_finite_number(sd) and sd >= 0.0)))
    return WithSd((float(value[0]), None if sd is None else float(sd)))


def read_zero_or_with_sd(value: Any) -> WithSd:
    """Read zero, or a positive value with or without its standard deviation."""
    parts = tuple(value) if isinstance(value, list | tuple) else (plain_number(value),)
    return WithSd((0.0, 0.0)) if parts in ((0,), (0, 0)) else read_with_sd(value)


def read_spacing(value: Any) -> tuple[float, ...]:
    """Read one positive number or three."""
    values = read_numbers([value] if is_finite_number(value) else value, (1, 3))
    require(min(values) > 0.0)
    return values


def read_box(value: Any) -> tuple[float, ...]:
    """Read the lower and the upper corner of a box."""
    values = read_numbers(value, (6,))
    require(all(low < high for low, high in zip(values[:3], values[3:], strict=True)))
    return values


def read_direction(value: Any) -> tuple[float, ...]:
    """Read three numbers that are not all zero."""
    values = read_numbers(value, (3,))
    require(any(values))
    return values


def read_beam(value: Any) -> str:
    """Read an axis or a direction of length 1."""
    if isinstance(value, str) and value.strip().lower() in _AXES:
        return value.strip().lower()
    values = read_numbers(value, (3,))
    require(abs(math.hypot(*values) - 1.0) < 1e-3)
    return ",".join(map(repr, values))


def read_voxels(value: Any) -> tuple[int, ...]:
    """Read three whole numbers of at least 2."""
    values = read_numbers(value, (3,))
    require(min(values) >= 2 and all(number == int(number) for number in values))
    return tuple(int(number) for number in values)


def read_range(value: Any) -> tuple[float, ...]:
    """Read two frequencies, the lower first."""
    if isinstance(value, str):
        match = _SPAN.fullmatch(value)
        value = match.groups() if match else value
    values = read_numbers(value, (2,))
    require(0.0 <= values[0] < values[1])
    return values


def advise_range(value: Any) -> str:
    """Return the range the right way round."""
    match = _SPAN.fullmatch(value) if isinstance(value, str) else None
    try:
        low, high = read_numbers(match.groups() if match else value, (2,))
    except (ValueError, TypeError):
        return "Write it like 400-5000"
    if 0.0 <= high < low:
        return f"Write {high:g}-{low:g}"
    return "Give two different frequencies in Hz that are not negative"


def read_ranges(value: Any) -> tuple[tuple[float, ...], ...]:
    """Read one range of frequencies or several."""
    return tuple(read_range(entry) for entry in entries_of(value))


def read_mass(value: Any) -> tuple[float, ...]:
    """Read a point mass: x, y, z, mg and its standard deviation."""
    if isinstance(value, str) and value.count(",") == 4:
        value = [float(part) for part in value.split(",")]
    if isinstance(value, str):
        place, _, last = value.rpartition(",")
        mass, sd = read_with_sd(last)
        return (*read_numbers(place, (3,)), mass, sd or 0.0)
    row = (*read_numbers(value, (4, 5)), 0.0)[:5]
    require(row[3] > 0.0 and row[4] >= 0.0)
    return row


def read_masses(value: Any) -> tuple[tuple[float, ...], ...]:
    """Read one point mass or several."""
    return tuple(read_mass(entry) for entry in entries_of(value))


def read_measured(points: int) -> Callable[[Any], tuple[tuple[float, ...], ...]]:
    """Return the reader of rows of so many points and a positive length with its standard deviation."""
    count = 3 * points

    def row(value: Any) -> tuple[float, ...]:
        if isinstance(value, str) and value.count(",") == count:
            place, _, last = value.rpartition(",")
            length, sd = read_with_sd(last)
            value = (*read_numbers(place, (count,)), length, sd or 0.0)
        result = read_numbers(value, (count + 2,))
        require(result[-2] > 0.0 and result[-1] > 0.0)
        return result

    return lambda value: tuple(row(entry) for entry in entries_of(value))


def read_named(value: Any) -> tuple[str, ...]:
    """Read a table of names, or NAME=VALUE texts, to such texts."""
    if isinstance(value, Mapping):
        rows = [(name, entry if isinstance(entry, list) else [entry]) for name, entry in value.items()]
        require(all(is_item(part) for _, parts in rows for part in parts))
        return tuple(f"{name}={','.join(map(str, parts))}" for name, parts in rows)
    entries = entries_of(value)
    for entry in entries:
        require(isinstance(entry, str))
        name, mark, rest = entry.partition("=")
        require(bool(mark and name.strip() and rest.strip()))
    return tuple(entries)


def read_channels(value: Any) -> tuple[str, ...]:
    """Read BODY:POINT or BODY:POINT:BEAM, one or several."""
    entries = entries_of(value)
    for entry in entries:
        require(isinstance(entry, str))
        body, mark, rest = entry.partition(":")
        require(bool(mark and body.strip() and rest.strip()))
    return tuple(dict.fromkeys(entry.strip() for entry in entries))


def is_item(value: object) -> bool:
    """Return whether a value can name a point: a whole number or text that is not empty."""
    return isinstance(value, int | str) and not isinstance(value, bool) and str(value).strip() != ""


def read_bounds(value: Any) -> dict[str, float]:
    """Read bounds of entries: ENTRY=VALUE or a table."""
    if isinstance(value, Mapping):
        require(all(is_finite_number(plain_number(entry)) for entry in value.values()))
        return {str(name): float(entry) for name, entry in value.items()}
    bounds = {}
    for entry in entries_of(value):
        require(isinstance(entry, str))
        name, mark, number = entry.partition("=")
        require(bool(mark and name.strip()))
        bounds[name.strip()] = read_number(number)
    return bounds


class Dof(tuple[str, ...]):
    """Degrees of freedom in the fixed order.

    Attributes
    ----------
    reordered : bool
        Whether they were given in another order.
    """

    reordered: bool = False


def read_covariates(value: Any) -> dict[str, Any]:
    """Read a table of numbers and texts."""
    require(isinstance(value, Mapping))
    require(all(isinstance(entry, str | bool) or is_finite_number(entry) for entry in value.values()))
    return {str(name): entry for name, entry in value.items()}


def read_dof(value: Any) -> Dof:
    """Read degrees of freedom into the fixed order."""
    if isinstance(value, Dof):
        return value
    names = tuple(word.lower() for word in read_words(value) if word)
    if names == ("all",):
        return Dof(DOF_NAMES)
    require(bool(names) and len(set(names)) == len(names) and set(names) <= set(DOF_NAMES))
    ordered = Dof(name for name in DOF_NAMES if name in names)
    ordered.reordered = names != ordered
    return ordered
