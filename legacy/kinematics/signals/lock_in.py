"""One sine by lock-in: least squares of cosine and sine, offset, drift and harmonics, with its noise.

Sources: IEEE Std 1057-2017, annex B (least-squares sine fits, frequency refinement); the variance of a
fitted amplitude in coloured noise is that of the noise near the line, G(f) / T for each of the two parts
with the one-sided spectrum G and the duration T (Kay, Fundamentals of Statistical Signal Processing I,
1993, ex. 3.14, with the local spectrum in the place of white noise).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legacy.kinematics.calibrated import calibrated
from legacy.kinematics.errors import KinematicsError
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.faults import Fault, raise_all

# Noise is read off so many offset frequencies on each side, from this many bins on, within this share of
# the frequency.
OFFSETS = 32
_GAP = 3
_NEAR = 0.35
_NOTABLE_CHANGE: float = calibrated("lock_in.notable_change")
# Fewest cycles of a reading, and samples of a third of it in which a drift is looked for.
_FEWEST_CYCLES = 4.0
_LEAST_THIRD = 16
_LEAST_BEND_RAD: float = calibrated("lock_in.least_bend_rad")
_NOTABLE_BEND_SD: float = calibrated("lock_in.notable_bend_sd")


@dataclass(frozen=True)
class SineFit:
    """One sine in several channels of one record.

    Attributes
    ----------
    freq_hz : float
        The nominal one, or refined.
    amplitude : ndarray, (channel,), complex
        Peak; the signal is Re(amplitude e^{+iwt}) with t = 0 at the first sample.
    sd : ndarray, (channel,)
        Standard deviation of the real (= imaginary) part, from the noise near the line.
    harmonics : ndarray, (channel, harmonic), complex
        Amplitudes at 2 f, 3 f, ... as far as they were fitted.
    residual : ndarray, (channel, offset), complex
        Samples of what is left near the line, each of the size that the error of the amplitude has.
    unsteady : float
        Change of the amplitude from the first to the second half of the record over its noise, the largest
        of all channels; changes below a thousandth of the amplitude do not count.
    share : ndarray, (channel,)
        Share of the power of the signal, without its mean, in the line.
    run_hz : float
        Change of the frequency from start to end of the record, ``freq_hz`` its mean; 0 where none is seen.
    """

    freq_hz: float
    amplitude: ComplexArray
    sd: Array
    harmonics: ComplexArray
    residual: ComplexArray
    unsteady: float
    share: Array
    run_hz: float = 0.0


@dataclass(frozen=True)
class SteppedSine:
    """How steps are evaluated.

    Attributes
    ----------
    settle : float
        Share of every step left out at its start, 0 to 0.9.
    harmonics : int
        Highest harmonic fitted with the line (1: none).
    drift : int
        Degree of the polynomial fitted beside it: 0 offset, 1 linear drift.
    refine : bool
        Find the frequency in the signals, for generators whose clock differs from the sampler's, and its run
        within the step where that is seen.

    Raises
    ------
    KinematicsError
        A value out of its range.
    """

    settle: float = 0.2
    harmonics: int = 3
    drift: int = 1
    refine: bool = True

    def __post_init__(self) -> None:
        faults = []
        if not 0.0 <= self.settle <= 0.9:
            faults.append(Fault("the share that settles", "from 0 to 0.9", self.settle))
        if not 1 <= self.harmonics <= 20:
            faults.append(Fault("the highest harmonic", "from 1 to 20", self.harmonics))
        if not 0 <= self.drift <= 5:
            faults.append(Fault("the degree of the drift", "from 0 to 5", self.drift))
        raise_all(KinematicsError, faults)


def fit_sine(
    signals: Array,
    sample_rate_hz: float,
    freq_hz: float,
    how: SteppedSine | None = None,
    where: str = "",
) -> SineFit:
    """Fit one sine to the channels of one record.

    Parameters
    ----------
    signals : ndarray, (channel, sample)
        All of the record is used: ``settle`` is left to stepped_frf.
    how : SteppedSine, optional
    where : str
        Place for messages.

    Raises
    ------
    KinematicsError
        The frequency lies above half the sampling rate or the record is shorter than four cycles or holds
        no such frequency.
    """
    how, run_hz = how or SteppedSine(), 0.0
    signals = np.atleast_2d(np.asarray(signals, dtype=float))
    count = signals.shape[1]
    if not 0.0 < freq_hz < 0.499 * sample_rate_hz:
        step = "Sample faster, or correct the table of steps"
        want = f"above 0 and below half the sampling rate ({0.5 * sample_rate_hz:g} Hz)"
        raise KinematicsError.of("the frequency of a step", want, f"{freq_hz:g} Hz", where, step)
    if count * freq_hz / sample_rate_hz < _FEWEST_CYCLES or count < 16:
        got = f"{count * freq_hz / sample_rate_hz:.3g} cycles, {count} samples"
        step = "Record longer steps or let less settle"
        raise KinematicsError.of("a step", "four cycles and 16 samples long", got, where, step)
    if how.refine:
        freq_hz = _refine(signals, sample_rate_hz, freq_hz, how, where)
        run_hz = _run(signals, sample_rate_hz, freq_hz, how)
    base = _regressors(count, sample_rate_hz, freq_hz, how, run_hz)
    coefficients = _solve(base, signals.T)
    residual_signals = signals - (base @ coefficients).T
    orders = _orders(sample_rate_hz, freq_hz, how)
    pairs = (coefficients[0 : 2 * orders : 2] - 1j * coefficients[1 : 2 * orders : 2]).T
    residual = _nearby_spectrum(residual_signals, sample_rate_hz, freq_hz)
    variance = np.mean(np.abs(residual) ** 2, axis=1) / 2.0
    sd = np.sqrt(variance)
    power = np.maximum(np.var(signals, axis=1), np.finfo(float).tiny)
    return SineFit(
        freq_hz,
        pairs[:, 0],
        sd,
        pairs[:, 1:],
        residual,
        _amplitude_change(residual_signals, sample_rate_hz, freq_hz, pairs[:, 0], sd),
        0.5 * np.abs(pairs[:, 0]) ** 2 / power,
        run_hz,
    )


def _orders(rate: float, freq: float, how: SteppedSine) -> int:
    """Return how many multiples of the line lie below half the sampling rate and are fitted."""
    return max(1, min(how.harmonics, int(0.49 * rate / freq)))


def _regressors(count: int, rate: float, freq: float, how: SteppedSine, run_hz: float = 0.0) -> Array:
    """Return cos and sin of the line and its harmonics, then the drift, (sample, column).

    The phase of a frequency that runs evenly is that of its mean at both ends of the record.
    """
    place = np.arange(count)
    angle = 2.0 * np.pi / rate * place * (freq + 0.5 * run_hz * (place / count - 1.0))
    columns = []
    for order in range(1, _orders(rate, freq, how) + 1):
        columns += [np.cos(order * angle), np.sin(order * angle)]
    ramp = np.linspace(-1.0, 1.0, count)
    columns += [ramp**degree for degree in range(how.drift + 1)]
    return np.column_stack(columns)


def _solve(base: Array, samples: Array) -> Array:
    """Return least-squares coefficients, (column, channel); the columns are far from dependent."""
    return np.asarray(np.linalg.solve(base.T @ base, base.T @ samples))


def _refine(signals: Array, rate: float, freq: float, how: SteppedSine, where: str) -> float:
    """Return the frequency of the sine near the nominal one, from the phases between two halves.

    All channels take part, each weighted by the inverse of what a fit leaves of it.
    """
    count = signals.shape[1]
    apart = rate / count
    quarters = np.arange(-12, 13)
    near = freq + 0.25 * apart * quarters
    within = (near > 0.5 * freq) & (near < 0.499 * rate)
    level = signals - np.mean(signals, axis=1, keepdims=True)
    level = level / np.maximum(np.std(level, axis=1, keepdims=True), np.finfo(float).tiny)
    spectrum = np.fft.fft(level * (_mixer(count, rate, freq) * np.hanning(count)), 4 * count)
    power = np.sum(np.abs(spectrum[:, quarters[within]]) ** 2, axis=0)
    coarse = float(near[within][np.argmax(power)])
    half = count // 2
    plain = replace(how, harmonics=1)
    for _ in range(6):
        base = _regressors(half, rate, coarse, plain)
        halves, energy = [], np.full(len(level), 1e-20)
        for part in (level[:, :half].T, level[:, half : 2 * half].T):
            fitted = _solve(base, part)
            halves.append(fitted[0] - 1j * fitted[1])
            energy += np.mean((part - base @ fitted) ** 2, axis=0)
        turn = np.sum(halves[1] * np.conj(halves[0]) / energy) * np.exp(-2j * np.pi * coarse * half / rate)
        if turn == 0.0:
            break
        change = float(np.angle(turn)) / (2.0 * np.pi) * rate / half
        coarse += change
        if abs(change) < 1e-9 * apart:
            break
    if abs(coarse - freq) > 4.0 * apart:
        step = "Correct the table of steps"
        want = f"within {4.0 * apart:.3g} Hz of its nominal {freq:g} Hz"
        raise KinematicsError.of("the sine of a step", want, f"{coarse:.6g} Hz", where, step)
    return coarse


def _mixer(count: int, rate: float, freq: float) -> ComplexArray:
    """Return what moves a frequency to 0 Hz, (sample,)."""
    return np.asarray(np.exp(-2j * np.pi * freq / rate * np.arange(count)))


def _run(signals: Array, rate: float, freq: float, how: SteppedSine) -> float:
    """Return by how much the frequency runs from start to end, Hz, from the phases of three thirds.

    0 unless the bend of the phase is seven times what the noise of all channels makes of it: with the phase
    variance v of a third it has 6 v.
    """
    third = signals.shape[1] // 3
    if third < _LEAST_THIRD or third * freq / rate < _FEWEST_CYCLES:
        return 0.0
    base = _regressors(third, rate, freq, replace(how, drift=min(how.drift, 1)))
    parts, noise = [], np.zeros(len(signals))
    for number in range(3):
        samples = signals[:, number * third : (number + 1) * third].T
        fitted = _solve(base, samples)
        parts.append(fitted[0] - 1j * fitted[1])
        noise += np.mean((samples - base @ fitted) ** 2, axis=0) / 3.0
    size = np.abs(parts[0] * parts[2]) * np.abs(parts[1]) ** 2
    turn = parts[2] * parts[0] * np.conj(parts[1]) ** 2
    weight = 0.5 * third * np.sqrt(size) / np.maximum(noise, 1e-20 * np.sqrt(size) + np.finfo(float).tiny)
    bend = float(np.angle(np.sum(weight * turn / np.maximum(size, np.finfo(float).tiny))))
    sd = np.sqrt(6.0 / max(float(np.sum(weight)), 1e-300))
    if abs(bend) < max(_LEAST_BEND_RAD, _NOTABLE_BEND_SD * sd):
        return 0.0
    return bend * rate / (2.0 * np.pi * third**2) * signals.shape[1]


def _nearby_spectrum(residual: Array, rate: float, freq: float) -> ComplexArray:
    """Return spectral samples of the residual next to the line, (channel, offset), scaled as its error.

    Offsets lie at least three bins away, where the fit took nothing out, and keep off 0 Hz; a Hann window
    keeps other frequencies out.
    """
    count = residual.shape[1]
    bins = np.concatenate([-np.arange(_GAP, _GAP + OFFSETS), np.arange(_GAP, _GAP + OFFSETS)])
    places, apart = freq + bins * rate / count, rate / count
    off_harmonics = np.abs(places - np.round(places / freq) * freq) > 2.5 * apart
    chosen = (places > 2.0 * apart) & (places < 0.5 * rate - 2.0 * apart) & off_harmonics
    narrow = chosen & (np.abs(places - freq) < _NEAR * freq)
    if np.sum(narrow) >= 12:
        chosen = narrow
    elif np.sum(chosen) < 4:
        chosen = places > 0.0
    taper = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(count) / count)
    spectrum = np.fft.fft(residual * (_mixer(count, rate, freq) * taper))
    return np.asarray(spectrum[:, bins[chosen] % count]) * 2.0 / count / np.sqrt(np.mean(taper**2))


def _amplitude_change(residual: Array, rate: float, freq: float, amplitude: ComplexArray, sd: Array) -> float:
    """Return the largest change of an amplitude between the halves of a record over its noise."""
    count = residual.shape[1]
    mixed = residual * _mixer(count, rate, freq)
    half = count // 2
    change = 2.0 * np.abs(mixed[:, half:].mean(axis=1) - mixed[:, :half].mean(axis=1))
    notable = change > _NOTABLE_CHANGE * np.abs(amplitude)
    return float(np.max(np.where(notable, change / np.maximum(np.sqrt(8.0) * sd, np.finfo(float).tiny), 0.0)))
