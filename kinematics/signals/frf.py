"""Frequency responses from time series: H1 with its coherence and the variance of each channel.

Random or transient excitation: averages over Hann segments that overlap by half. Periodic excitation: whole
periods without a window, the noise from what differs between them. One reference; any number of channels
recorded with it; any number of records.

Sources: Bendat and Piersol, Random Data, 4th ed. 2010, ch. 7 and 9 (H1, coherence, random errors); Welch
1967, IEEE Trans. Audio Electroacoust. 15:70, doi:10.1109/TAU.1967.1161901 (overlapping segments); Pintelon
and Schoukens, System Identification, 2nd ed. 2012, ch. 2 (periodic excitation).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

Records = Sequence[tuple[Array, Array]]
"""Reference (sample,) and responses (channel, sample) of every record."""

Blocks = Sequence[tuple[ComplexArray, ComplexArray]]
"""Spectra of the reference (line, block) and of the responses (channel, line, block) of every record."""

_FEWEST = 3  # two segments give no variance of a variance
_SHORTEST = 8  # samples of a segment: shorter ones have no line apart from 0 Hz and its neighbour
_STEADY = 100  # averages whose noise estimate needs no neighbouring lines: sd known to 7 %
_HANN_SPREAD = 35.0 / 18.0  # mean of w^4 over that of w^2 squared: correlation of neighbouring lines
_ROUNDS = 4  # of own and common noise in turn
_FEW = 8  # averages below which the stated noise is rough: sd of the sd above 25 %
_MOST_PERIODS = 50  # periods a block that are tried: more would need a clock better than 1e-3 of a sample
_LEAST_REFERENCE = 1e-3  # share of the largest line from which a line of a period counts as excited


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
        Standard deviation of the real (= imaginary) part: the channel's own noise, without what the noise of
        the reference does to all channels alike.
    coherence : ndarray, (channel, freq), or None
        None where nothing was averaged.
    n_avg : float
        Effective number of independent averages; NaN where nothing was averaged.
    common_sd : ndarray, (freq,)
        Relative standard deviation of the real (= imaginary) part of the factor that multiplies the responses
        of all channels: noise of the reference. It changes neither a rigid fit nor ratios of motions.
    line_spread : float
        By what factor the variance of slowly varying sums over lines exceeds that of independent lines.
    """

    freq_hz: Array
    value: ComplexArray
    sd: Array
    coherence: Array | None
    n_avg: float
    common_sd: Array
    line_spread: float = 1.0
    notices: tuple[Notice, ...] = ()


def effective_averages(segments: int) -> float:
    """Return how many independent averages so many Hann segments are worth that overlap by half.

    Notes
    -----
    n / (1 + 2 (1 - 1/n) rho) with rho = (sum w_t w_{t + half} / sum w_t^2)^2 = 1/36; Welch 1967.
    """
    return segments / (1.0 + (1.0 - 1.0 / segments) / 18.0)


def segment_for(samples: int, averages: int) -> int:
    """Return the longest even segment of which so many, overlapping by half, fit into a record."""
    return 2 * (samples // (averages + 1))


def welch_frf(records: Records, sample_rate_hz: float, segment: int, where: str = "") -> Frf:
    """Estimate H1 of random or transient excitation.

    Parameters
    ----------
    segment : int
        Samples of a segment, even: the resolution is the sampling rate over it.
    where : str
        Place for messages.

    Raises
    ------
    StapeskitError
        A reference without signal, or fewer than three segments.

    Notes
    -----
    With G the averaged spectra and n the effective averages H1 = Gxy / Gxx, low by 1 / (1 + noise over signal
    in the reference). Conditional on the reference E|dH1|^2 = Gyy (1 - g2) / ((n - 1) Gxx), g2 the coherence
    (Bendat and Piersol, Table 9.6, with n - 1 so that it is right in the mean for few averages); the real
    part has half of it. Below a hundred averages the noise power is averaged over neighbouring lines.
    """
    from scipy.signal import stft

    _check_reference(records, where)
    counts = [max(0, 2 * len(x) // segment - 1) if segment else 0 for x, _ in records]
    if sum(counts) < _FEWEST or segment < _SHORTEST:
        want, got = f"{_FEWEST} segments of {_SHORTEST} samples or longer", f"{sum(counts)} of {segment}"
        step = "Ask for fewer averages, or record longer"
        raise StapeskitError.of("the records", want, got, where, step)

    def spectra(signal: Array) -> ComplexArray:
        """Return the lines of every segment (..., line, segment), without 0 Hz and its neighbour."""
        lines = stft(signal, nperseg=segment, detrend="constant", boundary=None, padded=False)[2]
        return np.asarray(lines[..., 2 : segment // 2, :])

    blocks = [(spectra(x), spectra(y)) for (x, y), count in zip(records, counts, strict=True) if count]
    power, cross, _ = _sums(blocks)
    if not np.all(power > 0.0):
        step = "Check its channel; of a periodic excitation give it with --period"
        raise StapeskitError.of("the reference", "of some power at every line", 0, where, step)
    averages = sum(effective_averages(count) for count in counts if count)
    freq = np.arange(2, segment // 2) * sample_rate_hz / segment
    return _estimate(freq, blocks, cross / power, power / sum(counts), averages, _HANN_SPREAD)


def periodic_frf(records: Records, sample_rate_hz: float, period_s: float, where: str = "") -> Frf:
    """Estimate responses to periodic excitation at the lines that are excited; the first period settles.

    Raises
    ------
    StapeskitError
        Fewer than two periods are left, the period is no whole number of samples, or no line is excited.

    Notes
    -----
    With X_p, Y_p the discrete Fourier transforms of n periods H = sum X* Y / sum |X|^2 over the means of the
    records, and E|dH|^2 = mean |V|^2 / ((n - 1) mean |X|^2) with V_p = Y_p - H X_p: noise in both signals and
    its correlation are in it (Pintelon and Schoukens 2012, sec. 2.5). With few periods it is averaged over
    lines.
    """
    _check_reference(records, where)
    blocks = period_s * sample_rate_hz * np.arange(1, _MOST_PERIODS + 1)
    whole = blocks[(np.abs(blocks - np.round(blocks)) < 1e-3) & (blocks >= 2.0)]
    if not len(whole):
        step = "Give the exact period, or sample in step with the generator"
        raise StapeskitError.of("the period", "whole samples", f"{blocks[0]:.6g} samples", where, step)
    samples = round(float(whole[0]))
    stacks = [(_periods(x[samples:], samples), _periods(y[:, samples:], samples)) for x, y in records]
    counts = [x.shape[-1] for x, _ in stacks]
    if min(counts) < 2:
        want, got = f"at least two blocks of {samples} samples long", f"{min(counts)} after the first"
        raise StapeskitError.of("a record", want, got, where, "Record more periods")
    lines = _excited_lines([x for x, _ in stacks], where)
    stacks = [(x[lines], y[:, lines]) for x, y in stacks]
    means = [(x.mean(axis=-1, keepdims=True), y.mean(axis=-1, keepdims=True)) for x, y in stacks]
    weighted = [(np.sqrt(n) * x, np.sqrt(n) * y) for n, (x, y) in zip(counts, means, strict=True)]
    power, cross, _ = _sums(weighted)
    freq = (lines + 1) * sample_rate_hz / samples
    return _estimate(freq, stacks, cross / power, power / sum(counts), float(sum(counts)), 1.0)


def _estimate(
    freq_hz: Array, blocks: Blocks, value: ComplexArray, power: Array, averages: float, line_spread: float
) -> Frf:
    """Return responses with the noise that differs from block to block.

    Parameters
    ----------
    value : ndarray, (channel, freq), complex
    power : ndarray, (freq,)
        Mean square of the reference.
    averages, line_spread : float
        As in Frf.
    """
    coherence = _sums(blocks)[2]
    for x, y in blocks:
        for channel, response in zip(y, value, strict=True):  # in place: records may fill half of the memory
            channel -= response[:, None] * x
    parts = [y for _, y in blocks]
    own, common = split_noise(parts[0] if len(parts) == 1 else np.concatenate(parts, axis=-1), value)
    width = int(np.ceil(1.5 * _STEADY / averages)) if averages < _STEADY else 1
    share = 1.0 / (2.0 * max(averages - 1.0, 1e-3) * power)
    sd = np.sqrt(smoothed(own, width, (averages - 1.0) / line_spread) * share)
    common_sd = np.sqrt(smoothed(common, width) * share)
    notices = _notices(common_sd, averages)
    return Frf(freq_hz, value, sd, coherence, averages, common_sd, line_spread, notices)


def _periods(signal: Array, samples: int) -> ComplexArray:
    """Return the lines above 0 Hz of every block, (..., line, block)."""
    count = signal.shape[-1] // samples
    cut = signal[..., : count * samples].reshape(*signal.shape[:-1], count, samples)
    return np.asarray(np.fft.rfft(cut, axis=-1)[..., 1 : (samples + 1) // 2]).swapaxes(-1, -2)


def _excited_lines(references: Sequence[ComplexArray], where: str) -> NDArray[np.intp]:
    """Return the lines at which every reference (line, block) rises above its noise and is no leakage."""
    good = np.ones(references[0].shape[0], dtype=bool)
    for x in references:
        size, noise = np.abs(x.mean(axis=-1)), np.var(x, axis=-1, ddof=1) / x.shape[-1]
        noise = np.maximum(smoothed(noise, 41), noise)
        good &= (size > _LEAST_REFERENCE * np.max(size, initial=0.0)) & (size**2 > 25.0 * noise)
    if not np.any(good):
        step = "Check the period and the reference; random excitation has no period"
        raise StapeskitError.of("the reference", "periodic, with lines above its noise", "none", where, step)
    return np.flatnonzero(good)


def _sums(blocks: Blocks) -> tuple[Array, ComplexArray, Array]:
    """Return sums over blocks of references (line, block) and responses (channel, line, block).

    Power of the reference (line,), cross spectrum (channel, line) and coherence (channel, line).
    """
    xx = sum(np.sum(np.abs(x) ** 2, axis=-1) for x, _ in blocks)
    yy = sum(np.sum(np.abs(y) ** 2, axis=-1) for _, y in blocks)
    xy = np.asarray(sum(np.sum(x.conj() * y, axis=-1) for x, y in blocks))
    coherence = np.abs(xy) ** 2 / np.maximum(xx * yy, np.finfo(float).tiny)
    return np.asarray(xx), xy, np.clip(coherence, 0.0, 1.0)


def split_noise(residuals: ComplexArray, response: ComplexArray) -> tuple[Array, Array]:
    """Separate the noise of each channel from the noise of the reference, which all channels share.

    Parameters
    ----------
    residuals : ndarray, (channel, freq, block), complex
        Y - H X of every block.
    response : ndarray, (channel, freq), complex
        H.

    Returns
    -------
    own : ndarray, (channel, freq)
        Mean square of the residual without the common part; of all of it when no common part is significant
        or fewer than three channels were recorded together.
    common : ndarray, (freq,)
        Mean square of the reference's error e in the residual -H e; 0 when none is significant.

    Notes
    -----
    In every block the least-squares estimate of e over the channels, weighted by their noise, is taken out,
    and the loss of one of the channels' degrees of freedom given back by the leverage w_i |H_i|^2 / sum.
    Without a common part e times its information has mean 1 a line: the part is significant at four standard
    deviations of that.
    """
    channels, lines, blocks = residuals.shape
    whole = np.array([np.mean(np.abs(rest) ** 2, axis=-1) for rest in residuals])
    none, floor = np.zeros(lines), np.finfo(float).tiny
    if channels < 3 or not np.any(whole > 0.0):
        return whole, none
    power, own = np.abs(response) ** 2, whole
    for _ in range(_ROUNDS):
        weight = 1.0 / np.maximum(own, floor)
        information = np.maximum(np.sum(weight * power, axis=0), floor)
        error = -np.einsum("cf,cfb->fb", weight * response.conj(), residuals) / information[:, None]
        common = np.mean(np.abs(error) ** 2, axis=-1)
        rest = [
            np.mean(np.abs(r + h[:, None] * error) ** 2, axis=-1)
            for r, h in zip(residuals, response, strict=True)
        ]
        own = np.maximum(rest / np.maximum(1.0 - weight * power / information, 0.1), 1e-6 * whole)
        if np.mean(common * information) < 1.1 + 4.0 / np.sqrt(blocks * lines):
            return whole, none
    return own, np.maximum(common - 1.0 / information, 0.0)


def smoothed(spectrum: Array, width: int, freedom: float = np.inf) -> Array:
    """Average a noise spectrum (..., freq) over neighbouring lines, reflected at the ends.

    ``freedom`` are the complex degrees of freedom of each value: what is made of m of them is raised by m /
    (m - 1), the mean of one over a chi2 variable, so that chi2 of later fits keeps its mean.
    """
    from scipy.ndimage import uniform_filter1d

    width = max(1, min(width, spectrum.shape[-1]))
    mean = uniform_filter1d(spectrum, width, axis=-1)
    return np.asarray(mean / (1.0 - 1.0 / max(freedom * width, 2.0)))


def _check_reference(records: Records, where: str) -> None:
    """Refuse records without a signal in the reference."""
    if not records or any(not np.any(x != x[0]) for x, _ in records):
        step = "Check that the reference was connected, or name another one"
        raise StapeskitError.of("the reference", "a signal", "one value in all samples", where, step)


def _notices(common_sd: Array, averages: float) -> tuple[Notice, ...]:
    """Report noise of the reference, and averages that are too few for a good estimate of the noise."""
    notices = []
    if np.any(common_sd > 0.0):
        text = (
            "the noise of the reference moves all channels recorded together alike, by "
            f"{100.0 * float(np.median(common_sd)):.2g} % (median sd over the lines): it was separated from "
            "the noise of each channel, does not change ratios of motions, K and D, and is part of the "
            "covariance of the motion itself."
        )
        notices.append(Notice("reference_noise", text))
    if averages < _FEW:
        text = f"only {averages:.2g} independent averages were made: the stated noise is rough."
        notices.append(Notice("few_averages", text))
    return tuple(notices)
