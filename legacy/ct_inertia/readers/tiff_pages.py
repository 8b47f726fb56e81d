"""The voxels of a TIFF stack: mapped where they lie evenly, otherwise unpacked when they are asked for."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.readers.checks import check_memory, check_size
from legacy.ct_inertia.readers.memory_mapping import mapped, read_at
from legacy.ct_inertia.readers.ome import Calibration
from legacy.ct_inertia.readers.refusals import (
    header_fault,
    not_readable,
    not_three_dimensional,
    several_values,
)
from legacy.ct_inertia.readers.tiff_directories import packing_of
from legacy.ct_inertia.volume.lazy_arrays import BlockArray
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice

if TYPE_CHECKING:
    import tifffile

# Least rows that are unpacked at a time: fewer cost more calls, more waste memory on parts of a plane.
_ROWS = 64
# Pixels per inch of screens and printers, which programs write where they know none; 1 for none.
_NO_SCANNERS_DPI = (1.0, 72.0, 96.0, 100.0, 150.0, 200.0, 300.0, 400.0, 600.0, 1200.0)
# Decoders that neither crashed nor hung on 600 damaged files each; that of JPEG XR did both.
_PACKINGS = (
    *(
        "NONE",
        "ADOBE_DEFLATE",
        "DEFLATE",
        "LZW",
        "PACKBITS",
        "ZSTD",
        "ZSTD_DEPRECATED",
        "LZMA",
        "PNG",
        "LERC",
    ),
    *("JPEG", "JPEG2000", "JPEGXL", "CCITTRLE", "CCITTFAX3", "CCITTFAX4"),
)
WHITE_IS_ZERO = "white_is_zero"


def first_stack(tif: tifffile.TiffFile) -> Any:
    """Return the first series of three dimensions, which a thumbnail may precede; else the first one."""
    stacks = (series for series in tif.series if sum(n > 1 for n in series.shape) > 2)
    return next(stacks, tif.series[0])


def stack_array(series: Any, path: Path) -> NDArray[Any]:
    """Return a stack of a TIFF file [z, y, x] in its own type.

    Raises
    ------
    CtInertiaError
        Truncated, two-dimensional, coloured, or several channels or times.
    """
    page: Any = series.keyframe
    _check_kind(series, page, path)
    shape = tuple(n for n in series.shape if n > 1)
    # An image of several files may begin in another one than that which was opened.
    home: Any = page.parent
    dtype = np.dtype(home.byteorder + series.dtype.char)
    packed = page.compression.name != "NONE" or dtype.kind == "b" or page.bitspersample < 8
    # There is an offset where all pages lie in one piece: then they need not be looked at one by one.
    start = None if packed else series.dataoffset
    files = [Path(home.filehandle.path)] if start is not None else _files(series, path)
    size = sum(file.stat().st_size for file in set(files))
    check_size(shape, dtype, size, path.name, packing=packing_of(page) if packed else "raw")
    if start is not None:
        return mapped(files[0], dtype, start, shape, files[0].name)
    _check_pages(series, files, path)
    if len(series.pages) != shape[0]:
        # Tiles with a depth: boxes.
        check_size(shape, dtype, size, path.name, packing=packing_of(page), in_memory=True)
        return np.asarray(series.asarray()).reshape(shape)
    return _planes(series, page, files, shape, dtype)


def plane_calibration(page: Any) -> Calibration:
    """Return the spacing along x and y in mm that the tags of a page state, where they have a unit."""
    plane = resolution(page)
    unit = {2: 25.4, 3: 10.0}.get(int(getattr(page.tags.get("ResolutionUnit"), "value", 0) or 0))
    if plane is None or unit is None:
        return Calibration(None, known="the TIFF has no resolution with a unit")
    x, y = plane * unit
    if any(abs(x * dpi / 25.4 - 1.0) < 1e-4 for dpi in _NO_SCANNERS_DPI):
        return Calibration(None, known="the TIFF has the resolution of a screen or printer only")
    return Calibration(
        np.array([x, y, np.nan]),
        known=f"the TIFF says {x:.6g} x {y:.6g} mm in a slice but not the distance of slices",
    )


def resolution(page: Any) -> Array | None:
    """Return units per pixel along x and y (2,), where the tags of a page state both."""
    pair = []
    for name in ("XResolution", "YResolution"):
        tag = page.tags.get(name)
        if tag is None:
            return None
        top, bottom = tag.value
        if not top > 0 or not bottom > 0:
            return None
        pair.append(bottom / top)
    return np.array(pair)


def white_is_zero(page: Any) -> bool:
    """Return whether a page says that its lowest grey value is shown white (WhiteIsZero of TIFF 6.0)."""
    return page.photometric is not None and page.photometric.name == "MINISWHITE"


def turned_notice(path: Path) -> Notice:
    """Return the warning that bright and dark were exchanged."""
    text = (
        f"{path.name} says that 0 is white (WhiteIsZero): bright and dark were exchanged, so that bone is "
        f"bright. Grey values count from the other end of their range (255 less the stored one, 65535 less "
        f"it; floats change sign). If bone was bright as stored, correct the tag where the scan was exported."
    )
    return Notice(WHITE_IS_ZERO, text)


def _files(series: Any, path: Path) -> list[Path]:
    """Return the file of each page: an OME series may lie in several."""
    return [
        path if page is None else Path(page.parent.filehandle.path) if hasattr(page, "parent") else path
        for page in series.pages
    ]


def _planes(
    series: Any, page: Any, files: list[Path], shape: tuple[int, ...], dtype: np.dtype
) -> NDArray[Any]:
    """Return pages that do not lie in one piece: mapped at even steps, otherwise unpacked when asked for."""
    segments = [list(zip(p.dataoffsets, p.databytecounts, strict=True)) for p in series.pages]
    stepped = _strided_view(segments, page, files, shape, dtype)
    if stepped is not None:
        return stepped
    out_type = np.dtype(np.uint8) if dtype.kind == "b" else dtype.newbyteorder("=")
    decode, tables = page.decode, page.jpegtables
    step = page.tilelength if page.is_tiled else page.rowsperstrip
    width = page.tilewidth if page.is_tiled else shape[2]
    across = -(-shape[2] // width)
    needed, stored = across * -(-shape[1] // max(1, step)), min(map(len, segments))
    if stored < needed:
        raise not_readable(files[0], "TIFF", ValueError(f"a page has {stored} of {needed} strips or tiles"))
    # Rows are unpacked in groups, so that a part of a plane does not cost the whole of it.
    group = max(1, -(-_ROWS // step))
    rows = min(step * group, shape[1])
    segment = step * width if page.is_tiled else min(step, shape[1]) * width
    check_memory((segment + rows * shape[2]) * out_type.itemsize, files[0].name)

    def part(z: int, number: int, _x: int) -> NDArray[Any]:
        top = number * step * group
        out = np.zeros((min(rows, shape[1] - top), shape[2]), dtype=out_type)
        first = number * group * across
        chosen = [
            (index, offset, count)
            for index, (offset, count) in enumerate(segments[z][first : first + group * across], first)
            if count > 0
        ]
        for index, data in _read_segments(files[z], chosen):
            try:
                piece, (_, _, y, x, _), (_, height, width, _) = decode(data, index, jpegtables=tables)
            except Exception as fault:
                raise not_readable(files[z], "TIFF", fault) from fault
            if piece is None:
                continue
            if piece.size == 0:
                raise not_readable(files[z], "TIFF", ValueError("a tile or strip has no values"))
            place = out[y - top : y - top + height, x : x + width]
            place[...] = piece[0, : place.shape[0], : place.shape[1], 0]
        return out[None]

    return BlockArray(shape, out_type, (1, rows, shape[2]), part).as_array()


def _read_segments(file: Path, segments: list[tuple[int, int, int]]) -> Iterator[tuple[int, bytes]]:
    """Yield number and bytes of strips or tiles (number, offset, count), neighbours read at once."""
    if not segments:
        return
    start = min(offset for _, offset, _ in segments)
    end = max(offset + count for _, offset, count in segments)
    dense = end - start <= 2 * sum(count for _, _, count in segments)
    together = read_at(file, start, end - start) if dense else b""
    for index, offset, count in segments:
        yield (
            index,
            together[offset - start : offset - start + count] if dense else read_at(file, offset, count),
        )


def _strided_view(
    segments: list[list[tuple[int, int]]],
    page: Any,
    files: list[Path],
    shape: tuple[int, ...],
    dtype: np.dtype,
) -> NDArray[Any] | None:
    """Return uncompressed pages at even distances in one file as a strided view of the mapped file."""
    plane = shape[1] * shape[2] * dtype.itemsize
    starts = np.array([part[0][0] for part in segments], dtype=np.int64)
    whole = all(
        part[-1][0] + part[-1][1] - part[0][0] == plane == sum(count for _, count in part)
        for part in segments
    )
    steps = np.unique(np.diff(starts))
    if (
        page.compression.name != "NONE"
        or page.is_tiled
        or page.bitspersample < 8
        or not whole
        or len(set(files)) > 1
        or steps.size != 1
        or steps[0] < plane
        or steps[0] % dtype.itemsize
    ):
        return None
    return mapped(files[0], dtype, int(starts[0]), shape, files[0].name, int(steps[0]))


def _check_kind(series: Any, page: Any, path: Path) -> None:
    check_palette(page, path)
    if page.photometric is not None and page.photometric.name in ("RGB", "YCBCR", "CMYK"):
        raise several_values(path, "a colour (RGB) image")
    axes, shape = series.axes, series.shape
    if "S" in axes and shape[axes.index("S")] > 1:
        raise several_values(path, "several samples per voxel")
    extra = [f"{n} {axis}" for axis, n in zip(axes, shape, strict=True) if axis in "CTS" and n > 1]
    sizes = tuple(n for n in shape if n > 1)
    if extra and (len(sizes) > 3 or "Z" in axes):
        raise several_values(path, f"{', '.join(extra)} (channels or times)")
    if len(sizes) != 3:
        raise not_three_dimensional(path.name, sizes[::-1])


def check_palette(page: Any, path: Path) -> None:
    """Refuse a page with a colour palette, unless brightness grows with the number, as in lookup tables.

    Raises
    ------
    CtInertiaError
        The brightness of the colours does not grow with their number.
    """
    if page.photometric is None or page.photometric.name != "PALETTE":
        return
    colours = np.asarray(page.colormap, dtype=float).reshape(3, -1)
    if np.any(np.diff(colours.sum(axis=0)) < 0.0):
        raise CtInertiaError.of(
            "the volume",
            "grey values",
            "numbers of colours whose brightness does not grow with them",
            path.name,
            "Export it as grey values",
        )


def _check_pages(series: Any, files: list[Path], path: Path) -> None:
    sizes = {file: file.stat().st_size for file in set(files)}
    check_pieces(series.keyframe, path)
    for page, file in zip(series.pages, files, strict=True):
        if page is None:
            raise header_fault(path, "TIFF", "a missing page")
        check_offsets(page, file, sizes[file])


def check_pieces(page: Any, path: Path) -> None:
    """Refuse strips or tiles of no size, and packings whose decoders damaged files crash or hold up.

    Raises
    ------
    CtInertiaError
        A size is no number, or below 1; another packing than those of `_PACKINGS`.
    """
    if page.compression.name not in _PACKINGS:
        wanted, step = f"packed by one of {', '.join(_PACKINGS)}", "Export it unpacked, or packed by deflate"
        raise CtInertiaError.of("the TIFF", wanted, page.compression.name, path.name, step)
    for size in (page.tilewidth, page.tilelength) if page.is_tiled else (page.rowsperstrip,):
        if not isinstance(size, int) or size < 1:
            raise header_fault(path, "TIFF", f"strips or tiles of {size} voxels")


def check_offsets(page: Any, file: Path, file_bytes: int) -> None:
    """Refuse a page whose strips or tiles end behind the file, which a reader would make room for.

    Raises
    ------
    CtInertiaError
        Offsets are missing or negative, or lead beyond the end of the file.
    """
    numbers = (*page.dataoffsets, *page.databytecounts)
    if not all(isinstance(number, int) and number >= 0 for number in numbers):
        raise header_fault(file, "TIFF", "a page without usable offsets")
    ends = [a + b for a, b in zip(page.dataoffsets, page.databytecounts, strict=False)]
    if ends and max(ends) > file_bytes:
        raise CtInertiaError.of(
            "the TIFF",
            f"as long as its pages say ({max(ends)} bytes)",
            f"{file_bytes} bytes",
            file.name,
            "The file is truncated: copy or export it again",
        )
