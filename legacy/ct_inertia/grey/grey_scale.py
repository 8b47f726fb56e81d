"""A grey scale that is not linear: seen in the asymmetry of edges, reported with its effect."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.grey.partial_volume import voxel_effects, with_contribution
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.surface.moments import Moments
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.warnings import Notice

# What 4 Phi (1 - Phi), a bend of the scale of height 1, holds of He2(u) phi(u): half of 4 times the
# difference of its second moment, 5 / (6 sqrt(pi)), and its area, 1 / sqrt(pi).
_SKEWNESS_OF_BEND = -1.0 / (3.0 * np.sqrt(np.pi))


def bend_of_scale(share: NDArray[np.float32], skewness: float, noise: float = 0.0) -> NDArray[np.float32]:
    """Return by how much shares of bone are too bright where the scale bends, [z, y, x].

    Parameters
    ----------
    share : ndarray of float32, [z, y, x]
    skewness : float
        Of the edges (`edge_departure.skewness`).
    noise : float
        Standard deviation of a voxel, as a share of the contrast.

    Notes
    -----
    A smooth scale that is right for air and for bone departs by 4 a w (1 - w) in between, to second order.
    Noise lowers the mean of w (1 - w) by its variance, which is added.
    """
    return np.float32(4.0 * skewness / _SKEWNESS_OF_BEND) * (share * (1.0 - share) + np.float32(noise**2))


def with_bent_scale(
    bend: NDArray[np.float32], own: NDArray[np.bool_], cut: Cut, volume: Volume, moments: Moments
) -> tuple[Moments, Notice]:
    """Add the effect of a bent scale to the budget, and name it."""
    step = voxel_effects(bend, own, cut.first, volume, moments)[0].sum(axis=0)
    share = 100.0 * float(step[0]) / moments.volume_mm3
    text = (
        f"Edges of the bone are not symmetric between air and bone, as on a grey scale that is not linear: "
        f"volume and mass may be off by about {abs(share):.1f} %, by more where the grey value of air is "
        f"nearly black. Nothing was corrected, and the budget contains that much (grey scale). Export grey "
        f"values that are linear in the attenuation, without gamma or tone curve."
    )
    return with_contribution(moments, "grey_scale", np.outer(step, step)), Notice("grey_scale_bent", text)
