"""Noise that the channels of each point have in common, as x, y, z solved from three oblique beams have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.faults.noise_size import ChannelNoise
from legacy.kinematics.faults.packed_readings import Packed, real_parts
from legacy.kinematics.faults.score_information import State
from legacy.stapeskit.arrays import Array, ComplexArray

# Fewer samples, or more channels at a point, than this show no correlation.
_LEAST_SAMPLES, _MOST_AT_POINT = 24, 6
# Up to so many channels their correlation is made: the memory goes with the square.
_MOST_CHANNELS = 3000
# Rounds in which the covariance is corrected for the projection, of up to so many channels.
_CORRECTIONS, _MOST_CORRECTED = 15, 150
# Share of the largest information below which variances are not seen.
_UNSEEN = 1e-6
# Probability by which independent noise shows such correlations.
_LIKELY = 1e-3
# Samples of a prior without correlation, so that the inverse of an estimate is not too large.
_SHRINK = 5.0


def with_point_noise(state: State, noise: ChannelNoise) -> Packed:
    """Return the data of a fit whose noise within points is whitened, where it is correlated."""
    data, samples = state.data, noise.least
    if len(data.points) > _MOST_CHANNELS or not noise.held.shape[1] or len(_points(data)) < 2:
        return data
    if samples < _LEAST_SAMPLES or by_chance(state, noise.held, samples):
        return data
    covariance = point_covariance(state, noise.held, samples)
    if covariance is None:
        return data
    correlation = scaled(covariance) / (1.0 + _SHRINK / samples)
    np.fill_diagonal(correlation, 1.0)
    return data.under(replace(data.assumed, correlation=correlation))


def point_covariance(state: State, residual: ComplexArray, samples: float) -> Array | None:
    """Return the noise covariance (channel, channel) within each point, zero between points.

    Parameters
    ----------
    state : State
        Of data without correlation.
    residual : ndarray, (channel, n), complex
        Residuals over noise.
    samples : float
        Independent values of a channel in them.

    Returns
    -------
    ndarray or None
        None when there are too few samples, or points with more than one channel.

    Notes
    -----
    Residuals of noise of covariance C have the covariance Q C Q^T, Q the projector; the blocks of C are found
    by repeated correction of those measured.
    """
    own, live = _points(state.data), state.data.live
    if samples < _LEAST_SAMPLES or max(map(len, own)) > _MOST_AT_POINT:
        return None
    wanted = np.zeros((len(residual),) * 2, dtype=bool)
    for channels in own:
        wanted[np.ix_(channels, channels)] = True
    wanted[live, live] = True
    measured = np.where(wanted, _products(residual) / samples, 0.0)
    covariance = measured.copy()
    if len(residual) <= _MOST_CORRECTED:
        project = _projector(state)
        for _ in range(_CORRECTIONS):
            covariance = covariance + np.where(wanted, measured - project @ covariance @ project.T, 0.0)
    return covariance if np.all(np.diag(covariance)[live] > 0.0) else None


def scaled(covariance: Array) -> Array:
    """Return the correlation (channel, channel) of a covariance."""
    size = np.diag(covariance)
    sd = np.sqrt(np.where(size > 0.0, size, 1.0))
    return covariance / np.outer(sd, sd)


def by_chance(state: State, residual: ComplexArray, samples: float) -> bool:
    """Return whether independent noise may show what residuals have in common within points.

    Parameters as of ``point_covariance``. Only the half of the points that show least is looked at: a fault
    of one point is no correlation of all.

    Notes
    -----
    Independent noise of variances s leaves residuals of covariance E = P diag(s) P, P the projector on them.
    With s from the diagonal (Rao 1971, doi:10.1016/0047-259X(71)90001-7), a real part S_ij measured from N
    complex values has the variance (E_ii E_jj + E_ij^2) / 2 N: a loud channel, which shows in others too, is
    no correlation.
    """
    from scipy.special import chdtrc

    measured = _products(residual) / samples
    expected = np.diag(np.diag(measured))
    if len(measured) <= _MOST_CORRECTED:
        project = _projector(state)
        variance = np.linalg.lstsq(project**2, np.diag(measured), rcond=_UNSEEN)[0]
        expected = (project * np.maximum(variance, 0.0)) @ project
    value, size = [], []
    for own in _points(state.data):
        one, two = (own[k] for k in np.triu_indices(len(own), 1))
        spread = expected[one, one] * expected[two, two] + expected[one, two] ** 2
        apart = (measured - expected)[one, two] ** 2
        seen = spread > 0.0
        value.append(2.0 * samples * float(np.sum(apart[seen] / spread[seen])))
        size.append(max(int(np.sum(seen)), 1))
    shown, number = np.array(value), np.array(size)
    least = np.argsort(shown / number, kind="stable")[: (len(shown) + 1) // 2]
    return bool(chdtrc(np.sum(number[least]), np.sum(shown[least])) > _LIKELY)


def _projector(state: State) -> Array:
    """Return the projector (channel, channel) on the residuals."""
    span = np.real(state.span[0])
    return np.asarray(np.eye(len(span)) - span @ span.T)


def _products(values: ComplexArray) -> Array:
    """Return the real part (n, n) of the products of complex rows (n, k)."""
    parts = real_parts(values)
    return np.asarray(parts @ parts.T)


def _points(data: Packed) -> list[NDArray[np.intp]]:
    """Return the channels in use of the points that have several."""
    return [np.array(own) for own in data.by_point.values() if len(own) > 1]
