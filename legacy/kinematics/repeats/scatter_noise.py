"""The noise of repeats from their own scatter, where none is stated."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.repeats.repeat_shapes import Shapes
from legacy.stapeskit.arrays import Array

# Degrees of freedom to which neighbouring lines are added up (the sd is known to 7 % then), and the fewest
# that tell noise at all.
_WANTED_FREEDOM, _LEAST_FREEDOM = 100.0, 8.0
# The least degrees of freedom f that f - 2 is made of: with 4 or fewer, one over chi2 has no variance.
_LEAST_OWN = 4.0
# Blocks of lines that are looked at for correlation.
_LOOKED_AT = 8


def scatter_noise(shapes: Shapes) -> Array | None:
    """Return the noise of every channel (channel, freq) in units of its scale, from what takes leave.

    Returns
    -------
    ndarray, (channel, freq), or None
        None with too few degrees of freedom at every line.

    Notes
    -----
    Energies of neighbouring lines of a channel are added up to f degrees of freedom, over f - 2. Takes that
    differ by more than noise, by a point that was hit elsewhere, do so at neighbouring lines alike: with the
    correlation rho_m of lines m apart, w lines hold w / (1 + 2 sum (1 - m / w) rho_m^2) independent ones.
    """
    lines, takes = shapes.gain.shape
    channels = shapes.stack.channels
    energy, degrees = np.empty((channels, lines)), np.empty((channels, lines))
    for part in shapes.stack.blocks():
        data = shapes.data(part)
        present = np.any(data != 0.0, axis=1)
        energy[:, part] = np.where(present, np.sum(np.abs(shapes.residual(part, data)) ** 2, axis=1), 0.0).T
        size = np.abs(shapes.common(part, data)) ** 2
        whole = np.sum(size, axis=1, keepdims=True)
        share = np.where(shapes.clear[part][:, None] & (whole > 0.0), size / np.maximum(whole, 1e-300), 0.0)
        degrees[:, part] = np.where(present, 2.0 * (takes - 1) * np.maximum(1.0 - share, 0.05), 0.0).T
    width = int(np.clip(np.ceil(_WANTED_FREEDOM / (2.0 * (takes - 1))), 1, lines))
    together = _correlated_lines(shapes, width)
    start = np.clip(np.arange(lines) - width // 2, 0, lines - width)
    typical, number = np.zeros(channels), np.zeros(channels)
    most = 0.0
    for channel in range(channels):
        sums = np.concatenate([[0.0], np.cumsum(energy[channel])])
        counts = np.concatenate([[0.0], np.cumsum(degrees[channel])])
        freedom = counts[start + width] - counts[start]
        most = max(most, float(np.max(freedom, initial=0.0)))
        good = freedom >= _LEAST_FREEDOM
        number[channel] = np.sum(good)
        own = np.maximum(freedom / together, _LEAST_OWN)
        noise = (sums[start + width] - sums[start]) / np.where(good, freedom * (1.0 - 2.0 / own), 1.0)
        typical[channel] = np.sum(np.where(good, noise, 0.0)) / max(number[channel], 1.0)
        energy[channel] = np.where(good, noise, np.nan)
    if most < _LEAST_FREEDOM:
        return None
    typical = np.where(number > 0, typical, np.sum(typical * number) / np.sum(number))
    np.copyto(energy, np.broadcast_to(typical[:, None], energy.shape), where=np.isnan(energy))
    return np.sqrt(energy, out=energy)


def _correlated_lines(shapes: Shapes, width: int) -> float:
    """Return how many of ``width`` neighbouring lines scatter as one."""
    if width < 2:
        return 1.0
    parts = list(shapes.clear_blocks())
    step = max(1, len(parts) // _LOOKED_AT)
    product, chance, whole = np.zeros(width, dtype=complex), np.zeros(width), 0.0
    for part in parts[::step]:
        residual = shapes.residual(part, shapes.data(part)).reshape(len(part), -1)
        size = residual.real**2 + residual.imag**2
        product += _lag(residual, width)
        chance += _lag(size, width).real
        whole += float(np.sum(size))
    if whole <= 0.0:
        return 1.0
    squares = np.maximum(np.abs(product) ** 2 - chance, 0.0)[1:] / whole**2
    return float(1.0 + 2.0 * np.sum((1.0 - np.arange(1, width) / width) * squares))


def _lag(values: NDArray[np.complex128] | Array, width: int) -> NDArray[np.complex128]:
    """Return the sums of products (width,) of lines (n, ...) 0, 1, ... apart."""
    spectrum = np.fft.fft(values, 2 * len(values), axis=0)
    sums = np.fft.ifft(np.sum(np.abs(spectrum) ** 2, axis=1))
    lagged = np.zeros(width, dtype=complex)
    count = min(width, len(values))
    lagged[:count] = sums[:count]
    return lagged
