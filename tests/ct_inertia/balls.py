"""Balls and plates blurred by a Gaussian point spread, in closed form, and the cuts that hold them."""

from __future__ import annotations

import numpy as np
from scipy.special import erf, ndtr

from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.volume.volume import Volume

AIR, BONE = 1000.0, 11000.0


def places(shape_xyz, spacing_mm):
    """Return the coordinates (x, y, z) of voxel centres [z, y, x], mm, from the middle of the box."""
    axes = [(np.arange(n) - 0.5 * (n - 1)) * spacing_mm for n in shape_xyz]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    return x, y, z


def ball(distance_mm, radius_mm, sigma_mm):
    """Return a ball blurred by a Gaussian, at distances from its centre.

    Integral of the Gaussian over the ball: the difference of two error functions less their shell term.
    """
    r = np.maximum(distance_mm, 1e-9)
    wide = sigma_mm * np.sqrt(2.0)
    inner, outer = (r - radius_mm) / wide, (r + radius_mm) / wide
    shell = sigma_mm / (r * np.sqrt(2.0 * np.pi)) * (np.exp(-(inner**2)) - np.exp(-(outer**2)))
    return 0.5 * (erf(outer) - erf(inner)) - shell


def plate(height_mm, thickness_mm, sigma_mm):
    """Return a plate blurred by a Gaussian, at heights from its middle."""
    half = 0.5 * thickness_mm
    return ndtr((height_mm + half) / sigma_mm) - ndtr((height_mm - half) / sigma_mm)


def volume_of(share, spacing_mm, noise=0.0, seed=1):
    """Return a scan whose grey values run from AIR to BONE, with its first voxel at the origin."""
    grey = AIR + (BONE - AIR) * share + noise * np.random.default_rng(seed).standard_normal(share.shape)
    return Volume(grey.astype(np.float32), np.full(3, spacing_mm), np.zeros(3), np.eye(3))


def cut_of(share, stapes, others=None):
    """Return a cut that is the whole scan."""
    none = np.zeros(share.shape, dtype=bool)
    grey = (AIR + (BONE - AIR) * share).astype(np.float32)
    return Cut(np.zeros(3, dtype=np.int64), grey, stapes, none if others is None else others, none, "test")
