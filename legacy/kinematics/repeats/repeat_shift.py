"""By how much the response pattern of each repeat is moved along the frequency: a shifting resonance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.repeats.repeat_shapes import Shapes
from legacy.stapeskit.arrays import Array

# Fewer lines cannot separate a shift from noise.
_LEAST_LINES = 8


def frequency_shifts(shapes: Shapes, freq_hz: Array, body: NDArray[np.intp]) -> tuple[Array, float]:
    """Estimate the relative frequency shift of every take against their mean.

    Parameters
    ----------
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
    takes = shapes.gain.shape[1]
    unknown = np.full(takes, np.nan), 0.0
    lines = np.flatnonzero(shapes.clear)
    whole = np.ones(len(body), dtype=bool)
    strength = np.zeros(len(body))
    for part in shapes.clear_blocks():
        data = shapes.data(part)
        whole &= np.all(np.any(data != 0.0, axis=1), axis=0)
        strength += np.sum(np.abs(shapes.common(part, data)) ** 2, axis=0)
    if len(lines) < _LEAST_LINES or np.sum(whole) < 2:
        return unknown
    own = np.flatnonzero(whole & (body == np.max(body[whole])))
    reference = int(own[np.argmax(strength[own])])
    others = np.flatnonzero(whole & (np.arange(len(body)) != reference))
    normal, energy, moved = 0.0, 0.0, np.zeros(takes)
    start = 0
    for part in shapes.clear_blocks():
        stop = start + len(part)
        wide = lines[max(start - 1, 0) : stop + 1]
        inner = slice(start - max(start - 1, 0), start - max(start - 1, 0) + len(part))
        sums = _normal_equation(shapes, freq_hz, wide, inner, reference, others)
        normal, energy, moved = normal + sums[0], energy + sums[1], moved + sums[2]
        start = stop
    if normal <= 0.0:
        return unknown
    shifts = -moved / normal
    share = float(np.sum(shifts**2)) * normal / energy if energy > 0.0 else 0.0
    return shifts, min(share, 1.0)


def _normal_equation(
    shapes: Shapes,
    freq_hz: Array,
    wide: NDArray[np.intp],
    inner: slice,
    reference: int,
    others: NDArray[np.intp],
) -> tuple[float, float, Array]:
    """Return the normal equation, the energy of all differences and its right side (take,) of some lines.

    ``inner`` of the lines ``wide`` count; the ones beside them are there for the slope.
    """
    data = shapes.data(wide)
    common = shapes.common(wide, data)
    noise = shapes.noise_scale.T[wide]
    scale = noise[:, others] / noise[:, [reference]]
    ratio = common[:, others] / common[:, [reference]] * scale
    freq = freq_hz[wide]
    slope = (freq[:, None] * np.gradient(ratio, freq, axis=0))[inner]
    weight = (np.abs(common[:, [reference]]) / scale)[inner] ** 2
    energy, moved = 0.0, np.zeros(data.shape[1])
    for take in range(data.shape[1]):
        values = data[inner, take]
        with np.errstate(divide="ignore", invalid="ignore"):
            change = values[:, others] / values[:, [reference]] * scale[inner] - ratio[inner]
        change = np.where(np.isfinite(change), change, 0.0)
        moved[take] = float(np.sum(weight * (slope.conj() * change).real))
        energy += float(np.sum(weight * np.abs(change) ** 2))
    return float(np.sum(weight * np.abs(slope) ** 2)), energy, moved
