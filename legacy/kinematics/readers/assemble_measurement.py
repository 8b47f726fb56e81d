"""From recordings of one or several files to one measurement: bodies, positions, lines, all checks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.measurement import BodyChannels, Measurement, Take, direction_name
from legacy.kinematics.readers.apply_options import apply_stated, with_bodies, with_runs
from legacy.kinematics.readers.common_noise import noise_of_records, with_common_noise
from legacy.kinematics.readers.input_options import InputOptions, check_used
from legacy.kinematics.readers.recording import Recording, Recordings
from legacy.kinematics.readers.reported_noise import body_noise
from legacy.kinematics.readers.value_checks import value_faults
from legacy.kinematics.tidy.frequency_grids import check_bodies, check_filled, join_lines
from legacy.kinematics.tidy.points_csv import Points
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, Place, list_some, raise_all
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice, unique

K = TypeVar("K", bound=Hashable)
Index = NDArray[np.intp]
Channel = tuple[str, str, tuple[int, int, int]]
# Positions written with four digits agree to this.
_SAME_PLACE_MM = 1e-3


@dataclass(frozen=True)
class _Places:
    """Where recordings go: run, channel and lines of each, and the channels in order of bodies."""

    takes: tuple[Take, ...]
    channels: tuple[Channel, ...]
    lines: Array
    take_of: tuple[int, ...]
    channel_of: tuple[int, ...]
    lines_of: tuple[Index, ...]


def assemble(
    files: Sequence[Recordings],
    points: Points | None = None,
    options: InputOptions | None = None,
    frame: str = "vibrometer",
) -> Measurement:
    """Assemble the recordings of one or several files to one measurement.

    Parameters
    ----------
    points : Points, optional
        From a points file: the body of a point, and its position where the files have none; a position that
        both have must be the same.
    options : InputOptions, optional
        What the user says where the files do not.
    frame : str
        Frame of positions and directions.

    Returns
    -------
    Measurement
        Displacements, m, peak. Files that repeat points of each other are different runs, named after them;
        others are parts of one run.

    Raises
    ------
    KinematicsError
        A point without body, position or direction, a position that differs between files, one channel twice,
        frequencies that nearly meet, responses to different quantities, or an option that applies to
        nothing; faults of one kind are reported together.
    """
    options = options or InputOptions()
    raise_all(KinematicsError, check_used(options, [recording.file for recording in files]))
    recordings, notices = apply_stated(files, options)
    recordings, dropped = without_dc(recordings)
    notices += dropped
    if not recordings:
        step = "Export the points with their spectra"
        raise KinematicsError.of("the vibrometer files", "with values of one point", "none", "", step)
    named, dropped = with_runs(with_bodies(recordings, points, options), options)
    notices += dropped
    flat = [recording for _, recording in named]
    raise_all(KinematicsError, value_faults(flat))
    _check(flat, points)
    notices += _check_references(flat)
    places, matched, faults = _place(flat)
    notices += matched
    raise_all(KinematicsError, [*_find_duplicates(flat, places), *faults])
    order = Counter(recording.order for recording in flat).most_common(1)[0][0]
    takes = places.takes if any(t.repeat or np.isfinite(t.level) for t in places.takes) else ()
    shape = (len(places.takes), len(places.lines))
    records = () if takes else noise_of_records(flat, places.take_of, places.lines_of, shape)
    flat, common = with_common_noise(flat, places.take_of, places.lines_of, shape, bool(takes))
    bodies, dropped = _bodies(flat, places, points, order)
    notices += dropped
    runs = tuple(take.name for take in places.takes)
    return Measurement(
        frame,
        runs,
        places.lines,
        bodies,
        order,
        notices=unique(notices),
        takes=takes,
        common_sd=common,
        record_noise=records,
        line_spread=max(recording.line_spread for recording in flat),
    )


def without_dc(
    recordings: Sequence[tuple[str, Recording]],
) -> tuple[list[tuple[str, Recording]], list[Notice]]:
    """Drop the line at 0 Hz, which holds no motion, and say so.

    Raises
    ------
    KinematicsError
        A frequency below 0.
    """
    remaining, dropped, empty = [], Counter[str](), []
    step = "Export the lines above 0 Hz"
    below = [
        Fault("the frequencies", "positive", f"{np.min(recording.freq_hz):g} Hz", recording.where, step)
        for _, recording in recordings
        if np.any(recording.freq_hz < 0.0)
    ]
    raise_all(KinematicsError, below)
    for file, recording in recordings:
        good = recording.freq_hz > 0.0
        if np.all(good):
            remaining.append((file, recording))
            continue
        dropped[file] += 1
        if not np.any(good):
            empty.append(recording.where)
            continue
        shortened = replace(
            recording,
            freq_hz=recording.freq_hz[good],
            value=recording.value[good],
            sd=None if recording.sd is None else recording.sd[good],
            coherence=None if recording.coherence is None else recording.coherence[good],
            common_sd=None if recording.common_sd is None else recording.common_sd[good],
        )
        remaining.append((file, shortened))
    if empty and not remaining:
        raise KinematicsError.of("the frequencies", "above 0 Hz", "0 Hz alone", empty[0], step)
    if not dropped:
        return remaining, []
    listed = ", ".join(f"{count} spectra of {file}" for file, count in dropped.items())
    return remaining, [Notice("dc_line", f"the line at 0 Hz of {listed} holds no motion and was dropped.")]


def _check(recordings: Sequence[Recording], points: Points | None) -> None:
    """Refuse points without position or direction, and points with two positions."""
    faults = []
    positions: dict[tuple[str, str], tuple[Array, Place | str]] = {}
    without_position: dict[str, list[str]] = {}
    without_direction: dict[str, list[str]] = {}
    for recording in recordings:
        key = (recording.body, recording.point)
        known = None if points is None else points.positions.get(key)
        if known is not None and points is not None:
            positions.setdefault(key, (known, points.file))
        if np.all(np.isfinite(recording.position_mm)):
            first, where = positions.setdefault(key, (recording.position_mm, recording.where))
            if np.any(np.abs(first - recording.position_mm) > _SAME_PLACE_MM + 1e-5 * np.abs(first)):
                step = f"Correct it; {named('length_unit')} says the unit where a file does not"
                got = f"{_format_position(first)} and {_format_position(recording.position_mm)} mm"
                thing = f"the position of point {recording.point} of body {recording.body}"
                fault = Fault(thing, "one", got, f"{where} and {recording.where}", step)
                faults.append(fault)
                positions[key] = (recording.position_mm, recording.where)
        if not np.all(np.isfinite(recording.direction)):
            without_direction.setdefault(recording.body, []).append(recording.point)
    for recording in recordings:
        if (recording.body, recording.point) not in positions:
            without_position.setdefault(recording.body, []).append(recording.point)
    for body, names in without_position.items():
        step = f"Give them with {named('points')} points.csv (body, point, x_mm, y_mm, z_mm)"
        faults.append(
            Fault(f"points {list_some(names, 8)} of body {body}", "given with positions", "none", "", step)
        )
    for body, names in without_direction.items():
        thing = f"points {list_some(names, 8)} of body {body}"
        step = f"Say the direction towards the laser head with {named('beam')} z, -y or X,Y,Z"
        faults.append(Fault(thing, "given with the direction of the beam", "none", "", step))
    raise_all(KinematicsError, faults)


def _format_position(position: Array) -> str:
    return "(" + ", ".join(f"{value:.6g}" for value in position) + ")"


def _check_references(recordings: Sequence[Recording]) -> list[Notice]:
    """Refuse responses to different quantities in one run; report the quantity that the motion refers to."""
    by_run: dict[str, dict[str, Place | str]] = {}
    for recording in recordings:
        by_run.setdefault(recording.run, {}).setdefault(recording.per, recording.where)
    faults = []
    for run, by_unit in by_run.items():
        if len(by_unit) > 1:
            got = " and ".join(
                f"{f'responses per {per}' if per else 'amplitudes'} ({where})"
                for per, where in list(by_unit.items())[:3]
            )
            step = "Export all points as responses to one reference, or all as amplitudes"
            where = f"run {run}" if len(by_run) > 1 else ""
            faults.append(Fault("the values of one run", "of one unit", got, where, step))
    raise_all(KinematicsError, faults)
    units = {per for by_unit in by_run.values() for per in by_unit} - {""}
    if not units:
        return []
    text = (
        f"the values are responses per {' or '.join(sorted(units))}: so are all motions and their standard "
        "deviations; stiffness and damping do not depend on it."
    )
    return [Notice("per_reference", text)]


def _number_keys(keys: Iterable[K]) -> dict[K, int]:
    """Number different keys in the order of first appearance."""
    return {key: number for number, key in enumerate(dict.fromkeys(keys))}


def _place(recordings: Sequence[Recording]) -> tuple[_Places, tuple[Notice, ...], list[Fault]]:
    """Number runs, channels and lines, the channels of a body together; report how lines were matched."""
    takes = _number_keys((recording.run, recording.repeat, _level(recording)) for recording in recordings)
    bodies = _number_keys(recording.body for recording in recordings)
    check_bodies(tuple(bodies))
    keys = _number_keys(_channel(recording) for recording in recordings)
    channels = tuple(sorted(keys, key=lambda channel: bodies[channel[0]]))
    number = _number_keys(channels)
    channel_of = [number[_channel(recording)] for recording in recordings]
    lengths = [len(recording.freq_hz) for recording in recordings]
    grid, faults = join_lines(
        np.concatenate([recording.freq_hz for recording in recordings]),
        np.repeat(channel_of, lengths),
        np.repeat([bodies[recording.body] for recording in recordings], lengths),
        tuple(bodies),
    )
    check_filled((len(takes), len(channels), len(grid.freq_hz)), sum(lengths))
    places = _Places(
        tuple(Take(run, repeat, float("nan") if level is None else level) for run, repeat, level in takes),
        channels,
        grid.freq_hz,
        tuple(takes[recording.run, recording.repeat, _level(recording)] for recording in recordings),
        tuple(channel_of),
        tuple(np.split(grid.line, np.cumsum(lengths)[:-1])),
    )
    return places, grid.notices, faults


def _level(recording: Recording) -> float | None:
    return recording.level if np.isfinite(recording.level) else None


def _channel(recording: Recording) -> Channel:
    x, y, z = (round(float(value) * 1e6) for value in recording.direction)
    return recording.body, recording.point, (x, y, z)


def _find_duplicates(recordings: Sequence[Recording], places: _Places) -> list[Fault]:
    """List the values that two recordings give for one channel, run and line."""
    earlier: dict[tuple[int, int], list[int]] = {}
    faults = []
    for number, key in enumerate(zip(places.take_of, places.channel_of, strict=True)):
        for other in earlier.get(key, []):
            if np.intersect1d(places.lines_of[number], places.lines_of[other]).size:
                recording = recordings[number]
                name = f"{recording.body} {recording.point} ({direction_name(recording.direction)})"
                step = (
                    f"Name different excitations with {named('run')} NAME=FILE, or leave one of the two out"
                )
                got = f"two that share frequencies ({recordings[other].where} and {recording.where})"
                faults.append(Fault(f"the channel {name}", "there once in a run", got, "", step))
                break
        earlier.setdefault(key, []).append(number)
    return faults


def _bodies(
    recordings: Sequence[Recording], places: _Places, points: Points | None, order: int
) -> tuple[tuple[BodyChannels, ...], list[Notice]]:
    """Fill the arrays of every body."""
    channels_of: list[BodyChannels] = []
    notices: list[Notice] = []
    for body in dict.fromkeys(channel[0] for channel in places.channels):
        rows = [n for n, channel in enumerate(places.channels) if channel[0] == body]
        start = rows[0]
        shape = (len(places.takes), len(rows), len(places.lines))
        value = np.full(shape, np.nan + 1j * np.nan)
        first: dict[int, Recording] = {}
        entries = []
        for number, recording in enumerate(recordings):
            channel = places.channel_of[number] - start
            if recording.body != body:
                continue
            first.setdefault(channel, recording)
            where = (places.take_of[number], channel, places.lines_of[number])
            value[where] = recording.value / (2j * np.pi * recording.freq_hz) ** recording.order
            entries.append((where, recording))
        sd, relative, noise_notices = body_noise(body, entries, value, order)
        notices += noise_notices
        names = tuple(places.channels[row][1] for row in rows)
        positions = np.array([_position(first[n], recordings, points) for n in range(len(rows))])
        spread = [np.nan if points is None else points.sd_mm.get((body, name), np.nan) for name in names]
        directions = np.array([first[n].direction for n in range(len(rows))])
        channels_of.append(
            BodyChannels(
                body, names, positions, directions, value, sd, relative, np.array(spread, dtype=float)
            )
        )
    return tuple(channels_of), notices


def _position(recording: Recording, recordings: Sequence[Recording], points: Points | None) -> Array:
    """Return the position of a point: of the points file, else of its recording, else of another one."""
    listed: Mapping[tuple[str, str], Array] = {} if points is None else points.positions
    if (recording.body, recording.point) in listed:
        return listed[recording.body, recording.point]
    if np.all(np.isfinite(recording.position_mm)):
        return recording.position_mm
    return next(
        other.position_mm
        for other in recordings
        if (other.body, other.point) == (recording.body, recording.point)
        and np.all(np.isfinite(other.position_mm))
    )
