"""Scans of foreign stapedes with their truth: surroundings, blur, noise and storing as drawn or asked for."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, laplace, shift

from benchmarks import foreign_shapes as shapes

Array = NDArray[np.float64]
Grey = NDArray[np.float32]
_MARGIN_MM = 0.35
_CELL = 4


@dataclass(frozen=True)
class Scene:
    """What a scan shows. Lengths in mm, voxel in um, blur in voxels, levels and noise in contrasts air-bone.

    ``motion`` blurs along x, voxels; ``jump`` moves the sample by so many voxels half way; ``fringe``
    subtracts so much of the Laplacian; ``gamma`` is the exponent of a tone curve from 0.2 contrasts below air
    to 0.5 above bone. ``window`` are the contrasts of the lowest and the highest grey value,
    ``steps`` their number.
    """

    voxel_um: float = 25.0
    blur: float = 1.2
    noise: float = 0.02
    correlation: float = 0.0
    window: tuple[float, float] = (-0.4, 2.9)
    steps: int = 65536
    gap_mm: float | None = None
    incus_mm: float | None = None
    neighbour: float = 1.0
    plate: float | None = None
    plate_gap_mm: float = 0.05
    fluid: float = 0.0
    fluid_depth_mm: float = 0.3
    coat: float = 0.0
    coat_mm: float = 0.035
    void: float = 0.0
    rings: float = 0.0
    motion: float = 0.0
    jump: float = 0.0
    fringe: float = 0.0
    gamma: float = 1.0
    cropped_mm: float | None = None


@dataclass(frozen=True)
class Truth:
    """Volume, mm3, centroid (3,), second moments (3, 3), mm5, in scan axes; the body and its pose (4, 4)."""

    volume_mm3: float
    centroid_mm: Array
    second_mm5: Array
    anatomy: shapes.Anatomy
    scan_from_body: Array

    @property
    def scan_from_footplate(self) -> Array:
        """Return the footplate frame (4, 4), which takes as long to find as a scan to make."""
        return np.asarray(self.scan_from_body @ frame_in_body(self.anatomy))


def draw_scene(rng: np.random.Generator, **asked: Any) -> Scene:
    """Draw voxel size, blur and noise; the rest is as asked."""
    drawn = Scene(
        voxel_um=rng.uniform(18.0, 40.0),
        blur=rng.uniform(0.9, 1.7),
        noise=float(np.exp(rng.uniform(np.log(0.01), np.log(0.06)))),
        correlation=rng.choice((0.0, 0.7)),
    )
    return replace(drawn, **asked)


def make(anatomy: shapes.Anatomy, scene: Scene, rng: np.random.Generator, file: Path) -> Truth:
    """Write a scan as a TIFF and return the truth behind it."""
    import tifffile

    h = scene.voxel_um * 1e-3
    scan_from_body, shape = _pose(anatomy, h, scene, rng)
    grid = _Grid(scan_from_body, shape, h)
    own = grid.share(lambda p: shapes.body(anatomy, p))
    truth = _truth(own, h, anatomy, scan_from_body)
    grey = gaussian_filter(_fill(anatomy, scene, grid, own), scene.blur, truncate=5.0)
    if scene.motion:
        grey = gaussian_filter(grey, (0.0, 0.0, scene.motion))
    if scene.jump:
        grey = _jump(grey, scene.jump, rng)
    if scene.fringe:
        grey -= np.float32(scene.fringe) * laplace(grey)
    if scene.rings:
        grey += _rings(grey.shape, scene.rings, rng)
    noise = rng.standard_normal(grey.shape, dtype=np.float32)
    if scene.correlation:
        noise = gaussian_filter(noise, scene.correlation)
        noise /= noise.std()
    grey += np.float32(scene.noise) * noise
    if scene.gamma != 1.0:
        grey = np.float32(1.7) * np.clip((grey + np.float32(0.2)) / np.float32(1.7), 0.0, 1.0) ** scene.gamma
    low, high = scene.window
    step = (high - low) / (scene.steps - 1)
    stored = np.clip(np.rint((grey - low) / step), 0, scene.steps - 1)
    scale = 1 if scene.steps in (256, 65536) else 256 // scene.steps
    kind = np.uint8 if scene.steps <= 256 else np.uint16
    tifffile.imwrite(file, (stored * scale).astype(kind), photometric="minisblack")
    return truth


def fine_grid(h: float) -> tuple[_Grid, Array]:
    """Return a grid around a body in its own axes, and the transform (4, 4) from its index."""
    corners = np.array([[-1.9, -0.5, -1.1], [1.9, 4.1, 1.1]]) * 1.1
    start = np.eye(4)
    start[:3, 3] = -corners[0]
    shape = tuple(int(v) for v in np.ceil((corners[1] - corners[0]) / h)[::-1])
    index_to_body = np.diag([h, h, h, 1.0])
    index_to_body[:3, 3] = corners[0]
    return _Grid(start, shape, h), index_to_body


@cache
def _frame(anatomy: _Hashed) -> Array:
    from legacy.ct_inertia.frames.anatomy import AnatomyHints
    from legacy.ct_inertia.frames.footplate import footplate_frame
    from legacy.ct_inertia.surface.isosurface import iso_surface

    grid, index_to_body = fine_grid(0.022)
    signed = grid.signed(lambda p: shapes.body(anatomy.it, p))
    surface = iso_surface(-signed, 0.0, index_to_body)
    hints = AnatomyHints(np.array([1.0, 0.0, 0.0]), {}, None)
    return np.asarray(footplate_frame(surface, hints).scan_from_footplate.matrix)


@dataclass(frozen=True, eq=False)
class _Hashed:
    it: shapes.Anatomy

    def __hash__(self) -> int:
        return hash(repr(self.it))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Hashed) and repr(self.it) == repr(other.it)


def frame_in_body(anatomy: shapes.Anatomy) -> Array:
    """Return the footplate frame (4, 4) of the body itself, by the definition, on a fine surface."""
    return _frame(_Hashed(anatomy))


class _Grid:
    """Voxels of a scan; fields are looked at closely near their surfaces only."""

    def __init__(self, scan_from_body: Array, shape: tuple[int, ...], h: float) -> None:
        self.shape, self.h = shape, h
        self.body_from_scan = np.linalg.inv(scan_from_body)

    def points(self, index: tuple[Array, ...]) -> tuple[Grey, Grey, Grey]:
        """Return body coordinates of indices z, y, x."""
        z, y, x = (np.asarray(i, dtype=np.float32) * np.float32(self.h) for i in index)
        m = self.body_from_scan.astype(np.float32)
        return tuple(m[k, 0] * x + m[k, 1] * y + m[k, 2] * z + m[k, 3] for k in range(3))  # type: ignore[return-value]

    def signed(self, field: Any) -> Grey:
        """Return about the distance from a surface in mm near it, and +-1 elsewhere."""
        cells = tuple(-(-n // _CELL) for n in self.shape)
        middle = np.meshgrid(
            *(np.arange(n) * _CELL + 0.5 * (_CELL - 1) for n in cells), indexing="ij", sparse=True
        )
        coarse = field(tuple(np.broadcast_to(p, cells) for p in self.points(tuple(middle))))
        whole = np.repeat(np.repeat(np.repeat(np.sign(coarse), _CELL, 0), _CELL, 1), _CELL, 2)
        near = np.argwhere(np.abs(coarse) < 1.6 * _CELL * self.h)
        inner = np.stack(np.meshgrid(*[np.arange(_CELL)] * 3, indexing="ij"), axis=-1).reshape(1, -1, 3)
        index = (near[:, None, :] * _CELL + inner).reshape(-1, 3)
        value = field(self.points(tuple(index.T)))
        whole[tuple(index.T)] = value
        result = np.full(whole.shape, 1.0, dtype=np.float32)
        result[whole < 0] = -1.0
        # Gradients along the axes, for fields that are no exact distances.
        parts = value.reshape(-1, _CELL, _CELL, _CELL)
        steep = np.sqrt(sum(np.gradient(parts, self.h, axis=k) ** 2 for k in (1, 2, 3)))
        result[tuple(index.T)] = value / np.maximum(steep.ravel(), 0.2)
        return result[: self.shape[0], : self.shape[1], : self.shape[2]]

    def share(self, field: Any) -> Grey:
        """Return how much of each voxel a body fills."""
        return np.clip(0.5 - self.signed(field) / np.float32(self.h), 0.0, 1.0)


def _pose(
    anatomy: shapes.Anatomy, h: float, scene: Scene, rng: np.random.Generator
) -> tuple[Array, tuple[int, ...]]:
    """Draw a rotation near one of the axes' permutations; the box holds the body and a margin."""
    from scipy.spatial.transform import Rotation

    quarter = Rotation.from_euler("xyz", rng.integers(0, 4, 3) * 90, degrees=True)
    turn = (Rotation.from_rotvec(rng.normal(0.0, 0.15, 3)) * quarter).as_matrix()
    half, foot = 0.5 * anatomy.length + 0.25, -0.3
    top = anatomy.height + 0.15 + (0.6 if scene.incus_mm is not None else 0.0)
    if scene.plate is not None or scene.fluid:
        foot -= 0.4
    if scene.cropped_mm is not None:
        top = anatomy.height + (scene.incus_mm or 0.0) + scene.cropped_mm - _MARGIN_MM
    side = 0.5 * anatomy.width + 0.3
    ends = np.array(np.meshgrid((-half, half), (foot, top), (-side, side))).reshape(3, -1).T * anatomy.scale
    if scene.cropped_mm is not None:
        turn = quarter.as_matrix()
    turned = ends @ turn.T
    low, high = turned.min(axis=0) - _MARGIN_MM, turned.max(axis=0) + _MARGIN_MM
    start = np.eye(4)
    start[:3, :3], start[:3, 3] = turn, -low - rng.uniform(0.0, h, 3)
    return start, tuple(int(v) for v in np.ceil((high - low) / h)[::-1])


def _truth(own: Grey, h: float, anatomy: shapes.Anatomy, scan_from_body: Array) -> Truth:
    index = np.argwhere(own > 0)
    weight = own[tuple(index.T)].astype(float) * h**3
    points = index[:, ::-1] * h
    volume = float(weight.sum())
    centre = weight @ points / volume
    away = points - centre
    second = (away * weight[:, None]).T @ away - np.eye(3) * volume * h * h / 12.0
    return Truth(volume, centre, second, anatomy, scan_from_body)


def _fill(anatomy: shapes.Anatomy, scene: Scene, grid: _Grid, own: Grey) -> Grey:
    """Return the grey values of body and surroundings, not yet blurred."""
    grey = own.copy()
    free = 1 - own
    for wanted, field in (
        (scene.gap_mm, lambda p: shapes.window(anatomy, p, scene.gap_mm or 0.0)),
        (scene.incus_mm, lambda p: shapes.incus(anatomy, p, scene.incus_mm or 0.0)),
    ):
        if wanted is not None:
            share = np.minimum(grid.share(field), free)
            grey += np.float32(scene.neighbour) * share
            free = free - share
    if scene.coat:
        share = np.minimum(grid.share(lambda p: shapes.body(anatomy, p) - np.float32(scene.coat_mm)), 1) - own
        share = np.clip(np.minimum(share, free), 0, 1)
        grey += np.float32(scene.coat) * share
        free = free - share
    if scene.void:
        from scipy.ndimage import label

        parts, _ = label(free > 0.02)
        inside = (parts > 0) & (parts != parts[0, 0, 0])
        grey[inside] += np.float32(scene.void) * free[inside]
    if scene.plate is not None:
        share = np.minimum(grid.share(lambda p: _plate(scene, p)), free)
        grey += np.float32(scene.plate) * share
        free = free - share
    if scene.fluid:
        share = np.minimum(grid.share(_pool), free)
        grey += np.float32(scene.fluid) * share
    return grey


def _plate(scene: Scene, p: tuple[Grey, Grey, Grey]) -> Grey:
    """Return the field of a plate under the footplate, tilted a little."""
    lowest = -0.12 - scene.plate_gap_mm
    face = p[1] - np.float32(lowest) - np.float32(0.02) * p[0]
    return np.maximum(face, np.float32(lowest - 0.6) - p[1])


def _pool(p: tuple[Grey, Grey, Grey]) -> Grey:
    """Return the field of fluid under the footplate, with a meniscus."""
    level = np.float32(0.12) + np.float32(0.1) * (p[0] / 1.5) ** 2 + np.float32(0.15) * (p[2] / 0.7) ** 2
    return np.asarray(p[1] - level)


def _jump(grey: Grey, length: float, rng: np.random.Generator) -> Grey:
    """Return the mean of two images, moved apart along a drawn direction."""
    step = rng.normal(0.0, 1.0, 3)
    step *= 0.5 * length / np.linalg.norm(step)
    both = [shift(grey, sign * step, order=3, mode="nearest") for sign in (-1.0, 1.0)]
    return np.asarray(0.5 * (both[0] + both[1]), dtype=np.float32)


def _rings(shape: tuple[int, ...], height: float, rng: np.random.Generator) -> Grey:
    y, x = np.mgrid[: shape[1], : shape[2]]
    r = np.hypot(y - shape[1] * rng.uniform(0.2, 0.8), x - shape[2] * rng.uniform(0.2, 0.8))
    amount = np.interp(r, np.arange(int(r.max()) + 2), rng.normal(0.0, height, int(r.max()) + 2))
    return np.broadcast_to(amount.astype(np.float32), shape).copy()
