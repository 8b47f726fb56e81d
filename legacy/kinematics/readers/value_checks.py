"""Numbers that no recording may hold: infinite values, coherence beyond 0 to 1, impossible noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.recording import Recording
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, Place, raise_all
from legacy.stapeskit.units import FARTHEST_MM, HIGHEST_HZ, LARGEST, LOWEST_HZ


def in_mm(positions: NDArray[np.float64], metres: float) -> NDArray[np.float64]:
    """Return positions (..., 3) in mm from those in a unit of so many metres."""
    with np.errstate(over="ignore"):
        return np.asarray(positions * (metres * 1e3))


def value_faults(recordings: Sequence[Recording]) -> list[Fault]:
    """List what is wrong with the numbers of recordings, one sentence for each kind and recording."""
    faults = []
    for recording in recordings:
        known = ~np.isnan(recording.position_mm)
        if np.any(np.abs(recording.position_mm[known]) > FARTHEST_MM) or np.sum(known) in (1, 2):
            got = ", ".join(f"{value:g}" for value in recording.position_mm) + " mm"
            want = f"three numbers within {FARTHEST_MM:g} mm"
            faults.append(Fault(f"the position of point {recording.point}", want, got, recording.where))
        if len(recording.freq_hz) and recording.freq_hz[-1] > HIGHEST_HZ:
            want = f"below {HIGHEST_HZ:g} Hz"
            faults.append(Fault("the frequencies", want, f"{recording.freq_hz[-1]:g} Hz", recording.where))
        slow = recording.freq_hz[(recording.freq_hz > 0.0) & (recording.freq_hz < LOWEST_HZ)]
        if len(slow):
            want = f"{LOWEST_HZ:g} Hz or more"
            faults.append(Fault("the frequencies", want, f"{slow[0]:g} Hz", recording.where))
        bad = np.isinf(recording.value.real) | np.isinf(recording.value.imag)
        faults += _number_faults_of(
            recording, bad, "the values", "finite, or NaN where missing", recording.value
        )
        bad = ~bad & ((np.abs(recording.value.real) > LARGEST) | (np.abs(recording.value.imag) > LARGEST))
        faults += _number_faults_of(recording, bad, "the values", f"below {LARGEST:g}", recording.value)
        if recording.sd is not None:
            bad = (recording.sd < 0.0) | np.isinf(recording.sd)
            faults += _number_faults_of(
                recording, bad, "the standard deviations", "positive and finite", recording.sd
            )
            bad = np.isfinite(recording.sd) & (recording.sd > LARGEST)
            faults += _number_faults_of(
                recording, bad, "the standard deviations", f"below {LARGEST:g}", recording.sd
            )
        if recording.coherence is not None:
            bad = (recording.coherence < 0.0) | (recording.coherence > 1.0)
            faults += _number_faults_of(
                recording, bad, "the coherence", "within 0 and 1", recording.coherence
            )
        if recording.n_avg is not None and not 1.0 <= recording.n_avg < float("inf"):
            step = "Correct the number"
            faults.append(
                Fault("the number of averages", "1 or more", f"{recording.n_avg:g}", recording.where, step)
            )
    return faults


def check_frequencies(
    freq_hz: Array, where: Place | str, thing: str = "the frequencies", step: str = "Export it again"
) -> None:
    """Refuse frequencies (freq,) that do not ascend, or are negative or no numbers.

    Raises
    ------
    KinematicsError
        The first of them, and how many more there are.
    """
    with np.errstate(invalid="ignore"):
        bad = ~np.isfinite(freq_hz) | (freq_hz < 0.0) | (np.diff(freq_hz, prepend=-np.inf) <= 0.0)
    wanted = "ascending and not negative"
    raise_all(KinematicsError, number_faults(thing, freq_hz, bad, wanted, where, step))


def number_faults(
    thing: str,
    numbers: NDArray[np.generic],
    bad: NDArray[np.bool_],
    expected: str,
    where: Place | str,
    step: str = "Export it again",
) -> list[Fault]:
    """Return one sentence on the bad entries of an array, with the first of them and its place from 1."""
    if not np.any(bad):
        return []
    first = tuple(int(place) for place in np.argwhere(bad)[0])
    more = f" and {int(np.sum(bad)) - 1} more" if np.sum(bad) > 1 else ""
    place = ", ".join(str(entry + 1) for entry in first)
    return [Fault(thing, expected, f"{numbers[first]:g} at place {place}{more}", where, step)]


def _number_faults_of(
    recording: Recording, bad: NDArray[np.bool_], thing: str, expected: str, numbers: NDArray[np.generic]
) -> list[Fault]:
    if not np.any(bad):
        return []
    first = int(np.flatnonzero(bad)[0])
    more = f" and {int(np.sum(bad)) - 1} more" if np.sum(bad) > 1 else ""
    got = f"{numbers[first]} at {recording.freq_hz[first]:.6g} Hz{more}"
    return [Fault(f"{thing} of point {recording.point}", expected, got, recording.where, "Export it again")]
