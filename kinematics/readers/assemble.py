"""Assemble the recordings of one or several files to one measurement, with all checks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinematics.measurement import BodyChannels, Measurement, Repeat
from kinematics.readers.facts import FileFacts, unknown_files
from kinematics.readers.formats import companion_files, format_of, read_file
from kinematics.readers.identify import (
    Entry,
    assumptions,
    unused_options,
    with_bodies,
    with_facts,
    with_runs,
)
from kinematics.readers.lines import check_filled, common_grid, grid_faults
from kinematics.readers.noise import with_noise
from kinematics.readers.points import Points, read_points
from kinematics.readers.recording import QUANTITY_OF_ORDER, Channel, Recording
from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError, collect_faults, list_some, raise_all
from stapeskit.units import FARTHEST_MM, HIGHEST_HZ, LARGEST, LOWEST_HZ
from stapeskit.warnings import Notice, unique

_SAME_PLACE_M = 1e-6  # positions written with four digits


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
    if facts.mapping is not None and not faults and not any(format_of(path, True).mapped for path in paths):
        want = "left out: no MATLAB or HDF5 file and no wide table is read"
        faults.append(Fault("--mapping", want, facts.mapping.name))
    if facts.series is not None and not faults and not any(recording.from_series for recording in recordings):
        faults.append(Fault("--channels", "left out: no file holds time series", facts.series.channels.name))
    raise_all(faults)
    inputs = {"ldv" if number == 1 else f"ldv {number}": path for number, path in enumerate(paths, 1)}
    for path in paths:
        inputs |= companion_files(path, facts)
    if points is not None:
        inputs["points"] = Path(points)
    return replace(assemble(recordings, listed, facts, frame), inputs=inputs)


@dataclass(frozen=True)
class _Grid:
    """Lines, order of the quantity and runs of a measurement, and the lines of each recording among them.

    ``common_sd`` (r, L) is the noise of the reference of runs whose channels were all recorded together.
    """

    freq_hz: Array
    order: int
    takes: Sequence[tuple[str, str]]
    lines: Mapping[int, NDArray[np.intp]]
    common_sd: Array

    def take_of(self, entry: Entry) -> int:
        """Return the place of the run and repeat of a row."""
        return self.takes.index((entry.channel.run, entry.channel.repeat))

    def shares_reference(self, take: int) -> bool:
        """Return whether the noise of the reference is common to all channels of a run."""
        return bool(np.any(self.common_sd[take] > 0.0))


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
    raise_all([*unknown_files(facts, [one.file for one in recordings]), *unused_options(recordings, facts)])
    notices = [notice for one in recordings for notice in (*one.notices, *assumptions(one, facts))]
    recordings = [with_noise(with_facts(one, facts)) for one in recordings]
    raise_all(fault for one in recordings for fault in _value_faults(one))
    entries = [Entry(one, row, channel) for one in recordings for row, channel in enumerate(one.channels)]
    entries, about_bodies = with_bodies(entries, points, facts)
    entries, about_runs = with_runs(entries, facts)
    raise_all(_direction_faults(entries))
    about_reference = _reference_notices(entries)
    grid, about_lines = _grid_of(recordings, entries)
    notices += [*about_bodies, *about_runs, *about_reference, *about_lines]
    faults: list[Fault] = []
    bodies = []
    for name in dict.fromkeys(entry.channel.body for entry in entries):
        mine = [entry for entry in entries if entry.channel.body == name]
        with collect_faults(faults):
            body, missing = _body(name, mine, points, grid)
            bodies.append(body)
            notices += missing
    raise_all(faults)
    present = np.array([np.any(~np.isnan(body.value.real), axis=(0, 1)) for body in bodies])
    raise_all(grid_faults(grid.freq_hz, present, [body.body for body in bodies]))
    repeats = tuple(Repeat(run, repeat) for run, repeat in grid.takes)
    several = len({run for run, _ in grid.takes}) < len(grid.takes)
    return Measurement(
        frame,
        tuple(repeat.name if several else repeat.run for repeat in repeats),
        grid.freq_hz,
        tuple(bodies),
        QUANTITY_OF_ORDER[grid.order],
        notices=unique(notices),
        repeats=repeats if several else (),
        common_sd=grid.common_sd if np.any(grid.common_sd > 0.0) else None,
        line_spread=max(one.line_spread for one in recordings),
        statements=tuple(f"{one.file}: {one.statement}" for one in recordings if one.statement),
    )


def _grid_of(recordings: Sequence[Recording], entries: Sequence[Entry]) -> tuple[_Grid, list[Notice]]:
    """Join the lines of all files; find the runs, the most common quantity and the noise of references."""
    freq_hz, lines, notices = common_grid([one.freq_hz for one in recordings])
    takes = list(dict.fromkeys((entry.channel.run, entry.channel.repeat) for entry in entries))
    channels = len({(e.channel.body, e.channel.point, e.channel.beam_key) for e in entries})
    check_filled(len(takes) * channels, len(freq_hz), sum(one.value.size for one in recordings), "")
    order = Counter(entry.channel.order for entry in entries).most_common(1)[0][0]
    common_sd = np.zeros((len(takes), len(freq_hz)))
    grid = _Grid(freq_hz, order, takes, dict(zip(map(id, recordings), lines, strict=True)), common_sd)
    for take in range(len(takes)):
        mine = [entry for entry in entries if grid.take_of(entry) == take]
        noise = [None if e.recording.common_sd is None else e.recording.common_sd[e.row] for e in mine]
        first = noise[0]
        if first is not None and all(one is not None and np.array_equal(one, first) for one in noise):
            common_sd[take, grid.lines[id(mine[0].recording)]] = np.nan_to_num(first)
    return grid, notices


def _value_faults(one: Recording) -> list[Fault]:
    """List numbers that no motion can have, one sentence for each kind."""
    limits: tuple[tuple[str, Array | None, float, float], ...] = (
        ("the frequencies", one.freq_hz, LOWEST_HZ, HIGHEST_HZ),
        ("the values", np.abs(one.value), 0.0, LARGEST),
        ("the coordinates of the points, in mm", np.abs(1e3 * one.points_m), 0.0, FARTHEST_MM),
        ("the standard deviations", one.sd, 0.0, LARGEST),
        ("the coherence", one.coherence, 0.0, 1.0),
        ("the number of averages", one.n_avg, 1.0, LARGEST),
    )
    faults = []
    for thing, numbers, low, high in limits:
        bad = (numbers < low) | (numbers > high) if numbers is not None else np.zeros(0)
        if numbers is not None and np.any(bad):
            where = one.channels[int(np.argwhere(bad)[0][0])].where if bad.ndim == 2 else ""
            count = int(np.sum(bad))
            got = f"{numbers[bad][0]:.6g}" + (f" and {count - 1} more" if count > 1 else "")
            want = f"from {low:g} to {high:g}, or NaN where missing"
            faults.append(Fault(thing, want, got, where or one.file, "Export it again"))
    return faults


def _direction_faults(entries: Sequence[Entry]) -> list[Fault]:
    without: dict[str, list[str]] = {}
    for entry in entries:
        if np.any(np.isnan(entry.channel.direction)):
            without.setdefault(entry.channel.body, []).append(entry.channel.point)
    want = "given with the direction of the beam"
    step = "State the direction towards the laser head with --beam z, -y or X,Y,Z"
    return [
        Fault(f"points {list_some(names, 8)} of body {body}", want, "none", "", step)
        for body, names in without.items()
    ]


def _reference_notices(entries: Sequence[Entry]) -> list[Notice]:
    """Refuse responses to different quantities in one run; report the quantity that the motion refers to."""
    by_run: dict[str, dict[str, str]] = {}
    for entry in entries:
        where = str(entry.channel.where) or entry.recording.file
        by_run.setdefault(entry.channel.run, {}).setdefault(entry.channel.per, where)
    step = "Export all points as responses to one reference, or all as amplitudes"
    raise_all(
        Fault(
            "the values of one run",
            "of one unit",
            " and ".join(
                f"{f'responses per {per}' if per else 'amplitudes'} ({at})" for per, at in units.items()
            ),
            f"run {run}",
            step,
        )
        for run, units in by_run.items()
        if len(units) > 1
    )
    units = sorted({per for one in by_run.values() for per in one} - {""})
    if not units:
        return []
    text = (
        f"the values are responses per {' or '.join(units)}: so are all motions and their standard "
        "deviations; stiffness and damping do not depend on it."
    )
    return [Notice("per_reference", text)]


def _body(
    name: str, entries: Sequence[Entry], points: Points | None, grid: _Grid
) -> tuple[BodyChannels, list[Notice]]:
    """Fill the arrays of one body; report positions that differ and channels that are there twice."""
    first: dict[tuple[str, tuple[float, ...]], Channel] = {}
    for entry in entries:
        first.setdefault((entry.channel.point, entry.channel.beam_key), entry.channel)
    row_of = {key: row for row, key in enumerate(first)}
    shape = (len(grid.takes), len(first), len(grid.freq_hz))
    value, sd = np.full(shape, np.nan + 1j * np.nan), np.full(shape, np.nan)
    known = {entry.recording.relative for entry in entries if entry.recording.sd is not None}
    relative = False not in known
    filled: dict[tuple[int, int], Entry] = {}
    faults: list[Fault] = []
    for entry in entries:
        channel, one = entry.channel, entry.recording
        row, take = row_of[channel.point, channel.beam_key], grid.take_of(entry)
        own = ~np.isnan(one.value[entry.row].real)
        lines = grid.lines[id(one)][own]
        other = filled.setdefault((take, row), entry)
        if other is not entry and not np.all(np.isnan(value[take, row, lines].real)):
            step = "Name different excitations with --run NAME=FILE, or leave one of the two out"
            got = f"two that share frequencies ({other.channel.where} and {channel.where})"
            faults.append(Fault(f"the channel {channel.name}", "there once in a run", got, "", step))
        change = grid.order - channel.order
        factor = (2j * np.pi * one.freq_hz[own]) ** change if change else np.ones(len(lines))
        value[take, row, lines] = one.value[entry.row, own] * factor
        if one.sd is not None and one.relative == relative:
            spread = one.sd[entry.row, own]
            if one.common_sd is not None and not grid.shares_reference(take):
                spread = np.hypot(spread, one.common_sd[entry.row, own] * np.abs(one.value[entry.row, own]))
            sd[take, row, lines] = spread * np.abs(factor)
    positions = _positions(name, entries, points, faults)
    raise_all(faults)
    notices = []
    unused = int(np.sum(np.isnan(sd) & ~np.isnan(value.real)))
    if known and unused:
        text = f"{unused} values of body {name} have no standard deviation and were not used."
        notices.append(Notice("sd_missing", text))
    names = tuple(point for point, _ in first)
    listed = {} if points is None else points.sd_m
    body = BodyChannels(
        name,
        names,
        np.array([positions[point] for point in names]) if positions else None,
        np.array([channel.direction for channel in first.values()]),
        value,
        sd if known else None,
        relative,
        np.array([listed.get((name, point), np.nan) for point in names], dtype=float),
    )
    return body, notices


def _positions(
    body: str, entries: Sequence[Entry], points: Points | None, faults: list[Fault]
) -> dict[str, Array]:
    """Return the positions of the points of a body, m: of the points file, else of the files."""
    found: dict[str, tuple[Array, str]] = {}
    if points is not None:
        found = {
            point: (place, points.file) for (name, point), place in points.positions_m.items() if name == body
        }
    for entry in entries:
        point, place, where = entry.channel.point, entry.channel.position_m, str(entry.channel.where)
        if np.any(np.isnan(place)):
            continue
        known, source = found.setdefault(point, (place, where))
        if np.any(np.abs(known - place) > _SAME_PLACE_M + 1e-5 * np.abs(known)):
            got = f"{(1e3 * known).tolist()} ({source}) and {(1e3 * place).tolist()} mm"
            step = "Correct it; --length-unit states the unit where a file does not"
            faults.append(Fault(f"the position of point {point} of body {body}", "one", got, where, step))
            found[point] = (place, where)
    measured = {entry.channel.point: None for entry in entries}
    lacking = [point for point in measured if point not in found]
    if lacking and len(lacking) < len(measured):
        step = "Give them with --points points.csv (body, point, x_mm, y_mm, z_mm)"
        thing = f"points {list_some(lacking, 8)} of body {body}"
        faults.append(Fault(thing, "given with positions, as others are", "none", "", step))
    return {point: found[point][0] for point in measured if point in found}
