"""Fit points to a surface from a start: nearest planes, robust weights, edges left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.calibrated import calibrated
from legacy.kinematics.registration.icp_search import Candidate
from legacy.kinematics.registration.mesh_distance import TriangleSurface
from legacy.stapeskit.alignment.registration import displacement
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import RigidTransform, cross_matrix, rotation_from_vector
from legacy.stapeskit.spatial import point_rows

Guess = tuple[RigidTransform, Array]
OUTLIER_SD: float = calibrated("surface_fit.outlier_sd")
# Rounds in all, and rounds in which the width of the search narrows.
_ROUNDS = 40
_SETTLED = 8
_HUBER_SD: float = calibrated("surface_fit.huber_sd")
# Share of the size of the surface beyond which a distance counts no further.
_FAR = 0.05
_SURFACE_SD_EDGES: float = calibrated("surface_fit.surface_sd_edges")
_MOST_SURFACE_SD_MM: float = calibrated("surface_fit.most_surface_sd_mm")


@dataclass(frozen=True)
class Cloud:
    """Points measured on a surface.

    Attributes
    ----------
    names : tuple of str, (n,)
    points_mm : ndarray, (n, 3)
        In the source frame.
    sd_mm : ndarray, (n,), or None
        Standard deviation per coordinate; None when not stated.
    kind : str
        ``plate`` or ``bone``, for messages.
    """

    names: tuple[str, ...]
    points_mm: Array
    sd_mm: Array | None = None
    kind: str = "plate"


@dataclass(frozen=True)
class Refined:
    """A refined pose with distances and normals; ``near`` the surface, and ``used``: off its edges too."""

    pose: Candidate
    distance: Array
    normal: Array
    used: NDArray[np.bool_]
    near: NDArray[np.bool_]
    scale: float
    energy: float


def surface_floor(surface: TriangleSurface) -> float:
    """Return how well the surface itself is known, mm."""
    if surface.sd_mm is not None:
        return surface.sd_mm
    return min(_SURFACE_SD_EDGES * surface.edge_mm, _MOST_SURFACE_SD_MM)


def distance_sd(cloud: Cloud, surface: TriangleSurface, scale: float) -> Array:
    """Return the standard deviation (n,) of the distances, mm."""
    if cloud.sd_mm is None:
        return np.full(len(cloud.points_mm), max(scale, 1e-6))
    return np.hypot(cloud.sd_mm, surface_floor(surface))


def refined(
    cloud: Cloud,
    surface: TriangleSurface,
    start: Candidate,
    guess: Guess | None,
) -> Refined:
    """Iterate nearest planes from a start to the end."""
    rotation, shift = start.rotation, start.shift
    middle = cloud.points_mm.mean(axis=0)
    local = cloud.points_mm - middle
    scale = 0.0
    used = np.ones(len(local), dtype=bool)
    edge = np.zeros(len(local), dtype=bool)
    for number in range(_ROUNDS):
        distance, beside, normal = _offsets(surface, cloud.points_mm @ rotation.T + shift)
        scale = max(1.4826 * float(np.median(np.abs(distance))), 1e-6)
        sd = distance_sd(cloud, surface, scale)
        width = np.maximum(sd, scale) if number < _SETTLED else sd
        size = np.abs(distance) / width
        if number >= _SETTLED:
            if number % 4 == 0:
                edge = _at_edge(surface, cloud, rotation, shift, width)
            used = (size < OUTLIER_SD) & ~edge
        if np.sum(used) < max(6, 0.3 * len(used)):
            used = np.ones(len(local), dtype=bool)
        weight = used * np.minimum(1.0, _HUBER_SD / np.maximum(size, 1e-9)) / width**2
        gram, score = normal_equations(local, rotation, distance, normal, weight)
        if guess is not None:
            pulled, toward = pull(guess, rotation, shift, middle)
            gram, score = gram + pulled, score + toward
        ridge = np.diag(gram).max() * 1e-9 * np.eye(6)
        step = np.linalg.solve(gram + ridge, score)
        step[3:] *= min(1.0, 0.3 / max(float(np.linalg.norm(step[3:])), 1e-12))
        turn = rotation_from_vector(step[3:])
        shift = shift + rotation @ (step[:3] + middle - turn @ middle)
        rotation = rotation @ turn
        small = float(np.linalg.norm(step[:3])) + float(np.linalg.norm(step[3:])) * np.abs(local).max()
        if number > _SETTLED + 4 and small < 1e-3 * float(np.median(sd)) + 1e-9:
            break
    distance, beside, normal = _offsets(surface, cloud.points_mm @ rotation.T + shift)
    count = max(int(np.sum(used)) - 6, 1)
    scale = float(np.sqrt(np.sum(distance[used] ** 2) / count))
    sd = distance_sd(cloud, surface, scale)
    away = np.hypot(distance, np.maximum(beside - 2.0 * sd, 0.0))
    energy = float(np.sum(np.minimum(away / np.maximum(sd, 1e-9), OUTLIER_SD) ** 2))
    if cloud.sd_mm is None:
        energy = float(np.sum(np.minimum(away, _FAR * surface.diagonal_mm) ** 2))
    pose = Candidate(rotation, shift, float(np.mean(np.abs(distance[used]))))
    near = away < OUTLIER_SD * np.maximum(sd, 1e-9)
    return Refined(pose, distance, normal, used & near, near, scale, energy)


def _offsets(surface: TriangleSurface, placed: Array) -> tuple[Array, Array, Array]:
    """Return distances along the normals (n,), what points hang over edges (n,), and the normals (n, 3)."""
    near, away, triangle = surface.closest(placed)
    normal = surface.normals(triangle)
    along = np.sum((placed - near) * normal, axis=1)
    return along, np.sqrt(np.maximum(away**2 - along**2, 0.0)), normal


def _at_edge(
    surface: TriangleSurface, cloud: Cloud, rotation: Array, shift: Array, width: Array
) -> NDArray[np.bool_]:
    """Return which points lie so near an edge that noise could have put them on either side of it."""
    near, _, triangle = surface.closest(cloud.points_mm @ rotation.T + shift)
    reach = np.maximum(3.0 * width, min(1.5 * surface.edge_mm, 0.02 * surface.diagonal_mm))
    return surface.near_edge(near, surface.normals(triangle), reach)


def distance_rows(local: Array, rotation: Array, normal: Array) -> Array:
    """Return d(distance)/d(displacement of the source frame about the centroid), (n, 6), mm and rad."""
    return point_rows(local, normal @ rotation)


def normal_equations(
    local: Array, rotation: Array, distance: Array, normal: Array, weight: Array
) -> tuple[Array, Array]:
    """Return the weighted normal matrix (6, 6) and right side (6,) of a step, mm and rad."""
    rows = distance_rows(local, rotation, normal)
    return (rows * weight[:, None]).T @ rows, -rows.T @ (weight * distance)


def about(middle_mm: Array) -> Array:
    """Return the map (6, 6) from a displacement about a frame's origin to that about a point, mm and rad."""
    move = np.eye(6)
    move[:3, 3:] = -cross_matrix(middle_mm)
    return move


def pull(guess: Guess, rotation: Array, shift: Array, middle: Array) -> tuple[Array, Array]:
    """Return the information and the score of a first guess, about the centroid, mm and rad."""
    units = np.array([1e3] * 3 + [1.0] * 3)
    move = about(middle)
    covariance = move @ (guess[1] * np.outer(units, units)) @ move.T
    scale = 1.0 / np.sqrt(np.diag(covariance))
    information = np.linalg.inv(covariance * np.outer(scale, scale)) * np.outer(scale, scale)
    here = RigidTransform.from_parts(rotation, shift, guess[0].to, guess[0].source)
    away = move @ (displacement(here, guess[0]) * units)
    return information, information @ away
