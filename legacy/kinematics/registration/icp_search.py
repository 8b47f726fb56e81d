"""Where a cloud of measured points may lie on a surface: many starts at once, without a first guess."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legacy.kinematics.registration.mesh_distance import TriangleSurface
from legacy.stapeskit.alignment.paired_points import pose_rows
from legacy.stapeskit.arrays import Array

# Sizes of the search over all rotations: samples of the surface, points, samples and rotations of the start
# (about 33 degrees apart), and stages (rounds, width, starts kept).
_SAMPLES = 30_000
_MOST_POINTS = 40
_START_SAMPLES = 2_000
_ROTATIONS = 400
_STAGES = ((5, 0.3, 160), (8, 0.1, 40), (12, 0.03, 24))
# Cosine of normal and beam below which a point lies on the side that the laser cannot see.
_FACING = -0.2
# Share of points with the smallest distances that counts: outliers must not decide the start.
_TRIM = 0.85


@dataclass(frozen=True)
class Candidate:
    """A pose: rotation (3, 3) and shift (3,), mm, from source to target, and its trimmed mean distance."""

    rotation: Array
    shift: Array
    miss_mm: float

    def points(self, points_mm: Array) -> Array:
        """Map points (n, 3)."""
        return np.asarray(points_mm @ self.rotation.T + self.shift)


def even_rotations(count: int) -> Array:
    """Return rotation matrices (count, 3, 3) spread evenly.

    Notes
    -----
    Super-Fibonacci spirals: Alexa 2022 (doi:10.1109/CVPR52688.2022.00811), Algorithm 1.
    """
    s = np.arange(count) + 0.5
    share, turn = s / count, 2.0 * np.pi * s
    r, big = np.sqrt(share), np.sqrt(1.0 - share)
    alpha, beta = turn / np.sqrt(2.0), turn / 1.533751168755204288118041
    x, y, z, w = r * np.sin(alpha), r * np.cos(alpha), big * np.sin(beta), big * np.cos(beta)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def candidates(
    points_mm: Array, surface: TriangleSurface, towards: Array | None = None, apart_mm: float = 0.05
) -> list[Candidate]:
    """Return poses that lay points on a surface, best first, without near copies.

    Parameters
    ----------
    points_mm : ndarray, (n, 3)
        In the source frame.
    surface : TriangleSurface
        In the target frame.
    towards : ndarray, (3,), optional
        Mean direction to the laser heads, in the source frame: a point can only be seen on a face that looks
        that way.
    apart_mm : float
        Poses that move no point by more than this are one.

    Notes
    -----
    From evenly spread rotations, each with two shifts (centroids, and middles of the bounding boxes), the
    fit goes over from nearest points to nearest planes (Chen and Medioni 1992,
    doi:10.1016/0262-8856(92)90066-C) with weights 1 / (1 + (d / s)^2) whose s shrinks; the worst starts are
    dropped on the way.
    """
    from scipy.spatial import cKDTree

    samples, normals = surface.samples(_SAMPLES)
    tree = cKDTree(samples)
    chosen = points_mm[np.unique(np.linspace(0, len(points_mm) - 1, _MOST_POINTS).astype(int))]
    middle = chosen.mean(axis=0)
    local = chosen - middle
    few = slice(None, None, max(1, _SAMPLES // _START_SAMPLES))
    rotation, shift = _starts(local, samples[few], normals[few], towards)
    size = float(np.linalg.norm(np.ptp(samples, axis=0)))
    miss = np.zeros(len(rotation))
    for rounds, width, keep in _STAGES:
        for step in range(rounds):
            plane = width < 0.2 or step > rounds - 2
            rotation, shift = _step(
                local, rotation, shift, tree, samples, normals, max(width, 0.02) * size, plane
            )
        miss = _pose_distances(local, rotation, shift, tree, samples, normals, towards)
        order = np.argsort(miss)[:keep]
        rotation, shift, miss = rotation[order], shift[order], miss[order]
    shift = shift - rotation @ middle
    kept: list[Candidate] = []
    for r, t, value in zip(rotation, shift, miss, strict=True):
        new = Candidate(r, t, float(value))
        if all(separation(new, old, points_mm) > apart_mm for old in kept):
            kept.append(new)
    return kept


def separation(pose: Candidate, other: Candidate, points_mm: Array) -> float:
    """Return the largest distance between the places of a point under two poses, mm."""
    return float(np.max(np.linalg.norm(pose.points(points_mm) - other.points(points_mm), axis=1)))


def _starts(local: Array, samples: Array, normals: Array, towards: Array | None) -> tuple[Array, Array]:
    turns = even_rotations(_ROTATIONS)
    rotation, shift = [], []
    for turn in turns:
        visible = samples
        if towards is not None:
            facing = normals @ (turn @ towards) > 0.2
            visible = samples[facing] if np.count_nonzero(facing) > 50 else samples
        turned = local @ turn.T
        box = 0.5 * (visible.min(axis=0) + visible.max(axis=0)) - 0.5 * (
            turned.min(axis=0) + turned.max(axis=0)
        )
        rotation += [turn, turn]
        shift += [visible.mean(axis=0), box]
    return np.array(rotation), np.array(shift)


def _step(
    local: Array,
    rotation: Array,
    shift: Array,
    tree: object,
    samples: Array,
    normals: Array,
    width: float,
    plane: bool,
) -> tuple[Array, Array]:
    """Move all poses by one Gauss-Newton step to the nearest points or planes."""
    placed = np.einsum("sij,pj->spi", rotation, local) + shift[:, None]
    _, near = tree.query(placed)  # type: ignore[attr-defined]
    away = placed - samples[near]
    weight = 1.0 / (1.0 + np.sum(away**2, axis=2) / width**2)
    across = np.einsum("sji,spj->spi", rotation, normals[near])
    inside = np.einsum("sji,spj->spi", rotation, away)
    if plane:
        rows = np.concatenate([across, np.cross(local[None], across)], axis=2)
        miss = np.einsum("spi,spi->sp", inside, across)
        gram = np.einsum("sp,spi,spj->sij", weight, rows, rows, optimize=True)
        score = -np.einsum("sp,sp,spi->si", weight, miss, rows, optimize=True)
    else:
        arms = pose_rows(local)
        gram = np.einsum("sp,pki,pkj->sij", weight, arms, arms, optimize=True)
        score = -np.einsum("sp,spk,pki->si", weight, inside, arms, optimize=True)
    lever = np.sqrt(np.mean(np.sum(local**2, axis=1)))
    damping = 1e-3 * np.sum(weight, axis=1)[:, None] * np.array([1.0] * 3 + [lever**2] * 3)
    gram[:, range(6), range(6)] += damping
    step = np.linalg.solve(gram, score[:, :, None])[:, :, 0]
    shift = shift + np.einsum("sij,sj->si", rotation, step[:, :3])
    return rotation @ _rotations(step[:, 3:]), shift


def _rotations(vectors: Array) -> Array:
    """Return rotation matrices (s, 3, 3) of rotation vectors (s, 3), at most 0.6 rad each."""
    from scipy.spatial.transform import Rotation

    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    vectors = vectors * np.minimum(1.0, 0.6 / np.maximum(size, 1e-12))
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


def _pose_distances(
    local: Array,
    rotation: Array,
    shift: Array,
    tree: object,
    samples: Array,
    normals: Array,
    towards: Array | None,
) -> Array:
    """Return the trimmed mean distance of each pose, raised where points would lie on hidden faces."""
    placed = np.einsum("sij,pj->spi", rotation, local) + shift[:, None]
    distance, near = tree.query(placed)  # type: ignore[attr-defined]
    offset = np.einsum("spi,spi->sp", placed - samples[near], normals[near])
    distance = np.where(distance < 0.1 * np.ptp(samples, axis=0).max(), np.abs(offset), distance)
    nearest = max(4, int(_TRIM * distance.shape[1]))
    miss = np.mean(np.sort(distance, axis=1)[:, :nearest], axis=1)
    if towards is not None:
        facing = np.einsum("spi,si->sp", normals[near], rotation @ towards)
        miss = miss * (1.0 + 5.0 * np.mean(facing < _FACING, axis=1)) + 1e-3 * np.mean(
            facing < _FACING, axis=1
        )
    return np.asarray(miss)
