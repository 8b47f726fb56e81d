"""MATLAB files of version 5 to 7 (MAT-File Format, MathWorks, ch. 1), read with every length checked.

scipy.io.loadmat trusts the lengths that a file states and can end the process on a damaged one.
"""

from __future__ import annotations

import math
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.recording import from_parts
from legacy.stapeskit.faults import Fault, raise_all

# MAT-File Format (MathWorks), level 5: length of the header, data types and array classes.
_HEADER = 128
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_TEXTS = {16: "utf-8", 17: "utf-16", 18: "utf-32"}
_CELL, _STRUCT, _OBJECT, _CHAR = 1, 2, 3, 4
_DENSE = range(6, 16)
# Nesting of cells and structs; exports have two or three.
_DEEPEST = 12
# Deflate packs 1032 to one at best: a larger ratio is a lying length.
_BEST_PACKING = 1100


class _DamageError(Exception):
    """What is wrong with the bytes."""


_DAMAGE = (_DamageError, zlib.error, struct.error, UnicodeDecodeError, ValueError)


def read_mat5(path: Path) -> dict[str, Any]:
    """Read all variables.

    Returns
    -------
    dict
        Arrays in MATLAB's shape, str (char), list (cell, struct array, rows of char), dict (struct). What has
        no such form (functions, objects of classes, sparse matrices) is left out.

    Raises
    ------
    KinematicsError
        A length, type or shape that the file cannot hold.
    """
    path = Path(path)
    data = memoryview(path.read_bytes())
    order = "<" if bytes(data[126:128]) == b"IM" else ">"
    variables: dict[str, Any] = {}
    faults: list[Fault] = []
    place, number = _HEADER, 0
    while place + 8 <= len(data) and bytes(data[place : place + 8]) != b"\0" * 8:
        kind, length = struct.unpack(order + "II", data[place : place + 8])
        body = data[place + 8 : place + 8 + length]
        number += 1
        try:
            if len(body) != length:
                raise _DamageError(f"{len(data)} bytes where {place + 8 + length} are needed")
            if kind == _COMPRESSED:
                kind, body = _unpack(body, order)
            if kind != _MATRIX:
                raise _DamageError(f"an element of type {kind} at byte {place}")
            name, value = _matrix(_Elements(body, order), 0)
            if name and value is not None:
                variables[name] = value
        except _DAMAGE as fault:
            faults.append(_fault(path, f"{fault} in variable {number}"))
            if kind not in (_MATRIX, _COMPRESSED):
                break
        place += 8 + length
    if not faults and place < len(data) and any(data[place:]):
        faults.append(_fault(path, "bytes that are no variable at its end"))
    raise_all(KinematicsError, faults)
    return variables


def _fault(path: Path, got: str) -> Fault:
    step = "It is truncated or damaged: copy or export it again"
    return Fault(path.name, "a whole MATLAB file", got, "", step)


def _unpack(body: memoryview, order: str) -> tuple[int, memoryview]:
    """Return type and bytes of a compressed element, never more than its own tag announces."""
    packed = zlib.decompressobj()
    tag = packed.decompress(body, 8)
    if len(tag) < 8:
        raise _DamageError("a compressed element without content")
    kind, length = struct.unpack(order + "II", tag)
    if length > _BEST_PACKING * len(body) + 1024:
        raise _DamageError(f"{length} bytes packed into {len(body)}")
    content = packed.decompress(packed.unconsumed_tail, max(length, 1))
    if len(content) < length:
        raise _DamageError("a compressed element that is too short")
    return kind, memoryview(content)


class _Elements:
    """Walks over the elements within a matrix."""

    def __init__(self, data: memoryview, order: str) -> None:
        self.data, self.order, self.place = data, order, 0

    def next(self) -> tuple[int, memoryview]:
        """Return type and bytes of the next element."""
        if self.place + 8 > len(self.data):
            raise _DamageError("a variable that ends too early")
        (first,) = struct.unpack(self.order + "I", self.data[self.place : self.place + 4])
        if first >> 16:
            kind, length, start = first & 0xFFFF, first >> 16, self.place + 4
            if length > 4:
                raise _DamageError("a short element of more than 4 bytes")
            self.place += 8
        else:
            (length,) = struct.unpack(self.order + "I", self.data[self.place + 4 : self.place + 8])
            kind, start = first, self.place + 8
            self.place = start + length + (-length % 8)
        if start + length > len(self.data):
            raise _DamageError("an element that reaches beyond its variable")
        return kind, self.data[start : start + length]

    def numbers(self) -> np.ndarray[Any, Any]:
        """Return the next element as numbers."""
        kind, body = self.next()
        if kind not in _NUMBERS:
            raise _DamageError(f"type {kind} where numbers belong")
        dtype = np.dtype(self.order + _NUMBERS[kind])
        if len(body) % dtype.itemsize:
            raise _DamageError("a number cut in two")
        return np.frombuffer(body, dtype)

    @property
    def ended(self) -> bool:
        """Whether nothing follows."""
        return self.place >= len(self.data)


def _matrix(elements: _Elements, depth: int) -> tuple[str, Any]:
    """Return name and value; None for kinds that are left out."""
    if depth > _DEEPEST:
        raise _DamageError("structs nested too deep")
    if elements.ended:
        return "", np.empty((0, 0))
    flags = elements.numbers()
    if flags.size < 2:
        raise _DamageError("a variable without flags")
    kind, is_complex = int(flags[0]) & 0xFF, bool(int(flags[0]) & 0x800)
    if kind not in (_CELL, _STRUCT, _OBJECT, _CHAR, *_DENSE):
        return "", None
    shape = tuple(int(size) for size in elements.numbers())
    if len(shape) < 2 or min(shape) < 0:
        raise _DamageError(f"dimensions {shape}")
    name = bytes(elements.next()[1]).decode("utf-8", "replace").rstrip("\0")
    count = math.prod(shape)
    if kind == _CHAR:
        return name, _text(elements, shape)
    if kind == _CELL:
        return name, [_read_inner(elements, depth) for _ in range(_check_count(count, elements))]
    if kind in (_STRUCT, _OBJECT):
        return name, _structs(elements, count, kind == _OBJECT, depth)
    real = _resize(elements, count)
    if is_complex:
        real = from_parts(real, _resize(elements, count))
    return name, real.astype(real.dtype.newbyteorder("=")).reshape(shape, order="F")


def _check_count(count: int, elements: _Elements) -> int:
    """Return a count of elements that the bytes left can hold."""
    if 8 * count > len(elements.data) - elements.place:
        raise _DamageError(f"{count} elements in {len(elements.data) - elements.place} bytes")
    return count


def _resize(elements: _Elements, count: int) -> np.ndarray[Any, Any]:
    values = elements.numbers()
    if values.size != count:
        raise _DamageError(f"{values.size} numbers for a shape of {count}")
    return values


def _read_inner(elements: _Elements, depth: int) -> Any:
    kind, body = elements.next()
    if kind != _MATRIX:
        raise _DamageError(f"type {kind} where a variable belongs")
    return _matrix(_Elements(body, elements.order), depth + 1)[1]


def _structs(elements: _Elements, count: int, is_object: bool, depth: int) -> Any:
    if is_object:
        elements.next()
    sizes = elements.numbers()
    width = int(sizes[0]) if sizes.size else 0
    raw = bytes(elements.next()[1])
    if width <= 0 or len(raw) % width:
        raise _DamageError("field names of no length")
    names = [raw[k : k + width].split(b"\0")[0].decode("utf-8", "replace") for k in range(0, len(raw), width)]
    _check_count(count * len(names), elements)
    structs = [{name: _read_inner(elements, depth) for name in names} for _ in range(count if names else 0)]
    return structs[0] if len(structs) == 1 else structs


def _text(elements: _Elements, shape: tuple[int, ...]) -> str | list[str]:
    kind, body = elements.next()
    little = "-le" if elements.order == "<" else "-be"
    if kind in _TEXTS:
        text = bytes(body).decode(_TEXTS[kind] + (little if kind != 16 else ""), "replace")
    elif kind in (4, 3):
        text = bytes(body).decode("utf-16" + little, "replace")
    elif kind in _NUMBERS and np.dtype(_NUMBERS[kind]).kind in "iu":
        dtype = np.dtype(elements.order + _NUMBERS[kind])
        usable = len(body) - len(body) % dtype.itemsize
        text = "".join(chr(int(code) & 0xFFFF) for code in np.frombuffer(body[:usable], dtype))
    else:
        raise _DamageError(f"type {kind} where text belongs")
    if shape[0] <= 1:
        return text.rstrip("\0 ")
    return [text[row :: shape[0]].rstrip("\0 ") for row in range(min(shape[0], len(text)))]
