"""Simulated scans of a stapes, alone or in its oval window on a plate, with the exact body beside them."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from legacy.ct_inertia.surface.surface import Surface
from legacy.ct_inertia.volume.volume import Volume

from .solids import (
    box_surface,
    filled,
    grey_volume,
    imaged,
    implicit_surface,
    moved,
    random_rotation,
    stapes_surface,
)

AIR, PLASTIC, BONE = 2000.0, 9000.0, 20000.0


@dataclass(frozen=True)
class Ear:
    volume: Volume
    stapes: Surface
    plate: Surface | None
    air_share: np.ndarray


def window_field(points, gap):
    """Bone around the footplate with an oval window, about ``gap`` mm wider than the footplate."""
    x, y, z = np.moveaxis(points, -1, 0)
    block = np.maximum.reduce([np.abs(x) - 2.2, np.abs(z) - 1.5, np.abs(y) - 0.3])
    hole = np.sqrt((x / 1.4) ** 2 + (z / 0.65) ** 2) * 0.65 - 0.65 - gap
    return np.maximum(block, -hole)


def window(gap, rotation):
    """Return the bone around the oval window, turned like the stapes."""
    bone = implicit_surface(lambda p: window_field(p, gap), (-2.4, -0.5, -1.7), (2.4, 0.5, 1.7), 0.06)
    return moved(bone, rotation)


def scan_of(solids, spacing, sigma_mm, rng, noise=0.04, rays=6, margin=0.5):
    """Return a scan of (surface, contrast as a share of that of bone), and its grey values without noise.

    ``sigma_mm``: of the blur; ``noise``: standard deviation as a share of the contrast of bone; ``rays``:
    along each axis of a voxel; ``margin``: mm of air around the solids.
    """
    low = np.min([s.vertices_mm.min(axis=0) for s, _ in solids], axis=0) - margin
    high = np.max([s.vertices_mm.max(axis=0) for s, _ in solids], axis=0) + margin
    low = low + rng.random(3) * spacing
    count = np.ceil((high - low) / spacing).astype(int)
    share = sum(k * filled(s, count, spacing, low, rays) for s, k in solids)
    sharp = imaged(share, sigma_mm / spacing)
    grey = AIR + (BONE - AIR) * (sharp + noise * rng.standard_normal(sharp.shape, dtype=np.float32))
    return grey_volume(grey, spacing, low), sharp


@lru_cache(maxsize=12)
def ear(h=0.04, gap=None, plate_gap=None, seed=1, noise=0.04, psf=1.2, rays=6, margin=0.5, stretch=(1, 1, 1)):
    """A scan at voxel size h; ``gap`` adds the bone of the window, ``plate_gap`` a plate under it."""
    rotation = random_rotation(seed)
    stapes = moved(stapes_surface(0.05), rotation)
    solids = [(stapes, 1.0)]
    if gap is not None:
        solids.append((window(gap, rotation), 1.0))
    plate = None
    if plate_gap is not None:
        y = stapes_surface(0.05).vertices_mm[:, 1].min()
        plate = moved(box_surface((5.0, 0.8, 4.0), (0.0, y - plate_gap - 0.4, 0.0)), rotation)
        solids.append((plate, (PLASTIC - AIR) / (BONE - AIR)))
    spacing = h * np.array(stretch, dtype=float)
    volume, sharp = scan_of(solids, spacing, psf * h, np.random.default_rng(seed), noise, rays, margin)
    return Ear(volume, stapes, plate, sharp)


def errors(moments, surface):
    """Relative volume, centroid (um), and inertia entries over sqrt(Iii Ijj)."""
    truth = surface.moments()
    scale = np.sqrt(np.outer(np.diag(truth.inertia_mm5), np.diag(truth.inertia_mm5)))
    return (
        moments.volume_mm3 / truth.volume_mm3 - 1.0,
        np.abs(moments.centroid_mm - truth.centroid_mm).max() * 1e3,
        np.abs((moments.inertia_mm5 - truth.inertia_mm5) / scale).max(),
    )
