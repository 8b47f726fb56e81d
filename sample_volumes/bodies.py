"""The bodies of a temporal-bone sample as closed surfaces, built in the footplate frame (mm).

x anterior, y lateral, origin at the footplate centre. The stapes is the real one of the OpenEar library; the
peripheral bone, the ligament gap and the plastic plate are made around it.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.frames.anatomy import AnatomyHints
from legacy.ct_inertia.frames.footplate import footplate_frame
from legacy.ct_inertia.surface.surface import Surface, read_surface
from legacy.stapeskit.frames import RigidTransform, rotation_from_vector

Array = NDArray[np.float64]
OPENEAR_STAPES = Path(__file__).parent / "openear_stapes.ply"
WINDOW_TOP_MM = 0.45
_ANGLES = 192
_SECTORS = 20000
_LEAST_GAP_MM = 0.01


@dataclass(frozen=True)
class Solid:
    """A closed triangle mesh: vertices (n, 3) in mm and outward faces (m, 3)."""

    vertices: Array
    faces: NDArray[np.int64]


@functools.cache
def stapes_in_footplate(path: Path = OPENEAR_STAPES) -> Surface:
    """Return a stapes in its own footplate frame (ct_inertia.frames.footplate, on the exact mesh)."""
    mesh = read_surface(path)
    frame = footplate_frame(mesh, AnatomyHints())
    return Surface(frame.scan_from_footplate.inverse().points(mesh.vertices_mm), mesh.faces)


def footplate_outline(stapes: Surface, gap_mm: float, top_mm: float = WINDOW_TOP_MM) -> Array:
    """Return the outline of what stands in the oval window, widened by ``gap_mm`` on all sides.

    Parameters
    ----------
    stapes : Surface
        In the footplate frame.
    gap_mm : float
        Distance from the outline, kept all round, at the concave waist too.
    top_mm : float
        Height up to which the stapes stands in the window.

    Returns
    -------
    ndarray, (192, 2)
        x and z, mm, at equal angles around the footplate centre.

    Notes
    -----
    Kept for surfaces with the same bytes: one study asks four times, and many studies have one stapes.
    """
    return _outline(surface_bytes(stapes), float(gap_mm), float(top_mm)).copy()


def surface_bytes(surface: Surface) -> tuple[bytes, bytes]:
    """Return the coordinates and faces of a surface as a key of what is computed from them."""
    return surface.vertices_mm.tobytes(), surface.faces.astype(np.int64).tobytes()


@functools.lru_cache(maxsize=32)
def _outline(surface: tuple[bytes, bytes], gap_mm: float, top_mm: float) -> Array:
    vertices = np.frombuffer(surface[0]).reshape(-1, 3)
    stapes = Surface(vertices, np.frombuffer(surface[1], dtype=np.int64).reshape(-1, 3))
    angles = np.linspace(0.0, 2.0 * np.pi, _ANGLES, endpoint=False)
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    rim = _silhouette(stapes, top_mm)
    along = rim @ directions.T
    beside = rim[:, :1] * directions[:, 1] - rim[:, 1:] * directions[:, 0]
    around = max(gap_mm, _LEAST_GAP_MM)
    reach = np.where(
        np.abs(beside) < around, along + np.sqrt(np.maximum(around**2 - beside**2, 0.0)), -np.inf
    ).max(axis=0)
    return np.asarray(directions * (reach - (around - gap_mm))[:, None])


def _silhouette(stapes: Surface, top_mm: float) -> Array:
    """Return the outermost points (n, 2) of the stapes below a height, seen along y, densely by angle."""
    corners = stapes.vertices_mm[stapes.faces]
    corners = corners[corners[:, :, 1].min(axis=1) < top_mm]
    longest = np.ptp(corners, axis=1).max()
    steps = np.linspace(0.0, 1.0, 2 + int(longest / 0.003))[:, None, None, None]
    edges = corners + steps * (np.roll(corners, -1, axis=1) - corners)
    points = edges.reshape(-1, 3)
    flat = points[points[:, 1] < top_mm][:, [0, 2]]
    radius = np.hypot(flat[:, 0], flat[:, 1])
    sector = np.floor((np.arctan2(flat[:, 1], flat[:, 0]) / (2.0 * np.pi) + 0.5) * _SECTORS).astype(int)
    order = np.lexsort((-radius, sector))
    _, first = np.unique(sector[order], return_index=True)
    return np.asarray(flat[order[first]])


def ring(inner: Array, outer: Array, low: float, high: float) -> Solid:
    """Return the solid between two outlines (n, 2) of (x, z), from y = low to y = high."""
    count = len(inner)
    levels = [(inner, low), (outer, low), (outer, high), (inner, high)]
    vertices = np.concatenate([np.insert(part, 1, y, axis=1) for part, y in levels])
    here = np.arange(count)
    there = (here + 1) % count
    faces = []
    for level in range(4):
        a, b = level * count, ((level + 1) % 4) * count
        faces.append(np.column_stack([a + here, a + there, b + there]))
        faces.append(np.column_stack([a + here, b + there, b + here]))
    return outward(vertices, np.concatenate(faces))


def box(low: Array, high: Array) -> Solid:
    """Return an axis-parallel box."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    vertices = np.asarray(low) + corners * (np.asarray(high) - np.asarray(low))
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([part for a, b, c, d in quads for part in ((a, b, c), (a, c, d))])
    return outward(vertices, faces)


def rod(start: Array, end: Array, radius: float, sides: int = 48) -> Solid:
    """Return a cylinder between two points."""
    axis = np.asarray(end, dtype=float) - np.asarray(start, dtype=float)
    across = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    across /= np.linalg.norm(across)
    other = np.cross(axis / np.linalg.norm(axis), across)
    turns = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    circle = radius * (np.cos(turns)[:, None] * across + np.sin(turns)[:, None] * other)
    vertices = np.concatenate([circle + start, circle + end, [start], [end]])
    here = np.arange(sides)
    there = (here + 1) % sides
    faces = np.concatenate(
        [
            np.column_stack([here, there, there + sides]),
            np.column_stack([here, there + sides, here + sides]),
            np.column_stack([np.full(sides, 2 * sides), there, here]),
            np.column_stack([np.full(sides, 2 * sides + 1), here + sides, there + sides]),
        ]
    )
    return outward(vertices, faces)


def ellipsoid(centre: Array, radii: Array, steps: int = 48) -> Solid:
    """Return an ellipsoid with its axes along x, y and z, as a mesh of ``steps`` by ``steps`` / 2 patches."""
    around = np.linspace(0.0, 2.0 * np.pi, steps, endpoint=False)
    down = np.linspace(0.0, np.pi, steps // 2 + 1)[1:-1]
    belt = np.stack(
        [
            np.sin(down)[:, None] * np.cos(around),
            np.broadcast_to(np.cos(down)[:, None], (len(down), steps)),
            np.sin(down)[:, None] * np.sin(around),
        ],
        axis=-1,
    ).reshape(-1, 3)
    vertices = np.concatenate([belt, [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]]) * radii + centre
    north, south = len(belt), len(belt) + 1
    here = np.arange(steps)
    there = (here + 1) % steps
    faces = [np.column_stack([np.full(steps, north), there, here])]
    for row in range(len(down) - 1):
        a, b = row * steps, (row + 1) * steps
        faces.append(np.column_stack([a + here, a + there, b + there]))
        faces.append(np.column_stack([a + here, b + there, b + here]))
    last = (len(down) - 1) * steps
    faces.append(np.column_stack([np.full(steps, south), last + here, last + there]))
    return outward(vertices, np.concatenate(faces))


def outward(vertices: Array, faces: NDArray[np.int64]) -> Solid:
    """Return a solid whose faces are turned outward."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    if np.einsum("ij,ij->", a, np.cross(b, c)) < 0.0:
        faces = faces[:, ::-1]
    return Solid(vertices, np.ascontiguousarray(faces))


def moved(solid: Solid, transform: RigidTransform) -> Solid:
    """Return the solid in another frame."""
    return Solid(transform.points(solid.vertices), solid.faces)


def plate_pose(distance_mm: float, tilt_deg: tuple[float, float], turn_deg: float) -> RigidTransform:
    """Return footplate_from_plate for a plate below the footplate.

    Its face looks towards the stapes (+y of the plate frame), ``distance_mm`` from the footplate centre,
    tilted about x and z and turned about y against the footplate.
    """
    tilt = rotation_from_vector(np.radians([tilt_deg[0], 0.0, tilt_deg[1]]))
    turn = rotation_from_vector(np.radians([0.0, turn_deg, 0.0]))
    return RigidTransform.from_parts(tilt @ turn, tilt @ [0.0, -distance_mm, 0.0], "footplate", "plate")
