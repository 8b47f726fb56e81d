"""MATLAB files of version 4 (MAT-File Format, MathWorks, "Level 4"): matrices of numbers and texts."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.recording import from_parts

# Five whole numbers before each matrix, and the types of its numbers.
_HEAD = 20
_NUMBERS = ("f8", "f4", "i4", "i2", "u2", "u1")
_TEXT, _SPARSE = 1, 2
_LONGEST_NAME = 64  # bytes: MATLAB names variables with up to 63 letters


def is_mat4(head: bytes) -> bool:
    """Return whether the first bytes of a file are the head of a matrix of version 4."""
    return len(head) >= _HEAD and _head(head, 0) is not None


def read_mat4(path: Path) -> dict[str, Any]:
    """Read all variables: arrays (rows, columns), texts as str or lists of str; sparse ones are left out.

    Raises
    ------
    KinematicsError
        A matrix has no head, or is larger than the file.
    """
    data = path.read_bytes()
    variables: dict[str, Any] = {}
    place = 0
    while place < len(data):
        head = _head(data, place)
        if head is None:
            raise _damage_error(path, f"no head of a variable at byte {place}")
        order, number, content, rows, columns, is_complex, length = head
        place += _HEAD
        name = data[place : place + length].split(b"\0")[0].decode("latin-1")
        place += length
        dtype = np.dtype(order + _NUMBERS[number])
        count = rows * columns
        needed = count * dtype.itemsize * (2 if is_complex else 1)
        if place + needed > len(data):
            raise _damage_error(path, f"{len(data)} bytes where {place + needed} are needed")
        values = np.frombuffer(data, dtype, count * (2 if is_complex else 1), place)
        place += needed
        values = values.astype(dtype.newbyteorder("="))
        if is_complex:
            values = from_parts(values[:count], values[count:])
        matrix = values.reshape(rows, columns, order="F")
        if content == _TEXT:
            with np.errstate(invalid="ignore"):
                codes = matrix.real.astype(np.uint8)
            lines = [row.tobytes().decode("latin-1").rstrip("\0 ") for row in codes]
            variables[name] = lines[0] if len(lines) == 1 else lines
        elif content != _SPARSE:
            variables[name] = matrix
    return variables


def _head(data: bytes, place: int) -> tuple[str, int, int, int, int, bool, int] | None:
    """Return byte order, type, content, rows, columns, whether complex, length of the name; else None.

    Notes
    -----
    The first number is M O P T in decimal digits: byte order (0 little, 1 big endian), 0, type, content.
    """
    if place + _HEAD > len(data):
        return None
    for order, digit in (("<", 0), (">", 1)):
        kind, rows, columns, is_complex, length = struct.unpack_from(f"{order}5i", data, place)
        known = kind // 1000 == digit and kind // 100 % 10 == 0 and kind // 10 % 10 < len(_NUMBERS)
        possible = rows >= 0 and columns >= 0 and is_complex in (0, 1) and 0 < length <= _LONGEST_NAME
        if known and kind >= 0 and kind % 10 <= _SPARSE and possible:
            return order, kind // 10 % 10, kind % 10, rows, columns, bool(is_complex), length
    return None


def _damage_error(path: Path, got: str) -> KinematicsError:
    step = "It is truncated or damaged: copy or export it again"
    return KinematicsError.of(path.name, "a whole MATLAB file", got, "", step)
