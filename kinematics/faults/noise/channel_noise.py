"""How much noise each channel has: what the residuals hold that no fault of their rows explains."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from kinematics.faults.fault_model import State

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
# Fewer values than this tell no noise.
LEAST_SAMPLES = 8
# Fewer segments than this tell no drift.
_SEGMENTS = 4
# Leverage at which a channel has no residual left.
_WHOLE = 0.999
# The mean over the channels stands for their median unless they differ by so many standard deviations.
_APART = 3.0
# Energy of motion over that of noise, from which on it can be a fault that follows it.
_MOVING = 100.0


@dataclass(frozen=True)
class ChannelNoise:
    """The noise of a fit's channels, by residuals that no steady or drifting change of rows explains.

    Attributes
    ----------
    held : ndarray, (channel, n), complex
        Whitened residuals.
    number : int
        Independent complex values in each row of ``held``; 0 when there are too few to tell.
    ratios : ndarray, (channel,)
        Mean energy of each channel, corrected for leverage; 1 for noise of unit complex variance.
    level : float
        Of most channels.
    sure : float
        Degrees of freedom that ``level`` rests on.
    """

    held: ComplexArray
    number: int
    ratios: Array
    level: float
    sure: float

    @classmethod
    def of(cls, state: State, rest: ComplexArray) -> ChannelNoise:
        """Measure the noise of a fit; with few lines, by all residuals.

        Parameters
        ----------
        state : State
        rest : ndarray, (channel, sample), complex
            Whitened residuals of the lines without motion.

        Notes
        -----
        A fault that is the same at all lines leaves residuals that are the motion times a matrix, one that
        drifts the motion times a line over the measurement: both are projected off the packed lines.
        """
        off, taken = _off(state)
        number = off.shape[1] - taken + rest.shape[1]
        held = np.hstack([off, rest])
        if number < LEAST_SAMPLES:
            held = np.hstack([state.e, rest])
            number = held.shape[1]
        plain, h = state.plain(held), state.h
        left = np.where(h < _WHOLE, 1.0 - h, np.inf)
        ratios = np.asarray(np.sum(np.abs(plain) ** 2, axis=1) / left / max(number, 1))
        live = state.data.live
        if not live:
            return cls(held, number, ratios, 1.0, 1.0)
        free = max(len(live) - state.span.shape[1], 1)
        level, sure = float(np.median(ratios[live])), 2.0 * number * free
        mean = float(np.sum(np.abs(held) ** 2)) / max(number * free, 1)
        if abs(mean - level) < _APART * level * np.sqrt(2.0 / max(number * free, 1)):
            level = mean
        else:
            sure *= 2.0 / np.pi
        return cls(held, number, ratios, level, max(sure, 1.0))


def own_noise(state: State, rest: ComplexArray, channel: int) -> tuple[float, int]:
    """Return the mean energy of a channel as of ``ChannelNoise.ratios``, and of how many values.

    ``rest`` (channel, sample) are the whitened residuals of the lines without motion.

    The motion whose multiples are projected off is that of the other channels, which does not hold the
    noise of this one: nothing of it is taken for a fault of its row.
    """
    h = min(float(state.h[channel]), _WHOLE)
    residual = state.plain(state.e)[channel]
    z = state.span.T @ state.data.white(state.data.beams.basis @ state.z)
    z = z - np.outer(state.span[channel], residual / (1.0 - h))
    if len(np.unique(state.data.part)) >= _SEGMENTS:
        z = np.vstack([z, z * state.data.tau])
    held, number = residual[:0], rest.shape[1]
    if len(z) < z.shape[1]:
        base = np.linalg.qr((z / np.maximum(np.linalg.norm(z, axis=1, keepdims=True), 1e-300)).conj().T)[0]
        held = residual - base @ (base.conj().T @ residual)
        number += z.shape[1] - len(z)
    if number < LEAST_SAMPLES:
        held, number = residual, rest.shape[1] + len(residual)
    both = np.concatenate([held, state.plain(rest)[channel]])
    return float(np.sum(np.abs(both) ** 2)) / (1.0 - h) / max(number, 1), number


def _off(state: State) -> tuple[ComplexArray, int]:
    """Return the packed residuals without what changes of rows can make, and how many lines that takes.

    Only along motion well above the noise of any one channel: along the others the fitted motion is noise
    itself, that of the loudest channel first, which is not to be taken off.
    """
    z = state.span.T @ state.data.white(state.data.beams.basis @ state.z)
    lines = z.shape[1]
    vectors, s, _ = np.linalg.svd(z @ z.conj().T)
    left = max(len(state.data.live) - len(z), 1)
    noise = float(np.sum(np.abs(state.e) ** 2)) / left
    noise = min(noise, float(lines)) if noise > 0.0 else float(lines)
    z = vectors[:, s > _MOVING * noise].conj().T @ z
    if len(np.unique(state.data.part)) >= _SEGMENTS:
        z = np.vstack([z, z * state.data.tau])
    if len(z) >= lines:
        return state.e[:, :0], 0
    base = np.linalg.qr(z.conj().T)[0]
    return np.asarray(state.e - (state.e @ base) @ base.conj().T), base.shape[1]
