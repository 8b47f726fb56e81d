"""The chunks of a Zarr array, versions 2 and 3, sharded or not, unpacked when they are asked for.

The formats: https://zarr-specs.readthedocs.io
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.errors import CtInertiaError
from ct_inertia.readers.checks import amount, check_memory, header_fault, not_readable, unreadable
from ct_inertia.readers.unpack import CODECS, unpack
from stapeskit.faults import Fault

# Most chunks of an array: 1024^3 voxels in chunks of 8^3 have 2 million; damaged shapes claim more.
_MOST_FILES = 4e6
# Along an axis: more than any scanner has, small enough that products stay whole numbers of 64 bits.
_MOST_VOXELS = 1 << 20
_LONGEST_METADATA = 64 << 20
_ABSENT = (1 << 64) - 1
Meta = dict[str, Any]


@dataclass(frozen=True)
class ZarrArray:
    """A Zarr array: shape, type, chunks, and how a chunk of a given number is found and unpacked.

    Attributes
    ----------
    folder : Path
    shape, chunks : tuple of int
        Along every axis; of a sharded array the chunks inside the shards.
    dtype : dtype
    fill : float
        Value of chunks that are not stored.
    read : callable
        Takes the number of a chunk along every axis and returns its voxels.
    names : callable
        Takes the number of a stored file along every axis and returns its path.
    stored : tuple of int
        Voxels of a stored file along every axis: a chunk or a shard.
    """

    folder: Path
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: np.dtype
    fill: float
    read: Callable[[Sequence[int]], NDArray[Any]]
    names: Callable[[Sequence[int]], Path]
    stored: tuple[int, ...]

    def missing(self) -> tuple[int, int]:
        """Return how many of the stored files are not there, and how many there could be.

        Raises
        ------
        CtInertiaError
            More than a folder can hold.
        """
        counts = [-(-n // c) for n, c in zip(self.shape, self.stored, strict=True)]
        if float(np.prod(np.array(counts, dtype=float))) > _MOST_FILES:
            size = " x ".join(map(str, reversed(self.shape)))
            raise header_fault(self.folder, "Zarr array", f"a claim of {size} voxels")
        present = sum(self.names(at).is_file() for at in np.ndindex(*counts))
        total = int(np.prod(counts))
        return total - present, total


def zarr_array(folder: Path) -> ZarrArray:
    """Open a Zarr array of version 2 or 3.

    Raises
    ------
    CtInertiaError
        The metadata is missing or damaged, or asks for a codec that is not known.
    """
    for name, opened in (("zarr.json", _third), (".zarray", _second)):
        if (folder / name).is_file():
            meta = metadata(folder / name)
            try:
                array = opened(folder, meta)
            except (KeyError, TypeError, ValueError, AttributeError, LookupError, ArithmeticError) as fault:
                if isinstance(fault, CtInertiaError):
                    raise
                raise header_fault(folder, "Zarr array", f"metadata without usable {fault}") from fault
            lengths = {len(array.shape), len(array.chunks), len(array.stored)}
            numbers = (*array.chunks, *array.stored, *array.shape)
            if len(lengths) > 1 or not all(1 <= n < _MOST_VOXELS for n in numbers):
                raise header_fault(folder, "Zarr array", f"chunks of {array.chunks} for {array.shape}")
            check_memory(math.prod(array.chunks) * array.dtype.itemsize, folder.name)
            return array
    raise header_fault(folder, "Zarr array", "a folder without .zarray or zarr.json")


def metadata(path: Path) -> Meta:
    """Return the content of a metadata file."""
    try:
        if path.stat().st_size > _LONGEST_METADATA:
            raise header_fault(path.parent, "Zarr folder", f"{amount(path.stat().st_size)} of {path.name}")
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as fault:
        raise header_fault(path.parent, "Zarr folder", f"a damaged {path.name}") from fault
    if not isinstance(content, dict):
        raise header_fault(path.parent, "Zarr folder", f"a damaged {path.name}")
    return content


def _second(folder: Path, meta: Meta) -> ZarrArray:
    separator = meta.get("dimension_separator", ".")
    dtype = _dtype(str(meta["dtype"]), folder)
    chunks = _whole(meta["chunks"])
    if meta.get("filters"):
        raise _unknown("filter", str(meta["filters"][0].get("id")), folder)
    compressor = meta.get("compressor")
    steps = [] if compressor is None else [_known(str(compressor["id"]), folder)]
    order = meta.get("order", "C")
    if order not in ("C", "F") or not isinstance(separator, str):
        raise header_fault(folder, "Zarr array", f"the order {order!r} and the separator {separator!r}")
    fill = meta.get("fill_value")

    def name(at: Sequence[int]) -> Path:
        return folder / separator.join(map(str, at))

    def read(at: Sequence[int]) -> NDArray[Any]:
        file = name(at)
        data = _content(file)
        if data is None:
            return _filled(fill or 0, chunks, dtype, folder)
        return _unpacked(steps, data, dtype, chunks, file).reshape(chunks, order=order)

    shape = _whole(meta["shape"])
    return ZarrArray(folder, shape, chunks, dtype, _fill(fill), read, name, chunks)


def _third(folder: Path, meta: Meta) -> ZarrArray:
    if meta.get("node_type") != "array":
        raise header_fault(folder, "Zarr array", "a group")
    stored = _whole(meta["chunk_grid"]["configuration"]["chunk_shape"])
    keys = meta.get("chunk_key_encoding", {"name": "default"})
    first = keys["name"] == "default"
    separator = keys.get("configuration", {}).get("separator", "/" if first else ".")
    fill = meta.get("fill_value", 0)
    plain = np.dtype(meta["data_type"])

    def name(at: Sequence[int]) -> Path:
        return folder / separator.join([*(["c"] if first else []), *map(str, at)])

    codecs = meta["codecs"]
    sharded = codecs[0]["name"] == "sharding_indexed"
    inner = codecs[0]["configuration"] if sharded else {"codecs": codecs, "chunk_shape": stored}
    chunks = _whole(inner["chunk_shape"])
    decode, dtype = _decoder(inner["codecs"], plain, chunks, folder)
    shard = _Shard(inner, stored, chunks, folder) if sharded else None

    def read(at: Sequence[int]) -> NDArray[Any]:
        file = name(at if shard is None else shard.of(at))
        data = _content(file) if shard is None else shard.piece(file, at)
        return _filled(fill, chunks, dtype, folder) if data is None else decode(data, file)

    shape = _whole(meta["shape"])
    return ZarrArray(folder, shape, chunks, dtype, _fill(fill), read, name, stored)


class _Shard:
    """Where the chunks of a shard lie in its file."""

    def __init__(self, meta: Meta, stored: tuple[int, ...], chunks: tuple[int, ...], folder: Path) -> None:
        self._grid = tuple(s // c for s, c in zip(stored, chunks, strict=True))
        if any(s % c or s < c for s, c in zip(stored, chunks, strict=True)):
            raise header_fault(folder, "Zarr array", f"shards of {stored} for chunks of {chunks}")
        self._count = int(np.prod(self._grid))
        names = [codec["name"] for codec in meta.get("index_codecs", [])]
        if any(name not in ("bytes", "crc32c") for name in names):
            raise _unknown("index codec", ", ".join(names), folder)
        self._bytes = 16 * self._count + (4 if "crc32c" in names else 0)
        self._at_end = meta.get("index_location", "end") == "end"

    def of(self, at: Sequence[int]) -> list[int]:
        """Return the number of the shard that holds a chunk."""
        return [a // n for a, n in zip(at, self._grid, strict=True)]

    def piece(self, file: Path, at: Sequence[int]) -> bytes | None:
        """Return the packed bytes of a chunk, or None when it is not stored."""
        if not file.is_file():
            return None
        place = np.ravel_multi_index([a % n for a, n in zip(at, self._grid, strict=True)], self._grid)
        with file.open("rb") as stream:
            if self._at_end:
                stream.seek(-min(self._bytes, file.stat().st_size), 2)
            index = stream.read(self._bytes)
            if len(index) < self._bytes:
                raise not_readable(file, "Zarr shard", EOFError())
            offset, count = (
                np.frombuffer(index[: 16 * self._count], "<u8").reshape(-1, 2)[int(place)].tolist()
            )
            if offset == _ABSENT:
                return None
            if offset + count > file.stat().st_size:
                raise not_readable(file, "Zarr shard", EOFError())
            stream.seek(offset)
            data = stream.read(count)
        if len(data) < count:
            raise not_readable(file, "Zarr shard", EOFError())
        return data


def _decoder(
    codecs: list[Meta], plain: np.dtype, chunks: tuple[int, ...], folder: Path
) -> tuple[Callable[[bytes, Path], NDArray[Any]], np.dtype]:
    """Return what unpacks a chunk of version 3, and the type that comes out."""
    dtype, axes = plain.newbyteorder("<"), list(range(len(chunks)))
    steps: list[str] = []
    for codec in codecs:
        name, settings = codec["name"], codec.get("configuration", {})
        if name == "bytes":
            dtype = plain.newbyteorder(">" if settings.get("endian") == "big" else "<")
        elif name == "transpose":
            axes = [int(axis) for axis in settings["order"]]
            if sorted(axes) != list(range(len(chunks))):
                raise header_fault(folder, "Zarr array", f"the order of axes {axes}")
        else:
            steps.insert(0, _known(name.removeprefix("numcodecs."), folder))

    def decode(data: bytes, file: Path) -> NDArray[Any]:
        flat = _unpacked(steps, data, dtype, chunks, file)
        return flat.reshape([chunks[axis] for axis in axes]).transpose(np.argsort(axes))

    return decode, dtype


def _unpacked(
    steps: Sequence[str], data: bytes, dtype: np.dtype, chunks: tuple[int, ...], file: Path
) -> NDArray[Any]:
    """Return the voxels (n,) of a chunk, unpacked into no more memory than they need."""
    needed = math.prod(chunks) * dtype.itemsize
    try:
        for number, step in enumerate(steps, start=1):
            # A packed stream inside another one can be a little longer than what it holds.
            data = unpack(step, data, needed if number == len(steps) else needed + needed // 8 + (1 << 16))
    except Exception as fault:
        raise not_readable(file, "Zarr chunk", fault) from fault
    if len(data) != needed:
        raise CtInertiaError(
            Fault(
                "the Zarr chunk",
                f"of {needed} bytes",
                f"{len(data)} bytes",
                file.name,
                "The folder is damaged: copy or export it again",
            )
        )
    return np.frombuffer(data, dtype)


def _known(name: str, folder: Path) -> str:
    if name not in CODECS:
        raise _unknown("codec", name, folder)
    return name


def _whole(values: Sequence[int]) -> tuple[int, ...]:
    """Return numbers of voxels, which must be whole."""
    if any(int(n) != n for n in values):
        raise ValueError(f"numbers of voxels {values}")
    return tuple(int(n) for n in values)


def _dtype(text: str, folder: Path) -> np.dtype:
    try:
        return np.dtype(text)
    except TypeError as fault:
        raise header_fault(folder, "Zarr array", f"data type {text}") from fault


def _fill(value: object) -> float:
    return float(value) if isinstance(value, (int, float)) else 0.0


def _filled(value: object, chunks: tuple[int, ...], dtype: np.dtype, folder: Path) -> NDArray[Any]:
    """Return a chunk that is not stored, which needs no memory."""
    try:
        voxel = np.array(value, dtype=dtype).reshape(())
    except (TypeError, ValueError, OverflowError) as fault:
        raise header_fault(folder, "Zarr array", f"a fill_value of {str(value)[:40]}") from fault
    return np.broadcast_to(voxel, chunks)


def _content(file: Path) -> bytes | None:
    """Return a stored chunk, or None when it is not stored."""
    try:
        return file.read_bytes() if file.is_file() else None
    except OSError as fault:
        raise unreadable(file, fault) from fault


def _unknown(what: str, name: str, folder: Path) -> CtInertiaError:
    return CtInertiaError(
        Fault(
            f"the Zarr {what}",
            f"one of {', '.join(CODECS)}",
            name,
            folder.name,
            next_step="Write the volume again with one of these",
        )
    )
