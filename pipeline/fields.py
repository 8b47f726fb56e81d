"""The kinds of value a study file may hold, each with the words for what it must be."""

from __future__ import annotations

from argparse import ArgumentTypeError
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, ValidationInfo
from pydantic_core import PydanticCustomError

from stapeskit.command import value_with_sd

EXPECTED = "expected"


def refuse(expected: str, next_step: str = "") -> PydanticCustomError:
    """Return the error of one value; the reader of the study file turns it into a sentence."""
    return PydanticCustomError(EXPECTED, "{expected}", {"expected": expected, "next_step": next_step})


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < float("inf")


def _numbers(value: object, counts: tuple[int, ...], expected: str) -> tuple[float, ...]:
    if isinstance(value, list) and len(value) in counts and all(_is_number(entry) for entry in value):
        return tuple(float(entry) for entry in value)
    raise refuse(expected)


def _file(value: object, info: ValidationInfo) -> Path:
    """Resolve a path from the folder of the study file, and look whether it exists."""
    context: dict[str, Any] = info.context or {}
    if not isinstance(value, str) or not value.strip():
        raise refuse("a path, as text")
    path = Path(context.get("folder", "."), Path(value).expanduser())
    if context.get("check_files", True) and not path.exists():
        raise refuse(f"an existing file, seen from the folder of the study file (looked at {path})")
    return path


def _files(value: object, info: ValidationInfo) -> Path | tuple[Path, ...]:
    """Resolve one path, or a list of them."""
    if not isinstance(value, list):
        return _file(value, info)
    if not value:
        raise refuse("a path, or a list of paths")
    return tuple(_file(entry, info) for entry in value)


def _named(value: object) -> tuple[str, ...]:
    """Read a table of names, or a list of NAME=VALUE texts, to such texts."""
    expected = 'a table like { stapes = "1-10", base = "11-19" }'
    if isinstance(value, dict):
        rows = [(name, entry if isinstance(entry, list) else [entry]) for name, entry in value.items()]
        if all(_is_plain(part) for _, parts in rows for part in parts):
            return tuple(f"{name}={','.join(map(str, parts))}" for name, parts in rows)
    if isinstance(value, list) and all(isinstance(entry, str) and "=" in entry for entry in value):
        return tuple(value)
    raise refuse(expected)


def _is_plain(value: object) -> bool:
    return isinstance(value, int | str) and not isinstance(value, bool) and str(value).strip() != ""


def _beam(value: object) -> str:
    """Read a direction: a signed axis or three numbers."""
    if isinstance(value, list) and len(value) == 3 and all(_is_number(entry) for entry in value):
        return ",".join(repr(float(entry)) for entry in value)
    if not isinstance(value, str) or not value.strip():
        raise refuse("x, y, z, -x, -y, -z or three numbers of length 1")
    return value.strip()


def _value_with_sd(value: object) -> tuple[float, float | None]:
    expected = 'a positive number, or text with its standard deviation like "1900+-60"'
    if _is_number(value):
        value = repr(value)
    if not isinstance(value, str):
        raise refuse(expected)
    try:
        return value_with_sd(value)
    except ArgumentTypeError as fault:
        raise refuse(expected) from fault


def _spacing(value: object) -> tuple[float, ...]:
    expected = "a positive number, or three of them (x, y, z), mm"
    values = _numbers([value] if _is_number(value) else value, (1, 3), expected)
    if min(values) <= 0.0:
        raise refuse(expected)
    return values


def _box(value: object) -> tuple[float, ...]:
    expected = "six numbers x0, y0, z0, x1, y1, z1 in mm with x0 < x1, y0 < y1, z0 < z1"
    values = _numbers(value, (6,), expected)
    if any(low >= high for low, high in zip(values[:3], values[3:], strict=True)):
        raise refuse(expected)
    return values


def _vector(value: object) -> tuple[float, ...]:
    return _numbers(value, (3,), "three numbers x, y, z")


def _direction(value: object) -> tuple[float, ...]:
    values = _vector(value)
    if not any(values):
        raise refuse("a direction x, y, z that is not zero")
    return values


def _number(value: object) -> float:
    if not _is_number(value):
        raise refuse("a number")
    return float(value)  # type: ignore[arg-type]


def _percent(value: object) -> float:
    if not _is_number(value) or not 0.0 <= float(value) < 50.0:  # type: ignore[arg-type]
        raise refuse("a percentage from 0 to 50")
    return float(value)  # type: ignore[arg-type]


def _label(value: object) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise refuse("a whole number from 1 on")
    return value


def _whole(value: object) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise refuse("a whole number, 0 or more")
    return value


def _voxels(value: object) -> tuple[int, int, int]:
    expected = "three whole numbers of at least 2: voxels along x (runs fastest), y, z"
    values = _numbers(value, (3,), expected)
    if min(values) < 2 or any(n != int(n) for n in values):
        raise refuse(expected)
    return int(values[0]), int(values[1]), int(values[2])


def _bands(value: object) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value not in (0, *range(2, 101)):
        raise refuse("0, or 2 to 100 parts of the band")
    return value


def _refits(value: object) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or (value != 0 and not 20 <= value <= 1_000_000):
        raise refuse("a whole number from 20 to 1000000, or 0")
    return value


def _masses(value: object) -> tuple[tuple[float, ...], ...]:
    """Read point masses: x, y, z in mm, the mass in mg and, when known, its sd in mg."""
    expected = "a list of point masses [x, y, z, mg] or [x, y, z, mg, sd], mm and mg"
    if not isinstance(value, list) or not value:
        raise refuse(expected)
    rows = [_numbers(entry, (4, 5), expected) for entry in (value if isinstance(value[0], list) else [value])]
    if any(row[3] <= 0.0 or min(row[4:], default=0.0) < 0.0 for row in rows):
        raise refuse(f"{expected}, the mass positive")
    return tuple((*row, 0.0)[:5] for row in rows)


def _range(value: object) -> tuple[float, float]:
    values = _numbers(value, (2,), "two frequencies in Hz, the lower first")
    if not 0.0 <= values[0] < values[1]:
        raise refuse("two frequencies in Hz, the lower first")
    return values[0], values[1]


def _ranges(value: object) -> tuple[tuple[float, float], ...]:
    """Read one range of frequencies or a list of ranges."""
    if isinstance(value, list) and value and isinstance(value[0], list):
        return tuple(_range(entry) for entry in value)
    return (_range(value),)


def _dof(value: object) -> tuple[str, ...]:
    from stapeskit.spatial import DOF_NAMES, parse_dof

    if isinstance(value, list) and all(isinstance(entry, str) for entry in value):
        value = ",".join(value)
    try:
        return parse_dof(str(value))
    except ValueError as fault:
        raise refuse(f"all, or a list out of {', '.join(DOF_NAMES)}") from fault


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise refuse("text")
    return value.strip()


def _flag(value: object) -> bool:
    if not isinstance(value, bool):
        raise refuse("true or false")
    return value


def _bounds(value: object) -> dict[str, float]:
    """Read bounds of entries by name."""
    if not isinstance(value, dict) or not all(_is_number(entry) for entry in value.values()):
        raise refuse("a table of entries and numbers in SI, like { K11 = 100.0 }")
    return {str(name): float(entry) for name, entry in value.items()}


def _one_of(*known: str) -> Callable[[object], str]:
    def choose(value: object) -> str:
        if value not in known:
            raise refuse(f"one of {', '.join(known)}")
        return str(value)

    return choose


File = Annotated[Path, BeforeValidator(_file)]
Files = Annotated[Path | tuple[Path, ...], BeforeValidator(_files)]
Named = Annotated[tuple[str, ...], BeforeValidator(_named)]
Beam = Annotated[str, BeforeValidator(_beam)]
ValueWithSd = Annotated[tuple[float, float | None], BeforeValidator(_value_with_sd)]
Spacing = Annotated[tuple[float, ...], BeforeValidator(_spacing)]
Box = Annotated[tuple[float, float, float, float, float, float], BeforeValidator(_box)]
Vector = Annotated[tuple[float, float, float], BeforeValidator(_vector)]
Direction = Annotated[tuple[float, float, float], BeforeValidator(_direction)]
Number = Annotated[float, BeforeValidator(_number)]
Percent = Annotated[float, BeforeValidator(_percent)]
Whole = Annotated[int, BeforeValidator(_whole)]
Bands = Annotated[int, BeforeValidator(_bands)]
Refits = Annotated[int, BeforeValidator(_refits)]
Label = Annotated[int, BeforeValidator(_label)]
Voxels = Annotated[tuple[int, int, int], BeforeValidator(_voxels)]
VoxelType = Annotated[
    str,
    BeforeValidator(_one_of("uint8", "int8", "uint16", "int16", "uint32", "int32", "float32", "float64")),
]
ByteOrder = Annotated[str, BeforeValidator(_one_of("little", "big"))]
Masses = Annotated[tuple[tuple[float, float, float, float, float], ...], BeforeValidator(_masses)]
Range = Annotated[tuple[float, float], BeforeValidator(_range)]
Ranges = Annotated[tuple[tuple[float, float], ...], BeforeValidator(_ranges)]
Dof = Annotated[tuple[str, ...], BeforeValidator(_dof)]
Text = Annotated[str, BeforeValidator(_text)]
Flag = Annotated[bool, BeforeValidator(_flag)]
Bounds = Annotated[dict[str, float], BeforeValidator(_bounds)]
Axis = Annotated[str, BeforeValidator(_one_of("x", "y", "z"))]
Side = Annotated[str, BeforeValidator(_one_of("left", "right"))]
Amplitude = Annotated[str, BeforeValidator(_one_of("peak", "rms"))]
LengthUnit = Annotated[str, BeforeValidator(_one_of("m", "mm", "um"))]
Frame = Annotated[str, BeforeValidator(_one_of("footplate", "plate", "scan"))]
RobustPoints = Annotated[str, BeforeValidator(_one_of("none", "huber", "t4"))]
Repeats = Annotated[str, BeforeValidator(_one_of("pool", "separate"))]
RobustFit = Annotated[str, BeforeValidator(_one_of("none", "t4"))]
Estimator = Annotated[str, BeforeValidator(_one_of("ml", "irls", "pinv", "constrained"))]
Damping = Annotated[str, BeforeValidator(_one_of("viscous", "hysteretic", "fractional", "compare"))]
Inplane = Annotated[str, BeforeValidator(_one_of("auto", "load", "ignore"))]
Constraint = Annotated[str, BeforeValidator(_one_of("eigenvalues", "psd"))]
