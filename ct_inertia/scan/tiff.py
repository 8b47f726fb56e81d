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

from ct_inertia.scan.numbers import note_gaps, numbered
from ct_inertia.scan.place import is_printer_resolution, mm_per_unit
from ct_inertia.scan.stored import (
    Stored,
    beside,
    by_planes,
    native,
    several_values,
    unpack_once,
    wrong_file,
)
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError

_DAMAGE = ("invalid", "truncat", "corrupt", "failed to", "unexpected", "does not match", "missing data")
_EVEN_STEPS = 1e-3  # relative range of plane distances that is rounding
_OTHER_STEPS = 0.5  # relative difference of a plane distance: half way to a plane left out, or turned round


def open_tiff(path: Path) -> Stored:
    """Open a TIFF stack of one grey value per voxel."""
    import tifffile

    with listening(path):
        # Otherwise pages are taken to be alike when the first, the second, the eighth and the last one are.
        tif: Any = tifffile.TiffFile(path, is_uniform=False)
        meta: dict[str, Any] = (tif.imagej_metadata or {}) if tif.is_imagej else {}
        _check_count(tif, int(meta.get("images") or 0), path)
        xml = (tif.ome_metadata or "") if tif.is_ome else ""
        names = dict.fromkeys(re.findall(r'FileName="([^"]*)"', xml))
        files = tuple(beside(path, name) for name in names) if len(names) > 1 else ()  # one may be renamed
    with listening(path):
        all_series: list[Any] = list(tif.series)
        number = next((k for k, one in enumerate(all_series) if sum(n > 1 for n in one.shape) > 2), 0)
        series, page = all_series[number], all_series[number].keyframe
        stored = Stored(_shape(series, page), _dtype(series, page), files=files)
        _describe(stored, page, meta)
        _ome_place(stored, xml, number, len(all_series))
        _note_labels(stored, meta.get("Labels") or (), path.name)
        if len(all_series) > 1 and not all_series[0].is_pyramidal:
            stored.note(f"{path.name} holds {len(all_series)} images; the first stack was read.")
        pages = list(series.pages) if len(series.pages) == stored.shape[0] else []
        if any(one is None for one in pages):
            raise wrong_file("TIFF", "a missing plane: a file of the image is missing")
        if series.kind == "generic" and len(set(np.diff([one.index for one in pages]))) > 1:
            got, step = "others between them, which would be left out", "Export the whole stack again"
            raise StapeskitError.of("the pages of the TIFF", "of one size and type", got, next_step=step)
        planes = _raw_planes(series, pages, page, stored)

    def decoded(source: Any, shape: Sequence[int]) -> NDArray[Any]:
        with listening(path):
            return native(np.asarray(source.asarray()).reshape(shape))

    if planes:
        stored.voxels = planes
    elif pages:
        stored.voxels = by_planes(pages, lambda one: decoded(one, stored.shape[1:]))
    else:  # its tiles have a depth
        stored.voxels = unpack_once(lambda: decoded(series, stored.shape))
    return stored


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
        held = max(1, (path.stat().st_size - int(page.dataoffsets[0])) // max(int(page.nbytes), 1))
    if stated > held:
        wanted = f"as many slices as its description says ({stated})"
        step = "A program has split it, or it is truncated: export the whole stack again"
        raise StapeskitError.of("the TIFF", wanted, f"{held} slices", next_step=step)


def _shape(series: Any, page: Any) -> tuple[int, ...]:
    """Return the axes of a series that are longer than 1; colours, channels and times are refused."""
    axes = dict(zip(series.axes, series.shape, strict=True))
    shape = tuple(int(n) for n in series.shape if n > 1)
    colours = page.photometric is not None and page.photometric.name in ("RGB", "YCBCR", "CMYK")
    if colours or axes.get("S", 1) > 1:
        raise several_values("a colour (RGB) image or several samples per voxel")
    extra = [f"{axes[axis]} {axis}" for axis in "CT" if axes.get(axis, 1) > 1]
    if extra and (len(shape) > 3 or "Z" in axes):
        raise several_values(f"{', '.join(extra)} (channels or times)")
    return shape


def _dtype(series: Any, page: Any) -> np.dtype[Any]:
    return np.dtype(page.parent.byteorder + ("u1" if series.dtype.kind == "b" else series.dtype.str[1:]))


def _raw_planes(series: Any, pages: Sequence[Any], page: Any, stored: Stored) -> list[tuple[Path, int]]:
    """Return file and byte of each plane that is stored as it is; none where planes must be decoded."""
    plane = int(np.prod(stored.shape[1:], dtype=np.int64)) * stored.dtype.itemsize
    if not page.is_final or page.is_tiled or series.dtype.kind == "b":
        return []
    if series.dataoffset is not None:
        file = Path(page.parent.filehandle.path)
        return [(file, int(series.dataoffset) + plane * k) for k in range(stored.shape[0])]
    planes = []
    for one in pages:
        ends = np.cumsum([one.dataoffsets[0], *one.databytecounts])
        if not np.array_equal(ends[:-1], one.dataoffsets) or ends[-1] - ends[0] != plane:
            return []
        planes.append((Path(one.parent.filehandle.path), int(ends[0])))
    return planes


def describe_slice(stored: Stored, path: Path) -> None:
    """Take what the first of many files of one slice says of grey values and of spacing along x and y."""
    import tifffile

    with listening(path), tifffile.TiffFile(path) as tif:
        _describe(stored, tif.pages[0], (tif.imagej_metadata or {}) if tif.is_imagej else {})


def _note_labels(stored: Stored, labels: Sequence[str], name: str) -> None:
    """Report gaps in the numbers of the slices that ImageJ keeps in their labels: a substack lacks some."""
    series = numbered([Path(label.split("\n")[0]) for label in labels])
    numbers = sorted({number for slices in series.values() for number, _ in slices})
    if len(series) == 1 and len(numbers) == len(labels) > 1:
        note_gaps(stored, numbers, name)


def _describe(stored: Stored, page: Any, meta: dict[str, Any]) -> None:
    """Take bright and dark, and spacing x, y, from the tags of a page, and what ImageJ says of them."""
    photometric = "" if page.photometric is None else page.photometric.name
    stored.white_is_zero = photometric == "MINISWHITE"
    if photometric == "PALETTE":
        brightness = np.asarray(page.colormap, dtype=float).reshape(3, -1).sum(axis=0)
        stored.coloured = bool(np.any(np.diff(brightness) < 0.0))
    tag = page.tags.get("ResolutionUnit")
    x, y = _resolution(page) * {2: 25.4, 3: 10.0}.get(int(tag.value or 0) if tag is not None else 0, np.nan)
    stored.known = "the TIFF has no resolution with a unit"
    if is_printer_resolution(x):
        stored.known = "the TIFF has the resolution of a screen or printer only"
    elif np.isfinite(x + y):
        stored.spacing_mm, stored.known = np.array([x, y, np.nan]), ""
    if meta:
        _imagej_place(stored, meta, _resolution(page))
        _imagej_values(stored, meta)


def _resolution(page: Any) -> Array:
    """Return units per pixel along x and y (2,); NaN where the tags of a page do not state them."""
    pixels = np.full(2, np.nan)
    for k, name in enumerate(("XResolution", "YResolution")):
        tag = page.tags.get(name)
        if tag is not None and tag.value[0] > 0 and tag.value[1] > 0:
            pixels[k] = tag.value[1] / tag.value[0]
    return pixels


def _imagej_place(stored: Stored, meta: dict[str, Any], pixels: Array) -> None:
    """Set the place that ImageJ states; its origin is the voxel at 0, counted in voxels.

    Fiji writes a unit of its own for y and z where they differ from that of x.
    """
    unit = mm_per_unit(str(meta.get("unit", "")))
    if unit is None:
        stored.spacing_mm, stored.known = None, f"the ImageJ unit is {meta.get('unit') or 'not set'}"
        return
    units = np.array([unit, *(mm_per_unit(str(meta.get(f"{axis}unit", ""))) or unit for axis in "yz")])
    depth = float(meta.get("spacing") or np.nan)
    spacing = np.array([*pixels, depth if depth > 0.0 else np.nan]) * units
    stored.spacing_mm, stored.unit_mm = spacing, float(units[2])
    # Planes that were taken downwards: their order is open.
    stored.known = f"slices {depth * units[2]:.6g} mm apart" if depth < 0.0 else ""
    zero = np.array([float(meta.get(f"{axis}origin") or 0.0) for axis in "xyz"])
    stored.origin_mm = np.nan_to_num(-zero * spacing, posinf=0.0, neginf=0.0)


def _imagej_values(stored: Stored, meta: dict[str, Any]) -> None:
    """Take the straight line from stored to shown values, by which ImageJ keeps signed 16-bit pictures."""
    if meta.get("cf", 0) != 0:
        stored.note(f"ImageJ shows the grey values by its function {meta['cf']}; they were read as stored.")
    elif "cf" in meta and stored.dtype.kind == "u":
        stored.intercept, stored.slope = (float(meta.get(f"c{k}", k)) for k in (0, 1))


def _ome_place(stored: Stored, xml: str, number: int, count: int) -> None:
    """Set the place that OME-XML states of one of so many images.

    Lengths are in micrometres where no unit is given (OME schema 2016-06). A position in a reference frame
    without a length counts as 0. Where PhysicalSizeZ is missing, it is the distance of the planes; where the
    two differ, planes were left out or turned round, and neither is believed.
    """
    images = []
    with suppress(ElementTree.ParseError):
        images = ElementTree.fromstring(xml).findall(".//{*}Pixels")
    if len(images) not in (0, 1, count):  # readers leave out images without planes
        stored.spacing_mm = None
        stored.known = f"the OME header has {len(images)} images, and which one this is is open"
    if len(images) not in (1, count):
        return
    pixels = images[number if len(images) > 1 else 0]
    size = _lengths(pixels, "PhysicalSize", "µm")
    planes = sorted(pixels.findall("{*}Plane"), key=lambda one: int(one.get("TheZ", "0") or 0))
    places = np.array([_lengths(one, "Position", "reference frame") for one in planes]).reshape(-1, 3)
    if len(places):
        stored.origin_mm = np.nan_to_num(places[0])
    steps = np.diff(places[:, 2])
    if np.isnan(size[2]) and len(steps) and np.ptp(steps) < _EVEN_STEPS * np.abs(np.mean(steps)):
        size[2] = np.abs(np.mean(steps))
    size[size <= 0.0] = np.nan
    differ = steps[np.abs(steps - size[2]) > _OTHER_STEPS * size[2]]  # never where one is unknown
    stored.spacing_mm, stored.known = size, ""
    stored.unit_mm = mm_per_unit(pixels.get("PhysicalSizeZUnit", "µm")) or 1.0
    if len(differ):
        size[2] = np.nan
        stored.known = f"planes that are {differ[0]:.6g} mm apart"


def _lengths(element: Any, name: str, default_unit: str) -> Array:
    """Return lengths along x, y, z (3,) in mm; NaN where one is missing or has no unit of length."""
    found = np.full(3, np.nan)
    for k, key in enumerate(f"{name}{axis}" for axis in "XYZ"):
        factor = mm_per_unit(element.get(f"{key}Unit", default_unit))
        with suppress(ValueError, TypeError):  # no number, or none given
            found[k] = np.nan if factor is None else float(element.get(key)) * factor
    return found
