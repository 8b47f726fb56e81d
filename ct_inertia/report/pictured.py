"""The data of pictures beside mass.json: surfaces, grey values and labels around the stapes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.bodies import OTHER_BONE, PLATE, STAPES, Grey, Mask
from ct_inertia.surface.surface import Surface
from stapeskit.arrays import Array
from stapeskit.report.scene3d import decimate

if TYPE_CHECKING:
    from ct_inertia.results import MassResult
    from ct_inertia.scan.scan import Scan

_FACES = 6000  # of a drawn stapes: each is less than a millimetre on paper
_SMOOTH_VOXELS = 1.0  # of labels for a picture of their surface
_READING = ("spacing_mm", "mirror", "nan_as_air", "shape", "dtype", "byte_order", "header_bytes")
_MARGIN_MM = 0.5  # around the stapes: a choice for the eye


@dataclass(frozen=True)
class Slices:
    """Grey values and labels [z, y, x] around the stapes; index x, y, z to scan coordinates, mm, (4, 4)."""

    grey: Grey
    labels: NDArray[np.uint8]
    scan_from_index: Array

    def index_points(self, points_mm: Array) -> Array:
        """Map scan coordinates (..., 3) to index x, y, z of the box."""
        back = np.linalg.inv(self.scan_from_index)
        return np.asarray(points_mm @ back[:3, :3].T + back[:3, 3])

    @cached_property
    def window(self) -> tuple[float, float]:
        """Grey values shown black and white."""
        inside = self.grey[self.labels == STAPES]
        return float(np.percentile(self.grey, 1.0)), float(np.percentile(inside, 97.0))


@dataclass(frozen=True)
class Pictured:
    """What the pictures need in addition to mass.json.

    Attributes
    ----------
    slices : Slices or None
        None for a mesh, or where the scan is not at hand.
    """

    stapes: Surface
    plate: Surface | None = None
    slices: Slices | None = None

    @cached_property
    def light_stapes(self) -> Surface:
        """The stapes with few triangles, for views on a screen."""
        return Surface(*decimate(self.stapes.vertices_mm, self.stapes.faces, _FACES))

    @cached_property
    def bone(self) -> Surface | None:
        """The other bone around the stapes, as labelled."""
        if self.slices is None:
            return None
        return _surface_of(self.slices.labels == OTHER_BONE, self.slices.scan_from_index, False)


def pictured_of(result: MassResult) -> Pictured:
    """Return what the pictures of a result need."""
    if result.body is None:
        return Pictured(result.stapes, result.plate)
    box = result.body.labelled.box
    slices = Slices(box.grey, result.body.labelled.numbers(), box.scan_from_index)
    return Pictured(result.stapes, result.plate, slices)


def pictured_from(folder: Path, content: Mapping[str, Any], scan: Path | None = None) -> Pictured:
    """Return what the pictures need from the files of a result and the scan that it came from.

    ``content`` is that of the mass.json in the folder; without the scan there are no pictures of slices.

    Raises
    ------
    StapeskitError
        A file is missing or damaged.
    """
    from ct_inertia.surface.repair import read_mesh

    surfaces = {}
    for name in ("stapes", "plate"):
        path = folder / f"{name}.ply"
        if name == "stapes" or path.is_file():
            surfaces[name] = read_mesh(path)
    slices, plate = None, surfaces.get("plate")
    labels_file = content.get("labels_file")
    if labels_file and (folder / labels_file).is_file():
        from ct_inertia.scan.open_scan import open_labels

        labels, grid = open_labels(folder / labels_file)
        plate = _surface_of(labels == PLATE, grid.scan_from_index, True) if plate is None else plate
        slices = None if scan is None else _slices(labels, grid, scan, content)
    return Pictured(surfaces["stapes"], plate, slices)


def _surface_of(mask: Mask, scan_from_index: Array, largest: bool) -> Surface | None:
    """Return the surface of a mask [z, y, x] for the eye, of its largest piece or all; None if empty."""
    from ct_inertia.surface.contour import contour
    from ct_inertia.voxels.fields import smooth
    from ct_inertia.voxels.masks import used_box, widened

    used = used_box(mask)
    if used is None:
        return None
    box = widened(used, np.ceil(5.0 * _SMOOTH_VOXELS))
    field = smooth(mask[box].astype(np.float32), np.full(3, _SMOOTH_VOXELS))
    transform = scan_from_index.copy()
    transform[:3, 3] += scan_from_index[:3, :3] @ [part.start for part in box[::-1]]
    return contour(field, transform, 0.5, largest)


def _slices(
    labels: NDArray[np.integer[Any]], grid: Scan, scan_file: Path, content: Mapping[str, Any]
) -> Slices:
    from ct_inertia.options import MassOptions
    from ct_inertia.scan.open_scan import open_scan
    from ct_inertia.voxels.masks import used_box

    given = content["provenance"]["parameters"]
    known = {key: given[key] for key in _READING if key in given}
    options = MassOptions.read({**known, "file": scan_file}, "mass.json", {key: key for key in given})
    scan = open_scan(scan_file, options.spacing_mm, options.mirror, options.nan_as_air, options.raw)
    used = used_box(labels == STAPES) or (slice(0, 1),) * 3
    z, y, x = (
        slice(max(part.start - int(np.ceil(_MARGIN_MM / h)), 0), part.stop + int(np.ceil(_MARGIN_MM / h)))
        for part, h in zip(used, grid.spacing_mm[::-1], strict=True)
    )
    labelled = grid.part((z, y, x))
    first = np.rint(scan.index_points(labelled.origin_mm)).astype(np.int64)
    ends = zip(first[::-1], (first + labelled.size)[::-1], strict=True)
    seen = scan.part(tuple(slice(int(begin), int(end)) for begin, end in ends))  # type: ignore[arg-type]
    grey, shown = seen.read().astype(np.float32), labels[z, y, x].astype(np.uint8)
    return Slices(grey, shown, seen.scan_from_index)
