"""The grid that a header of NRRD, MetaImage, NIfTI, raw or another format describes, as a volume."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from ct_inertia.errors import CtInertiaError
from ct_inertia.readers.checks import check_size, header_fault, no_data_file, not_readable, settle_spacing
from ct_inertia.readers.formats import ReadOptions
from ct_inertia.readers.memory_mapping import mapped
from ct_inertia.volume.lazy_arrays import BlockArray, scaled
from ct_inertia.volume.volume import Volume, unmirrored_frame
from stapeskit.arrays import Array
from stapeskit.warnings import Notice

# Unpacked at once: bounds the memory beside the volume itself.
_STREAM_BYTES = 16 << 20
# Bytes of an unpacked stream before its voxels; headers have some thousands.
_MOST_SKIPPED = 1 << 30


@dataclass(frozen=True)
class Grid:
    """Where the voxels of a volume lie in its files, and where the volume lies in scan coordinates.

    Attributes
    ----------
    size : tuple of 3 int
        Voxels along x, y, z.
    dtype : dtype
        With its byte order.
    files : tuple of (Path, int)
        Files of equal numbers of slices in order, each with the offset of its first voxel; an offset of -1
        counts back from the end.
    spacing_mm : ndarray, (3,), or None
        None where the header does not have it.
    origin_mm : ndarray, (3,)
    direction : ndarray, (3, 3)
    packing : str
        ``raw``, ``gzip``, ``bzip2`` or ``zlib``.
    anatomical : bool
        The header ties the axes to the patient.
    slope, intercept : float
        Grey value = slope * stored + intercept.
    layers : int
        Values per voxel, the fastest index; 1 but for layered segmentations.
    skip : int
        Bytes of the unpacked stream before the first voxel.
    slab : int
        Slices in each file but the last, which may hold fewer; 0: as many in each.
    known : str
        The part of an incomplete spacing that the header has, for the message.
    notices : tuple of Notice
    """

    size: tuple[int, int, int]
    dtype: np.dtype
    files: tuple[tuple[Path, int], ...]
    spacing_mm: Array | None
    origin_mm: Array = field(default_factory=lambda: np.zeros(3))
    direction: Array = field(default_factory=lambda: np.eye(3))
    packing: str = "raw"
    anatomical: bool = False
    slope: float = 1.0
    intercept: float = 0.0
    layers: int = 1
    skip: int = 0
    slab: int = 0
    known: str = ""
    notices: tuple[Notice, ...] = ()


def grid_volume(
    grid: Grid,
    path: Path,
    options: ReadOptions,
    array: NDArray[Any] | None = None,
) -> Volume:
    """Return the volume behind a header.

    ``options.mirror`` reverses the slices along one axis; on a left-handed grid that makes it right-handed.

    Raises
    ------
    CtInertiaError
        A file is missing or too short, no spacing, or a left-handed direction matrix without ``mirror``.
    """
    spacing, settled = settle_spacing(grid.spacing_mm, options.spacing_mm, path.name, grid.known)
    origin, direction, mirror = grid.origin_mm, grid.direction, options.mirror
    if mirror is not None and np.linalg.det(direction) < 0.0:
        origin, direction = unmirrored_frame(origin, direction, np.array(grid.size), spacing, mirror)
        mirror = None
    voxels = grid_array(grid, path) if array is None else array
    return Volume(
        scaled(voxels, grid.slope, grid.intercept),
        spacing,
        origin,
        direction,
        grid.anatomical,
        path,
        notices=(*grid.notices, *settled),
    ).mirrored(mirror)


def grid_array(grid: Grid, path: Path) -> NDArray[Any]:
    """Return the voxels [z, y, x] (with layers [z, y, x, layer]): memory-mapped, or unpacked in their type.

    Raises
    ------
    CtInertiaError
        A file is missing, too short or damaged, or the sizes are not those of a volume.
    """
    check_dimensions(grid.size, path.name)
    shape = grid.size[::-1] + ((grid.layers,) if grid.layers > 1 else ())
    for file, _ in grid.files:
        if not file.is_file():
            raise no_data_file(path, file)
    if len(grid.files) > 1:
        return _stacked(grid, path)
    file, offset = grid.files[0]
    if grid.packing == "raw":
        return mapped(file, grid.dtype, offset, shape, path.name)
    if grid.skip > _MOST_SKIPPED:
        raise header_fault(path, "header", f"voxels at byte {grid.skip}")
    limit = "bzip2" if grid.packing == "bzip2" else "deflate"
    stored = file.stat().st_size - max(offset, 0)
    check_size(shape, grid.dtype, stored, path.name, packing=limit, held=True)
    return _unpacked(file, offset, grid, shape, path)


def check_dimensions(size: Sequence[int], name: str) -> None:
    """Refuse sizes that are not those of a volume."""
    if len(size) != 3 or min(size) < 2:
        raise CtInertiaError.of(
            "the volume",
            "three-dimensional",
            f"an image of shape {' x '.join(map(str, size))}",
            name,
            next_step="Give the whole stack",
        )


def _stacked(grid: Grid, path: Path) -> NDArray[Any]:
    """Return slabs of a volume that lie in a file each, mapped when they are asked for."""
    nx, ny, nz = grid.size
    count = len(grid.files)
    depth = grid.slab or nz // max(count, 1)
    rest = nz - (count - 1) * depth
    if not 0 < rest <= depth or (rest != depth and not grid.slab) or grid.packing != "raw" or grid.layers > 1:
        raise CtInertiaError.of(
            "the list of data files",
            f"uncompressed files of equal numbers of the {nz} slices",
            f"{count} files",
            path.name,
            "Export the volume as one file",
        )
    for number, (file, offset) in enumerate(grid.files):
        here = depth if number < count - 1 else rest
        check_size((here, ny, nx), grid.dtype, file.stat().st_size - max(offset, 0), file.name)

    def slab(z: int, _y: int, _x: int) -> NDArray[Any]:
        file, offset = grid.files[z]
        return mapped(file, grid.dtype, offset, (depth if z < count - 1 else rest, ny, nx), file.name)

    return BlockArray((nz, ny, nx), grid.dtype, (depth, ny, nx), slab).as_array()


def _unpacked(file: Path, offset: int, grid: Grid, shape: Sequence[int], path: Path) -> NDArray[Any]:
    array = np.empty(tuple(shape), dtype=grid.dtype)
    room = memoryview(cast(Any, array.reshape(-1).view(np.uint8)))
    try:
        with file.open("rb") as stream:
            stream.seek(max(offset, 0))
            filled = _filled(stream, grid.packing, grid.skip, room)
    except (OSError, EOFError, zlib.error) as fault:
        raise not_readable(path, f"{grid.packing} file", fault) from fault
    if filled < len(room):
        raise CtInertiaError.of(
            "the compressed volume",
            f"complete ({len(room)} bytes of voxels)",
            f"{filled} bytes",
            path.name,
            "Copy or export it again",
        )
    return array


def _filled(stream: BinaryIO, packing: str, skip: int, room: memoryview) -> int:
    """Unpack a stream into a buffer and return the number of bytes that came."""
    if packing == "zlib":
        return _inflated(stream, room)
    import bz2
    import gzip

    source: Any = bz2.BZ2File(stream) if packing == "bzip2" else gzip.GzipFile(fileobj=stream)
    while skip > 0 and (passed := len(source.read(min(skip, _STREAM_BYTES)))):
        skip -= passed
    filled = 0
    while filled < len(room):
        count = source.readinto(room[filled : filled + _STREAM_BYTES])
        if not count:
            break
        filled += count
    if filled == len(room):
        source.read(1 << 16)  # to the end, where the checksum is
    return filled


def _inflated(stream: BinaryIO, room: memoryview) -> int:
    unpack = zlib.decompressobj(47)
    filled = 0
    while filled < len(room) and not unpack.eof:
        data = unpack.unconsumed_tail or stream.read(_STREAM_BYTES >> 2)
        if not data:
            break
        piece = unpack.decompress(data, min(len(room) - filled, _STREAM_BYTES))
        room[filled : filled + len(piece)] = piece
        filled += len(piece)
    if filled == len(room) and not unpack.eof:
        unpack.decompress(unpack.unconsumed_tail + stream.read(1 << 16), 1 << 16)
    return filled
