"""The segmentation over slices: grey values with label outlines, in footplate planes and scan planes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.bodies import OTHER_BONE, PLATE, STAPES, LabelledVolume
from legacy.ct_inertia.report.colours import BODY_COLOURS, CUT
from legacy.ct_inertia.volume.grid_operations import used_box
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import RigidTransform

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


NAMES = {STAPES: "stapes", PLATE: "plate", OTHER_BONE: "other bone", CUT: "cut"}
# Border of the pictures around the stapes, and their width: choices for the eye.
_MARGIN_MM = 0.5
_PIXELS = 340


def slices_figure(crop: Crop, footplate: RigidTransform) -> Figure:
    """Draw six slices.

    Parameters
    ----------
    crop : Crop
    footplate : RigidTransform
        scan_from_footplate.
    """
    from matplotlib.lines import Line2D

    from legacy.stapeskit.page.page import new_figure

    drawing = new_figure(11.6, 8.2)
    axes = drawing.subplots(2, 3)
    corners = footplate.inverse().points(crop.stapes_points())
    low, high = corners.min(axis=0) - _MARGIN_MM, corners.max(axis=0) + _MARGIN_MM
    inside = 0.12
    for place, (right, up, normal, level) in enumerate(((0, 1, 2, 0.0), (2, 1, 0, 0.0), (0, 2, 1, inside))):
        _oblique(axes[0, place], crop, footplate, (right, up, normal), level, low, high)
    for place, axis in enumerate((2, 1, 0)):
        _native(axes[1, place], crop, axis)
    present = [label for label in NAMES if np.any(crop.mask(label))]
    handles = [Line2D([], [], color=BODY_COLOURS[label], label=NAMES[label]) for label in present]
    drawing.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return drawing


class Crop:
    """The part of scan and labels around the stapes, small enough to resample.

    Parameters
    ----------
    labelled : LabelledVolume
        Its grid is the scan with the grey values.
    """

    def __init__(self, labelled: LabelledVolume) -> None:
        volume = labelled.grid
        places = np.argwhere(labelled.labels == STAPES)[:, ::-1] + labelled.first_index
        margin = np.ceil((_MARGIN_MM + 0.3) / volume.spacing_mm).astype(np.int64)
        self.low = np.maximum(places.min(axis=0) - margin, 0)
        self.high = np.minimum(places.max(axis=0) + margin + 1, volume.size)
        (x0, y0, z0), (x1, y1, z1) = self.low, self.high
        self.grey = np.nan_to_num(np.asarray(volume.array[z0:z1, y0:y1, x0:x1], dtype=np.float32))
        self.labels = np.zeros(self.grey.shape, dtype=np.uint8)
        first, last = labelled.first_index, labelled.first_index + labelled.labels.shape[::-1]
        begin, end = np.maximum(first, self.low), np.minimum(last, self.high)
        target = tuple(
            slice(b, e) for b, e in zip((begin - self.low)[::-1], (end - self.low)[::-1], strict=True)
        )
        source = tuple(slice(b, e) for b, e in zip((begin - first)[::-1], (end - first)[::-1], strict=True))
        self.labels[target] = labelled.labels[source]
        self.volume = volume
        inner = self.grey[self.labels == STAPES]
        self.window = (float(np.percentile(self.grey, 1)), float(np.percentile(inner, 97)))
        self.middle = _largest_sections(self.labels == STAPES)
        self.cut = _voxels_at_cut(self.labels)
        if np.any(self.cut):
            self.middle = _middle_of_largest(self.cut)

    def mask(self, label: int) -> NDArray[np.bool_]:
        """Return the voxels [z, y, x] of one label, or of the cut between stapes and other bone."""
        return self.cut if label == CUT else np.asarray(self.labels == label)

    def stapes_points(self) -> Array:
        """Return scan coordinates (n, 3) of the stapes' voxels, mm."""
        places = np.argwhere(self.labels == STAPES)[:, ::-1]
        return self.volume.scan_points(places + self.low)

    def sample(self, points_mm: Array) -> tuple[Array, dict[int, Array]]:
        """Return grey values and the share of each label at scan points (..., 3)."""
        from scipy.ndimage import map_coordinates

        index = (self.volume.index_points(points_mm) - self.low)[..., ::-1]
        places = np.moveaxis(index, -1, 0)
        grey = map_coordinates(self.grey, places, order=1, mode="constant", cval=self.window[0])
        shares = {
            label: map_coordinates(self.mask(label).astype(np.float32), places, order=1)
            for label in NAMES
            if np.any(self.mask(label))
        }
        return np.asarray(grey), shares


def _voxels_at_cut(labels: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return the voxels on both sides of the border where the stapes was cut off other bone."""
    from scipy.ndimage import binary_dilation

    cut = np.zeros(labels.shape, dtype=bool)
    around = used_box(labels == STAPES)
    if around is None:
        return cut
    near = tuple(slice(max(part.start - 1, 0), part.stop + 1) for part in around)
    stapes, other = labels[near] == STAPES, labels[near] == OTHER_BONE
    cut[near] = (stapes & binary_dilation(other)) | (other & binary_dilation(stapes))
    return cut


def _largest_sections(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the slices across x, y, z in which a mask has the largest area."""
    areas = [np.count_nonzero(mask, axis=tuple(k for k in range(3) if k != 2 - axis)) for axis in range(3)]
    return np.array([int(np.argmax(area)) for area in areas], dtype=np.int64)


def _middle_of_largest(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the index x, y, z of the voxel nearest to the middle of a mask's largest connected patch."""
    from scipy.ndimage import label

    patches, _ = label(mask, structure=np.ones((3, 3, 3)))
    index = np.argwhere(patches == int(np.argmax(np.bincount(patches.ravel())[1:])) + 1)
    return np.asarray(index[np.argmin(np.linalg.norm(index - index.mean(axis=0), axis=1))][::-1])


def _oblique(
    axes: Axes,
    crop: Crop,
    footplate: RigidTransform,
    directions: tuple[int, int, int],
    level: float,
    low: Array,
    high: Array,
) -> None:
    right, up, normal = directions
    u = np.linspace(low[right], high[right], _PIXELS)
    v = np.linspace(low[up], high[up], _PIXELS)
    points = np.zeros((_PIXELS, _PIXELS, 3))
    points[..., right], points[..., up], points[..., normal] = u[None, :], v[:, None], level
    grey, shares = crop.sample(footplate.points(points))
    extent = (u[0], u[-1], v[0], v[-1])
    _draw(axes, crop, grey, shares, extent, (u, v))
    axes.set_title(f"footplate frame, {'xyz'[normal]} = {level:g} mm", fontsize=10)
    axes.set(xlabel=f"{'xyz'[right]} (mm)", ylabel=f"{'xyz'[up]} (mm)")


def _native(axes: Axes, crop: Crop, axis: int) -> None:
    right, up = (index for index in range(3) if index != axis)
    number = int(crop.middle[axis])
    cut = [slice(None)] * 3
    cut[2 - axis] = number  # type: ignore[call-overload]
    grey = crop.grey[tuple(cut)]
    spacing = crop.volume.spacing_mm
    u = (crop.low[right] + np.arange(grey.shape[1])) * spacing[right]
    v = (crop.low[up] + np.arange(grey.shape[0])) * spacing[up]
    shares = {label: crop.mask(label)[tuple(cut)].astype(float) for label in NAMES}
    shares = {label: share for label, share in shares.items() if np.any(share)}
    half_u, half_v = 0.5 * spacing[right], 0.5 * spacing[up]
    extent = (u[0] - half_u, u[-1] + half_u, v[-1] + half_v, v[0] - half_v)
    _draw(axes, crop, grey, shares, extent, (u, v))
    axes.set_title(f"scan slice {'xyz'[axis]} = {number + int(crop.low[axis])}", fontsize=10)
    axes.set(xlabel=f"array {'xyz'[right]} (mm)", ylabel=f"array {'xyz'[up]} (mm)")


def _draw(
    axes: Axes,
    crop: Crop,
    grey: NDArray[np.floating],
    shares: dict[int, Array],
    extent: tuple[float, ...],
    coordinates: tuple[Array, Array],
) -> None:
    options: dict[str, Any] = {"cmap": "gray", "vmin": crop.window[0], "vmax": crop.window[1]}
    origin: Any = "upper" if extent[2] > extent[3] else "lower"
    axes.imshow(grey, extent=extent, origin=origin, interpolation="nearest", aspect="equal", **options)  # type: ignore[arg-type]
    for label, share in shares.items():
        if label == CUT:
            axes.contourf(*coordinates, share, levels=[0.5, 2.0], colors=BODY_COLOURS[label])
            continue
        axes.contour(*coordinates, share, levels=[0.5], colors=BODY_COLOURS[label], linewidths=1.0)
    axes.tick_params(labelsize=8)
