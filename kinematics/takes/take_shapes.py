"""Repeats of one excitation as one shape over the channels at every line, times a gain of each repeat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
_CLEAR = 5.0
_LEAST_CHANNELS = 3


@dataclass(frozen=True)
class Shapes:
    """What several takes have in common, line by line.

    Attributes
    ----------
    data : ndarray, (freq, take, channel), complex
        Measured values over their noise scale; zero where a channel is missing in any of the takes.
    gain : ndarray, (freq, take), complex
        Unit vectors: the gain of every take.
    shape : ndarray, (freq, channel), complex
        Conjugate of the common response along the channels, unit vectors.
    strength : ndarray, (freq,)
        Squared size of the common part.
    counts : ndarray, (freq,)
        Channels measured in all takes.
    clear : ndarray, (freq,), bool
        Lines on which takes can be compared: three common channels and a response well above the noise.
    log_gain, phase : ndarray, (take,)
        Logarithm of the amplitude and phase (rad) of each take's gain over all lines, mean zero.
    take_scale : ndarray, (freq, take)
        Noise of each take relative to their geometric mean.
    noise_scale : ndarray, (channel, freq)
        Noise scale of each channel.
    """

    data: ComplexArray
    gain: ComplexArray
    shape: ComplexArray
    strength: Array
    counts: NDArray[np.intp]
    clear: NDArray[np.bool_]
    log_gain: Array
    phase: Array
    take_scale: Array
    noise_scale: Array

    @property
    def residual(self) -> ComplexArray:
        """What is left of ``data`` beside the common shape, (freq, take, channel)."""
        common = np.einsum("ft,ftc->fc", self.gain.conj(), self.data, optimize=True)
        made = self.gain[:, :, None] * common[:, None, :]
        return np.subtract(self.data, made, out=made)


def shapes_of(value: ComplexArray, sd: Array | None) -> Shapes:
    """Part takes into one shape and their gains.

    Parameters
    ----------
    value : ndarray, (take, channel, freq), complex
        NaN where missing.
    sd : ndarray, (take, channel, freq), or None
        Standard deviation of the real part, or what it is proportional to; None for equal noise.

    Notes
    -----
    The common part is the leading singular triple of the takes x channels matrix of every line, the
    maximum likelihood estimate for noise whose scale is a product of one factor for the take and one for the
    channel (Eckart and Young 1936, doi:10.1007/BF02288367). Where a line does not show its gains clearly,
    the gains over all lines stand in.
    """
    used = np.isfinite(value.real)
    if sd is not None:
        used &= np.isfinite(sd) & (np.where(np.isfinite(sd), sd, 0.0) > 0.0)
    common = np.all(used, axis=0)
    take_scale, noise_scale = _noise_scales(sd, used)
    with np.errstate(invalid="ignore", divide="ignore"):
        data = value / noise_scale[None]
        data /= take_scale.T[:, None, :]
    np.copyto(data, 0.0, where=~common[None])
    data = data.transpose(2, 0, 1)
    counts = np.sum(common, axis=0)
    values, vectors = np.linalg.eigh(data @ data.conj().transpose(0, 2, 1))
    strength, gain = np.maximum(values[:, -1], 0.0), vectors[:, :, -1]
    gain = gain * np.exp(-1j * np.angle(np.sum(gain, axis=1)))[:, None]
    clear = _clear(values, counts, data.shape[1])
    log_gain, phase = _overall(gain * take_scale, strength, clear)
    stand_in = np.exp(log_gain + 1j * phase) / take_scale
    stand_in = stand_in / np.linalg.norm(stand_in, axis=1, keepdims=True)
    gain = np.where(clear[:, None], gain, stand_in)
    shape = np.einsum("ft,ftc->fc", gain.conj(), data, optimize=True).conj()
    size = np.linalg.norm(shape, axis=1, keepdims=True)
    shape = np.where(size > 0.0, shape / np.where(size > 0.0, size, 1.0), 0.0)
    return Shapes(data, gain, shape, strength, counts, clear, log_gain, phase, take_scale, noise_scale)


def _noise_scales(sd: Array | None, used: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Part the noise into one factor for each take (freq, take) and one for each channel (channel, freq)."""
    takes, channels, lines = used.shape
    if sd is None:
        return np.ones((lines, takes)), np.ones((channels, lines))
    logs = np.where(used, np.log(np.where(used, sd, 1.0)), np.nan)
    whole = np.all(used, axis=0)
    count = np.maximum(np.sum(whole, axis=0), 1)
    mean = np.sum(np.where(whole[None], logs, 0.0), axis=1) / count
    take = np.exp(mean - np.mean(mean, axis=0)).T
    number = np.maximum(np.sum(used, axis=0), 1)
    channel = np.exp(np.sum(np.where(used, logs - np.log(take.T)[:, None, :], 0.0), axis=0) / number)
    return take, channel


def _clear(values: Array, counts: NDArray[np.intp], takes: int) -> NDArray[np.bool_]:
    """Tell the lines whose common part stands well above what noise alone would give."""
    left = np.maximum(np.sum(values[:, :-1], axis=1), 0.0)
    freedom = np.maximum((takes - 1) * (counts - 1), 1)
    noise = left / freedom
    level = (np.sqrt(takes) + np.sqrt(np.maximum(counts, 1))) ** 2
    return np.asarray((counts >= _LEAST_CHANNELS) & (values[:, -1] > _CLEAR * noise * level))


def _overall(gain: ComplexArray, strength: Array, clear: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the logarithm of the amplitude and the phase (take,) of the gains over all lines."""
    lines = clear if np.any(clear) else strength > 0.0
    if not np.any(lines):
        return np.zeros(gain.shape[1]), np.zeros(gain.shape[1])
    weights = strength[lines] / np.sum(strength[lines])
    size = np.log(np.maximum(np.abs(gain[lines]), 1e-12))
    size -= size.mean(axis=1, keepdims=True)
    turned = gain[lines] / np.maximum(np.abs(gain[lines]), 1e-300)
    mean = turned * np.exp(-1j * np.angle(np.sum(turned, axis=1)))[:, None]
    phase = np.angle(weights @ mean)
    return weights @ size, phase - phase.mean()
