"""The size of the noise: of all channels, of each channel, of one loud channel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.faults.nuisance import Marginal, Nuisance
from legacy.kinematics.faults.packed_readings import LEAST_SEGMENTS, Packed
from legacy.kinematics.faults.score_information import State
from legacy.stapeskit.arrays import Array, ComplexArray

# Fewer values than this show no noise of their own.
LEAST_SAMPLES = 8
# Leverage at which a channel has no residual left.
_WHOLE = 0.999
# The mean over the channels is taken for their median unless they differ by so many standard deviations.
_APART = 3.0
# Energy of motion over that of noise, from which on it can be a fault that follows it.
_MOVING = 100.0
# Decades below the mean residual energy in which the level is sought, and steps of the search in each.
_DECADES, _STEPS = 8, 64
# Share of the largest information below which a nuisance parameter leaves no trace in the residuals.
_UNSEEN = 1e-10


@dataclass(frozen=True)
class ChannelNoise:
    """The noise of a fit's channels, by residuals that no steady or drifting change of rows explains.

    Attributes
    ----------
    held : ndarray, (channel, n), complex
        Whitened residuals; empty when their number differs from channel to channel.
    number : ndarray, (channel,)
        Independent complex values behind each ratio.
    ratios : ndarray, (channel,)
        Mean energy of each channel, corrected for leverage; 1 for noise of unit complex variance.
    level : float
        Of most channels.
    sure : float
        Degrees of freedom that ``level`` rests on.
    """

    held: ComplexArray
    number: Array
    ratios: Array
    level: float
    sure: float

    @property
    def least(self) -> float:
        """The smallest number of values of a channel in use."""
        used = self.number[self.number > 0.0]
        return float(np.min(used)) if used.size else 0.0


def channel_noise(state: State) -> ChannelNoise:
    """Measure the noise of each channel.

    Notes
    -----
    A fault that is the same at all lines leaves residuals that are the motion times a matrix, one that drifts
    the motion times a line over the measurement: both are projected off.
    """
    data, live = state.data, state.data.live
    used = data.weight > 0.0
    kept = np.maximum(1.0 - state.leverage, 0.0) * used
    mean_kept = np.sum(kept, axis=0) / np.maximum(np.sum(used, axis=0), 1)
    columns = np.sum(used, axis=0) * float(state.z.shape[2])
    z, e, rest = _moving(state), _flat(state.e), _flat(state.rest)
    number = columns + (columns > 0.0) * rest.shape[1]
    if len(data.weight) == 1 or np.ptp(data.weight, axis=0).max() <= 1e-9 * data.weight.max():
        if np.max(number) - len(z) >= LEAST_SAMPLES and len(z) < e.shape[1]:
            base = np.linalg.qr(z.conj().T)[0]
            e, number = e - (e @ base) @ base.conj().T, number - (columns > 0.0) * len(z)
        held = np.hstack([e, rest])
        energy = np.sum(np.abs(state.plain(held)) ** 2, axis=1)
    else:
        held, e = e[:, :0], state.plain(e)
        energy = np.sum(np.abs(e) ** 2, axis=1)
        enough = np.array([c for c in live if columns[c] - len(z) >= LEAST_SAMPLES], dtype=np.intp)
        if len(z) and len(enough):
            energy[enough] = _off_each(e[enough], z, _column_weight(state, enough))
            number[enough] -= len(z)
        energy += np.sum(np.abs(_flat(state.plain(state.rest))) ** 2, axis=1)
    left = np.where(mean_kept > 1.0 - _WHOLE, mean_kept, np.inf)
    ratios = energy / left / np.maximum(number, 1.0)
    if not live:
        return ChannelNoise(held, number, ratios, 1.0, 1.0)
    degrees = float(np.sum((number * mean_kept)[live]))
    level = float(np.median(ratios[live]))
    mean = float(np.sum(energy[live])) / max(degrees, 1e-9)
    sure = 2.0 * degrees
    if abs(mean - level) < _APART * level * np.sqrt(2.0 / max(degrees, 1.0)):
        level = mean
    else:
        sure *= 2.0 / np.pi
    return ChannelNoise(held, number, ratios, level, max(sure, 1.0))


def channel_noise_energy(state: State, channel: int) -> tuple[float, float]:
    """Return the mean energy of a channel as of ``ChannelNoise.ratios``, and of how many values.

    The motion whose multiples are projected off is that of the other channels, which does not hold the noise
    of this one: nothing of it is taken for a fault of its row.
    """
    data = state.data
    h = np.minimum(state.leverage[:, channel], _WHOLE)
    residual = state.plain(state.e)[:, channel]
    rest = state.plain(state.rest)[:, channel].ravel()
    change = state.upper @ (
        state.span[:, channel].conj()[:, :, None] * (residual / (1.0 - h[:, None]))[:, None]
    )
    z = _rows(state, state.z - change)
    used = data.weight[:, channel] > 0.0
    number = float(np.sum(used) * residual.shape[1])
    flat = residual.ravel()
    energy = float(np.sum(np.abs(flat) ** 2))
    if number - len(z) + len(rest) >= LEAST_SAMPLES and len(z) < number:
        weight = _column_weight(state, np.array([channel]))
        energy, number = float(_off_each(flat[None], z, weight)[0]), number - len(z)
    kept = float(np.mean(1.0 - h[used])) if np.any(used) else 1.0
    number += len(rest)
    return (energy + float(np.sum(np.abs(rest) ** 2))) / kept / max(number, 1.0), number


def _flat(values: ComplexArray) -> ComplexArray:
    """Return values (group, channel, n) as (channel, group n)."""
    groups, rows, columns = values.shape
    return np.asarray(values.transpose(1, 0, 2).reshape(rows, groups * columns))


def _column_weight(state: State, channels: NDArray[np.intp]) -> Array:
    return np.repeat(state.data.weight[:, channels].T, state.z.shape[2], axis=-1)


def _rows(state: State, z: ComplexArray) -> ComplexArray:
    """Return the motion (m or 2 m, columns), and where there are enough lines its multiples by place."""
    flat = _flat(z)
    if len(z) >= LEAST_SEGMENTS and not state.data.few:
        flat = np.vstack([flat, flat * np.repeat(state.data.tau, z.shape[2])])
    return np.asarray(flat)


def _moving(state: State) -> ComplexArray:
    """Return the motion well above the noise of any one channel: along others it is noise itself."""
    weight = np.sqrt(np.mean(state.data.weight**2, axis=1))
    flat = _flat(state.z * weight[:, None, None])
    vectors, s, _ = np.linalg.svd(flat @ flat.conj().T)
    free = max(float(np.mean(state.free())), 1.0)
    # Gathered, the motion of few lines would lie in half as many columns.
    lines = flat.shape[1] / (2.0 if state.data.few else 1.0)
    noise = min(state.energy / free, lines) if state.energy > 0.0 else lines
    # In units of the noise of a reading the basis of the beams is orthonormal.
    z = vectors[:, s > _MOVING * noise].conj().T[None] @ state.z
    return _rows(state, z)


def _off_each(values: ComplexArray, rows: ComplexArray, weight: Array) -> Array:
    """Return the energy (channel,) of values (channel, n) without multiples of rows (k, n) times a weight.

    The weights (channel, n) change from channel to channel, and the rows' products with them.
    """
    count = len(rows)
    size = np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300)
    rows = rows / size
    pairs = (rows.conj()[:, None] * rows[None]).reshape(count * count, -1)
    gram = (weight**2 @ pairs.T).reshape(len(values), count, count)
    seen = (values * weight) @ rows.conj().T
    held, vectors = np.linalg.eigh(gram)
    along = np.abs(vectors.conj().swapaxes(1, 2) @ seen[:, :, None])[:, :, 0] ** 2
    kept = held > 1e-12 * np.maximum(held[:, -1:], 1e-300)
    fall = np.sum(np.where(kept, along / np.where(kept, held, 1.0), 0.0), axis=1)
    return np.asarray(np.maximum(np.sum(np.abs(values) ** 2, axis=1) - fall, 0.0))


def common_level(data: Packed, nuisance: Nuisance) -> tuple[float, float]:
    """Return the variance of the complex noise over the assumed one, and its degrees of freedom.

    For few lines: estimated with the nuisance parameters, from all residuals.

    Notes
    -----
    Restricted maximum likelihood of a variance next to random effects (Patterson and Thompson 1971,
    doi:10.1093/biomet/58.3.545): along the eigenvectors of the information of the nuisance parameters, in
    units of their sd, the real residuals have the variance v / 2 + lambda_i, along all others v / 2.
    """
    state = State.of(data)
    energy = float(np.sum(np.abs(state.both) ** 2))
    number = 2.0 * float(np.sum(state.free()) * state.both.shape[2])
    if not number > 0.0 or not energy > 0.0:
        return 0.0, 1.0
    plain = 2.0 * energy / number
    if not len(nuisance.sd):
        return plain, number
    marginal = Marginal(state, nuisance)
    sd = nuisance.sd
    values, vectors = np.linalg.eigh(marginal.information * np.outer(sd, sd))
    score = marginal.score - marginal.information @ np.broadcast_to(nuisance.mean, sd.shape)
    seen = values > _UNSEEN * max(float(values[-1]), 1e-300)
    values, along = values[seen], (vectors.T @ (sd * score))[seen] ** 2 / values[seen]
    others = max(number - len(values), 1.0)
    left = max(energy - float(np.sum(along)), 1e-12 * energy)
    half = 0.5 * plain * np.geomspace(10.0**-_DECADES, 1.0, _DECADES * _STEPS + 1)[:, None]
    size = half + values
    minus = np.sum(np.log(size) + along / size, axis=1) + (others * np.log(half) + left / half)[:, 0]
    best = float(half[int(np.argmin(minus)), 0])
    return 2.0 * best, others + float(np.sum((best / (best + values)) ** 2))
