"""Numbers that no recording may hold: infinite values, coherence beyond 0 to 1, impossible noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinematics.readers.recording import Recording
from stapeskit.faults import Fault, Place
from stapeskit.units import FARTHEST_MM, HIGHEST_HZ, LARGEST, LOWEST_HZ


def scaled(values: NDArray[np.complex128], factor: float) -> NDArray[np.complex128]:
    """Return numbers in another unit; infinite parts leave the other part alone."""
    made = np.array(values, dtype=complex)
    with np.errstate(over="ignore", invalid="ignore"):
        made.real *= factor
        made.imag *= factor
    return made


def in_mm(positions: NDArray[np.float64], metres: float) -> NDArray[np.float64]:
    """Return positions (..., 3) in mm from those in a unit of so many metres."""
    with np.errstate(over="ignore"):
        return np.asarray(positions * (metres * 1e3))


def value_faults(recordings: Sequence[Recording]) -> list[Fault]:
    """List what is wrong with the numbers of recordings, one sentence for each kind and recording."""
    faults = []
    for one in recordings:
        known = ~np.isnan(one.position_mm)
        if np.any(np.abs(one.position_mm[known]) > FARTHEST_MM) or np.sum(known) in (1, 2):
            got = ", ".join(f"{value:g}" for value in one.position_mm) + " mm"
            want = f"three numbers within {FARTHEST_MM:g} mm"
            faults.append(Fault(f"the position of point {one.point}", want, got, one.where))
        if len(one.freq_hz) and one.freq_hz[-1] > HIGHEST_HZ:
            want = f"below {HIGHEST_HZ:g} Hz"
            faults.append(Fault("the frequencies", want, f"{one.freq_hz[-1]:g} Hz", one.where))
        slow = one.freq_hz[(one.freq_hz > 0.0) & (one.freq_hz < LOWEST_HZ)]
        if len(slow):
            want = f"{LOWEST_HZ:g} Hz or more"
            faults.append(Fault("the frequencies", want, f"{slow[0]:g} Hz", one.where))
        bad = np.isinf(one.value.real) | np.isinf(one.value.imag)
        faults += _told(one, bad, "the values", "finite, or NaN where missing", one.value)
        bad = ~bad & ((np.abs(one.value.real) > LARGEST) | (np.abs(one.value.imag) > LARGEST))
        faults += _told(one, bad, "the values", f"below {LARGEST:g}", one.value)
        if one.sd is not None:
            bad = (one.sd < 0.0) | np.isinf(one.sd)
            faults += _told(one, bad, "the standard deviations", "positive and finite", one.sd)
            bad = np.isfinite(one.sd) & (one.sd > LARGEST)
            faults += _told(one, bad, "the standard deviations", f"below {LARGEST:g}", one.sd)
        if one.coherence is not None:
            bad = (one.coherence < 0.0) | (one.coherence > 1.0)
            faults += _told(one, bad, "the coherence", "within 0 and 1", one.coherence)
        if one.n_avg is not None and not 1.0 <= one.n_avg < float("inf"):
            step = "Correct the number"
            faults.append(Fault("the number of averages", "1 or more", f"{one.n_avg:g}", one.where, step))
    return faults


def number_faults(
    thing: str, numbers: NDArray[np.generic], bad: NDArray[np.bool_], expected: str, where: Place | str
) -> list[Fault]:
    """Return one sentence on the bad entries of an array, with the first of them and its place from 1."""
    if not np.any(bad):
        return []
    first = tuple(int(place) for place in np.argwhere(bad)[0])
    more = f" and {int(np.sum(bad)) - 1} more" if np.sum(bad) > 1 else ""
    place = ", ".join(str(entry + 1) for entry in first)
    return [Fault(thing, expected, f"{numbers[first]} at place {place}{more}", where, "Export it again")]


def _told(
    one: Recording, bad: NDArray[np.bool_], thing: str, expected: str, numbers: NDArray[np.generic]
) -> list[Fault]:
    if not np.any(bad):
        return []
    first = int(np.flatnonzero(bad)[0])
    more = f" and {int(np.sum(bad)) - 1} more" if np.sum(bad) > 1 else ""
    got = f"{numbers[first]} at {one.freq_hz[first]:.6g} Hz{more}"
    return [Fault(f"{thing} of point {one.point}", expected, got, one.where, "Export it again")]
