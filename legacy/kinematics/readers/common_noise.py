"""Noise of a reference: shared by all channels of a run recorded together, else each record's own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.measurement import RecordNoise
from legacy.kinematics.readers.recording import Recording
from legacy.stapeskit.arrays import Array


def with_common_noise(
    recordings: Sequence[Recording],
    take_of: Sequence[int],
    lines_of: Sequence[NDArray[np.intp]],
    shape: tuple[int, int],
    pooled: bool,
) -> tuple[list[Recording], Array | None]:
    """Store noise of the reference separately where a whole run shares it; elsewhere add it to ``sd``.

    Parameters
    ----------
    take_of : sequence of int
        Run of each recording.
    lines_of : sequence of ndarray
        Place of its lines among those of the measurement.
    shape : tuple of int
        Runs and lines.
    pooled : bool
        Whether runs are repeats that will be pooled, which share nothing.

    Returns
    -------
    list of Recording
    ndarray, (run, line), or None
        Relative standard deviation of the common factor's real (= imaginary) part; None without any.
    """
    changed = list(recordings)
    common = np.zeros(shape)
    for run in range(shape[0]):
        members = [place for place, take in enumerate(take_of) if take == run]
        first = changed[members[0]] if members else None
        if first is None:
            continue
        together = not pooled and all(_is_same_noise(changed[place], first) for place in members)
        for place in members:
            recording = changed[place]
            if recording.common_sd is None:
                continue
            if together:
                common[run, lines_of[place]] = recording.common_sd
            elif recording.sd is not None:
                spread = np.hypot(recording.sd, recording.common_sd * np.abs(recording.value))
                changed[place] = replace(recording, sd=spread, common_sd=None)
    return changed, common if np.any(common > 0.0) else None


def noise_of_records(
    recordings: Sequence[Recording],
    take_of: Sequence[int],
    lines_of: Sequence[NDArray[np.intp]],
    shape: tuple[int, int],
) -> tuple[RecordNoise, ...]:
    """Return what the channels of each record share where a run was recorded piece by piece.

    Parameters are those of with_common_noise, the recordings before it. Points whose beams come from several
    records share nothing that can be separated.
    """
    record_noises: list[RecordNoise] = []
    for run in range(shape[0]):
        members = [place for place, take in enumerate(take_of) if take == run]
        groups: list[list[int]] = []
        for place in members:
            own = next(
                (group for group in groups if _is_same_noise(recordings[group[0]], recordings[place])), None
            )
            groups.append([place]) if own is None else own.append(place)
        if len(groups) < 2:
            continue
        records: dict[tuple[str, str], set[int]] = {}
        for number, group in enumerate(groups):
            for place in group:
                records.setdefault((recordings[place].body, recordings[place].point), set()).add(number)
        for number, group in enumerate(groups):
            first = recordings[group[0]]
            points = tuple(point for point, in_records in records.items() if in_records == {number})
            if len(group) < 2 or first.common_sd is None or not np.any(first.common_sd > 0.0) or not points:
                continue
            sd = np.zeros(shape[1])
            sd[lines_of[group[0]]] = first.common_sd
            record_noises.append(RecordNoise(run, points, sd))
    return tuple(record_noises)


def _is_same_noise(first: Recording, second: Recording) -> bool:
    """Return whether two recordings have the same noise of the reference."""
    if first.common_sd is None or second.common_sd is None:
        return False
    return np.array_equal(first.common_sd, second.common_sd) and np.array_equal(first.freq_hz, second.freq_hz)
