"""TIFF stacks by tifffile: plain, ImageJ, OME (also in several files) and BigTIFF."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.header import (
    Header,
    beside,
    by_planes,
    several_values,
    unpack_once,
    wrong_header,
    wrong_size,
)
from ct_inertia.scan.place import believed_spacing, is_printer_resolution, mm_per_unit
from ct_inertia.scan.scan import check_grey_values
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError

_DAMAGE = ("invalid", "truncat", "corrupt", "failed to", "unexpected", "does not match", "missing data")
_EVEN_STEPS = 1e-3  # relative range of plane distances that is rounding


def open_tiff(path: Path) -> Header:
    """Open a TIFF stack.

    Raises
    ------
    StapeskitError
        Damaged, truncated, two-dimensional, coloured, or with channels or times.
    """
    import tifffile

    with listening(path):
        tif = tifffile.TiffFile(path)
        meta: dict[str, Any] = (tif.imagej_metadata or {}) if tif.is_imagej else {}
        _check_count(tif, int(meta.get("images") or 0), path)
        xml = (tif.ome_metadata or "") if tif.is_ome else ""
        files = _ome_files(path, xml)
    with listening(path):
        series = next((one for one in tif.series if sum(n > 1 for n in one.shape) > 2), tif.series[0])
        page: Any = series.keyframe
        shape = tuple(int(n) for n in series.shape if n > 1)
        dtype = np.dtype(page.parent.byteorder + ("u1" if series.dtype.kind == "b" else series.dtype.str[1:]))
        _check_kind(series, page, shape, dtype, path)
        header = Header(shape, dtype, files=files)
        read_page_tags(header, page, path)
        if not _ome_place(header, xml, list(tif.series).index(series), len(tif.series)) and meta:
            _imagej_place(header, meta, _resolution(page))
        _imagej_values(header, meta)
        pages = _pages(series, shape, path)
        header.planes = _raw_planes(series, pages, page, shape, dtype)
        if len(tif.series) > 1 and not tif.series[0].is_pyramidal:
            header.note(f"{path.name} holds {len(tif.series)} images; the first stack was read.")

    def decoded(source: Any, size: Sequence[int]) -> NDArray[Any]:
        with listening(path):
            values = np.asarray(source.asarray()).reshape(size)
        return values.astype(np.uint8 if values.dtype.kind == "b" else values.dtype.newbyteorder("="))

    if header.planes is None and pages:
        header.read = by_planes(pages, lambda one: decoded(one, shape[1:]))
    elif header.planes is None:
        header.read = unpack_once(lambda: decoded(series, shape))
    return header


@contextmanager
def listening(path: Path) -> Iterator[None]:
    """Raise the damage that tifffile only logs.

    Raises
    ------
    StapeskitError
        tifffile logged that the file is damaged.
    """
    heard: list[str] = []

    class Listener(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if any(word in record.getMessage().lower() for word in _DAMAGE):
                heard.append(record.getMessage())

    logger, listener = logging.getLogger("tifffile"), Listener(logging.WARNING)
    logger.addHandler(listener)
    propagate, logger.propagate = logger.propagate, False
    try:
        yield
    except Exception:
        if not heard:
            raise
    finally:
        logger.removeHandler(listener)
        logger.propagate = propagate
    if heard:
        got = f"a truncated or damaged file of {path.stat().st_size} bytes"
        raise StapeskitError.of("the TIFF", "complete", got, path.name, "Copy or export it again")


def _check_count(tif: Any, stated: int, path: Path) -> None:
    """Refuse a file of fewer slices than its ImageJ description says.

    Where one page describes all slices, they lie behind each other.
    """
    page: Any = tif.pages[0]
    held = len(tif.pages)
    if held == 1 and tif.is_imagej:
        plane = int(np.prod(page.shape)) * page.dtype.itemsize
        held = max(1, (path.stat().st_size - int(page.dataoffsets[0])) // max(plane, 1))
    if stated > held:
        wanted = f"as many slices as its description says ({stated})"
        step = "A program has split it, or it is truncated: export the whole stack again"
        raise StapeskitError.of("the TIFF", wanted, f"{held} slices", path.name, step)


def read_page_tags(header: Header, page: Any, path: Path) -> None:
    """Take the exchange of bright and dark, and spacing x, y from the resolution tags, from a page.

    Raises
    ------
    StapeskitError
        Its colours are a palette whose brightness does not grow with the number, as in lookup tables.
    """
    photometric = "" if page.photometric is None else page.photometric.name
    header.white_is_zero = photometric == "MINISWHITE"
    if photometric == "PALETTE":
        brightness = np.asarray(page.colormap, dtype=float).reshape(3, -1).sum(axis=0)
        if np.any(np.diff(brightness) < 0.0):
            got, step = "numbers of colours whose brightness does not grow with them", "Export grey values"
            raise StapeskitError.of("the volume", "grey values", got, path.name, step)
    tag = page.tags.get("ResolutionUnit")
    unit = {2: 25.4, 3: 10.0}.get(int(tag.value) if tag is not None and tag.value else 0, np.nan)
    x, y = _resolution(page) * unit
    header.spacing_mm = None
    if is_printer_resolution(x):
        header.known = "the TIFF has the resolution of a screen or printer only"
    elif np.isfinite(x + y):
        header.spacing_mm = np.array([x, y, np.nan])
        header.known = f"the TIFF says {x:.6g} x {y:.6g} mm in a slice but not the distance of slices"
    else:
        header.known = "the TIFF has no resolution with a unit"


def _check_kind(series: Any, page: Any, shape: Sequence[int], dtype: np.dtype[Any], path: Path) -> None:
    axes = dict(zip(series.axes, series.shape, strict=True))
    colours = page.photometric is not None and page.photometric.name in ("RGB", "YCBCR", "CMYK")
    if colours or axes.get("S", 1) > 1:
        raise several_values(path, "a colour (RGB) image or several samples per voxel")
    extra = [f"{axes[axis]} {axis}" for axis in "CT" if axes.get(axis, 1) > 1]
    if extra and (len(shape) > 3 or "Z" in axes):
        raise several_values(path, f"{', '.join(extra)} (channels or times)")
    check_grey_values(shape, dtype, path.name)


def _pages(series: Any, shape: Sequence[int], path: Path) -> list[Any]:
    """Return the pages of a series where there is one a plane; none where its tiles have a depth."""
    if len(series.pages) != shape[0]:
        return []
    pages = list(series.pages)
    if any(one is None for one in pages):
        raise wrong_header(path, "TIFF", "a missing plane: a file of the image is missing")
    return pages


def _raw_planes(
    series: Any, pages: Sequence[Any], page: Any, shape: Sequence[int], dtype: np.dtype[Any]
) -> list[tuple[Path, int]] | None:
    """Return file and byte of each uncompressed plane; None where planes must be decoded.

    Raises
    ------
    StapeskitError
        A file ends before its last plane.
    """
    plane = shape[1] * shape[2] * dtype.itemsize
    if page.compression.name != "NONE" or page.bitspersample < 8 or page.is_tiled or series.dtype.kind == "b":
        return None
    home = Path(page.parent.filehandle.path)
    if series.dataoffset is not None:
        planes = [(home, series.dataoffset + plane * k) for k in range(shape[0])]
    else:
        planes = []
        for one in pages:
            ends = np.cumsum([one.dataoffsets[0], *one.databytecounts])
            if not np.array_equal(ends[:-1], one.dataoffsets) or ends[-1] - ends[0] != plane:
                return None
            file = Path(one.parent.filehandle.path) if hasattr(one, "parent") else home
            planes.append((file, int(ends[0])))
    for file in dict.fromkeys(file for file, _ in planes):
        needed = max(start for one, start in planes if one == file) + plane
        if needed > file.stat().st_size:
            raise wrong_size(shape, needed, file.stat().st_size, file)
    return planes or None


def _resolution(page: Any) -> Array:
    """Return units per pixel along x and y (2,); NaN where the tags of a page do not state them."""
    pixels = np.full(2, np.nan)
    for k, name in enumerate(("XResolution", "YResolution")):
        tag = page.tags.get(name)
        if tag is not None and tag.value[0] > 0 and tag.value[1] > 0:
            pixels[k] = tag.value[1] / tag.value[0]
    return pixels


def _imagej_place(header: Header, meta: dict[str, Any], pixels: Array) -> None:
    """Set the place that ImageJ states; its origin is the voxel at 0, counted in voxels.

    Fiji writes a unit of its own for y and z where they differ from that of x.
    """
    unit = mm_per_unit(str(meta.get("unit", "")))
    if unit is None:
        header.spacing_mm, header.known = None, f"the ImageJ unit is {meta.get('unit') or 'not set'}"
        return
    units = np.array([unit, *(mm_per_unit(str(meta.get(f"{axis}unit", ""))) or unit for axis in "yz")])
    depth = float(meta.get("spacing") or np.nan)
    spacing, known = believed_spacing(np.array([*pixels, abs(depth)]), unit)
    spacing = spacing * units / unit
    header.spacing_mm = spacing
    header.known = known or f"the ImageJ header says {spacing[0]:.6g} x {spacing[1]:.6g} mm in a slice"
    zero = np.array([float(meta.get(f"{axis}origin") or 0.0) for axis in "xyz"])
    header.origin_mm = np.nan_to_num(-zero * spacing, posinf=0.0, neginf=0.0)
    if depth < 0.0:
        header.note(
            "ImageJ states a negative slice distance; its size was used and the order of slices kept. "
            "Reverse them with --mirror z if the ear is a mirror image."
        )


def _imagej_values(header: Header, meta: dict[str, Any]) -> None:
    """Take the straight line from stored to shown values, by which ImageJ keeps signed 16-bit pictures."""
    if "cf" not in meta:
        return
    if meta["cf"] != 0:
        header.note(f"ImageJ shows the grey values by its function {meta['cf']}; they were read as stored.")
    elif header.dtype.kind == "u":
        header.intercept, header.slope = (float(meta.get(f"c{k}", k)) for k in (0, 1))


def _ome_files(path: Path, xml: str) -> tuple[Path, ...]:
    """Return the files of an OME image, which lie in one folder.

    Raises
    ------
    StapeskitError
        One of several is missing.
    """
    names = dict.fromkeys(re.findall(r'FileName="([^"]*)"', xml))
    # One file alone may have been renamed since.
    return tuple(beside(path, name) for name in names) if len(names) > 1 else ()


def _ome_place(header: Header, xml: str, number: int, count: int) -> bool:
    """Set the place that OME-XML states of one of so many images; return False where it has none.

    Notes
    -----
    Lengths are in micrometres where no unit is given (OME schema 2016-06). A position in a reference frame
    without a length counts as 0. Where PhysicalSizeZ is missing, it is the distance of the planes.
    """
    try:
        root = ElementTree.fromstring(xml)
    except ElementTree.ParseError:
        return False
    images = [element for element in root.iter() if element.tag.rsplit("}", 1)[-1] == "Pixels"]
    if len(images) not in (0, 1, count):  # readers leave out images without planes
        header.spacing_mm = None
        header.known = f"the OME header has {len(images)} images, and which one this is is open"
        return True
    if not images:
        return False
    pixels = images[number if len(images) > 1 else 0]
    size = _lengths(pixels, "PhysicalSize", "µm")
    planes = [one for one in pixels if one.tag.rsplit("}", 1)[-1] == "Plane"]
    planes.sort(key=lambda one: int(one.get("TheZ", "0") or 0))
    places = np.array([_lengths(one, "Position", "reference frame") for one in planes]).reshape(-1, 3)
    if len(places):
        header.origin_mm = np.nan_to_num(places[0])
    steps = np.abs(np.diff(places[:, 2]))
    if np.isnan(size[2]) and len(steps) and np.ptp(steps) < _EVEN_STEPS * np.mean(steps):
        size[2] = np.mean(steps)
    size[size <= 0.0] = np.nan
    unit = mm_per_unit(pixels.get("PhysicalSizeZUnit", "µm")) or 1.0
    header.spacing_mm, unset = believed_spacing(size / unit, unit)
    known = [
        f"{axis} {value:.6g} mm" for axis, value in zip("xyz", header.spacing_mm, strict=True) if value > 0
    ]
    header.known = unset or f"the OME header says {', '.join(known) or 'no physical size'}"
    return True


def _lengths(element: Any, name: str, default_unit: str) -> Array:
    """Return lengths along x, y, z (3,) in mm; NaN where one is missing or has no unit of length."""
    found = np.full(3, np.nan)
    for k, key in enumerate(f"{name}{axis}" for axis in "XYZ"):
        factor = mm_per_unit(element.get(f"{key}Unit", default_unit))
        with suppress(ValueError, TypeError):  # no number, or none given
            found[k] = np.nan if factor is None else float(element.get(key)) * factor
    return found
