"""Pictures: the medial side of the stapes with its directions, and slices with what was measured."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ct_inertia.bodies import OTHER_BONE, PLATE
from ct_inertia.frames.anatomy import NO_HINT, directions
from ct_inertia.report.pictured import Pictured, Slices
from ct_inertia.surface.surface import Surface
from stapeskit.arrays import Array
from stapeskit.frames import RigidTransform
from stapeskit.report.colours import BODY_COLOURS, OTHER_COLOURS, lighten
from stapeskit.report.figures import panels, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LIGHT = np.array([-0.35, 0.45, 0.82])  # direction of the light: right, up, towards the eye
_PIXELS = 340  # along an edge of a slice
_MARGIN_MM = 0.4
_ABOVE_MM = 0.12  # height of the slice along the footplate: within its bone
_BODIES = ((OTHER_BONE, OTHER_COLOURS[0], "other bone"), (PLATE, BODY_COLOURS["plate"], "plate"))


def frame_of(content: Mapping[str, Any], name: str) -> RigidTransform | None:
    """Return scan_from_NAME of a mass.json; None where it has none."""
    matrix = content["frames"][f"scan_from_{name}"]
    return None if matrix is None else RigidTransform(np.array(matrix, dtype=float), "scan", name)


def anatomy_of(content: Mapping[str, Any]) -> dict[str, str]:
    """Return the names of the ends of the footplate axes, ``+x`` to ``-z``, as far as they are known."""
    frames = content["frames"]
    return directions(frames.get("side"), frames.get("anterior_from") != NO_HINT)


@style()
def medial_view(content: Mapping[str, Any], pictured: Pictured) -> Figure:
    """Draw the stapes seen from its footplate, +x to the right and +z up; mm from the footplate centre."""
    frame = frame_of(content, "footplate")
    assert frame is not None  # noqa: S101 - every mass.json has it
    local = frame.inverse().points(pictured.light_stapes.vertices_mm)
    drawing, grid = panels(1, 1, width=4.6, height=2.6, margins=(0.72, 0.1, 0.3, 0.46), gaps=(0.6, 0.1))
    axes, names = grid[0, 0], anatomy_of(content)
    _shade(axes, local @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]).T, pictured)
    axes.set_title(f"seen from {_word('-y', names)}")
    axes.set(xlabel=f"towards {_word('+x', names)}, mm", ylabel=f"towards {_word('+z', names)}, mm")
    axes.set(aspect="equal")
    axes.margins(0.08)
    return drawing


def _word(name: str, names: Mapping[str, str]) -> str:
    sign = name.replace("-", "−")
    return f"{names[name]} ({sign})" if name in names else sign


def _shade(axes: Axes, points: Array, pictured: Pictured) -> None:
    """Draw lit triangles from back to front; points (n, 3) to the right, up and towards the eye."""
    from matplotlib.collections import PolyCollection

    corners = points[pictured.light_stapes.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    shown = np.flatnonzero(normals[:, 2] > 0.0)
    order = shown[np.argsort(corners[shown, :, 2].mean(axis=1))]
    light = np.clip(normals[order] @ (_LIGHT / np.linalg.norm(_LIGHT)), 0.0, 1.0)
    base = np.array([int(lighten(BODY_COLOURS["stapes"], 0.35)[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0
    colours = np.clip(base * (0.45 + 0.65 * light[:, None]), 0.0, 1.0)
    triangles = PolyCollection(list(corners[order, :, :2]), rasterized=True, linewidths=0.3)
    triangles.set(facecolors=colours, edgecolors=colours)
    axes.add_collection(triangles)


@style()
def slices_figure(content: Mapping[str, Any], pictured: Pictured) -> Figure | None:
    """Draw three planes of the footplate frame with the outlines; None without grey values."""
    from matplotlib.lines import Line2D

    slices, frame = pictured.slices, frame_of(content, "footplate")
    if slices is None or frame is None:
        return None
    drawing, axes = panels(1, 3, width=10.4, height=3.7, margins=(0.5, 0.1, 0.3, 0.75), gaps=(0.5, 0.6))
    local = frame.inverse().points(pictured.stapes.vertices_mm)
    ends = np.stack([local.min(axis=0) - _MARGIN_MM, local.max(axis=0) + _MARGIN_MM])
    for ax, plane in zip(axes[0], ((0, 1, 2, 0.0), (2, 1, 0, 0.0), (0, 2, 1, _ABOVE_MM)), strict=True):
        _plane(ax, slices, pictured.stapes, frame, plane, ends)
        right, up, normal, level = plane
        ax.set(title=f"footplate frame, {'xyz'[normal]} = {level:g} mm")
        ax.set(xlabel=f"{'xyz'[right]} (mm)", ylabel=f"{'xyz'[up]} (mm)")
    handles = [Line2D([], [], color=BODY_COLOURS["stapes"], label="stapes, as measured")]
    for number, colour, words in _BODIES:
        if np.any(slices.labels == number):
            handles.append(Line2D([], [], color=colour, label=words))
    drawing.legend(handles=handles, loc="lower center", ncols=len(handles))
    return drawing


def _plane(
    axes: Axes,
    slices: Slices,
    stapes: Surface,
    frame: RigidTransform,
    plane: tuple[int, int, int, float],
    ends: Array,
) -> None:
    """Draw grey values and outlines in a plane.

    ``plane``: axes of ``frame`` to the right, up and along the normal, and the height along that; ``ends``
    (2, 3): first and last place shown along each axis.
    """
    from scipy.ndimage import map_coordinates

    right, up, normal, level = plane
    u = np.linspace(ends[0, right], ends[1, right], _PIXELS)
    v = np.linspace(ends[0, up], ends[1, up], _PIXELS)
    points = np.full((_PIXELS, _PIXELS, 3), float(level))
    points[..., right], points[..., up] = u[None, :], v[:, None]
    places = np.moveaxis(slices.index_points(frame.points(points))[..., ::-1], -1, 0)
    black, white = slices.window
    grey = map_coordinates(slices.grey, places, order=1, mode="constant", cval=black)
    axes.imshow(
        grey,
        extent=(u[0], u[-1], v[0], v[-1]),
        origin="lower",
        cmap="gray",
        vmin=black,
        vmax=white,
        interpolation="none",
    )
    for number, colour, _ in _BODIES:
        mask = slices.labels == number
        share = map_coordinates(mask, places, np.float32, order=1) if mask.any() else np.zeros(1)
        if share.max() > 0.5:
            axes.contour(u, v, share, levels=[0.5], colors=colour, linewidths=1.1)
    for line in _cut(stapes, frame.points(level * np.eye(3)[normal]), frame.rotation[:, normal]):
        at = frame.inverse().points(line)
        axes.plot(at[:, right], at[:, up], color=BODY_COLOURS["stapes"], lw=1.1)
    axes.set(xlim=(u[0], u[-1]), ylim=(v[0], v[-1]))
    axes.grid(visible=False)


def _cut(surface: Surface, origin: Array, normal: Array) -> list[Array]:
    """Return the lines (n, 3) in which a plane cuts a surface."""
    cut = surface.mesh().slice(normal=normal, origin=origin).strip(join=True, max_length=10**6)
    lines, points, found, place = np.asarray(cut.lines), np.asarray(cut.points, dtype=float), [], 0
    while place < len(lines):
        found.append(points[lines[place + 1 : place + 1 + lines[place]]])
        place += 1 + int(lines[place])
    return found
