"""A micro-CT scanner: grey values of a placed ear from exact partial volumes to stored numbers, slab by slab.

The order is that of a scanner: partial volumes of bone, plastic and soft tissue; point spread; motion; edge
fringes; cupping; rings; noise; tone curve; storing. No slice depends on how a volume is cut into slabs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulate.coverage import crossings
from simulate.ear import Ear, Placed, place
from simulate.solids import Solid, joined
from stapeskit.arrays import Array
from stapeskit.frames import rotation_from_vector

Floats = NDArray[np.float32]
STORED = {"uint8": (1.0 / 257.0, 0.0), "int16": (1.0, -32768.0), "uint16": (1.0, 0.0), "float32": (1.0, 0.0)}
"""Numbers of a file by type: factor and offset of grey values 0 to 65535."""
_SLAB_BYTES = 1 << 28  # of floats that are rendered at once
_TRUNCATE = 5.0  # sigmas of a blur: what is beyond is below a 16 bit step
_SLICE_OF_SEED = 1 << 20  # seeds of correlated noise lie beyond those of any slice


@dataclass(frozen=True, kw_only=True)
class Scan:
    """How an ear is scanned; blurs in voxels, noise, fringes and rings in contrasts between bone and air."""

    voxel_um: float | tuple[float, float, float] = 25.0  # one number, or x, y, z
    # voxels x, y, z; None: the smallest box with 0.25 mm around everything
    shape: tuple[int, int, int] | None = None
    upright: str = "z"  # scan axis near the lateral direction
    tilt_deg: float = 18.0  # how far the ear may lean in the scanner, drawn by ``seed``
    # sigma of the point spread; standard deviation of the noise; sigma of the blur of the noise
    blur_voxels: float = 1.2
    noise: float = 0.04
    noise_correlation_voxels: float = 0.0
    # share of the contrast lost in the middle of the view: a parabola that vanishes at the border
    cupping: float = 0.0
    rings: float = 0.0  # standard deviation of the height of rings about the rotation axis
    # blur along x; distance by which the ear has moved half way through the scan
    motion_voxels: float = 0.0
    jump_voxels: float = 0.0
    # share of the Laplacian that is subtracted (bright and dark edges of phase contrast)
    fringe: float = 0.0
    gamma: float = 1.0  # exponent of a tone curve from 0.2 contrasts below air to 0.5 above bone
    # grey values of air, plastic and bone as 16 bit numbers
    levels: tuple[float, float, float] = (8000.0, 15000.0, 30000.0)
    soft: float = 0.2  # contrast of soft tissue and fluid
    dtype: str = "uint16"  # one of STORED
    # grey values (16 bit) of the lowest and the highest stored number: all beyond is clipped
    window: tuple[float, float] | None = None
    steps: int | None = None  # only so many different stored numbers
    # only the circle within the slices is reconstructed; outside it is ``padding`` (a stored number)
    round_field: bool = False
    padding: float = 0.0
    mirror: str = ""  # scan axis along which the slices are stored in reverse order, or empty
    samples: int | None = None  # sub-columns along each side of a voxel; None: 3 um apart, from 2 to 16
    format: str = "tif"  # one of simulate.files.volumes.WRITERS; empty: no scan is written
    seed: int = 1  # of the pose, noise, rings and stated density

    @property
    def voxel_mm(self) -> Array:
        """Voxel size x, y, z, mm."""
        return np.broadcast_to(np.asarray(self.voxel_um, dtype=float) * 1e-3, 3).copy()

    def placed(self, ear: Ear) -> Placed:
        """Return the ear placed in the scan."""
        rng = np.random.default_rng(self.seed)
        rotation = _UPRIGHT[self.upright] @ _random_tilt(rng, self.tilt_deg)
        return place(ear, self.voxel_mm, rotation, rng, self.shape)

    def stored_levels(self) -> list[float]:
        """Return the grey values of air, plastic and bone as they stand in the file, before rounding."""
        factor, offset = self._to_stored()
        return [level * factor + offset for level in self.levels]

    def _to_stored(self) -> tuple[float, float]:
        if self.window is None:
            return STORED[self.dtype]
        low, high = self.window
        ends = (0.0, 1.0) if self.dtype == "float32" else (np.iinfo(self.dtype).min, np.iinfo(self.dtype).max)
        factor = (ends[1] - ends[0]) / (high - low)
        return factor, ends[0] - factor * low


_UPRIGHT = {
    axis: rotation_from_vector(np.radians(turn))
    for axis, turn in {"x": [0.0, 0.0, -90.0], "y": [0.0, 0.0, 0.0], "z": [90.0, 0.0, 0.0]}.items()
}


def _random_tilt(rng: np.random.Generator, most_deg: float) -> Array:
    lean = rng.normal(size=3) * np.array([1.0, 0.0, 1.0])
    lean *= np.radians(most_deg) * rng.uniform(0.4, 1.0) / np.linalg.norm(lean)
    turn = rotation_from_vector([0.0, np.radians(rng.uniform(-most_deg, most_deg)), 0.0])
    return rotation_from_vector(lean) @ turn


class Renderer:
    """Grey values of a placed ear, any range of slices at a time."""

    def __init__(self, placed: Placed, scan: Scan) -> None:
        self.placed, self.scan = placed, scan
        self.margin = int(_TRUNCATE * scan.blur_voxels + 0.5)
        bodies = _bodies(placed, scan)
        corners = np.concatenate([solid.vertices_mm for solid in bodies.values()]) / placed.voxel_mm
        reach, shape = self.margin + 1, np.asarray(placed.shape)
        low = np.floor(corners.min(axis=0) + 0.5).astype(np.int64) - reach
        high = np.floor(corners.max(axis=0) + 0.5).astype(np.int64) + 1 + reach
        self.low = np.clip(low, -self.margin, shape + self.margin)
        self.high = np.clip(high, self.low, shape + self.margin)
        samples = scan.samples or int(np.clip(np.ceil(placed.voxel_mm[:2].max() / 0.003 - 1e-9), 2, 16))
        corner, (nx, ny, _) = np.array([self.low[0], self.low[1], 0]), self.high - self.low
        self.grids = {
            material: crossings(solid.vertices_mm / placed.voxel_mm - corner, solid.faces, (nx, ny), samples)
            for material, solid in bodies.items()
        }

    def coverage(self, first: int, count: int) -> Floats:
        """Return what fills each voxel of the box around all, in its contrast, not blurred.

        Overlapping bodies of one material count once; plastic and soft tissue fill what bone leaves free.
        """
        air, plastic, bone = self.scan.levels
        nx, ny, _ = self.high - self.low
        grey, free = np.zeros((count, ny, nx), dtype=np.float32), np.ones((count, ny, nx), dtype=np.float32)
        contrasts = {"bone": 1.0, "plastic": (plastic - air) / (bone - air), "soft": self.scan.soft}
        for material in (name for name in contrasts if name in self.grids):
            share = self.grids[material].slab(first, count)
            if self.scan.jump_voxels:
                share *= np.float32(0.5)
            np.minimum(share, free, out=share)
            free -= share
            grey += np.float32(contrasts[material]) * share
        return grey

    def contrast(self, first: int, count: int) -> Floats:
        """Return noise-free grey values above air, (count, y, x), in units of the bone contrast."""
        if not self.scan.fringe:
            return self._blurred(first, count)
        from scipy.ndimage import laplace

        wide = self._blurred(first - 1, count + 2)
        return np.asarray((wide - np.float32(self.scan.fringe) * laplace(wide))[1:-1])

    def _blurred(self, first: int, count: int) -> Floats:
        from scipy.ndimage import gaussian_filter1d

        nx, ny, _ = self.placed.shape
        grey = np.zeros((count, ny, nx), dtype=np.float32)
        start, stop = max(first, int(self.low[2])), min(first + count, int(self.high[2]))
        if start >= stop or np.any(self.high <= self.low):
            return grey
        box = self.coverage(start - self.margin, stop - start + 2 * self.margin)
        sigma = self.scan.blur_voxels
        if self.margin:
            box = gaussian_filter1d(box, sigma, axis=0, truncate=_TRUNCATE)[self.margin : -self.margin]
            for axis in (1, 2):
                box = gaussian_filter1d(box, sigma, axis=axis, truncate=_TRUNCATE)
        if self.scan.motion_voxels:
            box = gaussian_filter1d(box, self.scan.motion_voxels, axis=2, truncate=_TRUNCATE)
        low, high = np.maximum(self.low[:2], 0), np.minimum(self.high[:2], [nx, ny])
        (x0, y0), (x1, y1) = low - self.low[:2], high - self.low[:2]
        grey[start - first : stop - first, low[1] : high[1], low[0] : high[0]] = box[:, y0:y1, x0:x1]
        return grey

    def slices(self, first: int, count: int) -> NDArray[Any]:
        """Return slices as the scanner stores them, noise included."""
        scan = self.scan
        air, _, bone = scan.levels
        grey = self.contrast(first, count)
        if scan.cupping:
            # beam hardening as a scanner's correction leaves it: a parabola that vanishes at the border
            share = np.minimum(_radius2(grey.shape), 1.0)
            grey *= (1.0 - scan.cupping * (1.0 - share)).astype(np.float32)
        if scan.rings:
            grey += _rings(grey.shape, scan)
        if scan.noise > 0.0:
            add_noise(grey, first, scan)
        if scan.gamma != 1.0:
            share = np.clip((grey + np.float32(0.2)) / np.float32(1.7), 0.0, 1.0)
            grey = np.asarray(np.float32(1.7) * share**scan.gamma - np.float32(0.2), dtype=np.float32)
        grey *= np.float32(bone - air)
        return self._stored(grey)

    def _stored(self, grey: Floats) -> NDArray[Any]:
        """Return grey values above air (overwritten) as numbers of the file's type, rounded and clipped."""
        scan = self.scan
        factor, offset = scan._to_stored()
        if factor != 1.0:
            grey *= np.float32(factor)
        whole = scan.dtype != "float32"
        grey += np.float32(scan.levels[0] * factor + offset + (0.5 if whole else 0.0))
        if whole:
            np.floor(grey, out=grey)
            ends = np.iinfo(scan.dtype)
            np.clip(grey, ends.min, ends.max, out=grey)
        if scan.steps is not None:
            step = np.float32((65536.0 if scan.dtype != "uint8" else 256.0) / scan.steps)
            grey = np.asarray(np.floor(grey / step) * step, dtype=np.float32)
        if scan.round_field:
            grey[:, _radius2(grey.shape) > 1.0] = scan.padding
        return grey.astype(scan.dtype)


def _bodies(placed: Placed, scan: Scan) -> dict[str, Solid]:
    """Return all bodies of each material, in both places when the ear moves half way through the scan."""
    step = np.random.default_rng([scan.seed, 29]).normal(size=3)
    step *= 0.5 * scan.jump_voxels / np.linalg.norm(step) * placed.voxel_mm
    found = dict[str, list[Solid]]()
    for solid, material in placed.solids:
        for way in (-1.0, 1.0) if scan.jump_voxels else (0.0,):
            found.setdefault(material, []).append(Solid(solid.vertices_mm + way * step, solid.faces))
    return {material: joined(*solids) for material, solids in found.items()}


def _radius2(shape: tuple[int, ...]) -> Array:
    """Return the squared distance (y, x) from the rotation axis, divided by that of the slices' border."""
    _, ny, nx = shape
    x, y = ((np.arange(n) - 0.5 * (n - 1)) / (0.5 * n) for n in (nx, ny))
    return np.asarray(x[None, :] ** 2 + y[:, None] ** 2)


def _rings(shape: tuple[int, ...], scan: Scan) -> Floats:
    """Return the heights (y, x) of rings one voxel wide about the middle of the slices."""
    rng = np.random.default_rng([scan.seed, 31])
    radius = np.hypot(*np.meshgrid(*(np.arange(n) - 0.5 * (n - 1) for n in shape[:0:-1])))
    count = int(radius.max()) + 2
    height = np.interp(radius, np.arange(count), rng.normal(0.0, scan.rings, count))
    return np.asarray(height, dtype=np.float32)


def add_noise(grey: Floats, first: int, scan: Scan) -> None:
    """Add Gaussian noise to slices from slice ``first`` on, in place.

    Correlated noise is white noise blurred by a Gaussian and brought back to its standard deviation.
    """
    count, ny, nx = grey.shape
    sigma = scan.noise_correlation_voxels
    if sigma <= 0.0:
        for k in range(count):
            rng = np.random.default_rng([scan.seed, first + k])
            grey[k] += np.float32(scan.noise) * rng.standard_normal((ny, nx), dtype=np.float32)
        return
    from scipy.ndimage import correlate1d

    reach = int(np.ceil(4.0 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel = (kernel / np.sqrt((kernel**2).sum())).astype(np.float32)
    white = np.empty((count + 2 * reach, ny, nx), dtype=np.float32)
    for k in range(len(white)):
        rng = np.random.default_rng([scan.seed, _SLICE_OF_SEED + first + k - reach])
        rng.standard_normal(out=white[k], dtype=np.float32)
        for axis in (0, 1):
            white[k] = correlate1d(white[k], kernel, axis=axis, mode="wrap")
    grey += np.float32(scan.noise) * correlate1d(white, kernel, axis=0, mode="wrap")[reach : reach + count]


def render_into(target: Any, placed: Placed, scan: Scan) -> None:
    """Write all slices into an array (z, y, x), in slabs."""
    renderer = Renderer(placed, scan)
    nx, ny, nz = placed.shape
    built = np.flip(target, axis="zyx".index(scan.mirror)) if scan.mirror else target
    height = max(1, min(nz, _SLAB_BYTES // (4 * nx * ny)))
    for first in range(0, nz, height):
        count = min(height, nz - first)
        built[first : first + count] = renderer.slices(first, count)


def render(placed: Placed, scan: Scan) -> NDArray[Any]:
    """Return the whole volume as it is stored, (z, y, x)."""
    volume = np.empty(placed.shape[::-1], dtype=scan.dtype)
    render_into(volume, placed, scan)
    return volume
