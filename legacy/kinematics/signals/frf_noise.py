"""Estimates of frequency responses and their noise: of each channel, and common to all channels."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from legacy.kinematics.calibrated import calibrated
from legacy.kinematics.errors import KinematicsError
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.faults import Fault, raise_all
from legacy.stapeskit.warnings import Notice

# Rounds of own and common noise in turn.
_ROUNDS = 4
_NOTABLE_EXCESS: float = calibrated("frf.notable_common_noise")
# Lines from which on the level of common noise may slope.
_TREND_FROM = 16


@dataclass(frozen=True)
class Frf:
    """Frequency responses of several channels to one reference.

    Attributes
    ----------
    freq_hz : ndarray, (freq,)
        Ascending, positive.
    value : ndarray, (channel, freq), complex
        Unit of the response over unit of the reference, e^{+iwt}.
    sd : ndarray, (channel, freq)
        Standard deviation of the real (= imaginary) part: the channel's own noise, without what the noise
        of the reference does to all channels alike (``common_sd``).
    coherence : ndarray, (channel, freq), or None
        Ordinary coherence, 0 to 1; None where nothing was averaged.
    n_avg : float
        Effective number of independent averages; NaN where nothing was averaged.
    common_sd : ndarray, (freq,)
        Relative standard deviation of the real (= imaginary) part of the factor (1 + e) that multiplies
        the responses of all channels recorded together: noise of the reference. 0 where none is seen.
    line_spread : float
        By what factor the variance of slowly varying sums over lines exceeds that of independent lines: a
        window correlates the noise of neighbouring lines.
    reference : ndarray, (freq,)
        Size of the reference: peak amplitude of a line, or root mean square in a resolution band.

    Notes
    -----
    A factor common to all channels of a record changes neither the fit of a rigid motion nor ratios of
    motions: K and D follow from a homogeneous equation, in which it cancels. It adds
    ``common_sd**2 * q q^H`` (twice that for both parts) to the covariance of the motion itself.
    """

    freq_hz: Array
    value: ComplexArray
    sd: Array
    coherence: Array | None
    n_avg: float
    common_sd: Array
    reference: Array
    notices: tuple[Notice, ...] = ()
    line_spread: float = 1.0


def split_noise(
    residuals: Callable[[], Iterable[ComplexArray]], spectrum: Array, response: ComplexArray, dof: float
) -> tuple[Array, Array]:
    """Separate the noise of each channel from the noise of the reference, which all channels share.

    Parameters
    ----------
    residuals : callable
        Gives an iterable of Y - H X of every block, ndarray (channel, freq), complex; blocks may overlap.
    spectrum : ndarray, (channel, freq)
        Mean of their squared size, per degree of freedom.
    response : ndarray, (channel, freq), complex
        H.
    dof : float
        Blocks less one, by which sums over the blocks become means.

    Returns
    -------
    own : ndarray, (channel, freq)
        Squared size of the residual without the common part; ``spectrum`` itself when no common part is
        significant or fewer than three channels were recorded together.
    common : ndarray, (freq,)
        Mean square of the reference's error e in the residual -H e; 0 when none is significant.

    Notes
    -----
    In every block the least-squares estimate of e over the channels, weighted by their noise, is taken out
    and the loss of one of the channels' degrees of freedom given back by the leverage w_i |H_i|^2 / sum.
    """
    channels = len(response)
    power = np.abs(response) ** 2
    none = np.zeros(spectrum.shape[1])
    floor = np.finfo(float).tiny
    weight = 1.0 / np.maximum(spectrum, floor)
    if channels < 3 or dof <= 0.0 or not np.any(spectrum > 0.0):
        return spectrum, none
    own, common, information = spectrum, none, none
    for _ in range(_ROUNDS):
        information = np.sum(weight * power, axis=0)
        safe = np.maximum(information, floor)
        own, common = np.zeros(spectrum.shape), np.zeros(len(none))
        for block in residuals():
            error = -np.sum(weight * response.conj() * block, axis=0) / safe
            common += np.abs(error) ** 2 / dof
            own += np.abs(block + response * error) ** 2 / dof
        redundancy = np.maximum(1.0 - weight * power / safe, 0.1)
        own = np.maximum(own / redundancy, 1e-6 * spectrum)
        weight = 1.0 / np.maximum(own, floor)
        excess = (common * information)[information > 0.0]
        if not excess.size or np.mean(excess) < _NOTABLE_EXCESS + 4.0 / np.sqrt(max(dof, 1.0) * excess.size):
            return spectrum, none
    return own, np.maximum(common - 1.0 / np.maximum(information, floor), 0.0)


def smoothed(spectrum: Array, width: int, freedom: float = np.inf) -> Array:
    """Average a noise spectrum over neighbouring lines, about its trend (a cubic of its logarithm).

    Parameters
    ----------
    spectrum : ndarray, (channel, freq)
    width : int
        Lines; fewer towards the ends, evenly to both sides.
    freedom : float
        Complex degrees of freedom of each value. What is made of m of them is raised by m / (m - 1), the mean
        of one over a chi2 variable, so that chi2 of later fits keeps its mean.
    """
    lines = spectrum.shape[1]
    width = min(width, lines)
    if width <= 1:
        return spectrum * _small_sample_factor(freedom)
    trend = np.ones_like(spectrum)
    if lines >= _TREND_FROM:
        floor = np.maximum(1e-12 * np.max(spectrum, axis=1, keepdims=True), np.finfo(float).tiny)
        base = np.vander(np.linspace(-1.0, 1.0, lines), 4)
        logs = np.log(np.maximum(spectrum, floor))
        trend = np.exp((base @ np.linalg.lstsq(base, logs.T, rcond=None)[0]).T)
    total = np.cumsum(np.pad(spectrum / trend, ((0, 0), (1, 0))), axis=1)
    place = np.arange(lines)
    half = np.minimum(width // 2, np.maximum(np.minimum(place, place[::-1]), 2))
    start, stop = np.maximum(place - half, 0), np.minimum(place + half + 1, lines)
    mean = (total[:, stop] - total[:, start]) / (stop - start)
    return np.asarray(mean * trend * _small_sample_factor(freedom * (stop - start)))


def steady_common(common: Array, width: int) -> Array:
    """Average the noise (freq,) of a reference over neighbouring lines; it is one number a line."""
    width = min(width, len(common))
    if width <= 1 or not np.any(common > 0.0):
        return common
    from scipy.ndimage import uniform_filter1d

    return np.maximum(uniform_filter1d(common, width, mode="nearest"), 0.0)


def _small_sample_factor(freedom: Array | float) -> Array | float:
    """Return f / (f - 1) for f complex degrees of freedom, 2 at most; 1 for infinitely many."""
    return 1.0 / (1.0 - 1.0 / np.maximum(freedom, 2.0))


def common_notice(common_sd: Array, more: str = "") -> list[Notice]:
    """Return the warning about the noise of the reference, when it is significant."""
    if not np.any(common_sd > 0.0):
        return []
    text = (
        f"the noise of the reference moves all channels recorded together alike, by "
        f"{100.0 * float(np.median(common_sd)):.2g} % (median sd over the lines): it was separated from the "
        "noise of each channel, does not change ratios of motions, K and D, and is part of the covariance of "
        f"the motion itself.{more}"
    )
    return [Notice("reference_noise", text)]


def check_signals(reference: Array, responses: Array, sample_rate_hz: float, where: str) -> None:
    """Refuse signals that no estimate can be made of.

    Raises
    ------
    KinematicsError
        The rate is not positive, lengths differ, samples are not finite, or the reference is zero.
    """
    faults = []
    if not (np.isfinite(sample_rate_hz) and sample_rate_hz > 0.0):
        faults.append(Fault("the sampling rate", "positive", sample_rate_hz, where))
    if reference.ndim != 1 or responses.ndim != 2 or responses.shape[1] != len(reference):
        got = f"{reference.shape} and {responses.shape}"
        faults.append(Fault("reference and responses", "of shapes (sample,), (channel, sample)", got, where))
    elif not (np.all(np.isfinite(reference)) and np.all(np.isfinite(responses))):
        step = "Cut the record where samples are missing"
        faults.append(Fault("the samples", "finite numbers", "NaN or infinite ones", where, step))
    elif not np.any(reference != reference[0]):
        step = "Check that the reference was connected, or name another one"
        faults.append(Fault("the reference", "a signal", "one value in all samples", where, step))
    raise_all(KinematicsError, faults)
