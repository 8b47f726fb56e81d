"""Frequency responses from time series: H1 with its coherence and the variance of each channel.

Random or transient excitation: averages over Hann segments that overlap by half. Periodic excitation: whole
periods without a window, the noise from what differs between them. One reference; any number of channels
recorded with it.

Sources: Bendat and Piersol, Random Data, 4th ed. 2010, ch. 7 and 9 (H1, coherence, random errors); Welch
1967, IEEE Trans. Audio Electroacoust. 15:70, doi:10.1109/TAU.1967.1161901 (overlapping segments); Pintelon
and Schoukens, System Identification, 2nd ed. 2012, ch. 2 (periodic excitation).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import StapeskitError

STEADY_AVERAGES = 100
"""Averages whose noise estimate needs no neighbouring lines: its variance is known to 10 %."""

_FEWEST = 3  # two segments give no variance of a variance
_SHORTEST = 8  # samples of a segment: shorter ones have no line apart from 0 Hz and its neighbour
_HANN_SPREAD = 35.0 / 18.0  # mean of w^4 over that of w^2 squared: correlation of neighbouring lines
_MOST_PERIODS = 50  # periods a block that are tried: more would need a clock better than 1e-3 of a sample
_SINGLE = 100.0  # times the power next to it: three segments of noise reach 20 in 10^5 lines
_NEIGHBOURS, _LOWER_PERCENT = 25, 25  # lines around one, of which the lower quarter holds no single line
_LEAST_REFERENCE = 1e-3  # share of the largest line from which a line of a period counts as excited


@dataclass(frozen=True)
class Frf:
    """Frequency responses (channel, freq) to one reference, e^{+iwt}, with the sd of their real parts.

    ``n_avg`` is the effective number of independent averages, ``line_spread`` the factor by which the
    variance of slowly varying sums over lines exceeds that of independent lines.
    """

    freq_hz: Array
    value: ComplexArray
    sd: Array
    coherence: Array
    n_avg: float
    line_spread: float = 1.0


def effective_averages(segments: int) -> float:
    """Return how many independent averages so many Hann segments are worth that overlap by half.

    Notes
    -----
    n / (1 + 2 (1 - 1/n) rho) with rho = (sum w_t w_{t + half} / sum w_t^2)^2 = 1/36; Welch 1967.
    """
    return segments / (1.0 + (1.0 - 1.0 / segments) / 18.0)


def welch_frf(
    reference: Array, responses: Array, sample_rate_hz: float, segments: int, where: str = ""
) -> Frf:
    """Estimate H1 of random or transient excitation from so many segments, overlapping by half.

    ``reference`` is (sample,), ``responses`` (channel, sample), ``where`` the place for messages.

    Raises
    ------
    StapeskitError
        A reference without power at a line or with most of it in single lines, as of sines; a record too
        short for three segments.

    Notes
    -----
    With G the averaged spectra and n the effective averages H1 = Gxy / Gxx, low by 1 / (1 + noise over signal
    in the reference).
    """
    from scipy.ndimage import percentile_filter
    from scipy.signal import stft

    segment = 2 * (len(reference) // (max(segments, _FEWEST) + 1))
    if segment < _SHORTEST:
        got, step = f"{len(reference)} samples", "Ask for fewer averages, or record longer"
        want = f"long enough for {max(segments, _FEWEST)} segments of {_SHORTEST} samples"
        raise StapeskitError.of("the record", want, got, where, step)

    def spectra(signal: Array) -> ComplexArray:
        """Return the lines of every segment (..., line, segment), without 0 Hz and its neighbour."""
        lines = stft(signal, nperseg=segment, detrend="constant", boundary=None, padded=False)[2]
        return np.asarray(lines[..., 2 : segment // 2, :])

    x, y = spectra(reference), spectra(responses)
    power = np.mean(np.abs(x) ** 2, axis=-1)
    if not np.all(power > 0.0):
        step = "Check its channel; of a periodic excitation give it with --period"
        raise StapeskitError.of("the reference", "of some power at every line", 0, where, step)
    single = power > _SINGLE * percentile_filter(power, _LOWER_PERCENT, _NEIGHBOURS)
    if np.sum(power[single]) > 0.5 * np.sum(power):
        step = "Give the period with --period; of steps of a sine give amplitudes and phases as a tidy table"
        got = f"{100.0 * np.sum(power[single]) / np.sum(power):.0f} % of it in {np.sum(single)} single lines"
        want = "of power at all lines of its band, as random and transient excitation"
        raise StapeskitError.of("the reference", want, got, where, step)
    freq = np.arange(2, segment // 2) * sample_rate_hz / segment
    value = np.mean(x.conj() * y, axis=-1) / power
    return _with_noise(freq, x, y, value, power, effective_averages(x.shape[-1]), _HANN_SPREAD)


def periodic_frf(
    reference: Array, responses: Array, sample_rate_hz: float, period_s: float, where: str = ""
) -> Frf:
    """Estimate responses to periodic excitation at the lines that are excited; the first period settles.

    Raises
    ------
    StapeskitError
        Fewer than two periods are left, the period is no whole number of samples, or no line is excited.

    Notes
    -----
    With X_p, Y_p the discrete Fourier transforms of n periods H = mean Y_p / mean X_p: noise in both signals
    and its correlation are in the residuals Y_p - H X_p (Pintelon and Schoukens 2012, sec. 2.5).
    """
    blocks = period_s * sample_rate_hz * np.arange(1, _MOST_PERIODS + 1)
    whole = blocks[(np.abs(blocks - np.round(blocks)) < 1e-3) & (blocks >= 2.0)]
    if not len(whole):
        step = "Give the exact period, or sample in step with the generator"
        raise StapeskitError.of("the period", "whole samples", f"{blocks[0]:.6g} samples", where, step)
    samples = round(float(whole[0]))
    count = len(reference) // samples - 1
    if count < 2:
        want, got = f"at least three blocks of {samples} samples long", f"{len(reference)} samples"
        raise StapeskitError.of("the record", want, got, where, "Record more periods")

    def spectra(signal: Array) -> ComplexArray:
        """Return the lines above 0 Hz of every block but the first, (..., line, block)."""
        cut = signal[..., samples : samples * (count + 1)].reshape(*signal.shape[:-1], count, samples)
        return np.asarray(np.fft.rfft(cut, axis=-1)[..., 1 : (samples + 1) // 2]).swapaxes(-1, -2)

    x = spectra(reference)
    size, noise = np.abs(x.mean(axis=-1)), np.var(x, axis=-1, ddof=1) / count
    noise = np.maximum(smoothed(noise, 41), noise)
    excited = (size > _LEAST_REFERENCE * np.max(size, initial=0.0)) & (size**2 > 25.0 * noise)
    if not np.any(excited):
        step = "Check the period and the reference; random excitation has no period"
        raise StapeskitError.of("the reference", "periodic, with lines above its noise", "none", where, step)
    x, y = x[excited], spectra(responses)[:, excited]
    freq = (np.flatnonzero(excited) + 1) * sample_rate_hz / samples
    value = y.mean(axis=-1) / x.mean(axis=-1)
    return _with_noise(freq, x, y, value, size[excited] ** 2, float(count), 1.0)


def _with_noise(
    freq_hz: Array,
    reference: ComplexArray,
    responses: ComplexArray,
    value: ComplexArray,
    power: Array,
    averages: float,
    line_spread: float,
) -> Frf:
    """Return responses ``value`` (channel, line) with the noise that differs from block to block.

    ``reference`` (line, block) and ``responses`` (channel, line, block) are spectra, ``power`` (line,) the
    mean square of the reference.

    Notes
    -----
    Conditional on the reference E|dH|^2 = mean |Y - H X|^2 / ((n - 1) Gxx), of which the real part has half
    (Bendat and Piersol, Table 9.6, with n - 1 so that it is right in the mean for few averages). Below a
    hundred averages the noise power is averaged over neighbouring lines.
    """
    xx = np.sum(np.abs(reference) ** 2, axis=-1)
    yy = np.sum(np.abs(responses) ** 2, axis=-1)
    xy = np.sum(reference.conj() * responses, axis=-1)
    coherence = np.clip(np.abs(xy) ** 2 / np.maximum(xx * yy, np.finfo(float).tiny), 0.0, 1.0)
    residual = [y - one[:, None] * reference for y, one in zip(responses, value, strict=True)]
    noise = np.array([np.mean(np.abs(one) ** 2, axis=-1) for one in residual])
    width = lines_to_pool(averages)
    freedom = (averages - 1.0) / line_spread
    share = 1.0 / (2.0 * max(averages - 1.0, 1e-3) * power)
    sd = np.sqrt(smoothed(noise, width, freedom) * share)
    return Frf(freq_hz, value, sd, coherence, averages, line_spread)


def lines_to_pool(averages: float) -> int:
    """Return from how many neighbouring lines the noise is taken; windows correlate them, hence half more."""
    return int(np.ceil(1.5 * STEADY_AVERAGES / averages)) if averages < STEADY_AVERAGES else 1


def smoothed(spectrum: Array, width: int, freedom: float = np.inf) -> Array:
    """Average a noise spectrum (..., freq) over neighbouring lines, reflected at the ends.

    ``freedom`` are the complex degrees of freedom of each value: what is made of m of them is raised by m /
    (m - 1), the mean of one over a chi2 variable, so that chi2 of later fits keeps its mean.
    """
    from scipy.ndimage import uniform_filter1d

    width = max(1, min(width, spectrum.shape[-1]))
    mean = np.maximum(uniform_filter1d(spectrum, width, axis=-1), spectrum / width)  # sums round below 0
    return np.asarray(mean / (1.0 - 1.0 / max(freedom * width, 2.0)))
