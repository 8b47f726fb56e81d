"""The plane faces of a solid such as the plate: found by direction, fitted robustly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ct_inertia.calibrated import calibrated
from ct_inertia.surface.fields import ring_normals, unit
from ct_inertia.surface.surface import Surface
from stapeskit.arrays import Array
from stapeskit.frames import rotation_from_vector

_BINS = 8  # per unit of a normal's components: 7 degrees, less than the cone of a face
_FAILURES = 3  # layers without a face after which the search ends: what is left are rounded edges
_LEAST_SHARE = 0.01  # of the area of the solid: smaller faces are left out
_ROUNDS, _STILL_RAD = 30, 1e-8  # of the robust plane: 0.1 nm over 10 mm
_TUKEY = 4.685  # standard deviations beyond which Tukey's weights vanish: 95 % efficient
_CONE_DEG = calibrated("plate_frame.cone_deg")
_LAYER_MM = calibrated("plate_frame.layer_mm")
_CELL_MM = calibrated("plate_frame.cell_mm")
_SCATTER = calibrated("plate_frame.scatter") ** 2
_UNKNOWN_SD = (0.01, 0.1, 0.1)  # mm, rad, rad: of a plane through a handful of pieces, as good as unknown


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
        return float(along @ self.turning_1_mm @ along) / max(float(along @ along), 1e-30)

    def distance(self, points_mm: Array) -> Array:
        """Return signed distances (n,) of points (n, 3), positive outside, mm."""
        return np.asarray((points_mm - self.point_mm) @ self.normal)


@dataclass(frozen=True)
class _Pieces:
    """Pieces of surface: centres (n, 3), unit normals (n, 3), areas (n,)."""

    centres: Array
    normals: Array
    areas: Array

    def chosen(self, keep: NDArray[np.bool_]) -> _Pieces:
        """Return some of the pieces."""
        return _Pieces(self.centres[keep], self.normals[keep], self.areas[keep])

    def main_direction(self) -> Array:
        """Return about the direction (3,) that most of the area faces within the cone of a face."""
        group = np.unique(
            np.rint(_BINS * self.normals) @ [1.0, 4.0 * _BINS, 16.0 * _BINS**2], return_inverse=True
        )[1]
        areas = np.bincount(group, self.areas)
        weighted = self.normals * self.areas[:, None]
        directions = unit(np.stack([np.bincount(group, column) for column in weighted.T], axis=1))
        near = directions @ directions.T > np.cos(np.radians(_CONE_DEG))
        return np.asarray(directions[int(np.argmax(near @ areas))])


def plane_faces(surface: Surface) -> list[PlaneFace]:
    """Return plane faces of more than a hundredth of the area of a closed surface, the largest first.

    Notes
    -----
    Faces are found one after the other: the direction that most of the remaining area faces, the layer in
    which most of that lies, then a robust plane (Tukey's weights) through it. Height noise is taken from
    means over cells, so that correlation between neighbours counts. The border of the field of view is
    looked at apart, for at a shallow angle it would pass for the face.
    """
    areas = np.linalg.norm(surface.area_vectors_mm2, axis=1)
    at_border = np.zeros(len(areas), dtype=int)
    if surface.on_border is not None:
        at_border = np.count_nonzero(surface.on_border[surface.faces], axis=1)
    least = _LEAST_SHARE * float(areas.sum())
    every = _Pieces(surface.centres_mm, ring_normals(surface), areas)
    faces: list[PlaneFace] = []
    for border, chosen in ((False, at_border == 0), (True, at_border == 3)):
        pieces = every.chosen(chosen)
        failures = 0
        while pieces.areas.sum() > least and failures < _FAILURES:
            face, members = _largest(pieces)
            if face is not None and face.area_mm2 >= least:
                faces.append(replace(face, at_border=border))
            else:
                failures += 1
            pieces = pieces.chosen(~members)
    return sorted(faces, key=lambda face: -face.area_mm2)


def _largest(pieces: _Pieces) -> tuple[PlaneFace | None, NDArray[np.bool_]]:
    """Return the largest plane face among the pieces, and which of them it takes up."""
    areas = pieces.areas
    cosine = np.cos(np.radians(_CONE_DEG))
    normal = pieces.main_direction()
    for _ in range(3):
        facing = pieces.normals @ normal > cosine
        total = areas[facing] @ pieces.normals[facing]
        if not np.any(total):
            return None, np.ones(len(areas), dtype=bool)
        normal = total / np.linalg.norm(total)
    facing = pieces.normals @ normal > cosine
    height = pieces.centres @ normal
    width = 0.5 * _LAYER_MM  # the layer with most area is looked for in three bins at a time
    start = float(height[facing].min()) - _LAYER_MM
    bins = np.bincount(((height[facing] - start) / width).astype(int), areas[facing])
    level = start + (int(np.argmax(np.convolve(bins, np.ones(3), mode="same"))) + 0.5) * width
    members = facing & (np.abs(height - level) < 2.0 * _LAYER_MM)
    if np.count_nonzero(members) < 3:
        return None, facing
    face = fitted_plane(pieces.centres[members], areas[members], normal)
    turning = _turning(pieces.centres[members], pieces.normals[members], areas[members], face.basis)
    return replace(face, turning_1_mm=turning), members


def fitted_plane(points: Array, areas: Array, normal: Array) -> PlaneFace:
    """Fit a robust plane to pieces of surface at points (n, 3), mm, that face about along a normal (3,)."""
    weights = areas.copy()
    for _ in range(_ROUNDS):
        centre = weights @ points / weights.sum()
        away = points - centre
        vectors = np.linalg.eigh((away * weights[:, None]).T @ away)[1]
        new = vectors[:, 0] * np.sign(vectors[:, 0] @ normal)
        step = float(np.linalg.norm(new - normal))
        normal = new
        distance = away @ normal
        scale = max(1.4826 * _weighted_median(np.abs(distance), areas), 1e-4)
        weights = areas * np.clip(1.0 - (distance / (_TUKEY * scale)) ** 2, 0.0, None) ** 2
        if step < _STILL_RAD:
            break
    centre = weights @ points / weights.sum()
    kept = weights > 0.0
    basis = np.linalg.svd(normal[None, :])[2][1:].T
    covariance = _covariance(points[kept] - centre, weights[kept], normal, basis)
    return PlaneFace(normal, centre, basis, covariance, float(areas[kept].sum()), points[kept])


def _weighted_median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][int(np.searchsorted(total, 0.5 * total[-1]))])


def _turning(points: Array, normals: Array, areas: Array, basis: Array) -> Array:
    """Return the slope (2, 2) of the normals over the position in the plane, 1/mm."""
    share = areas / areas.sum()
    flat = (points - share @ points) @ basis
    turn = (normals - share @ normals) @ basis
    spread = (flat * share[:, None]).T @ flat
    if np.linalg.cond(spread) > 1e8:
        return np.zeros((2, 2))
    slope = np.linalg.solve(spread, (flat * share[:, None]).T @ turn)
    return np.asarray(0.5 * (slope + slope.T))


def _covariance(away: Array, weights: Array, normal: Array, basis: Array) -> Array:
    """Return the covariance (3, 3) of height and slopes from the scatter of means over cells (sandwich)."""
    flat = away @ basis
    cells = np.floor(flat / _CELL_MM).astype(np.int64)
    cells -= cells.min(axis=0)
    group = np.unique(cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1], return_inverse=True)[1]
    mass = np.bincount(group, weights)

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(group, weights * values) / mass)

    height = mean(away @ normal)
    design = np.column_stack([np.ones(len(mass)), mean(flat[:, 0]), mean(flat[:, 1])])
    information = (design * mass[:, None]).T @ design
    if len(mass) < 6 or np.linalg.cond(information) > 1e12:
        return np.diag(np.square(_UNKNOWN_SD))
    inverse = np.linalg.inv(information)
    residual = height - design @ (inverse @ (design.T @ (mass * height)))
    scores = design * (mass * residual)[:, None]
    freedom = len(mass) / (len(mass) - 3.0)
    return np.asarray(inverse @ scores.T @ scores @ inverse * (freedom * _SCATTER))


def jacobian(of: Callable[[PlaneFace], Array], face: PlaneFace, step: float = 1e-6) -> Array:
    """Return the derivative by a face's height (mm) and slopes (rad), (n, 3), of what is 0 for the face."""
    return np.column_stack([of(face.moved(move)) / step for move in np.eye(3) * step])
