"""Grey values of placed bodies: partial volumes, a Gaussian point spread, the scanner's noise; slab by slab.

Only the box around the bodies is rendered and blurred; the rest of a volume is air and noise. Nothing is ever
held as a whole but the integers asked for.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sample_volumes import bodies
from sample_volumes.bodies import Solid
from sample_volumes.coverage import Crossings, crossings
from sample_volumes.density import height_range, relative_density
from sample_volumes.scanner import add_noise, cup, stored

if TYPE_CHECKING:
    from sample_volumes.ear import Scene

_TRUNCATE = 5.0
_PITCH_MM = 0.003
_IMAGEJ_BYTES = 1 << 31


@dataclass(frozen=True)
class _Part:
    """One body on its own grid: first column and row in the volume, crossings, material."""

    corner: tuple[int, int]
    grid: Crossings
    material: int


class Renderer:
    """Grey values of a scene, any range of slices at a time."""

    def __init__(self, placed: Scene) -> None:
        self.placed = placed
        ear = placed.ear
        spacing = np.asarray(ear.voxel_mm)
        self.margin = int(_TRUNCATE * ear.psf_voxels + 0.5)
        shape = np.asarray(placed.shape)
        boxes = [_box(solid, spacing, 0) for solid, _ in placed.solids]
        reach = self.margin + 1
        low = np.min([box[0] for box in boxes], axis=0) - reach
        high = np.max([box[1] for box in boxes], axis=0) + reach
        self.low = np.clip(low, -self.margin, shape + self.margin)
        self.high = np.clip(high, self.low, shape + self.margin)
        samples = int(np.clip(np.ceil(spacing[:2].max() / _PITCH_MM - 1e-9), 2, 16))
        self.parts = [
            part
            for (solid, material), box in zip(placed.solids, boxes, strict=True)
            if (part := self._part(solid, material, box, spacing, samples)) is not None
        ]

    def _part(
        self,
        solid: Solid,
        material: int,
        box: tuple[NDArray[np.int64], NDArray[np.int64]],
        spacing: NDArray[np.float64],
        samples: int,
    ) -> _Part | None:
        low, high = np.maximum(box[0], self.low)[:2], np.minimum(box[1], self.high)[:2]
        if np.any(high <= low):
            return None
        corner = (int(low[0]), int(low[1]))
        shape = (int(high[0] - low[0]), int(high[1] - low[1]))
        shift = np.array([*corner, 0])
        return _Part(
            corner, crossings(solid.vertices / spacing - shift, solid.faces, shape, samples), material
        )

    def _filled(self, first: int, count: int, material: int) -> NDArray[np.float32]:
        """Return how far a material fills the box around the bodies, overlapping bodies counted once."""
        size = self.high - self.low
        filled = np.zeros((count, size[1], size[0]), dtype=np.float32)
        for part in self.parts:
            if part.material != material or not part.grid.touches(first, count):
                continue
            x, y = part.corner[0] - self.low[0], part.corner[1] - self.low[1]
            nx, ny = part.grid.shape
            filled[:, y : y + ny, x : x + nx] += part.grid.slab(first, count)
        return np.minimum(filled, 1.0, out=filled)

    def contrast(self, first: int, count: int) -> NDArray[np.float32]:
        """Return noise-free grey values above air, blurred, (count, y, x), in units of the bone contrast."""
        from scipy.ndimage import gaussian_filter1d

        ear = self.placed.ear
        air, plastic, bone = ear.levels
        nx, ny, _ = self.placed.shape
        grey = np.zeros((count, ny, nx), dtype=np.float32)
        start, stop = max(first, int(self.low[2])), min(first + count, int(self.high[2]))
        if start >= stop or np.any(self.high <= self.low):
            return grey
        wide = (start - self.margin, stop - start + 2 * self.margin)
        box = self._filled(*wide, 2)
        plastics = self._filled(*wide, 1)
        np.minimum(plastics, 1.0 - box, out=plastics)
        plastics *= np.float32((plastic - air) / (bone - air))
        if ear.gradient:
            box *= self._relative_density(*wide)
        box += plastics
        del plastics
        if self.margin:
            box = gaussian_filter1d(box, ear.psf_voxels, axis=0, truncate=_TRUNCATE)
            box = box[self.margin : -self.margin]
            for axis in (1, 2):
                box = gaussian_filter1d(box, ear.psf_voxels, axis=axis, truncate=_TRUNCATE)
        low = np.maximum(self.low[:2], 0)
        high = np.minimum(self.high[:2], [nx, ny])
        (x0, y0), (x1, y1) = low - self.low[:2], high - self.low[:2]
        grey[start - first : stop - first, low[1] : high[1], low[0] : high[0]] = box[:, y0:y1, x0:x1]
        return grey

    def _relative_density(self, first: int, count: int) -> NDArray[np.float32]:
        """Return density over stated density at the voxel centres of the box around the bodies."""
        placed = self.placed
        ends = height_range(bodies.stapes_in_footplate(placed.ear.stapes))
        size = self.high - self.low
        x, y = (np.arange(size[axis]) + self.low[axis] for axis in (0, 1))
        z = np.arange(first, first + count)
        dx, dy, dz = placed.ear.voxel_mm
        lateral = placed.scan_from_footplate.rotation[:, 1]
        start = -lateral @ placed.scan_from_footplate.translation_mm
        height = (
            (lateral[2] * dz * z + start)[:, None, None]
            + (lateral[1] * dy * y)[:, None]
            + lateral[0] * dx * x
        )
        return relative_density(height, ends, placed.ear.gradient).astype(np.float32)

    def slices(self, first: int, count: int) -> NDArray[Any]:
        """Return slices as the scanner stores them, noise included; it does not depend on the slabs."""
        ear = self.placed.ear
        air, _, bone = ear.levels
        grey = self.contrast(first, count)
        if ear.cupping:
            cup(grey, ear.cupping)
        if ear.noise > 0.0:
            add_noise(grey, first, ear)
        grey *= np.float32(bone - air)
        return stored(grey, air, ear.dtype)


def _box(
    solid: Solid, spacing: NDArray[np.float64], reach: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first voxel of a body and the one after its last, with ``reach`` voxels around."""
    low = np.floor(solid.vertices.min(axis=0) / spacing + 0.5).astype(np.int64) - reach
    high = np.floor(solid.vertices.max(axis=0) / spacing + 0.5).astype(np.int64) + 1 + reach
    return low, high


def slab_height(shape: tuple[int, int, int], most_bytes: int = 1 << 28) -> int:
    """Return how many slices are rendered at a time, so that a slab of floats stays small."""
    nx, ny, nz = shape
    return max(1, min(nz, most_bytes // (4 * nx * ny)))


def render(placed: Scene) -> NDArray[Any]:
    """Return the whole volume, (z, y, x)."""
    nx, ny, nz = placed.shape
    volume = np.empty((nz, ny, nx), dtype=placed.ear.dtype)
    _fill(_as_built(volume, placed.ear.mirror), placed)
    return volume


def _as_built(stored: Any, mirror: str) -> Any:
    """Return a view of the stored slices in the order in which they lie in space."""
    return np.flip(stored, axis="zyx".index(mirror)) if mirror else stored


def _fill(target: Any, placed: Scene) -> None:
    """Write all slices into an array (z, y, x), two slabs at a time where there are two cores."""
    from concurrent.futures import ThreadPoolExecutor

    renderer = Renderer(placed)
    nz = placed.shape[2]
    workers = min(2, os.cpu_count() or 1)
    height = min(slab_height(placed.shape), -(-nz // workers))

    def fill(first: int) -> None:
        count = min(height, nz - first)
        target[first : first + count] = renderer.slices(first, count)

    with ThreadPoolExecutor(workers) as pool:
        for done in [pool.submit(fill, first) for first in range(0, nz, height)]:
            done.result()


def write_scan(path: Path, placed: Scene) -> None:
    """Write the scan as an uncompressed TIFF stack with its spacing, slab by slab.

    Up to 2 GiB it is an ImageJ stack (big-endian, as ImageJ has it), above that, or named .ome.tif, an OME
    BigTIFF in the machine's byte order; both can be mapped into memory.
    """
    import tifffile

    nx, ny, nz = placed.shape
    dx, dy, dz = placed.ear.voxel_mm
    dtype = np.dtype(placed.ear.dtype)
    common: dict[str, Any] = {"shape": (nz, ny, nx), "dtype": dtype}
    if dtype.itemsize * nx * ny * nz <= _IMAGEJ_BYTES and not path.name.endswith(".ome.tif"):
        common["dtype"] = dtype.newbyteorder(">")
        stack = tifffile.memmap(
            path,
            imagej=True,
            resolution=(1.0 / dx, 1.0 / dy),
            metadata={"spacing": dz, "unit": "mm", "axes": "ZYX"},
            **common,
        )
    else:
        sizes = {"PhysicalSizeX": dx, "PhysicalSizeY": dy, "PhysicalSizeZ": dz}
        units = {f"{name}Unit": "mm" for name in sizes}
        stack = tifffile.memmap(
            path, bigtiff=True, ome=True, metadata={"axes": "ZYX", **sizes, **units}, **common
        )
    _fill(_as_built(stack, placed.ear.mirror), placed)
    stack.flush()
    del stack
