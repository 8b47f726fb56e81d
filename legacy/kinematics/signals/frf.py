"""Frequency responses from time series: H1, H2, Hv, coherence and the variance of each.

Random or transient excitation: averages over windowed, overlapping segments. Periodic excitation
(multisine, pseudo-random, periodic chirp): whole periods without a window, the noise from what differs
between periods. One reference; any number of channels recorded with it; any number of records.

Sources: Bendat and Piersol, Random Data, 4th ed. 2010, ch. 7 and 9 (H1, H2, coherence, random errors);
Welch 1967, IEEE Trans. Audio Electroacoust. 15:70, doi:10.1109/TAU.1967.1161901 (overlapping segments);
Fuller, Measurement Error Models, 1987, sec. 1.3 (total least squares with a known ratio of the noises);
Pintelon and Schoukens, System Identification, 2nd ed. 2012, ch. 2 (periodic excitation).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from legacy.kinematics.calibrated import calibrated
from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.options import FRF_ESTIMATORS, LOCAL, WINDOWS
from legacy.kinematics.signals.frf_noise import (
    Frf,
    check_signals,
    common_notice,
    smoothed,
    split_noise,
    steady_common,
)
from legacy.kinematics.signals.leakage import bend_notice, edge_notice
from legacy.kinematics.signals.record_delays import delay_notice
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.faults import Fault, raise_all
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

Records = Sequence[tuple[Array, Array]]
# Segments: two give no variance of a variance.
_FEWEST = 3
# Averages whose noise estimate needs no neighbouring lines (sd known to 7 %).
_STEADY = 100
_FEW_AVERAGES: float = calibrated("frf.few_averages")
_NOTABLE_BIAS_SD: float = calibrated("frf.notable_bias_sd")
# Fewer channels cannot show noise that all share.
_LEAST_TOGETHER = 3
_SEGMENTED = tuple(name for name in FRF_ESTIMATORS if name != LOCAL)


@dataclass(frozen=True)
class Welch:
    """How records of random excitation are averaged.

    Attributes
    ----------
    segment : int
        Samples of a segment: the resolution is the sampling rate over it.
    window : str
        ``hann`` (default), ``hamming``, ``blackman``, ``flattop``, or ``none``.
    overlap : float
        Share of a segment that it has in common with the next, 0 to 0.95.
    estimator : str
        ``h1`` (noise in the responses only), ``h2`` (noise in the reference only), ``hv`` (both: total
        least squares).
    noise_ratio : float or None
        For ``hv``: noise power of the response over that of the reference, in their units squared. None:
        in the ratio of the powers of the two signals themselves, for which Hv is the geometric mean of H1
        and H2 and does not depend on units.

    Raises
    ------
    KinematicsError
        A value out of its range.
    """

    segment: int
    window: str = "hann"
    overlap: float = 0.5
    estimator: str = "h1"
    noise_ratio: float | None = None

    def __post_init__(self) -> None:
        faults = []
        if self.estimator not in _SEGMENTED:
            faults.append(Fault("the estimator", ", ".join(_SEGMENTED), self.estimator))
        if self.window not in WINDOWS:
            faults.append(Fault("the window", ", ".join(WINDOWS), self.window))
        if not 0.0 <= self.overlap <= 0.95:
            faults.append(Fault("the overlap", "between 0 and 0.95", self.overlap))
        if self.segment < 8:
            faults.append(Fault("a segment", "of at least 8 samples", self.segment))
        if self.noise_ratio is not None and not (np.isfinite(self.noise_ratio) and self.noise_ratio > 0.0):
            faults.append(Fault("the noise ratio", "positive", self.noise_ratio))
        raise_all(KinematicsError, faults)

    @property
    def hop(self) -> int:
        """Samples from the start of a segment to that of the next."""
        return max(1, round(self.segment * (1.0 - self.overlap)))

    def taper(self) -> Array:
        """Return the window, (segment,), periodic."""
        if self.window == "none":
            return np.ones(self.segment)
        from scipy.signal import get_window

        return np.asarray(get_window(self.window, self.segment), dtype=float)


def effective_averages(taper: Array, hop: int, segments: int) -> float:
    """Return how many independent averages overlapping segments are worth.

    Parameters
    ----------
    taper : ndarray, (segment,)

    Notes
    -----
    n / (1 + 2 sum_m (1 - m/n) rho_m) with rho_m = (sum_t w_t w_{t + m hop} / sum_t w_t^2)^2; Welch 1967.
    """
    total = 1.0
    power = float(np.sum(taper**2))
    for step in range(1, segments):
        shift = step * hop
        if shift >= len(taper):
            break
        rho = (float(taper[:-shift] @ taper[shift:]) / power) ** 2
        total += 2.0 * (1.0 - step / segments) * rho
    return segments / total


def line_spread(taper: Array) -> float:
    """Return the variance of slowly varying sums over lines over that of independent lines.

    Notes
    -----
    Spectra of white signals at lines m apart have the correlation R_m = DFT(w^2)_m / DFT(w^2)_0, products
    of reference and noise R_m^2; summed over all m that is N sum w^4 / (sum w^2)^2 by Parseval.
    """
    return float(len(taper) * np.sum(taper**4) / np.sum(taper**2) ** 2)


def segment_for(samples: int, averages: int, overlap: float) -> int:
    """Return the longest even segment of which so many fit into a record."""
    length = int(samples / (1.0 + (averages - 1) * (1.0 - overlap)))
    return length - length % 2


def welch_frf(records: Records, sample_rate_hz: float, how: Welch, where: str = "") -> Frf:
    """Estimate frequency responses to random or transient excitation.

    Parameters
    ----------
    records : sequence of (ndarray (sample,), ndarray (channel, sample))
        Reference and responses of every record; each record is cut into segments by itself.
    where : str
        Place for messages.

    Returns
    -------
    Frf

    Raises
    ------
    KinematicsError
        Signals that are not finite, a reference without signal, or fewer than three segments.

    Notes
    -----
    With G the averaged spectra and n the effective averages: H1 = Gxy / Gxx is low by 1 / (1 + noise over
    signal in the reference), H2 = Gyy / Gyx is high by 1 + noise over signal in the response, and Hv lies
    between. Conditional on the reference, E|dH1|^2 = Gyy (1 - g2) / ((n - 1) Gxx), g2 the coherence
    (Bendat and Piersol, Table 9.6, with n - 1 so that it is right in the mean for few averages); the real
    part has half of it. For all three, with u = |Gxy| / |H| the power of the true reference, e = Gxx - u
    and v = Gyy - |H|^2 u: E|dH|^2 = (v + |H|^2 e + e v / u) / ((n - 1) u) (Fuller 1987, eq. 1.3.12), for
    the geometric mean |H|^2 (1 - g2)(1 + 1 / g2) / (2 (n - 1)). Below a hundred averages the noise power in
    it is averaged over neighbouring lines, so that weights and chi2 made of it are steady.
    """
    records = checked_records(records, sample_rate_hz, where)
    taper = how.taper()
    counts = [1 + (len(x) - how.segment) // how.hop if len(x) >= how.segment else 0 for x, _ in records]
    averages = sum(effective_averages(taper, how.hop, count) for count in counts if count)
    if sum(counts) < _FEWEST:
        step = "Take shorter segments (a coarser resolution) or record longer"
        got = f"{sum(counts)} of {how.segment} samples"
        raise KinematicsError.of("the records", f"at least {_FEWEST} segments long", got, where, step)
    first = 1 if how.window == "none" else 2
    lines = slice(first, (how.segment + 1) // 2)
    freq = np.arange(how.segment)[lines] * sample_rate_hz / how.segment

    def segments() -> Iterator[tuple[ComplexArray, ComplexArray]]:
        for (x, y), count in zip(records, counts, strict=True):
            for start in range(0, count * how.hop, how.hop):
                part = slice(start, start + how.segment)
                yield _spectrum(x[part], taper, lines), _spectrum(y[:, part], taper, lines)

    total = sum(counts)
    gxx = np.zeros(len(freq))
    gyy = np.zeros((len(records[0][1]), len(freq)))
    gxy = np.zeros(gyy.shape, dtype=complex)
    for x, y in segments():
        gxx += np.abs(x) ** 2 / total
        gyy += np.abs(y) ** 2 / total
        gxy += x.conj() * y / total
    if np.any(gxx == 0.0):
        step = "Restrict the band to where the reference has power"
        raise KinematicsError.of("the reference", "of some power at every line", 0, where, step)
    tiny = np.finfo(float).tiny
    value, variance, coherence = _estimate(gxx, gyy, gxy, averages, how)
    unexplained = gyy - 2.0 * np.abs(gxy) * np.abs(value) + np.abs(value) ** 2 * gxx
    own, common = split_noise(
        lambda: (y - value * x for x, y in segments()), np.maximum(unexplained, 0.0), value, float(total)
    )
    share = np.where(unexplained > 0.0, own / np.where(unexplained > 0.0, unexplained, 1.0), 1.0)
    variance = variance * np.minimum(share, 1.0)
    if averages < _STEADY:
        true = np.maximum(np.abs(gxy) / np.maximum(np.abs(value), tiny), tiny)
        width = int(np.ceil(1.5 * _STEADY / averages))
        variance = smoothed(variance * true, width, (averages - 1.0) / line_spread(taper)) / true
        common = steady_common(common, width)
    common_sd = np.sqrt(common / (2.0 * max(averages - 1.0, 1e-3) * gxx))
    notices = _notices(common_sd, common / gxx, averages, how)
    notices += _high_notice(own / np.maximum(gyy - own, 0.1 * gyy + tiny), value, variance, how)
    if len(records) >= _FEWEST and np.any(common > 0.0):
        firsts = [(_spectrum(x[: how.segment], taper, lines), y[:, : how.segment]) for x, y in records]
        pairs = ((x, _spectrum(y, taper, lines)) for x, y in firsts)
        notices += delay_notice(pairs, freq, value, variance, gxx, sample_rate_hz)
    if how.window == "none":
        notices += edge_notice([records[0][1][:, : how.segment]])
    sd = np.sqrt(0.5 * variance)
    notices += bend_notice(freq, value, np.hypot(sd, common_sd * np.abs(value)), taper, gxx)
    return Frf(
        freq,
        value,
        sd,
        coherence,
        averages,
        common_sd,
        np.sqrt(gxx) * np.sqrt(2.0) / np.sqrt(how.segment * np.sum(taper**2)),
        tuple(notices),
        line_spread(taper),
    )


def _notices(common_sd: Array, share: Array, averages: float, how: Welch) -> list[Notice]:
    """Return the warnings about the noise of the reference and about few averages."""
    more = ""
    if how.estimator == "h1":
        low = 100.0 * float(np.median(share))
        more = (
            f" H1 reads all of them {low:.2g} % low for it, by one factor, which K, D and responses per "
            "reference do not contain; Hv reads half of that, H2 none where channels have no own noise."
        )
    notices = common_notice(common_sd, more)
    if averages < _FEW_AVERAGES:
        text = f"only {averages:.2g} independent averages were made: the stated noise is rough."
        notices.append(Notice("few_averages", text))
    if how.window == "flattop":
        text = (
            "a flattop window is made for single sines: it spreads every line of random excitation over "
            f"four, which smears responses by more than their noise shows. Take {named('window')} hann or "
            f"{named('frf')} lpm."
        )
        notices.append(Notice("window_wide", text))
    return notices


def _high_notice(own: Array, value: ComplexArray, variance: Array, how: Welch) -> list[Notice]:
    """Warn where H2 or Hv reads channels high by their own noise, each by its own factor.

    Parameters
    ----------
    own : ndarray, (channel, freq)
        Power of each channel's own noise over that of its signal; of fewer than three channels it is not
        separated from the noise of the reference.
    value : ndarray, (channel, freq), complex
    variance : ndarray, (channel, freq)
        E|dH|^2.

    Notes
    -----
    H2 is high by 1 + noise over signal in the response, the geometric mean by the root of it (Bendat and
    Piersol 2010, sec. 6.1.4); over the lines the sum of it stands out from noise by the root of their number.
    """
    if how.estimator == "h1" or how.noise_ratio is not None or len(own) < _LEAST_TOGETHER:
        return []
    high = own if how.estimator == "h2" else 0.5 * own
    bias = np.sum(high**2 * np.abs(value) ** 2 / np.maximum(variance, np.finfo(float).tiny), axis=1)
    if np.max(bias) < _NOTABLE_BIAS_SD**2:
        return []
    worst = float(np.max(np.median(high, axis=1)))
    text = (
        f"{how.estimator.upper()} reads every channel high by its own noise, by up to {100.0 * worst:.2g} % "
        "(median over the lines of the noisiest channel), each by its own factor: that is not in their "
        "stated noise and looks like gain errors of channels. H1 is free of it."
    )
    return [Notice("estimator_bias", text)]


def _spectrum(signal: Array, taper: Array, lines: slice) -> ComplexArray:
    """Return the lines of windowed samples (..., sample), their mean taken out."""
    level = np.mean(signal, axis=-1, keepdims=True)
    return np.asarray(np.fft.rfft((signal - level) * taper, axis=-1)[..., lines])


def _estimate(
    gxx: Array, gyy: Array, gxy: ComplexArray, averages: float, how: Welch
) -> tuple[ComplexArray, Array, Array]:
    """Return H (channel, freq), E|dH|^2 and the coherence from averaged spectra."""
    tiny = np.finfo(float).tiny
    size = np.maximum(np.abs(gxy), tiny)
    coherence = np.clip(size**2 / np.maximum(gxx * gyy, tiny), 0.0, 1.0)
    count = max(averages - 1.0, 1e-3)
    if how.estimator == "h1":
        gain = size / gxx
    elif how.estimator == "h2":
        gain = gyy / size
    elif how.noise_ratio is None:
        gain = np.sqrt(gyy / gxx)
    else:
        apart = gyy - how.noise_ratio * gxx
        root = np.sqrt(apart**2 + 4.0 * how.noise_ratio * size**2)
        gain = np.where(apart > 0.0, apart + root, 4.0 * how.noise_ratio * size**2 / (root - apart + tiny))
        gain = gain / (2.0 * size)
    value = gain * gxy / size
    true = size / np.maximum(gain, tiny)
    if how.estimator == "hv" and how.noise_ratio is None:
        variance = gain**2 * (1.0 - coherence) * (1.0 + 1.0 / np.maximum(coherence, tiny)) / (2.0 * count)
    else:
        below, above = np.maximum(gxx - true, 0.0), np.maximum(gyy - gain**2 * true, 0.0)
        variance = (above + gain**2 * below + above * below / true) / (count * true)
    return value, variance, coherence


def checked_records(records: Records, sample_rate_hz: float, where: str) -> list[tuple[Array, Array]]:
    """Return the records as arrays.

    Raises
    ------
    KinematicsError
        No record, records of different channels, or what check_signals says.
    """
    if not records:
        raise KinematicsError.of("the records", "at least one", "none", where)
    arrays = []
    for reference, responses in records:
        x, y = np.asarray(reference, dtype=float), np.asarray(responses, dtype=float)
        check_signals(x, y, sample_rate_hz, where)
        arrays.append((x, y))
    if len({len(y) for _, y in arrays}) != 1:
        raise KinematicsError.of("the records", "of the same channels", "others", where)
    return arrays
