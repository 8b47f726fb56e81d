"""TIFF stacks by tifffile: plain, ImageJ, OME (also in several files) and BigTIFF."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.opened import (
    Opened,
    RawPlanes,
    ReadOptions,
    beside,
    looks_like,
    no_data_file,
    several_values,
    too_short,
    wrong_header,
)
from ct_inertia.scan.place import believed_spacing, is_printer_resolution, mm_per_unit
from ct_inertia.scan.scan import Fetch, check_grey_values
from ct_inertia.scan.streams import by_planes, unpack_once
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    import tifffile

_DAMAGE = ("invalid", "truncat", "corrupt", "failed to", "unexpected", "does not match", "missing data")
_COLOURS = ("RGB", "YCBCR", "CMYK")
_OTHER_AXES = "CTS"  # channels, times, samples
_EVEN_STEPS = 1e-3  # relative range of plane distances that is rounding


def open_file(path: Path, _: ReadOptions) -> Opened:
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
        stated, held = int(meta.get("images") or 0), _held_slices(tif, path)
        xml = tif.ome_metadata if tif.is_ome else None
    if max(stated, 1) > held:
        wanted = f"as many slices as its description says ({stated})"
        step = "A program has split it, or it is truncated: export the whole stack again"
        raise StapeskitError.of("the TIFF", wanted, f"{held} slices", path.name, step)
    files = _ome_files(path, xml)
    with listening(path):
        series = next((one for one in tif.series if sum(n > 1 for n in one.shape) > 2), tif.series[0])
        page: Any = series.keyframe
        shape = tuple(int(n) for n in series.shape if n > 1)
        dtype = np.dtype(page.parent.byteorder + ("u1" if series.dtype.kind == "b" else series.dtype.str[1:]))
        _check_kind(series, page, shape, dtype, path)
        opened = Opened(shape, dtype, files=files, white_is_zero=white_is_zero(page))
        place = _ome_place(xml, list(tif.series).index(series), len(tif.series)) if xml else None
        if place is None and meta:
            place = _imagej_place(meta, _resolution(page))
        if place is None:
            spacing, known = plane_spacing(page)
            place = spacing, np.zeros(3), known
        opened.spacing_mm, opened.origin_mm, opened.known = place
        opened.planes = _raw_planes(series, page, shape, dtype, path)
        several = len(tif.series) > 1 and not tif.series[0].is_pyramidal
    if opened.planes is None:
        opened.read = _decoder(series, shape, path)
    if several:
        text = f"{path.name} holds {len(tif.series)} images; the first stack was read."
        opened.notices.append(Notice("file_read", text))
    if float(meta.get("spacing") or 1.0) < 0.0:
        text = (
            f"{path.name} has a negative slice distance; its size was used and the order of slices kept. "
            f"Reverse them with --mirror z if the ear is a mirror image."
        )
        opened.notices.append(Notice("file_read", text))
    return opened


@contextmanager
def listening(path: Path) -> Iterator[None]:
    """Raise the damage that tifffile only logs.

    Raises
    ------
    StapeskitError
        tifffile raised, or logged that the file is damaged.
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
    except (StapeskitError, MemoryError):
        if not heard:
            raise
    except Exception as fault:
        heard.append(str(fault))
    finally:
        logger.removeHandler(listener)
        logger.propagate = propagate
    if heard:
        got = f"a truncated or damaged file of {path.stat().st_size} bytes{looks_like(path, 'TIFF')}"
        raise StapeskitError.of("the TIFF", "complete", got, path.name, "Copy or export it again")


def white_is_zero(page: Any) -> bool:
    """Return whether a page says that its lowest grey value is shown white (WhiteIsZero of TIFF 6.0)."""
    return page.photometric is not None and page.photometric.name == "MINISWHITE"


def check_palette(page: Any, path: Path) -> None:
    """Refuse a page with a colour palette, unless brightness grows with the number, as in lookup tables.

    Raises
    ------
    StapeskitError
        It does not.
    """
    if page.photometric is None or page.photometric.name != "PALETTE":
        return
    if np.any(np.diff(np.asarray(page.colormap, dtype=float).reshape(3, -1).sum(axis=0)) < 0.0):
        got = "numbers of colours whose brightness does not grow with them"
        raise StapeskitError.of("the volume", "grey values", got, path.name, "Export it as grey values")


def plane_spacing(page: Any) -> tuple[Array | None, str]:
    """Return spacing x, y and NaN, mm, that the resolution tags of a page state, and what they say of it."""
    pixels = _resolution(page)
    tag = page.tags.get("ResolutionUnit")
    unit = {2: 25.4, 3: 10.0}.get(int(tag.value) if tag is not None and tag.value else 0)
    if pixels is None or unit is None:
        return None, "the TIFF has no resolution with a unit"
    x, y = pixels * unit
    if is_printer_resolution(x):
        return None, "the TIFF has the resolution of a screen or printer only"
    return (
        np.array([x, y, np.nan]),
        f"the TIFF says {x:.6g} x {y:.6g} mm in a slice but not the distance of slices",
    )


def _resolution(page: Any) -> Array | None:
    """Return units per pixel along x and y (2,), where the tags of a page state both."""
    pair = []
    for name in ("XResolution", "YResolution"):
        tag = page.tags.get(name)
        if tag is None or not tag.value[0] > 0 or not tag.value[1] > 0:
            return None
        pair.append(tag.value[1] / tag.value[0])
    return np.array(pair)


def _ome_files(path: Path, xml: str | None) -> tuple[Path, ...]:
    """Return the files of an OME image, which lie in one folder.

    Raises
    ------
    StapeskitError
        One of several is missing.
    """
    import re

    named = [beside(path, name) for name in dict.fromkeys(re.findall(r'FileName="([^"]*)"', xml or ""))]
    missing = [file for file in named if not file.is_file()]
    if missing and len(named) > 1:  # one alone may have been renamed since
        raise no_data_file(missing[0], path.name)
    return tuple(dict.fromkeys([path, *(file for file in named if file.is_file())]))


def _check_kind(series: Any, page: Any, shape: Sequence[int], dtype: np.dtype[Any], path: Path) -> None:
    check_palette(page, path)
    axes = dict(zip(series.axes, series.shape, strict=True))
    if (page.photometric is not None and page.photometric.name in _COLOURS) or axes.get("S", 1) > 1:
        raise several_values(path, "a colour (RGB) image or several samples per voxel")
    extra = [f"{n} {axis}" for axis, n in axes.items() if axis in _OTHER_AXES and n > 1]
    if extra and (len(shape) > 3 or "Z" in axes):
        raise several_values(path, f"{', '.join(extra)} (channels or times)")
    check_grey_values(tuple(shape), dtype, path.name)


def _held_slices(tif: tifffile.TiffFile, path: Path) -> int:
    """Return how many slices a file holds; of ImageJ one page describes those that lie behind each other."""
    page: Any = tif.pages[0]
    if len(tif.pages) > 1 or not tif.is_imagej:
        return len(tif.pages)
    plane = int(np.prod(page.shape)) * page.dtype.itemsize
    return max(1, (path.stat().st_size - int(page.dataoffsets[0])) // max(plane, 1))


def _raw_planes(
    series: Any, page: Any, shape: Sequence[int], dtype: np.dtype[Any], path: Path
) -> RawPlanes | None:
    """Return where uncompressed planes lie; None where they must be decoded.

    Raises
    ------
    StapeskitError
        The file ends before its last plane.
    """
    plane = shape[1] * shape[2] * dtype.itemsize
    if page.compression.name != "NONE" or page.bitspersample < 8 or page.is_tiled or series.dtype.kind == "b":
        return None
    if series.dataoffset is not None:
        home = Path(page.parent.filehandle.path)
        every = [(home, series.dataoffset + plane * k) for k in range(shape[0])]
    elif len(series.pages) != shape[0]:
        return None
    else:
        every = []
        for one in _pages(series, path):
            ends = np.cumsum([one.dataoffsets[0], *one.databytecounts])
            if not np.array_equal(ends[:-1], one.dataoffsets) or ends[-1] - ends[0] != plane:
                return None
            home = Path(one.parent.filehandle.path) if hasattr(one, "parent") else path
            every.append((home, int(one.dataoffsets[0])))
    files = tuple(dict.fromkeys(file for file, _ in every))
    number = np.array([files.index(file) for file, _ in every])
    offset = np.array([start for _, start in every])
    for k, file in enumerate(files):
        needed, stored = int(offset[number == k].max()) + plane, file.stat().st_size
        if needed > stored:
            raise too_short(shape, needed, stored, file.name)
    return RawPlanes(files, number, offset)


def _pages(series: Any, path: Path) -> list[Any]:
    """Return the pages of a series, one a plane.

    Raises
    ------
    StapeskitError
        One is in a file that is missing.
    """
    pages = list(series.pages)
    if any(one is None for one in pages):
        raise wrong_header(path, "TIFF", "a missing plane: a file of the image is missing")
    return pages


def _decoder(series: Any, shape: Sequence[int], path: Path) -> Fetch:
    """Return a function that decodes planes one by one, or the whole image where its tiles have a depth."""

    def decode(source: Any) -> NDArray[Any]:
        with listening(path):
            values = np.asarray(source.asarray())
        return values.astype(np.uint8 if values.dtype.kind == "b" else values.dtype.newbyteorder("="))

    if len(series.pages) != shape[0]:
        return unpack_once(lambda: decode(series).reshape(shape))
    return by_planes(_pages(series, path), lambda page: decode(page).reshape(shape[1:]))


def _imagej_place(meta: dict[str, Any], pixels: Array | None) -> tuple[Array | None, Array, str]:
    """Return the place that ImageJ states; its origin is the voxel at 0, counted in voxels."""
    unit = mm_per_unit(str(meta.get("unit", "")))
    if unit is None:
        return None, np.zeros(3), f"the ImageJ unit is {meta.get('unit') or 'not set'}"
    depth = abs(float(meta.get("spacing") or np.nan))
    # Fiji writes a unit of its own for y and z where they differ from that of x.
    units = np.array([unit, *(mm_per_unit(str(meta.get(f"{axis}unit", ""))) or unit for axis in "yz")])
    spacing, known = believed_spacing(
        np.array([*(pixels if pixels is not None else [np.nan] * 2), depth]), unit
    )
    spacing = spacing * units / unit
    if not known and not np.all(np.isfinite(spacing)):
        plane = f"{spacing[0]:.6g} x {spacing[1]:.6g} mm in a slice"
        known = f"the ImageJ header has a unit but no complete spacing ({plane})"
    zero = np.array([float(meta.get(f"{axis}origin") or 0.0) for axis in "xyz"])
    return spacing, np.nan_to_num(-zero * spacing, posinf=0.0, neginf=0.0), known


def _ome_place(xml: str, number: int, count: int) -> tuple[Array | None, Array, str] | None:
    """Return the place that OME-XML states, or None where it has no image.

    Notes
    -----
    Lengths are in micrometres where no unit is given (OME schema 2016-06). A position in a reference frame
    without a length counts as 0. Where PhysicalSizeZ is missing, it is the distance of the planes.
    """
    from xml.etree import ElementTree

    try:
        root = ElementTree.fromstring(xml)
    except ElementTree.ParseError:
        return None
    images = [element for element in root.iter() if element.tag.rsplit("}", 1)[-1] == "Pixels"]
    if len(images) > 1 and len(images) != count:  # readers leave out images without planes
        return None, np.zeros(3), f"the OME header has {len(images)} images, and which one this is is open"
    if not images:
        return None
    pixels = images[number if len(images) > 1 else 0]
    size = _lengths(pixels, "PhysicalSize", "µm")
    planes = [one for one in pixels if one.tag.rsplit("}", 1)[-1] == "Plane"]
    planes.sort(key=lambda one: int(one.get("TheZ", "0") or 0))
    places = np.array([_lengths(one, "Position", "reference frame") for one in planes]).reshape(-1, 3)
    origin = np.nan_to_num(places[0]) if len(places) else np.zeros(3)
    if np.isnan(size[2]) and len(places) > 1:
        steps = np.abs(np.diff(places[:, 2]))
        if np.ptp(steps) < _EVEN_STEPS * np.mean(steps):
            size[2] = np.mean(steps)
    size[size <= 0.0] = np.nan
    unit = mm_per_unit(pixels.get("PhysicalSizeZUnit", "µm")) or 1.0
    size, unset = believed_spacing(size / unit, unit)
    known = [f"{axis} {value:.6g} mm" for axis, value in zip("xyz", size, strict=True) if value > 0.0]
    return size, origin, unset or f"the OME header says {', '.join(known) or 'no physical size'}"


def _lengths(element: Any, name: str, default_unit: str) -> Array:
    """Return lengths along x, y, z (3,) in mm; NaN where one is missing or has no unit of length."""
    found = np.full(3, np.nan)
    for k, key in enumerate(f"{name}{axis}" for axis in "XYZ"):
        factor = mm_per_unit(element.get(f"{key}Unit", default_unit))
        with suppress(ValueError, TypeError):  # no number, or none given
            found[k] = np.nan if factor is None else float(element.get(key)) * factor
    return found
