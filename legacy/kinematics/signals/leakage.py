"""Leakage: warn where sharp responses or abrupt segments bias a spectrum by more than its noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.calibrated import calibrated
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

# The end of a segment that is looked at, and what share of its mean power is too much there.
_EDGE = 0.02
_MOST_EDGE_POWER: float = calibrated("leakage.most_edge_power")
# Lines to each side over which windows spread: the main lobe of the widest (flat top) has five.
_WIDEST = 6
# Excitation is even where its least power around is this share of its largest.
_EVEN_SHARE: float = calibrated("leakage.even_share")


def bend_notice(freq_hz: Array, value: ComplexArray, sd: Array, taper: Array, power: Array) -> list[Notice]:
    """Warn where responses bend so much within the width of the window that their bias exceeds the noise.

    Parameters
    ----------
    freq_hz : ndarray, (freq,)
        Evenly spaced lines of the segments.
    value : ndarray, (channel, freq), complex
    sd : ndarray, (channel, freq)
        Of the real (= imaginary) part.
    taper : ndarray, (segment,)
    power : ndarray, (freq,)
        Of the reference. Lines at the edge of an excited band and outside are not looked at.

    Notes
    -----
    Under an excitation of even power the mean of an estimate by segments is H averaged over the power |W|^2
    of the window: H + H'' m / 2 with the second moment m of |W|^2, H'' by second differences (Bendat and
    Piersol 2010, sec. 8.5). Noise puts (6 - 8 r1 + 2 r2) of its variance into the differences, r1 and r2 the
    correlation of the noise of H at lines one and two apart, which is the square of that of the spectra
    (``kinematics.signals.frf.line_spread``); it is subtracted from the mean over the channels.
    """
    if value.shape[1] < 3 or not np.ptp(taper) > 0.0:
        return []
    lobe = np.abs(np.fft.fft(taper)[: _WIDEST + 1]) ** 2
    steps = np.arange(_WIDEST + 1)
    moment = float(2.0 * np.sum(lobe * steps**2) / (lobe[0] + 2.0 * np.sum(lobe[1:])))
    bias = 0.5 * moment * (value[:, 2:] - 2.0 * value[:, 1:-1] + value[:, :-2])
    variance = np.maximum(2.0 * sd[:, 1:-1] ** 2, np.finfo(float).tiny)
    chance = (0.5 * moment) ** 2 * noise_of_differences(taper)
    excess = np.mean(np.abs(bias) ** 2 / variance, axis=0) - chance
    wide = chance * (1.0 + 4.0 / np.sqrt(len(value)))
    beyond = (excess > 1.0 + wide) & _find_even_lines(power)[1:-1]
    count = int(np.sum(beyond))
    if count == 0:
        return []
    off = np.linalg.norm(bias, axis=0) / np.maximum(np.linalg.norm(value[:, 1:-1], axis=0), 1e-300)
    worst = int(np.argmax(np.where(beyond, off, 0.0)))
    text = (
        f"the responses bend so much within the resolution of {freq_hz[1] - freq_hz[0]:.3g} Hz that they are "
        f"wrong by more than their noise at {count} of {len(freq_hz)} lines, most near "
        f"{freq_hz[1 + worst]:.4g} Hz (by {100.0 * off[worst]:.2g} %): leakage. It is the same factor for "
        f"motions that share the sharp resonance and not in their stated noise. Take {named('frf')} lpm, "
        "a finer "
        f"{named('resolution')}, or longer records."
    )
    return [Notice("leakage", text)]


def noise_of_differences(taper: Array) -> float:
    """Return the variance of second differences of a response over that of one line, 6 - 8 r1 + 2 r2.

    Parameters
    ----------
    taper : ndarray, (segment,)
        Window of the segments; for random excitation.
    """
    near = np.abs(np.fft.fft(taper**2)[:3]) ** 2
    return float((6.0 * near[0] - 8.0 * near[1] + 2.0 * near[2]) / near[0])


def _find_even_lines(power: Array) -> NDArray[np.bool_]:
    """Return the lines around which the excitation has much the same power."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    least, most = minimum_filter1d(power, 2 * _WIDEST + 1), maximum_filter1d(power, 2 * _WIDEST + 1)
    return np.asarray((least > _EVEN_SHARE * most) & (power > _EVEN_SHARE * np.median(power)))


def edge_notice(segments: list[Array]) -> list[Notice]:
    """Warn of segments taken without a window that do not begin and end at rest.

    Parameters
    ----------
    segments : list of ndarray, (channel, sample)
        Responses of some segments.
    """
    edge = whole = 0.0
    for segment in segments:
        level = segment - np.mean(segment, axis=1, keepdims=True)
        size = np.maximum(np.mean(level**2, axis=1), np.finfo(float).tiny)
        count = max(1, int(_EDGE * level.shape[1]))
        edge += float(np.mean(np.mean(level[:, -count:] ** 2, axis=1) / size))
        whole += 1.0
    if whole == 0.0 or edge / whole < _MOST_EDGE_POWER:
        return []
    text = (
        "segments without a window do not end at rest (the last 2 % of a segment hold "
        f"{100.0 * np.sqrt(edge / whole):.2g} % of its mean amplitude): leakage is in the responses and more "
        f"than their stated noise. Take {named('window')} hann or {named('frf')} lpm, or "
        f"{named('period')} for periodic excitation."
    )
    return [Notice("leakage", text)]
