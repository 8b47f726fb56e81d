"""Thresholded scans: the error of the volume when grey values within a voxel are lost."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.grey.partial_volume import sensitivity, with_contribution
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.surface.surface import Surface
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

# Most grey values of a scan that somebody has thresholded: a few materials, where a scan has hundreds.
_FEW_VALUES = 4
# Voxels a piece, after each of which the search can end.
_PIECE = 10_000


def is_thresholded(grey: NDArray[Any]) -> bool:
    """Return whether grey values [z, y, x] are so few different ones that they are classes, not a picture."""
    known: NDArray[Any] = np.zeros(0, dtype=grey.dtype)
    flat = grey.ravel()
    for start in range(0, flat.size, _PIECE):
        known = np.union1d(known, flat[start : start + _PIECE])
        if known.size > _FEW_VALUES:
            return False
    return True


def with_threshold(moments: Moments, surface: Surface, voxel_mm: float) -> tuple[Moments, Notice]:
    """Add the uncertainty of the surface from an unknown threshold, with a warning.

    Parameters
    ----------
    moments : Moments
    surface : Surface
        The body's.
    voxel_mm : float
        Edge of a voxel.

    Returns
    -------
    Moments
        With the contribution ``threshold``.
    Notice
        ``scan_thresholded``.

    Notes
    -----
    The surface may lie anywhere within half a voxel of where it is drawn, all of it together: a uniform
    distribution has the standard deviation voxel / sqrt(12). A shift d along the normal adds d dA.
    """
    shift = voxel_mm / np.sqrt(12.0)
    a, b, c = (surface.vertices_mm[surface.faces[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    away = (a + b + c) / 3.0 - moments.centroid_mm
    step = shift * (sensitivity(away, moments.volume_mm3, 0.0).T @ area)
    share = 100.0 * shift * float(area.sum()) / moments.volume_mm3
    text = (
        f"Around the stapes the scan holds no more than {_FEW_VALUES} grey values: it was thresholded, or is "
        f"a label volume (then give it with {named('labels')}). Where its surface lies within a voxel is "
        "lost, which "
        f"makes volume and mass uncertain by {share:.1f} %. Give the grey values as they were reconstructed."
    )
    return with_contribution(moments, "threshold", np.outer(step, step)), Notice("scan_thresholded", text)
