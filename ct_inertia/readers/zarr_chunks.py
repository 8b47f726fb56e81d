"""The chunks of a Zarr array, versions 2 and 3, sharded or not, unpacked when they are asked for.

The formats: https://zarr-specs.readthedocs.io
"""

from __future__ import annotations

import bz2
import gzip
import json
import lzma
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.errors import CtInertiaError
from ct_inertia.readers.checks import header_fault, not_readable
from stapeskit.faults import Fault

_MOST_FILES = 4e6
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
            if len(lengths) > 1 or min(*array.chunks, *array.stored, *array.shape) < 1:
                raise header_fault(folder, "Zarr array", f"chunks of {array.chunks} for {array.shape}")
            return array
    raise header_fault(folder, "Zarr array", "a folder without .zarray or zarr.json")


def metadata(path: Path) -> Meta:
    """Return the content of a metadata file."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as fault:
        raise header_fault(path.parent, "Zarr folder", f"a damaged {path.name}") from fault
    if not isinstance(content, dict):
        raise header_fault(path.parent, "Zarr folder", f"a damaged {path.name}")
    return content


def _second(folder: Path, meta: Meta) -> ZarrArray:
    separator = meta.get("dimension_separator", ".")
    dtype = _dtype(str(meta["dtype"]), folder)
    chunks = tuple(int(n) for n in meta["chunks"])
    if meta.get("filters"):
        raise _unknown("filter", str(meta["filters"][0].get("id")), folder)
    compressor = meta.get("compressor")
    steps = [] if compressor is None else [_unpacker(str(compressor["id"]), folder)]
    order = meta.get("order", "C")
    fill = meta.get("fill_value")

    def name(at: Sequence[int]) -> Path:
        return folder / separator.join(map(str, at))

    def read(at: Sequence[int]) -> NDArray[Any]:
        file = name(at)
        if not file.is_file():
            return np.full(chunks, 0 if fill is None else fill, dtype=dtype)
        data = _through(steps, file.read_bytes(), file)
        return _shaped(data, dtype, chunks, file).reshape(chunks, order=order)

    shape = tuple(int(n) for n in meta["shape"])
    return ZarrArray(folder, shape, chunks, dtype, _fill(fill), read, name, chunks)


def _third(folder: Path, meta: Meta) -> ZarrArray:
    if meta.get("node_type") != "array":
        raise header_fault(folder, "Zarr array", "a group")
    stored = tuple(int(n) for n in meta["chunk_grid"]["configuration"]["chunk_shape"])
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
    chunks = tuple(int(n) for n in inner["chunk_shape"])
    decode, dtype = _decoder(inner["codecs"], plain, chunks, folder)
    shard = _Shard(inner, stored, chunks, folder) if sharded else None

    def read(at: Sequence[int]) -> NDArray[Any]:
        file = name(at if shard is None else shard.of(at))
        data = None
        if file.is_file():
            data = file.read_bytes() if shard is None else shard.piece(file, at)
        return np.full(chunks, fill, dtype=dtype) if data is None else decode(data, file)

    shape = tuple(int(n) for n in meta["shape"])
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
    steps: list[Callable[[bytes], bytes]] = []
    for codec in codecs:
        name, settings = codec["name"], codec.get("configuration", {})
        if name == "bytes":
            dtype = plain.newbyteorder(">" if settings.get("endian") == "big" else "<")
        elif name == "transpose":
            axes = [int(axis) for axis in settings["order"]]
        else:
            steps.insert(0, _unpacker(name.removeprefix("numcodecs."), folder))

    def decode(data: bytes, file: Path) -> NDArray[Any]:
        flat = _shaped(_through(steps, data, file), dtype, chunks, file)
        return flat.reshape([chunks[axis] for axis in axes]).transpose(np.argsort(axes))

    return decode, dtype


def _shaped(data: bytes, dtype: np.dtype, chunks: tuple[int, ...], file: Path) -> NDArray[Any]:
    needed = int(np.prod(chunks)) * dtype.itemsize
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


def _through(steps: Sequence[Callable[[bytes], bytes]], data: bytes, file: Path) -> bytes:
    try:
        for step in steps:
            data = step(data)
    except Exception as fault:
        raise not_readable(file, "Zarr chunk", fault) from fault
    return data


def _unpacker(name: str, folder: Path) -> Callable[[bytes], bytes]:
    known: dict[str, Callable[[bytes], bytes]] = {
        "zlib": zlib.decompress,
        "gzip": gzip.decompress,
        "bz2": bz2.decompress,
        "lzma": lzma.decompress,
        "crc32c": lambda data: data[:-4],
        "blosc": _blosc,
        "zstd": _zstd,
        "lz4": _lz4,
    }
    if name not in known:
        raise _unknown("codec", name, folder)
    return known[name]


def _blosc(data: bytes) -> bytes:
    import imagecodecs

    return bytes(imagecodecs.blosc_decode(data))


def _zstd(data: bytes) -> bytes:
    import imagecodecs

    return bytes(imagecodecs.zstd_decode(data))


def _lz4(data: bytes) -> bytes:
    import imagecodecs

    return bytes(imagecodecs.lz4_decode(data, header=True))


def _dtype(text: str, folder: Path) -> np.dtype:
    try:
        return np.dtype(text)
    except TypeError as fault:
        raise header_fault(folder, "Zarr array", f"data type {text}") from fault


def _fill(value: object) -> float:
    return float(value) if isinstance(value, (int, float)) else 0.0


def _unknown(what: str, name: str, folder: Path) -> CtInertiaError:
    return CtInertiaError(
        Fault(
            f"the Zarr {what}",
            "one of blosc, zstd, lz4, zlib, gzip, bz2, lzma",
            name,
            folder.name,
            next_step="Write the volume again with one of these",
        )
    )
