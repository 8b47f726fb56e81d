"""Compare the time between reference and responses over the records of one measurement."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from legacy.kinematics.calibrated import calibrated
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.warnings import Notice

# Share of the largest power above which a line carries the excitation, and how many such lines are needed.
_EXCITED = 0.1
_LEAST_LINES = 8
_LEAST_DELAY_SAMPLES: float = calibrated("record_delays.least_samples")
_LEAST_DELAY_SD: float = calibrated("record_delays.least_sd")


def delay_notice(
    spectra: Iterable[tuple[ComplexArray, ComplexArray]],
    freq_hz: Array,
    value: ComplexArray,
    variance: Array,
    power: Array,
    sample_rate_hz: float,
) -> list[Notice]:
    """Warn of records whose reference is early or late against that of the others.

    Parameters
    ----------
    spectra : iterable of (ndarray (freq,), ndarray (channel, freq)), complex
        Reference and responses of every record.
    freq_hz : ndarray, (freq,)
    value, variance : ndarray, (channel, freq)
        The estimate over all records and E|dH|^2, by which channels are weighted.
    power : ndarray, (freq,)
        Of the reference.

    Notes
    -----
    The delay of a record is the slope of the phase of sum H* Y X* over the excited lines, by the products of
    neighbouring lines; what a straight phase leaves of every line tells how well the slope is known.
    """
    used = power > _EXCITED * np.max(power)
    if np.sum(used) < _LEAST_LINES:
        return []
    weight = value.conj() / np.maximum(variance, np.finfo(float).tiny)
    step, delays, doubts = freq_hz[1] - freq_hz[0], [], []
    for x, y in spectra:
        both = np.where(used, np.sum(weight * y, axis=0) * x.conj(), 0.0)
        phase = both / np.maximum(np.abs(both), np.finfo(float).tiny)
        slope = float(np.angle(np.sum(phase[1:] * phase[:-1].conj())))
        flat = (phase * np.exp(-1j * slope * np.arange(len(phase))))[used]
        phase_error = np.angle(flat * np.conj(np.mean(flat)))
        place = np.flatnonzero(used) - np.mean(np.flatnonzero(used))
        further = float(place @ phase_error / (place @ place))
        spread = float(np.var(phase_error - further * place))
        delays.append(-(slope + further) / (2.0 * np.pi * step))
        doubts.append(np.sqrt(spread / (place @ place)) / (2.0 * np.pi * step))
    apart = np.abs(np.array(delays) - np.median(delays))
    late = (apart * sample_rate_hz > _LEAST_DELAY_SAMPLES) & (apart > _LEAST_DELAY_SD * np.array(doubts))
    if not np.any(late):
        return []
    most, which = 1e6 * float(np.max(apart[late])), int(np.argmax(apart * late)) + 1
    text = (
        f"{int(np.sum(late))} of {len(delays)} records have the reference early or late against the others, "
        f"by up to {most:.3g} us (record {which}): channels were not started together. Amplitudes of all "
        "channels are low and phases off by one factor for it, which K, D and responses per reference do not "
        "contain; record reference and responses with one trigger."
    )
    return [Notice("records_late", text)]
