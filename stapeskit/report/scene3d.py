"""Describe a three-dimensional scene and pack it for the one viewer of all pages, ``viewer.js``.

Surfaces, points, lines and motions of rigid bodies; all lengths in mm, motions in m and rad about the
origin of the axes. ``page.viewer(scene)`` makes the block.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stapeskit.arrays import Array, ComplexArray
from stapeskit.frames import RigidTransform
from stapeskit.polydata import arrays_of, polydata
from stapeskit.report.colours import AXIS_COLOURS, PAGE_COLOURS, VERDICT_COLOURS, lighten

Faces = NDArray[np.int64]
# Steps of 16 bit numbers over the span of a surface: 0.1 µm for a stapes.
_STEPS = 32_000


@dataclass(frozen=True)
class Mesh:
    """A surface of vertices (n, 3), mm, and outward triangles (m, 3), decimated to ``most_faces``.

    ``name`` is also that of its checkbox, and of the body that it moves with unless ``body`` is given; the
    ``colour`` (``#rrggbb``, of `colours.BODY_COLOURS`) is drawn lighter, as areas are.
    """

    name: str
    vertices_mm: Array
    faces: Faces
    colour: str
    opacity: float = 1.0
    body: str | None = None
    most_faces: int = 6000  # enough for a screen, few enough for a page


@dataclass(frozen=True)
class Point:
    """A measured point: its colour is that of its verdict, its name appears under the mouse."""

    name: str
    position_mm: ArrayLike
    body: str = ""
    verdict: str = "ok"


@dataclass(frozen=True)
class Line:
    """A polyline (n, 3), mm, that moves with a body: beams, axes of stiffness, an outline.

    Lines of a group are hidden together, and ``shown`` at the start or not; ``label`` stands at the end.
    """

    name: str
    points_mm: Array
    colour: str
    group: str = "lines"
    shown: bool = True
    label: str = ""
    arrow: bool = False
    width: float = 2.0
    body: str = ""


@dataclass(frozen=True)
class Motion:
    """A harmonic motion of rigid bodies, played enlarged; its name is that of its button.

    Amplitudes (6,) or (lines, 6), of ``stapes`` or by body, are x, y, z in m, alpha, beta, gamma in rad,
    about the origin and along the axes of the scene, in e^{+i w t}; several lines have a slider. ``measured``
    ones are lengths and not only a shape: the viewer says how much it enlarges them.
    """

    name: str
    amplitudes: ComplexArray | Mapping[str, ComplexArray]
    frequency_hz: float | Array
    measured: bool = False

    def content(self) -> dict[str, Any]:
        """Return the motion as the viewer reads it: real parts, then imaginary parts, line by line."""
        bodies = self.amplitudes if isinstance(self.amplitudes, Mapping) else {"stapes": self.amplitudes}
        lines = np.atleast_1d(np.asarray(self.frequency_hz, dtype=float))
        parts = {name: np.nan_to_num(np.atleast_2d(value)) for name, value in bodies.items()}
        size = sum(np.abs(value[:, :3]).max(axis=1) for value in parts.values())
        return {
            "name": self.name,
            "hz": [float(f"{value:.7g}") for value in lines],
            "measured": self.measured,
            "start": int(np.argmax(size)),
            "bodies": {
                name: _packed(np.hstack([value.real, value.imag]), "<f4") for name, value in parts.items()
            },
        }


@dataclass(frozen=True)
class Scene:
    """What a viewer shows.

    ``axes`` leads from the frame whose axes are drawn (and in which motions are given) to the frame of
    surfaces, points and lines, such as ``scan_from_footplate``; None where they are the same frame.
    ``directions`` are what x, y and z point to; empty where it is not known.
    """

    surfaces: Sequence[Mesh] = ()
    points: Sequence[Point] = ()
    axes: RigidTransform | None = None
    motions: Sequence[Motion] = ()
    lines: Sequence[Line] = ()
    directions: tuple[str, str, str] = ("anterior", "lateral", "")
    title: str = "The stapes in three dimensions"
    caption: str = ""
    axis_mm: float = 1.4

    @property
    def groups(self) -> list[dict[str, Any]]:
        """What can be hidden, and whether it is shown at the start."""
        shown = {mesh.name: True for mesh in self.surfaces}
        shown |= {"axes": True} | ({"points": True} if self.points else {})
        for line in self.lines:
            shown.setdefault(line.group, line.shown)
        return [{"name": name, "shown": on} for name, on in shown.items()]

    def content(self) -> str:
        """Return the scene as JSON that can stand within a page."""
        low, high = self._span()
        data = {
            "meshes": [self._mesh(mesh) for mesh in self.surfaces if len(mesh.faces)],
            "points": [self._point(point) for point in self.points],
            "lines": [*self._axes(), *(_drawn(line, self._placed(line.points_mm)) for line in self.lines)],
            "motions": [motion.content() for motion in self.motions],
            "middle": (0.5 * (low + high)).tolist(),
            "reach": max(0.5 * float(np.linalg.norm(high - low)), 1e-6),
        }
        text = json.dumps(data, separators=(",", ":"), allow_nan=False)
        return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")

    def _placed(self, points_mm: ArrayLike) -> Array:
        """Return points in the frame whose axes are drawn, mm, rounded to 10 nm."""
        points = np.asarray(points_mm, dtype=float)
        return np.round(points if self.axes is None else self.axes.inverse().points(points), 5)

    def _span(self) -> tuple[Array, Array]:
        """Return the corners of the box that the view at the start holds.

        It holds all surfaces, of large ones what lies within one size of the first, so that this stays seen.
        """
        held = [mesh.vertices_mm for mesh in self.surfaces if len(mesh.faces)]
        if not held and self.points:
            held = [np.array([point.position_mm for point in self.points])]
        if not held:
            return -self.axis_mm * np.ones(3), self.axis_mm * np.ones(3)
        boxes = [(placed.min(axis=0), placed.max(axis=0)) for placed in map(self._placed, held)]
        low, high = (np.array(ends) for ends in zip(*boxes, strict=True))
        size = float(np.max(high[0] - low[0]))
        return np.maximum(low.min(axis=0), low[0] - size), np.minimum(high.max(axis=0), high[0] + size)

    def _point(self, point: Point) -> dict[str, Any]:
        colour = VERDICT_COLOURS.get(point.verdict, PAGE_COLOURS["do-not-use"])
        known = {"name": point.name, "body": point.body, "verdict": point.verdict, "colour": colour}
        return known | {"at": self._placed(point.position_mm).tolist()}

    def _mesh(self, mesh: Mesh) -> dict[str, Any]:
        vertices, faces = decimate(mesh.vertices_mm, mesh.faces, mesh.most_faces)
        vertices = self._placed(vertices)
        low = vertices.min(axis=0)
        step = max(float(np.max(np.ptp(vertices, axis=0))), 1e-9) / _STEPS
        return {
            "name": mesh.name,
            "body": mesh.name if mesh.body is None else mesh.body,
            "colour": lighten(mesh.colour),
            "opacity": mesh.opacity,
            "low": low.tolist(),
            "step": step,
            "vertices": _packed(np.round((vertices - low) / step), "<i2"),
            "faces": _packed(faces, "<u2"),
        }

    def _axes(self) -> list[dict[str, Any]]:
        drawn = []
        for name, end, direction in zip("xyz", self.axis_mm * np.eye(3), self.directions, strict=True):
            points, label = np.array([np.zeros(3), end]), f"{name} {direction}".strip()
            line = Line(name, points, AXIS_COLOURS[name], "axes", label=label, arrow=True, width=2.6)
            drawn.append(_drawn(line, points))
        return drawn


def _drawn(line: Line, points_mm: Array) -> dict[str, Any]:
    """Return a line as the viewer reads it, with its points in the frame whose axes are drawn."""
    names = ("colour", "group", "label", "arrow", "width", "body")
    return {"at": points_mm.tolist(), **{name: getattr(line, name) for name in names}}


def decimate(vertices_mm: ArrayLike, faces: ArrayLike, most: int) -> tuple[Array, Faces]:
    """Return a surface (n, 3), (m, 3) of about ``most`` triangles, for the eye: it may have small holes.

    The corners in each cell of a grid become the one that is nearest to the planes of their triangles
    (Lindstrom 2000, doi:10.1145/344779.344912).
    """
    vertices, triangles = np.asarray(vertices_mm, dtype=float), np.asarray(faces, dtype=np.int64)
    if len(triangles) <= most:
        return vertices, triangles
    from vtkmodules.vtkFiltersCore import vtkQuadricClustering

    a, b, c = vertices[triangles].swapaxes(0, 1)
    area = 0.5 * float(np.sum(np.linalg.norm(np.cross(b - a, c - a), axis=1)))
    cell = np.sqrt(2.2 * area / most)  # a cell has about 2.2 triangles for each face that is cut
    cells = np.maximum(np.ptp(vertices, axis=0) / cell, 1.0).astype(int)
    clusters = vtkQuadricClustering()
    clusters.SetInputData(polydata(vertices, triangles))
    clusters.AutoAdjustNumberOfDivisionsOff()
    clusters.SetNumberOfDivisions(*cells.tolist())
    clusters.Update()
    return arrays_of(clusters.GetOutput())


def _packed(values: NDArray[Any], kind: str) -> str:
    """Return the bytes of an array of another type as text."""
    return base64.b64encode(values.astype(kind).tobytes()).decode()
