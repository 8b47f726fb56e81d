"""By how much the response pattern of each repeat is moved along the frequency: a shifting resonance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinematics.takes.take_shapes import Shapes

Array = NDArray[np.float64]
_LEAST_LINES = 8


def frequency_shifts(shapes: Shapes, freq_hz: Array, body: NDArray[np.intp]) -> tuple[Array, float]:
    """Estimate the relative frequency shift of every take against their mean.

    Parameters
    ----------
    shapes : Shapes
    freq_hz : ndarray, (freq,)
    body : ndarray, (channel,), int
        Body of each channel; responses are taken relative to the strongest channel of the last one, the
        base of a middle ear, so that the excitation does not matter.

    Returns
    -------
    shifts : ndarray, (take,)
        d ln f; positive: the pattern lies at higher frequencies. NaN when there are too few lines.
    share : float
        Part of all differences between takes (noise included) that such shifts explain.

    Notes
    -----
    First order: R(f) becomes R(f) - s f R'(f) under a shift s = d ln f; s by least squares over lines and
    channels, R' by central differences of the mean of all takes.
    """
    takes = shapes.data.shape[1]
    whole = np.all(np.any(shapes.data != 0.0, axis=1)[shapes.clear], axis=0)
    lines = np.flatnonzero(shapes.clear)
    unknown = np.full(takes, np.nan), 0.0
    if len(lines) < _LEAST_LINES or np.sum(whole) < 2:
        return unknown
    own = np.flatnonzero(whole & (body == np.max(body[whole])))
    common = shapes.shape[lines].conj() * np.sqrt(shapes.strength[lines])[:, None]
    reference = own[np.argmax(np.sum(np.abs(common[:, own]) ** 2, axis=0))]
    others = np.flatnonzero(whole & (np.arange(len(body)) != reference))
    noise = shapes.noise_scale.T[lines]
    scale = noise[:, others] / noise[:, [reference]]
    ratio = common[:, others] / common[:, [reference]] * scale
    freq = freq_hz[lines]
    slope = freq[:, None] * np.gradient(ratio, freq, axis=0)
    weight = (np.abs(common[:, [reference]]) / scale) ** 2
    normal = float(np.sum(weight * np.abs(slope) ** 2))
    if normal <= 0.0:
        return unknown
    shifts, energy = np.empty(takes), 0.0
    for take in range(takes):
        data = shapes.data[lines, take]
        with np.errstate(divide="ignore", invalid="ignore"):
            change = data[:, others] / data[:, [reference]] * scale - ratio
        change = np.where(np.isfinite(change), change, 0.0)
        shifts[take] = -float(np.sum(weight * (slope.conj() * change).real)) / normal
        energy += float(np.sum(weight * np.abs(change) ** 2))
    share = float(np.sum(shifts**2)) * normal / energy if energy > 0.0 else 0.0
    return shifts, min(share, 1.0)
