"""Channels x, y, z of a point that were computed from the readings of several beams."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinematics.fit.beams import BeamSet
from kinematics.fit.line_noise import LineNoise
from kinematics.fit.rigid_fit import fit_noise
from kinematics.measurement import BodyChannels

Array = NDArray[np.float64]
# Share of the points of a body that have all three axes, from which on they are no single beams.
_MOST = 0.8
_ALONG = 1e-6
# Below this redundancy of an axis (real values) its noise would be known to worse than a fifth.
_LEAST_FREEDOM = 25.0
_ROUNDS = 4


def triad_axes(body: BodyChannels) -> NDArray[np.intp] | None:
    """Return the axis (channel,), 0 to 2, of a body whose points have readings along x, y and z.

    None for other beams, and where fewer than two points or four fifths of them have all three.
    """
    axes = np.argmax(np.abs(body.reported_directions), axis=1)
    size = np.abs(body.reported_directions)[np.arange(len(axes)), axes]
    if not np.all(np.abs(size - 1.0) < _ALONG):
        return None
    seen: dict[str, set[int]] = {}
    for point, axis in zip(body.points, axes.tolist(), strict=True):
        seen.setdefault(point, set()).add(axis)
    whole = sum(len(found) == 3 for found in seen.values())
    return axes if whole >= max(2.0, _MOST * len(seen)) else None


def noise_by_axis(
    beams: BeamSet, value: NDArray[np.complex128], noise: LineNoise, axes: NDArray[np.intp]
) -> Array:
    """Return the noise of each channel (channel,) relative to the others, one size for each axis.

    Parameters
    ----------
    beams : BeamSet
    value : ndarray, (channel, freq), complex
    noise : LineNoise
        In the proportions that hold for beams of equal noise.
    axes : ndarray, (channel,)

    Notes
    -----
    Variance components from residuals over their redundancy, in turn until they stay (Foerstner 1979,
    Allgemeine Vermessungs-Nachrichten 86:446). Ones where an axis has too little redundancy.
    """
    factor = np.ones(len(axes))
    for _ in range(_ROUNDS):
        fit = fit_noise(beams, value, LineNoise(noise.stated * factor[:, None], noise.factor, noise.floor))
        scaled, freedom = (
            np.array([float(np.sum(part[axes == axis])) for axis in range(3)])
            for part in (fit.solution.scaled, fit.solution.freedom)
        )
        if np.min(freedom) < _LEAST_FREEDOM or not np.min(scaled) > 0.0:
            return np.ones(len(axes))
        change = np.sqrt(scaled / freedom)
        factor = factor * (change / np.exp(np.mean(np.log(change))))[axes]
    return factor
