"""The plane faces of a solid such as the plate: found by direction, fitted robustly below voxel size."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.frames.footplate_search import sphere
from legacy.ct_inertia.surface.surface_field import Mesh
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import rotation_from_vector

if TYPE_CHECKING:
    from legacy.ct_inertia.frames.footplate import SurfaceLike


_PLATE_CONE_DEG = calibrated("plane_faces.cone_deg")
_LAYER_MM = calibrated("plane_faces.layer_mm")
# Bins of height; the layer with most area is looked for in three of them at a time.
_BIN_MM = 0.5 * _LAYER_MM
_CELL_MM = calibrated("plane_faces.cell_mm")
_SCATTER = calibrated("plane_faces.scatter") ** 2
_UNKNOWN_SD = calibrated("plane_faces.unknown")
# Most iterations of the robust plane, against a cycle, and the turn that ends them: 0.1 nm over 10 mm.
_ROUNDS = 30
_STILL_RAD = 1e-8
# Directions over the sphere in which faces are looked for: 8 degrees apart, less than the cone of a face.
_DIRECTIONS = 600
# Layers without a face of the area asked for after which the search ends: what is left are rounded edges.
_FAILURES = 3
# Rows of a table of 600 directions that fit the processor's cache.
_PIECE = 200


@dataclass(frozen=True)
class PlaneFace:
    """One plane face.

    Attributes
    ----------
    normal : ndarray, (3,)
        Unit, outward.
    point_mm : ndarray, (3,)
        Centroid of what was fitted.
    basis : ndarray, (3, 2)
        Two directions in the plane, for the covariance.
    covariance : ndarray, (3, 3)
        Of height at the point (mm) and of the slopes along the basis (rad).
    area_mm2 : float
        Fitted area.
    samples_mm : ndarray, (n, 3)
        Centres of the pieces of surface that belong to it.
    turning_1_mm : ndarray, (2, 2)
        How the surface's normal turns along the basis; a cylinder of radius R has the eigenvalue 1 / R.
    at_border : bool
        The field of view ends here; it is no face of the solid.
    """

    normal: Array
    point_mm: Array
    basis: Array
    covariance: Array
    area_mm2: float
    samples_mm: Array
    turning_1_mm: Array = field(default_factory=lambda: np.zeros((2, 2)))
    at_border: bool = False

    def moved(self, step: Array) -> PlaneFace:
        """Return the face displaced by a height (mm) and two slopes (rad)."""
        turn = rotation_from_vector(np.cross(self.normal, -self.basis @ step[1:]))
        return replace(self, normal=turn @ self.normal, point_mm=self.point_mm + step[0] * self.normal)

    def curvature(self, direction: Array) -> float:
        """Return the curvature (1/mm) along a direction (3,) in the plane."""
        along = self.basis.T @ direction
        square = float(along @ along)
        return float(along @ self.turning_1_mm @ along) / max(square, 1e-30)

    def distance(self, points_mm: Array) -> Array:
        """Return signed distances (n,) of points (n, 3), positive outside, mm."""
        return np.asarray((points_mm - self.point_mm) @ self.normal)


def plane_faces(
    mesh: Mesh, least_area_mm2: float, on_border: NDArray[np.bool_] | None = None
) -> list[PlaneFace]:
    """Return the plane faces of a closed outward surface by falling area.

    Parameters
    ----------
    mesh : Mesh
    least_area_mm2 : float
        Smaller faces are left out.
    on_border : ndarray of bool, (n,), optional
        Vertices at the border of the field of view.

    Notes
    -----
    Faces are found one after the other: the direction that most of the remaining area faces within 12
    degrees, the layer in which most of that lies, then a robust plane (Tukey's weights) through it. Height
    noise is taken from means over cells of 0.4 mm, so that correlation between neighbours counts;
    the choice of what faces the plane adds scatter that these means do not see (measured: 1.5 times in sd).
    The border of the field of view is looked at apart, for at a shallow angle it would pass for the face.
    """
    vectors = mesh.area_vectors
    areas = np.linalg.norm(vectors, axis=1)
    flags = np.zeros(len(mesh.points), dtype=bool) if on_border is None else on_border
    count = np.count_nonzero(flags[mesh.faces], axis=1)
    directions = sphere(_DIRECTIONS)
    normals = _smooth(mesh, vectors)
    centres = mesh.points[mesh.faces].mean(axis=1)
    nearest = _nearest_direction(directions, normals)
    faces: list[PlaneFace] = []
    for border, chosen in ((False, count == 0), (True, count == 3)):
        pieces = _Pieces(centres[chosen], normals[chosen], areas[chosen], nearest[chosen])
        failures = 0
        while pieces.areas.sum() > least_area_mm2 and failures < _FAILURES:
            face, members = _largest(pieces, directions)
            if face is not None and face.area_mm2 >= least_area_mm2:
                faces.append(replace(face, at_border=border))
            else:
                failures += 1
            pieces = pieces.chosen(~members)
    return sorted(faces, key=lambda face: -face.area_mm2)


def large_faces(surface: SurfaceLike, on_border: NDArray[np.bool_] | None = None) -> list[PlaneFace]:
    """Return the plane faces of a closed surface that hold more than a hundredth of its area."""
    mesh = Mesh(np.asarray(surface.vertices_mm, dtype=float), np.asarray(surface.faces, dtype=np.intp))
    area = float(np.linalg.norm(mesh.area_vectors, axis=1).sum())
    return plane_faces(mesh, 0.01 * area, on_border)


@dataclass(frozen=True)
class _Pieces:
    """Pieces of surface: centres (n, 3), unit normals (n, 3), areas, nearest direction."""

    centres: Array
    normals: Array
    areas: Array
    direction: NDArray[np.intp]

    def chosen(self, keep: NDArray[np.bool_]) -> _Pieces:
        """Return some of the pieces."""
        return _Pieces(self.centres[keep], self.normals[keep], self.areas[keep], self.direction[keep])


def _nearest_direction(directions: Array, normals: Array) -> NDArray[np.intp]:
    """Return which of some unit directions (m, 3) each unit normal (n, 3) is nearest to."""
    parts = [normals[start : start + _PIECE] for start in range(0, len(normals), _PIECE)]
    nearest = [np.argmax(part @ directions.T, axis=1) for part in parts]
    return np.concatenate([np.zeros(0, dtype=np.intp), *nearest])


def _smooth(mesh: Mesh, vectors: Array) -> Array:
    """Return unit normals (m, 3) of the faces, averaged over two rings of neighbours."""
    for _ in range(2):
        at_vertices = np.stack(
            [
                np.bincount(mesh.faces.ravel(), np.repeat(vectors[:, k], 3), minlength=len(mesh.points))
                for k in range(3)
            ],
            axis=1,
        )
        vectors = at_vertices[mesh.faces].mean(axis=1)
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30))


def _largest(pieces: _Pieces, directions: Array) -> tuple[PlaneFace | None, NDArray[np.bool_]]:
    """Return the largest plane face among the pieces, and which of them it takes up."""
    areas = pieces.areas
    pooled = np.bincount(pieces.direction, areas, minlength=len(directions))
    cosine = np.cos(np.radians(_PLATE_CONE_DEG))
    near = directions @ directions.T > cosine
    normal = directions[int(np.argmax(near @ pooled))]
    for _ in range(3):
        facing = pieces.normals @ normal > cosine
        total = areas[facing] @ pieces.normals[facing]
        if not np.any(total):
            return None, np.ones(len(areas), dtype=bool)
        normal = total / np.linalg.norm(total)
    facing = pieces.normals @ normal > cosine
    height = pieces.centres @ normal
    start = float(height[facing].min()) - _LAYER_MM
    bins = np.bincount(((height[facing] - start) / _BIN_MM).astype(int), areas[facing])
    layer = np.convolve(bins, np.ones(3), mode="same")
    level = start + (int(np.argmax(layer)) + 0.5) * _BIN_MM
    members = facing & (np.abs(height - level) < 2.0 * _LAYER_MM)
    if np.count_nonzero(members) < 3:
        return None, facing
    face = fitted_plane(pieces.centres[members], areas[members], normal)
    turning = _normal_slope(pieces.centres[members], pieces.normals[members], areas[members], face.basis)
    return replace(face, turning_1_mm=turning), members


def fitted_plane(points: Array, areas: Array, normal: Array) -> PlaneFace:
    """Fit a robust plane to pieces of surface.

    Parameters
    ----------
    points : ndarray, (n, 3)
        Their centres, mm.
    areas : ndarray, (n,)
        mm2.
    normal : ndarray, (3,)
        About where the plane faces.
    """
    weights = areas.copy()
    for _ in range(_ROUNDS):
        centre = weights @ points / weights.sum()
        away = points - centre
        _, vectors = np.linalg.eigh((away * weights[:, None]).T @ away)
        new = vectors[:, 0] * np.sign(vectors[:, 0] @ normal)
        step = float(np.linalg.norm(new - normal))
        normal = new
        distance = (points - centre) @ normal
        scale = max(1.4826 * _weighted_median(np.abs(distance), areas), 1e-4)
        weights = areas * np.clip(1.0 - (distance / (4.685 * scale)) ** 2, 0.0, None) ** 2
        if step < _STILL_RAD:
            break
    centre = weights @ points / weights.sum()
    kept = weights > 0.0
    basis = np.linalg.svd(normal[None, :])[2][1:].T
    covariance = _covariance(points[kept] - centre, weights[kept], normal, basis)
    return PlaneFace(normal, centre, basis, covariance, float(areas[kept].sum()), points[kept])


def _normal_slope(points: Array, normals: Array, areas: Array, basis: Array) -> Array:
    """Return the slope (2, 2) of the normals over the position in the plane, 1/mm."""
    share = areas / areas.sum()
    flat = (points - share @ points) @ basis
    turn = (normals - share @ normals) @ basis
    spread = (flat * share[:, None]).T @ flat
    if np.linalg.cond(spread) > 1e8:
        return np.zeros((2, 2))
    slope = np.linalg.solve(spread, (flat * share[:, None]).T @ turn)
    return np.asarray(0.5 * (slope + slope.T))


def _weighted_median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][int(np.searchsorted(total, 0.5 * total[-1]))])


def _covariance(away: Array, weights: Array, normal: Array, basis: Array) -> Array:
    """Return the covariance (3, 3) of height and slopes from the scatter of cell means."""
    flat = away @ basis
    cells = np.floor(flat / _CELL_MM).astype(np.int64)
    cells -= cells.min(axis=0)
    _, group = np.unique(cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1], return_inverse=True)
    mass = np.bincount(group, weights)
    height = np.bincount(group, weights * (away @ normal)) / mass
    design = np.column_stack(
        [np.ones(len(mass)), *(np.bincount(group, weights * flat[:, k]) / mass for k in range(2))]
    )
    information = (design * mass[:, None]).T @ design
    if len(mass) < 6 or np.linalg.cond(information) > 1e12:
        return np.diag(np.square(_UNKNOWN_SD))
    inverse = np.linalg.inv(information)
    residual = height - design @ (inverse @ (design.T @ (mass * height)))
    middle = (design * (mass * residual)[:, None]).T @ (design * (mass * residual)[:, None])
    freedom = len(mass) / (len(mass) - 3.0)
    return np.asarray(inverse @ middle @ inverse * (freedom * _SCATTER))
