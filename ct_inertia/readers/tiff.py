"""TIFF stacks: plain multi-page, ImageJ, OME and BigTIFF; memory-mapped where the data lie in one piece."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.errors import CtInertiaError
from ct_inertia.readers.checks import check_size, mm_per_unit, not_readable, settle_spacing
from ct_inertia.volume import Volume
from kinematics.errors import sentence
from kinematics.notices import Notice

if TYPE_CHECKING:
    import tifffile

Array = NDArray[np.float64]


def read_tiff(path: Path, spacing_mm: Sequence[float] | None = None) -> Volume:
    """Read a TIFF stack with its spacing from OME, ImageJ or resolution tags.

    Raises
    ------
    CtInertiaError
        Not readable, truncated, two-dimensional, coloured, complex, or without a complete spacing.

    Notes
    -----
    A TIFF says nothing of origin, direction or handedness: origin 0, identity, not confirmed. Plain
    resolution tags tell x and y only; the distance of slices is then asked for, not guessed.
    """
    import tifffile

    told = _Listener()
    logger = logging.getLogger("tifffile")
    logger.addHandler(told)
    propagate, logger.propagate = logger.propagate, False
    try:
        with tifffile.TiffFile(path) as tif:
            array = _array(tif, path)
            found, known = _spacing(tif)
            notices = _notices(tif, path)
            told.check(path)
    except CtInertiaError:
        told.check(path)
        raise
    except Exception as fault:
        raise not_readable(path, "TIFF", fault) from fault
    finally:
        logger.removeHandler(told)
        logger.propagate = propagate
    spacing, settled = settle_spacing(found, spacing_mm, path.name, known)
    return Volume(array, spacing, np.zeros(3), np.eye(3), source=path, notices=(*notices, *settled))


class _Listener(logging.Handler):
    """Collects what tifffile only logs about damaged files."""

    _WORDS = ("invalid", "truncat", "corrupt", "failed to", "unexpected", "does not match", "missing data")

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.faults: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if any(word in text.lower() for word in self._WORDS):
            self.faults.append(text.replace("\n", " ")[:200])

    def check(self, path: Path) -> None:
        if self.faults:
            raise CtInertiaError(
                sentence(
                    "the TIFF",
                    "complete",
                    f"a truncated or damaged file of {path.stat().st_size} bytes",
                    path.name,
                    "Copy or export it again",
                )
            ) from None


def _array(tif: tifffile.TiffFile, path: Path) -> NDArray[Any]:
    series = tif.series[0]
    page: Any = series.keyframe
    if page.photometric is not None and page.photometric.name in ("RGB", "PALETTE", "YCBCR", "CMYK"):
        raise CtInertiaError(
            sentence(
                "the volume", "grey values", "a colour (RGB) image", path.name, "Export it as grey values"
            )
        )
    axes, shape = series.axes, series.shape
    if "S" in axes and shape[axes.index("S")] > 1:
        raise CtInertiaError(
            sentence(
                "the volume", "grey values", "several samples per voxel", path.name, "Export one channel"
            )
        )
    kept = tuple(n for n in shape if n > 1)
    extra = [f"{n} {axis}" for axis, n in zip(axes, shape, strict=True) if axis in "CTS" and n > 1]
    if extra and len(kept) > 3:
        raise CtInertiaError(
            sentence(
                "the volume",
                "one stack",
                f"{', '.join(extra)} (channels or times)",
                path.name,
                "Export one channel and one time",
            )
        )
    if len(kept) != 3:
        raise CtInertiaError(
            sentence(
                "the volume",
                "three-dimensional",
                f"an image of shape {' x '.join(map(str, reversed(kept)))}",
                path.name,
                "Give the whole stack, or the folder of slices",
            )
        )
    dtype = np.dtype(tif.byteorder + series.dtype.char)
    size = path.stat().st_size
    packed = page.compression.name != "NONE"
    check_size(kept, dtype, size, packed, path.name)
    if series.dataoffset is not None:
        check_size(kept, dtype, size - series.dataoffset, False, path.name)
        return np.memmap(path, dtype=dtype, mode="r", offset=series.dataoffset, shape=kept)
    _check_strips(series, size, path)
    return np.asarray(series.asarray()).reshape(kept)


def _check_strips(series: Any, size: int, path: Path) -> None:
    for page in series.pages:
        if page is None:
            raise CtInertiaError(
                sentence("the TIFF", "complete", "a missing page", path.name, "Copy or export it again")
            )
        ends = [a + b for a, b in zip(page.dataoffsets, page.databytecounts, strict=False)]
        if ends and max(ends) > size:
            raise CtInertiaError(
                sentence(
                    "the TIFF",
                    f"as long as its pages say ({max(ends)} bytes)",
                    f"{size} bytes",
                    path.name,
                    "The file is truncated: copy or export it again",
                )
            )


def _spacing(tif: tifffile.TiffFile) -> tuple[Array | None, str]:
    """Return the spacing x, y, z in mm, or None and what the file does say."""
    if tif.is_ome and tif.ome_metadata:
        found = _ome_spacing(tif.ome_metadata)
        if found is not None:
            return found, ""
    plane = _resolution(tif)
    if tif.is_imagej and tif.imagej_metadata is not None:
        return _imagej_spacing(tif.imagej_metadata, plane)
    page: Any = tif.pages[0]
    unit = {2: 25.4, 3: 10.0}.get(int(getattr(page.tags.get("ResolutionUnit"), "value", 0) or 0))
    if plane is None or unit is None:
        return None, "the TIFF has no resolution with a unit"
    x, y = plane * unit
    if abs(x - 25.4 / 72.0) < 1e-6 or abs(x - 25.4 / 96.0) < 1e-6:
        return None, "the TIFF has the screen resolution only"
    return None, f"the TIFF says {x:.6g} x {y:.6g} mm in a slice but not the distance of slices"


def _resolution(tif: tifffile.TiffFile) -> Array | None:
    """Return units per pixel along x and y."""
    page: Any = tif.pages[0]
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


def _imagej_spacing(meta: dict[str, Any], plane: Array | None) -> tuple[Array | None, str]:
    unit = mm_per_unit(str(meta.get("unit", "")))
    depth = meta.get("spacing")
    if unit is None:
        return None, f"the ImageJ unit is {meta.get('unit') or 'not set'}"
    if plane is None or not depth:
        return None, "the ImageJ header has a unit but no complete spacing"
    return np.array([plane[0], plane[1], abs(float(depth))]) * unit, ""


def _ome_spacing(xml: str) -> Array | None:
    from xml.etree import ElementTree

    for element in ElementTree.fromstring(xml).iter():
        if element.tag.rsplit("}", 1)[-1] != "Pixels":
            continue
        values = []
        for axis in "XYZ":
            value = element.get(f"PhysicalSize{axis}")
            unit = mm_per_unit(element.get(f"PhysicalSize{axis}Unit", "µm"))
            if value is None or unit is None:
                return None
            values.append(float(value) * unit)
        return np.array(values)
    return None


def _notices(tif: tifffile.TiffFile, path: Path) -> list[Notice]:
    notices = []
    if len(tif.series) > 1 and not tif.series[0].is_pyramidal:
        text = f"{path.name} holds {len(tif.series)} images; the first stack was read."
        notices.append(Notice("first_series_read", text))
    meta = tif.imagej_metadata if tif.is_imagej else None
    if meta and float(meta.get("spacing") or 1.0) < 0.0:
        text = (
            f"{path.name} has a negative slice distance; its size was used and the order of slices kept. "
            f"Reverse them with --mirror z if the ear is a mirror image."
        )
        notices.append(Notice("negative_slice_distance", text))
    return notices
