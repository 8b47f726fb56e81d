"""Assemble the recordings of one or several files to one measurement, with all checks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.measurement import BodyChannels, Measurement, Repeat
from kinematics.readers.facts import (
    FileFacts,
    assumptions,
    unused_options,
    with_bodies,
    with_facts,
    with_runs,
)
from kinematics.readers.formats import format_of, read_file
from kinematics.readers.gather import Row, matrices_of, twice_faults
from kinematics.readers.lines import check_filled, grid_faults
from kinematics.readers.points import Points, read_points
from kinematics.readers.recording import QUANTITY_OF_ORDER, Channel, Recording
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, StapeskitError, collect_faults, list_some, raise_all
from stapeskit.warnings import Notice, unique

Take = tuple[str, str]
"""Run and repeat."""

_SAME_PLACE_M = 1e-6  # positions written with four digits
_ONE_RUN = "Name different excitations with --run NAME=FILE, or leave one of the two out"


def read_measurement(
    paths: Sequence[Path],
    points: Path | None = None,
    frame: str = "vibrometer",
    facts: FileFacts | None = None,
) -> Measurement:
    """Read one or several vibrometer files as one measurement.

    Parameters
    ----------
    paths : sequence of Path
        Files and folders of any known format.
    points : Path, optional
        CSV with positions, and with the bodies of points whose files do not name them.
    frame : str
        The frame in which positions and directions are given.
    facts : FileFacts, optional
        What the user states where files are silent.

    Raises
    ------
    StapeskitError
        What is wrong with the files; the faults of all of them together.
    """
    facts = facts or FileFacts()
    paths = [path if path.name else path.resolve() for path in map(Path, paths)]
    twice = [name for name, times in Counter(path.name for path in paths).items() if times > 1]
    if twice:
        step = "Rename one of them: runs and bodies are identified by the names of files"
        got = f"{list_some(twice)} twice"
        raise StapeskitError.of("the names of the vibrometer files", "different", got, "", step)
    recordings: list[Recording] = []
    faults: list[Fault] = []
    for path in paths:
        with collect_faults(faults):
            recordings.append(read_file(path, facts))
    listed = None
    if points is not None:
        with collect_faults(faults):
            listed = read_points(points)
    raise_all(faults)
    formats = [format_of(path, facts.mapping is not None) for path in paths]
    if facts.mapping is not None and not any(one.name == "wide" for one in formats):
        faults.append(Fault("--mapping", "left out: no wide table is read", facts.mapping.name))
    if facts.channels is not None and not any(one.series for one in formats):
        faults.append(Fault("--channels", "left out: no file holds time series", facts.channels.name))
    raise_all(faults)
    inputs = {"ldv" if number == 1 else f"ldv {number}": path for number, path in enumerate(paths, 1)}
    return replace(assemble(recordings, listed, facts, frame), inputs=inputs)


def assemble(
    recordings: Sequence[Recording],
    points: Points | None = None,
    facts: FileFacts | None = None,
    frame: str = "vibrometer",
) -> Measurement:
    """Assemble the recordings of one or several files to one measurement.

    Parameters
    ----------
    points : Points, optional
        The body of a point, and its position where the files have none; a position that both have must be the
        same.

    Notes
    -----
    Files that repeat points of each other are different runs, named after them; others are parts of one run.

    Raises
    ------
    StapeskitError
        A point without body or direction, a position that differs between files, one channel twice, bodies at
        different frequencies, responses to different quantities, or an option that applies to nothing; faults
        of one kind are reported together.
    """
    facts = facts or FileFacts()
    raise_all(unused_options(recordings, facts))
    notices = [notice for one in recordings for notice in (*one.notices, *assumptions(one, facts))]
    recordings = [with_facts(one, facts).with_noise() for one in recordings]
    freq_hz, held, about_lines = matrices_of([row for one in recordings for row in _rows(one)])
    channels = [channel for one in recordings for channel in one.channels]
    channels, about_bodies = with_bodies(channels, points, facts)
    channels, about_runs = with_runs(channels, facts)
    raise_all(_channel_faults(channels))
    value, sd = held["value"], held.get("sd", np.full(held["value"].shape, np.nan))
    raise_all(twice_faults(channels, value, _ONE_RUN))
    order = _to_one_quantity(channels, freq_hz, value, sd)
    takes = list(dict.fromkeys((channel.run, channel.repeat) for channel in channels))
    different = len({(channel.body, channel.point, channel.beam_key) for channel in channels})
    check_filled(len(takes) * different, len(freq_hz), value.size, "")
    common_sd = _reference_noise(channels, takes, held) if "common_sd" in held else None
    notices += [*about_bodies, *about_runs, *_reference_notices(channels), *about_lines]
    relative = np.repeat([one.relative for one in recordings], [len(one.channels) for one in recordings])
    faults: list[Fault] = []
    bodies = []
    for name in dict.fromkeys(channel.body for channel in channels):
        own = np.array([channel.body == name for channel in channels])
        mine = [channel for channel in channels if channel.body == name]
        with collect_faults(faults):
            body, missing = _body(name, mine, value[own], sd[own], relative[own], takes, points)
            bodies.append(body)
            notices += missing
    raise_all(faults)
    present = {body.body: np.any(~np.isnan(body.value.real), axis=(0, 1)) for body in bodies}
    raise_all(grid_faults(freq_hz, present))
    repeats = tuple(Repeat(run, repeat) for run, repeat in takes)
    several = len({run for run, _ in takes}) < len(takes)
    return Measurement(
        frame,
        tuple(repeat.name if several else repeat.run for repeat in repeats),
        freq_hz,
        tuple(bodies),
        QUANTITY_OF_ORDER[order],
        notices=unique(notices),
        repeats=repeats if several else (),
        common_sd=common_sd,
        line_spread=max(one.line_spread for one in recordings),
        statements=tuple(f"{one.file}: {one.statement}" for one in recordings if one.statement),
    )


def _rows(one: Recording) -> list[Row]:
    """Return the channels of a recording apart, with their noise."""
    return [
        Row(
            channel,
            one.freq_hz,
            one.value[k],
            sd=None if one.sd is None else one.sd[k],
            common_sd=None if one.common_sd is None else one.common_sd[k],
        )
        for k, channel in enumerate(one.channels)
    ]


def _to_one_quantity(channels: Sequence[Channel], freq_hz: Array, value: ComplexArray, sd: Array) -> int:
    """Turn all values in place into the most common quantity, and return its order."""
    orders = np.array([channel.order for channel in channels])
    order = Counter(orders.tolist()).most_common(1)[0][0]
    for other in set(orders.tolist()) - {order}:
        rows, factor = orders == other, (2j * np.pi * freq_hz) ** (order - other)
        value[rows] *= factor
        sd[rows] *= np.abs(factor)
    return order


def _reference_noise(
    channels: Sequence[Channel], takes: Sequence[Take], held: dict[str, Any]
) -> Array | None:
    """Return the noise of the reference, (r, L), of runs whose channels were all recorded together.

    Where they were not, the noise of their references is added to that of the channels in place.
    """
    common_sd = np.zeros((len(takes), held["value"].shape[1]))
    for number, take in enumerate(takes):
        rows = np.array([(channel.run, channel.repeat) == take for channel in channels])
        noise = np.nan_to_num(held["common_sd"][rows])
        if np.all(noise == noise[0]):
            common_sd[number] = noise[0]
        else:
            held["sd"][rows] = np.hypot(held["sd"][rows], noise * np.abs(held["value"][rows]))
    return common_sd if np.any(common_sd > 0.0) else None


def _channel_faults(channels: Sequence[Channel]) -> list[Fault]:
    """Refuse channels without direction, and responses to different quantities in one run."""
    silent: dict[str, list[str]] = {}
    kinds: dict[str, dict[str, str]] = {}
    for channel in channels:
        if np.any(np.isnan(channel.direction)):
            silent.setdefault(channel.body, []).append(channel.point)
        kind = f"responses per {channel.per}" if channel.per else "amplitudes"
        kinds.setdefault(channel.run, {}).setdefault(kind, f"{kind} ({channel.where or channel.file})")
    step = "State the direction towards the laser head with --beam z, -y or X,Y,Z"
    want = "given with the direction of the beam"
    faults = [
        Fault(f"points {list_some(names, 8)} of body {body}", want, "none", "", step)
        for body, names in silent.items()
    ]
    step = "Export all points as responses to one reference, or all as amplitudes"
    for run, found in kinds.items():
        if len(found) > 1:
            got = " and ".join(found.values())
            faults.append(Fault("the values of one run", "of one unit", got, f"run {run}", step))
    return faults


def _reference_notices(channels: Sequence[Channel]) -> list[Notice]:
    """Report the quantity that the motion refers to."""
    units = sorted({channel.per for channel in channels} - {""})
    text = (
        f"the values are responses per {' or '.join(units)}: so are all motions and their standard "
        "deviations; stiffness and damping do not depend on it."
    )
    return [Notice("file_read", text)] if units else []


def _body(
    name: str,
    channels: Sequence[Channel],
    value: ComplexArray,
    sd: Array,
    relative: NDArray[np.bool_],
    takes: Sequence[Take],
    points: Points | None,
) -> tuple[BodyChannels, list[Notice]]:
    """Arrange the rows of one body by run, channel and line; ``relative`` says whose sd lacks a factor.

    Where some sd are absolute, values with a relative one have none.
    """
    first: dict[tuple[str, tuple[float, ...]], Channel] = {}
    for channel in channels:
        first.setdefault((channel.point, channel.beam_key), channel)
    row_of = {key: number for number, key in enumerate(first)}
    shape = (len(takes), len(first), value.shape[1])
    values, spread = np.full(shape, np.nan + 1j * np.nan), np.full(shape, np.nan)
    noisy = np.any(~np.isnan(sd), axis=1)
    all_relative = not np.any(noisy & ~relative)
    for row, channel in enumerate(channels):
        own = ~np.isnan(value[row].real)
        place = takes.index((channel.run, channel.repeat)), row_of[channel.point, channel.beam_key]
        values[place][own] = value[row, own]
        if relative[row] == all_relative:
            spread[place][own] = sd[row, own]
    positions = _positions(name, channels, points)
    notices = []
    unused = int(np.sum(np.isnan(spread) & ~np.isnan(values.real)))
    if np.any(noisy) and unused:
        text = f"{unused} values of body {name} have no standard deviation and were not used."
        notices.append(Notice("file_read", text))
    names = tuple(point for point, _ in first)
    listed = {} if points is None else points.sd_m
    body = BodyChannels(
        name,
        names,
        np.array([positions[point] for point in names]) if positions else None,
        np.array([channel.direction for channel in first.values()]),
        values,
        spread if np.any(noisy) else None,
        all_relative,
        np.array([listed.get((name, point), np.nan) for point in names], dtype=float),
    )
    return body, notices


def _positions(body: str, channels: Sequence[Channel], points: Points | None) -> dict[str, Array]:
    """Return the positions of the points of a body, m: of the points file, else of the files.

    Raises
    ------
    StapeskitError
        A point with two, or some points without any.
    """
    faults: list[Fault] = []
    found: dict[str, tuple[Array, str]] = {}
    if points is not None:
        listed = points.positions_m.items()
        found = {point: (place, points.file) for (name, point), place in listed if name == body}
    for channel in channels:
        place, where = channel.position_m, str(channel.where)
        if np.any(np.isnan(place)):
            continue
        known, source = found.setdefault(channel.point, (place, where))
        if np.any(np.abs(known - place) > _SAME_PLACE_M + 1e-5 * np.abs(known)):
            got = f"{(1e3 * known).tolist()} ({source}) and {(1e3 * place).tolist()} mm"
            thing = f"the position of point {channel.point} of body {body}"
            step = "Correct it; --length-unit states the unit where a file does not"
            faults.append(Fault(thing, "one", got, where, step))
            found[channel.point] = (place, where)
    measured = dict.fromkeys(channel.point for channel in channels)
    lacking = [point for point in measured if point not in found]
    if lacking and len(lacking) < len(measured):
        step = "Give them with --points points.csv (body, point, x_mm, y_mm, z_mm)"
        thing = f"points {list_some(lacking, 8)} of body {body}"
        faults.append(Fault(thing, "given with positions, as others are", "none", "", step))
    raise_all(faults)
    return {point: found[point][0] for point in measured if point in found}
