"""Voxel size and origin from OME-XML."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from legacy.ct_inertia.readers.checks import mm_per_unit
from legacy.stapeskit.arrays import Array

_UM = "µm"


@dataclass(frozen=True)
class Calibration:
    """Voxel size and origin of a file.

    Attributes
    ----------
    spacing_mm : ndarray, (3,), or None
        x, y, z; NaN where the file does not say it, None where it says nothing.
    origin_mm : ndarray, (3,)
        Scan coordinates of the first voxel's centre.
    known : str
        The part of an incomplete spacing that the file has, for the message.
    """

    spacing_mm: Array | None
    origin_mm: Array = field(default_factory=lambda: np.zeros(3))
    known: str = ""


def ome_calibration(xml: str, number: int, count: int, shape: Sequence[int]) -> Calibration | None:
    """Return voxel size and place of an image, or None when the XML has none.

    Parameters
    ----------
    xml : str
    number, count : int
        Which image it is, from 0, and how many were found in the file.
    shape : sequence of int
        Its size, in any order of the axes.

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
    images = [element for element in root.iter() if _name(element.tag) == "Pixels"]
    if not images:
        return None
    if len(images) > 1 and len(images) != count:
        # Images without planes are left out by readers: the one meant has the same size.
        images = [image for image in images if _size(image) == _sorted(shape)]
        if len(images) != 1:
            return Calibration(None, known="the OME header has several images, and which one is this is open")
    pixels = images[number if len(images) > 1 else 0]
    sizes = [_length(pixels.get(f"PhysicalSize{a}"), pixels.get(f"PhysicalSize{a}Unit", _UM)) for a in "XYZ"]
    planes = sorted(
        (p for p in pixels if _name(p.tag) == "Plane"), key=lambda p: int(p.get("TheZ", "0") or 0)
    )
    places = [
        [_length(plane.get(f"Position{a}"), plane.get(f"Position{a}Unit", "reference frame")) for a in "XYZ"]
        for plane in planes
    ]
    origin = np.array([value or 0.0 for value in places[0]] if places else [0.0] * 3)
    if sizes[2] is None and len(places) > 1:
        heights = np.array([place[2] if place[2] is not None else np.nan for place in places])
        steps = np.abs(np.diff(heights))
        if np.all(np.isfinite(steps)) and np.ptp(steps) < 1e-3 * np.mean(steps):
            sizes[2] = float(np.mean(steps))
    lengths = [value for value in sizes if value is not None and value > 0.0]
    if len(lengths) < 3:
        shown = ", ".join(f"{a} {v:.6g} mm" for a, v in zip("xyz", sizes, strict=True) if v)
        part = np.array([value if value is not None and value > 0.0 else np.nan for value in sizes])
        return Calibration(part, origin, f"the OME header says {shown or 'no physical size'}")
    return Calibration(np.array(lengths), origin)


def _size(image: Any) -> list[int]:
    return _sorted(int(image.get(f"Size{axis}", "1") or 1) for axis in "XYZCT")


def _sorted(shape: Iterable[int]) -> list[int]:
    """Return the sizes above 1, ascending."""
    return sorted(n for n in shape if n > 1)


def _name(tag: str) -> str:
    return tag.rsplit("}", 1)[-1]


def _length(value: str | None, unit: str | None) -> float | None:
    factor = mm_per_unit(unit)
    try:
        return None if value is None or factor is None else float(value) * factor
    except ValueError:
        return None
