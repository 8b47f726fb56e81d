"""The chunks of a Zarr array, versions 2 and 3, sharded or not, unpacked when they are asked for.

The formats: https://zarr-specs.readthedocs.io
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.readers.checks import amount, check_memory
from legacy.ct_inertia.readers.decompression import CODECS, unpack
from legacy.ct_inertia.readers.refusals import header_fault, not_readable, unreadable
from legacy.ct_inertia.readers.zarr_files import ZarrFiles
from legacy.stapeskit.json_toml import read_json

# Along an axis: more than any scanner has, small enough that products stay whole numbers of 64 bits.
_MOST_VOXELS = 1 << 20
_LONGEST_METADATA = 64 << 20
_ABSENT = (1 << 64) - 1
# Indices of shards kept between reads. A shard of a thousand chunks has an index of 16 kB.
_KEPT_INDICES = 64
# 4096^3 voxels in chunks of 16^3 have 17 million.
_MOST_CHUNKS = 1 << 26
Meta = dict[str, Any]


@dataclass(frozen=True)
class ZarrArray:
    """A Zarr array: shape, type, chunks, and how a chunk of a given number is found and unpacked.

    Attributes
    ----------
    shape, chunks : tuple of int
        Along every axis; of a sharded array the chunks inside the shards.
    fill : object
        Value of voxels that are not stored, as the metadata has it.
    read : callable
        Takes the number of a stored chunk along every axis and returns its voxels.
    files : ZarrFiles
        The chunks or shards that are stored.
    shard : _Shard or None
        Where chunks lie in the files of a sharded array.
    """

    folder: Path
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: np.dtype
    fill: object
    read: Callable[[Sequence[int]], NDArray[Any]]
    files: ZarrFiles
    shard: _Shard | None = None

    def present(self) -> NDArray[np.bool_]:
        """Return which chunks are stored, by their number along every axis.

        Raises
        ------
        CtInertiaError
            The array claims more chunks than it can have, or an index cannot be read.
        """
        files = self.files.present
        if self.shard is None:
            return files
        counts = [-(-n // c) for n, c in zip(self.shape, self.chunks, strict=True)]
        if math.prod(counts) > _MOST_CHUNKS:
            raise header_fault(self.folder, "Zarr array", f"a claim of {math.prod(counts)} chunks")
        there = np.zeros(counts, dtype=np.bool_)
        for at in np.argwhere(files).tolist():
            in_shard = self.shard.holds(self.files.path(at))
            first = [number * n for number, n in zip(at, in_shard.shape, strict=True)]
            part = there[tuple(slice(a, a + n) for a, n in zip(first, in_shard.shape, strict=True))]
            part[...] = in_shard[tuple(slice(n) for n in part.shape)]
        return there

    def missing(self) -> tuple[int, int]:
        """Return how many of the stored files are not there, and how many there could be.

        Raises
        ------
        CtInertiaError
            More than a folder can hold.
        """
        there = self.files.present
        return int(there.size - np.count_nonzero(there)), int(there.size)

    @property
    def fill_voxel(self) -> NDArray[Any]:
        """The value () of voxels that are not stored.

        Raises
        ------
        CtInertiaError
            The metadata has none of the array's type.
        """
        return _voxel(self.fill, self.dtype, self.folder)


def zarr_array(folder: Path) -> ZarrArray:
    """Open a Zarr array of version 2 or 3.

    Raises
    ------
    CtInertiaError
        The metadata is missing or damaged, or asks for a codec that is not known.
    """
    for name, opened in (("zarr.json", _open_version_3), (".zarray", _open_version_2)):
        if (folder / name).is_file():
            meta = metadata(folder / name)
            try:
                array = opened(folder, meta)
            except (KeyError, TypeError, ValueError, AttributeError, LookupError, ArithmeticError) as fault:
                if isinstance(fault, CtInertiaError):
                    raise
                raise header_fault(folder, "Zarr array", f"metadata without usable {fault}") from fault
            stored = array.files.stored
            lengths = {len(array.shape), len(array.chunks), len(stored)}
            numbers = (*array.chunks, *stored, *array.shape)
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
        return read_json(path)
    except (OSError, ValueError) as fault:
        raise header_fault(path.parent, "Zarr folder", f"a damaged {path.name}") from fault


def _open_version_2(folder: Path, meta: Meta) -> ZarrArray:
    separator = meta.get("dimension_separator", ".")
    dtype = _dtype(str(meta["dtype"]), folder)
    chunks = _check_whole(meta["chunks"])
    if meta.get("filters"):
        raise _unknown("filter", str(meta["filters"][0].get("id")), folder)
    compressor = meta.get("compressor")
    steps = [] if compressor is None else [_check_codec(str(compressor["id"]), folder)]
    order = meta.get("order", "C")
    if order not in ("C", "F"):
        raise header_fault(folder, "Zarr array", f"the order {str(order)[:40]!r}")
    shape = _check_whole(meta["shape"])
    files = ZarrFiles(folder, shape, chunks, separator)

    def read(at: Sequence[int]) -> NDArray[Any]:
        file = files.path(at)
        return _unpack(steps, _content(file), dtype, chunks, file).reshape(chunks, order=order)

    return ZarrArray(folder, shape, chunks, dtype, meta.get("fill_value") or 0, read, files)


def _open_version_3(folder: Path, meta: Meta) -> ZarrArray:
    if meta.get("node_type") != "array":
        raise header_fault(folder, "Zarr array", "a group")
    stored = _check_whole(meta["chunk_grid"]["configuration"]["chunk_shape"])
    keys = meta.get("chunk_key_encoding", {"name": "default"})
    first = keys["name"] == "default"
    separator = keys.get("configuration", {}).get("separator", "/" if first else ".")
    shape = _check_whole(meta["shape"])
    files = ZarrFiles(folder, shape, stored, separator, ("c",) if first else ())
    fill = meta.get("fill_value", 0)
    plain = np.dtype(meta["data_type"])
    codecs = meta["codecs"]
    sharded = codecs[0]["name"] == "sharding_indexed"
    inner = codecs[0]["configuration"] if sharded else {"codecs": codecs, "chunk_shape": stored}
    chunks = _check_whole(inner["chunk_shape"])
    decode, dtype = _decoder(inner["codecs"], plain, chunks, folder)
    shard = _Shard(inner, stored, chunks, folder) if sharded else None

    def read(at: Sequence[int]) -> NDArray[Any]:
        file = files.path(at if shard is None else shard.of(at))
        return decode(_content(file) if shard is None else shard.piece(file, at), file)

    return ZarrArray(folder, shape, chunks, dtype, fill, read, files, shard)


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
        # Every chunk of a shard asks for its index; a plane of voxels seldom crosses more shards.
        self._index = lru_cache(maxsize=_KEPT_INDICES)(self._read_index)

    def of(self, at: Sequence[int]) -> list[int]:
        """Return the number of the shard that holds a chunk."""
        return [a // n for a, n in zip(at, self._grid, strict=True)]

    def holds(self, file: Path) -> NDArray[np.bool_]:
        """Return which chunks a shard holds, by their number within it along every axis."""
        return np.asarray(self._index(file)[:, 0] != _ABSENT).reshape(self._grid)

    def piece(self, file: Path, at: Sequence[int]) -> bytes:
        """Return the packed bytes of a chunk that the shard holds."""
        place = np.ravel_multi_index([a % n for a, n in zip(at, self._grid, strict=True)], self._grid)
        offset, count = self._index(file)[int(place)].tolist()
        try:
            with file.open("rb") as stream:
                if offset + count > os.fstat(stream.fileno()).st_size:
                    raise not_readable(file, "Zarr shard", EOFError())
                stream.seek(offset)
                data = stream.read(count)
        except OSError as fault:
            raise unreadable(file, fault) from fault
        if len(data) < count:
            raise not_readable(file, "Zarr shard", EOFError())
        return data

    def _read_index(self, file: Path) -> NDArray[np.uint64]:
        """Return offset and length (n, 2) of every chunk of a shard, in bytes."""
        try:
            with file.open("rb") as stream:
                if self._at_end:
                    stream.seek(-min(self._bytes, os.fstat(stream.fileno()).st_size), os.SEEK_END)
                index = stream.read(self._bytes)
        except OSError as fault:
            raise unreadable(file, fault) from fault
        if len(index) < self._bytes:
            raise not_readable(file, "Zarr shard", EOFError())
        return np.frombuffer(index, "<u8", 2 * self._count).reshape(-1, 2)


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
            steps.insert(0, _check_codec(name.removeprefix("numcodecs."), folder))

    def decode(data: bytes, file: Path) -> NDArray[Any]:
        flat = _unpack(steps, data, dtype, chunks, file)
        return flat.reshape([chunks[axis] for axis in axes]).transpose(np.argsort(axes))

    return decode, dtype


def _unpack(
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
        raise CtInertiaError.of(
            "the Zarr chunk",
            f"of {needed} bytes",
            f"{len(data)} bytes",
            file.name,
            "The folder is damaged: copy or export it again",
        )
    return np.frombuffer(data, dtype)


def _check_codec(name: str, folder: Path) -> str:
    if name not in CODECS:
        raise _unknown("codec", name, folder)
    return name


def _check_whole(values: Sequence[int]) -> tuple[int, ...]:
    """Return numbers of voxels, which must be whole."""
    if any(int(n) != n for n in values):
        raise ValueError(f"numbers of voxels {values}")
    return tuple(int(n) for n in values)


def _dtype(text: str, folder: Path) -> np.dtype:
    try:
        return np.dtype(text)
    except TypeError as fault:
        raise header_fault(folder, "Zarr array", f"data type {text}") from fault


def _voxel(fill: object, dtype: np.dtype, folder: Path) -> NDArray[Any]:
    """Return the value () of voxels that are not stored."""
    try:
        return np.array(fill, dtype=dtype).reshape(())
    except (TypeError, ValueError, OverflowError) as fault:
        raise header_fault(folder, "Zarr array", f"a fill_value of {str(fill)[:40]}") from fault


def _content(file: Path) -> bytes:
    """Return a stored chunk."""
    try:
        return file.read_bytes()
    except OSError as fault:
        raise unreadable(file, fault) from fault


def _unknown(what: str, name: str, folder: Path) -> CtInertiaError:
    return CtInertiaError.of(
        f"the Zarr {what}",
        f"one of {', '.join(CODECS)}",
        name,
        folder.name,
        next_step="Write the volume again with one of these",
    )
