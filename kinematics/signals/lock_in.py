"""Stepped sine by lock-in: least squares of cosine, sine, second and third harmonic, offset and drift.

Sources: IEEE Std 1057-2017, annex B (least-squares sine fits); the variance of a fitted amplitude in coloured
noise is that of the noise near the line, G(f) / T for each of the two parts with the one-sided spectrum G and
the duration T (Kay, Fundamentals of Statistical Signal Processing I, 1993, ex. 3.14, with the local spectrum
for white noise).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kinematics.signals.frf import Frf
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, StapeskitError, collect_faults, raise_all

OFFSETS = 32
"""Bins on each side of the line in which the noise is read."""

_GAP = 2.5  # bins to the line and its harmonics, which a Hann window keeps apart
_HARMONICS = 3
_SETTLING = 0.2  # share of every step left out at its start
_FEWEST_CYCLES, _FEWEST_SAMPLES = 4.0, 16


@dataclass(frozen=True)
class Step:
    """One step: set frequency, samples of the reference (sample,) or None, responses (channel, sample)."""

    freq_hz: float
    reference: Array | None
    responses: Array


def stepped_frf(steps: Sequence[Step], sample_rate_hz: float, where: str = "") -> Frf:
    """Return responses per unit of the reference, or amplitudes where the steps have none.

    Raises
    ------
    StapeskitError
        A frequency above half the sampling rate, a step shorter than four cycles, one frequency twice, or a
        reference without its line; of all steps.
    """
    faults: list[Fault] = []
    found: list[tuple[float, ComplexArray, Array, float]] = []
    for step in sorted(steps, key=lambda one: one.freq_hz):
        place = f"{where}, step of {step.freq_hz:g} Hz"
        with collect_faults(faults):
            if found and np.isclose(step.freq_hz, found[-1][0], rtol=1e-9):
                want, advice = "of another frequency than the others", "Give repeats as files of their own"
                raise StapeskitError.of("a step", want, "it again", place, advice)
            found.append((step.freq_hz, *_response(step, sample_rate_hz, place)))
    raise_all(faults)
    if not found:
        raise StapeskitError.of("the steps", "at least one", "none", where)
    freq, values, spreads, common = (np.array(part) for part in zip(*found, strict=True))
    return Frf(freq, values.T, spreads.T, None, float("nan"), common)


def _response(step: Step, sample_rate_hz: float, where: str) -> tuple[ComplexArray, Array, float]:
    """Return responses (channel,), their sd (channel,) and the relative sd of the reference."""
    begin = round(_SETTLING * step.responses.shape[1])
    signals = step.responses[:, begin:]
    if step.reference is None:
        return *fit_sine(signals, sample_rate_hz, step.freq_hz, where), 0.0
    signals = np.vstack([step.reference[begin:], signals])
    amplitude, sd = fit_sine(signals, sample_rate_hz, step.freq_hz, where)
    size = abs(amplitude[0])
    if not size > 5.0 * sd[0]:
        got = f"{size:.3g} with a noise of {sd[0]:.3g}"
        raise StapeskitError.of(
            "the line of the reference", "above its noise", got, where, "Check its channel"
        )
    return amplitude[1:] / amplitude[0], sd[1:] / size, float(sd[0] / size)


def fit_sine(
    signals: Array, sample_rate_hz: float, freq_hz: float, where: str = ""
) -> tuple[ComplexArray, Array]:
    """Fit one sine to the channels of one record.

    Parameters
    ----------
    signals : ndarray, (channel, sample)

    Returns
    -------
    amplitude : ndarray, (channel,), complex
        Peak; the signal is Re(amplitude e^{+iwt}) with t = 0 at the first sample.
    sd : ndarray, (channel,)
        Standard deviation of the real (= imaginary) part.

    Raises
    ------
    StapeskitError
        The frequency lies above half the sampling rate, or the record is shorter than four cycles or 16
        samples.
    """
    count = signals.shape[1]
    if not 0.0 < freq_hz < 0.49 * sample_rate_hz:
        want, got = f"above 0 and below half the sampling rate ({sample_rate_hz:g} Hz)", f"{freq_hz:g} Hz"
        raise StapeskitError.of("the frequency of a step", want, got, where, "Correct the column freq_hz")
    cycles = count * freq_hz / sample_rate_hz
    if cycles < _FEWEST_CYCLES or count < _FEWEST_SAMPLES:
        got, step = f"{cycles:.3g} cycles, {count} samples", "Record longer steps"
        raise StapeskitError.of("a step", "four cycles and 16 samples long", got, where, step)
    angle = 2.0 * np.pi * freq_hz / sample_rate_hz * np.arange(count)
    orders = max(1, min(_HARMONICS, int(0.49 * sample_rate_hz / freq_hz)))
    columns = [part(order * angle) for order in range(1, orders + 1) for part in (np.cos, np.sin)]
    base = np.column_stack([*columns, np.ones(count), np.linspace(-1.0, 1.0, count)])
    fitted = np.linalg.lstsq(base, signals.T, rcond=None)[0]
    rest = signals - (base @ fitted).T
    return np.asarray(fitted[0] - 1j * fitted[1]), _noise(rest, sample_rate_hz, freq_hz)


def _noise(rest: Array, sample_rate_hz: float, freq_hz: float) -> Array:
    """Return the sd of an amplitude from what the fit leaves near the line, off its harmonics.

    A Hann window keeps other frequencies out; sum w^2 / (sum w)^2 of it takes the place of 1 / n.
    """
    count = rest.shape[1]
    window = np.hanning(count)
    power = np.abs(np.fft.rfft(rest * window, axis=1)) ** 2
    bins, line = np.arange(power.shape[1]), freq_hz * count / sample_rate_hz
    away, off_harmonics = np.abs(bins - line), np.abs(bins - np.round(bins / line) * line)
    near = (bins > 2) & (away > _GAP) & (away < _GAP + OFFSETS) & (off_harmonics > _GAP)
    if not np.any(near):
        return np.asarray(np.std(rest, axis=1) * np.sqrt(2.0 / count))
    return np.asarray(np.sqrt(2.0 * power[:, near].mean(axis=1) / (count * np.sum(window**2))))
