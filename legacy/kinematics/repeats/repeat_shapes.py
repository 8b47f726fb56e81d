"""Repeats of one excitation as one shape over the channels at every line, times a gain of each repeat."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.calibrated import calibrated
from legacy.kinematics.fit.line_noise import Lines, blocks
from legacy.kinematics.measurement import BodyChannels
from legacy.stapeskit.arrays import Array, ComplexArray

_CLEAR_RATIO: float = calibrated("repeats.clear_ratio")
# A shape needs three channels.
_LEAST_CHANNELS = 3
# Values at a time: 3 MB.
_VALUES = 200_000
# Lines over which the level of noise is smoothed.
_STEADY = 31


@dataclass(frozen=True)
class Stack:
    """Several takes of all channels of all bodies, read piece by piece.

    Attributes
    ----------
    places : tuple of int
        Indices of the takes among the runs of the bodies.
    rate : ndarray, (freq,)
        (2 pi f) to the order of the measured quantity: noise that is not stated is level in it.
    noise : ndarray, (channel, freq), or None
        Factor on the noise of every channel.
    doubt : float
        Relative variance of the true noise power over the stated one of all takes together.
    """

    bodies: tuple[BodyChannels, ...]
    places: tuple[int, ...]
    rate: Array
    noise: Array | None = None
    doubt: float = 0.0

    @cached_property
    def stated(self) -> bool:
        """Whether every body states standard deviations, at least relative ones."""
        return all(body.sd is not None for body in self.bodies)

    @cached_property
    def known(self) -> bool:
        """Whether every body states standard deviations of absolute size."""
        return self.stated and not any(body.relative for body in self.bodies)

    @property
    def channels(self) -> int:
        """Number of channels of all bodies."""
        return sum(len(body.points) for body in self.bodies)

    def blocks(self) -> Iterator[slice]:
        """Yield runs of lines that hold a moderate number of values."""
        return blocks(self.channels * len(self.places), len(self.rate), _VALUES)

    def value(self, lines: Lines) -> ComplexArray:
        """Return the readings (take, channel, n) at some lines; NaN where missing."""
        return np.concatenate(
            [body.displacement[:, :, lines][list(self.places)] for body in self.bodies], axis=1
        )

    def sd(self, lines: Lines) -> Array:
        """Return standard deviations (take, channel, n) at some lines, or what they are proportional to."""
        parts = []
        for body in self.bodies:
            if body.sd is None or not self.stated:
                shape = (len(self.places), len(body.points), len(self.rate[lines]))
                parts.append(np.broadcast_to(1.0 / self.rate[lines], shape))
            else:
                parts.append(body.sd[:, :, lines][list(self.places)])
        deviations = np.concatenate(parts, axis=1)
        return deviations if self.noise is None else deviations * self.noise[:, lines]


@dataclass(frozen=True)
class Shapes:
    """What several takes have in common, line by line.

    Attributes
    ----------
    stack : Stack
        The takes; ``data`` gives them over their noise.
    gain : ndarray, (freq, take), complex
        Unit vectors: the gain of every take.
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

    stack: Stack
    gain: ComplexArray
    strength: Array
    counts: NDArray[np.intp]
    clear: NDArray[np.bool_]
    log_gain: Array
    phase: Array
    take_scale: Array
    noise_scale: Array

    def data(self, lines: Lines) -> ComplexArray:
        """Return measured values over their noise (n, take, channel), zero where any take lacks them."""
        value, sd = self.stack.value(lines), self.stack.sd(lines)
        whole = np.all(_is_usable(value, sd), axis=0)
        return _whiten(value, whole, self.take_scale[lines], self.noise_scale[:, lines])

    def common(self, lines: Lines, data: ComplexArray) -> ComplexArray:
        """Return the common response (n, channel) of ``data`` (n, take, channel) at some lines."""
        return np.asarray(np.einsum("ft,ftc->fc", self.gain[lines].conj(), data, optimize=True))

    def residual(self, lines: Lines, data: ComplexArray) -> ComplexArray:
        """Return the residual of ``data`` after the common shape, (n, take, channel)."""
        difference = self.gain[lines][:, :, None] * self.common(lines, data)[:, None, :]
        return np.subtract(data, difference, out=difference)

    def clear_blocks(self) -> Iterator[NDArray[np.intp]]:
        """Yield the clear lines in runs that hold a moderate number of values."""
        lines = np.flatnonzero(self.clear)
        for part in blocks(self.stack.channels * len(self.stack.places), len(lines), _VALUES):
            yield lines[part]


def shapes_of(stack: Stack) -> Shapes:
    """Decompose takes into one common shape and a gain of each.

    Notes
    -----
    The common part is the leading singular triple of the takes x channels matrix of every line, the
    maximum likelihood estimate for noise whose scale is a product of one factor for the take and one for the
    channel (Eckart and Young 1936, doi:10.1007/BF02288367). Where a line does not show its gains clearly,
    the gains over all lines stand in.
    """
    takes, lines = len(stack.places), len(stack.rate)
    gain: ComplexArray = np.empty((lines, takes), dtype=complex)
    strength, counts = np.empty(lines), np.empty(lines, dtype=np.intp)
    clear = np.empty(lines, dtype=bool)
    take_scale, noise_scale = np.empty((lines, takes)), np.empty((stack.channels, lines))
    for part in stack.blocks():
        value, sd = stack.value(part), stack.sd(part)
        used = _is_usable(value, sd)
        take_scale[part], noise_scale[:, part] = _noise_scales(sd, used, stack.doubt > 0.0)
        whole = np.all(used, axis=0)
        data = _whiten(value, whole, take_scale[part], noise_scale[:, part])
        counts[part] = np.sum(whole, axis=0)
        values, vectors = np.linalg.eigh(data @ data.conj().transpose(0, 2, 1))
        strength[part], own = np.maximum(values[:, -1], 0.0), vectors[:, :, -1]
        gain[part] = own * np.exp(-1j * np.angle(np.sum(own, axis=1)))[:, None]
        clear[part] = _is_above_noise(values, counts[part], takes)
    log_gain, phase = _average_gains(np.asarray(gain * take_scale, dtype=complex), strength, clear)
    stand_in = np.exp(log_gain + 1j * phase) / take_scale
    stand_in = stand_in / np.linalg.norm(stand_in, axis=1, keepdims=True)
    gain = np.where(clear[:, None], gain, stand_in)
    return Shapes(stack, gain, strength, counts, clear, log_gain, phase, take_scale, noise_scale)


def _is_usable(value: ComplexArray, sd: Array) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return np.asarray(np.isfinite(value.real) & np.isfinite(sd) & (sd > 0.0))


def _whiten(value: ComplexArray, whole: NDArray[np.bool_], take: Array, channel: Array) -> ComplexArray:
    """Return values (n, take, channel) over noise take (n, take) x channel (channel, n)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        data = value / channel[None]
        data /= take.T[:, None, :]
    np.copyto(data, 0.0, where=~whole[None])
    return data.transpose(2, 0, 1)


def _noise_scales(sd: Array, used: NDArray[np.bool_], doubted: bool) -> tuple[Array, Array]:
    """Factorise the noise into one factor for each take (n, take) and one for each channel (channel, n).

    The factors of takes are averaged over neighbouring lines where the noise is ``doubted``: an error in one
    would make all channels of a line louder.
    """
    logs = np.where(used, np.log(np.where(used, sd, 1.0)), np.nan)
    whole = np.all(used, axis=0)
    count = np.maximum(np.sum(whole, axis=0), 1)
    mean = np.sum(np.where(whole[None], logs, 0.0), axis=1) / count
    apart = mean - np.mean(mean, axis=0)
    if doubted:
        from scipy.ndimage import uniform_filter1d

        apart = uniform_filter1d(apart, _STEADY, axis=1, mode="nearest")
    take = np.exp(apart).T
    number = np.maximum(np.sum(used, axis=0), 1)
    channel = np.exp(np.sum(np.where(used, logs - np.log(take.T)[:, None, :], 0.0), axis=0) / number)
    return take, channel


def _is_above_noise(values: Array, counts: NDArray[np.intp], takes: int) -> NDArray[np.bool_]:
    """Return the lines whose common part is well above the noise."""
    scatter = np.maximum(np.sum(values[:, :-1], axis=1), 0.0)
    freedom = np.maximum((takes - 1) * (counts - 1), 1)
    noise = scatter / freedom
    level = (np.sqrt(takes) + np.sqrt(np.maximum(counts, 1))) ** 2
    return np.asarray((counts >= _LEAST_CHANNELS) & (values[:, -1] > _CLEAR_RATIO * noise * level))


def _average_gains(gain: ComplexArray, strength: Array, clear: NDArray[np.bool_]) -> tuple[Array, Array]:
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
