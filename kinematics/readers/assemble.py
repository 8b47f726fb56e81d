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
    if not faults and facts.series is not None and not any(recording.from_series for recording in recordings):
        faults.append(Fault("--channels", "left out: no file holds time series", facts.series.channels.name))
    raise_all(faults)
    inputs = {"ldv" if number == 0 else f"ldv {number + 1}": path for number, path in enumerate(paths)}
    for path in paths:
        inputs |= companion_files(path, facts)
    if points is not None:
        inputs["points"] = Path(points)
    return replace(assemble(recordings, listed, facts, frame), inputs=inputs)


@dataclass(frozen=True)
class _Grid:
    """Lines, quantity and runs of a measurement, and the lines of each recording among them."""

    freq_hz: Array
    order: int
    takes: Sequence[tuple[str, str]]
    lines: Mapping[int, NDArray[np.intp]]

    def take_of(self, entry: Entry) -> int:
        """Return the place of the run and repeat of a row."""
        return self.takes.index((entry.channel.run, entry.channel.repeat))

    def lines_of(self, entry: Entry) -> NDArray[np.intp]:
        """Return which lines the frequencies of a row are."""
        return self.lines[id(entry.recording)]


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
    raise_all(_value_faults(recordings))
    entries = [
        Entry(one, row, channel, None if one.common_sd is None else one.common_sd[row])
        for one in recordings
        for row, channel in enumerate(one.channels)
    ]
    entries, added = with_bodies(entries, points, facts)
    notices += added
    entries, added = with_runs(entries, facts)
    notices += added
    raise_all(_direction_faults(entries))
    notices += _reference_notices(entries)
    freq_hz, lines, added = common_grid([one.freq_hz for one in recordings])
    takes = list(dict.fromkeys((entry.channel.run, entry.channel.repeat) for entry in entries))
    order = Counter(entry.channel.order for entry in entries).most_common(1)[0][0]
    grid = _Grid(freq_hz, order, takes, dict(zip(map(id, recordings), lines, strict=True)))
    channels = len({(e.channel.body, e.channel.point, e.channel.beam_key) for e in entries})
    check_filled(len(takes) * channels, len(freq_hz), sum(one.value.size for one in recordings), "")
    entries, common_sd = _common_noise(entries, grid)
    faults: list[Fault] = []
    bodies = []
    for name in dict.fromkeys(entry.channel.body for entry in entries):
        mine = [entry for entry in entries if entry.channel.body == name]
        with collect_faults(faults):
            body, missing = _body(name, mine, points, grid)
            bodies.append(body)
            added += missing
    raise_all(faults)
    present = np.array([np.any(~np.isnan(body.value.real), axis=(0, 1)) for body in bodies])
    raise_all(grid_faults(freq_hz, present, [body.body for body in bodies]))
    repeats = tuple(Repeat(run, repeat) for run, repeat in takes)
    several = len({run for run, _ in takes}) < len(takes)
    return Measurement(
        frame,
        tuple(repeat.name if several else repeat.run for repeat in repeats),
        freq_hz,
        tuple(bodies),
        QUANTITY_OF_ORDER[order],
        notices=unique([*notices, *added]),
        repeats=repeats if several else (),
        common_sd=common_sd,
        line_spread=max(one.line_spread for one in recordings),
        statements=tuple(f"{one.file}: {one.statement}" for one in recordings if one.statement),
    )


def _value_faults(recordings: Sequence[Recording]) -> list[Fault]:
    """List numbers that no motion can have, one sentence for each kind and file."""
    faults = []

    def check(
        bad: NDArray[np.bool_], thing: str, expected: str, one: Recording, numbers: NDArray[np.generic]
    ) -> None:
        if np.any(bad):
            row = int(np.argwhere(bad)[0][0])
            more = f" and {int(np.sum(bad)) - 1} more" if np.sum(bad) > 1 else ""
            got = f"{numbers[bad][0]:.6g}{more}"
            where = one.channels[row].where if len(bad) == len(one.channels) else one.file
            faults.append(Fault(thing, expected, got, where or one.file, "Export it again"))

    for one in recordings:
        freq = one.freq_hz
        check(
            (freq < LOWEST_HZ) | (freq > HIGHEST_HZ), "the frequencies", f"below {HIGHEST_HZ:g} Hz", one, freq
        )
        large = (np.abs(one.value.real) > LARGEST) | (np.abs(one.value.imag) > LARGEST)
        check(large, "the values", f"finite and below {LARGEST:g}, or NaN where missing", one, one.value)
        far = np.any(np.abs(one.points_m) > 1e-3 * FARTHEST_MM, axis=1)
        check(far, "the position of a point", f"within {FARTHEST_MM:g} mm", one, one.points_m[:, 0])
        if one.sd is not None:
            bad = (one.sd < 0.0) | (one.sd > LARGEST)
            check(bad, "the standard deviations", f"positive and below {LARGEST:g}", one, one.sd)
        if one.coherence is not None:
            check(
                (one.coherence < 0.0) | (one.coherence > 1.0),
                "the coherence",
                "within 0 and 1",
                one,
                one.coherence,
            )
        if one.n_avg is not None:
            check(
                (one.n_avg < 1.0) | np.isinf(one.n_avg), "the number of averages", "1 or more", one, one.n_avg
            )
    return faults


def _direction_faults(entries: Sequence[Entry]) -> list[Fault]:
    without: dict[str, list[str]] = {}
    for entry in entries:
        if np.any(np.isnan(entry.channel.direction)):
            without.setdefault(entry.channel.body, []).append(entry.channel.point)
    step = "State the direction towards the laser head with --beam z, -y or X,Y,Z"
    return [
        Fault(
            f"points {list_some(names, 8)} of body {body}",
            "given with the direction of the beam",
            "none",
            "",
            step,
        )
        for body, names in without.items()
    ]


def _reference_notices(entries: Sequence[Entry]) -> list[Notice]:
    """Refuse responses to different quantities in one run; report the quantity that the motion refers to."""
    by_run: dict[str, dict[str, str]] = {}
    for entry in entries:
        where = str(entry.channel.where) or entry.recording.file
        by_run.setdefault(entry.channel.run, {}).setdefault(entry.channel.per, where)
    faults = []
    for run, by_unit in by_run.items():
        if len(by_unit) > 1:
            kinds = [
                f"{f'responses per {per}' if per else 'amplitudes'} ({at})" for per, at in by_unit.items()
            ]
            step = "Export all points as responses to one reference, or all as amplitudes"
            where = f"run {run}" if len(by_run) > 1 else ""
            faults.append(Fault("the values of one run", "of one unit", " and ".join(kinds[:3]), where, step))
    raise_all(faults)
    units = sorted({per for by_unit in by_run.values() for per in by_unit} - {""})
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
    keys = list(dict.fromkeys((entry.channel.point, entry.channel.beam_key) for entry in entries))
    place_of = {key: n for n, key in enumerate(keys)}
    shape = (len(grid.takes), len(keys), len(grid.freq_hz))
    value, sd = np.full(shape, np.nan + 1j * np.nan), np.full(shape, np.nan)
    known = {entry.recording.relative for entry in entries if entry.recording.sd is not None}
    relative = False not in known
    filled: dict[tuple[int, int], Entry] = {}
    first: dict[int, Channel] = {}
    faults: list[Fault] = []
    for entry in entries:
        channel, one = entry.channel, entry.recording
        row, take = place_of[channel.point, channel.beam_key], grid.take_of(entry)
        first.setdefault(row, channel)
        own = ~np.isnan(one.value[entry.row].real)
        lines = grid.lines_of(entry)[own]
        other = filled.setdefault((take, row), entry)
        if other is not entry and not np.all(np.isnan(value[take, row, lines].real)):
            step = "Name different excitations with --run NAME=FILE, or leave one of the two out"
            got = f"two that share frequencies ({other.channel.where} and {channel.where})"
            faults.append(Fault(f"the channel {channel.name}", "there once in a run", got, "", step))
        factor = (2j * np.pi * one.freq_hz[own]) ** (grid.order - channel.order)
        factor = factor if grid.order != channel.order else np.ones(len(lines))
        value[take, row, lines] = one.value[entry.row, own] * factor
        if one.sd is not None and one.relative == relative:
            spread = one.sd[entry.row, own]
            if entry.common_sd is not None:
                spread = np.hypot(spread, entry.common_sd[own] * np.abs(one.value[entry.row, own]))
            sd[take, row, lines] = spread * np.abs(factor)
    positions = _positions(name, entries, points, faults)
    raise_all(faults)
    notices = []
    unused = int(np.sum(np.isnan(sd) & ~np.isnan(value.real)))
    if known and unused:
        text = f"{unused} values of body {name} have no standard deviation and were not used."
        notices.append(Notice("sd_missing", text))
    names = tuple(point for point, _ in keys)
    spread_m = [np.nan if points is None else points.sd_m.get((name, point), np.nan) for point in names]
    body = BodyChannels(
        name,
        names,
        np.array([positions[point] for point in names]) if positions else None,
        np.array([first[row].direction for row in range(len(keys))]),
        value,
        sd if known else None,
        relative,
        np.array(spread_m, dtype=float),
    )
    return body, notices


def _positions(
    body: str, entries: Sequence[Entry], points: Points | None, faults: list[Fault]
) -> dict[str, Array]:
    """Return the positions of the points of a body, m: of the points file, else of the files."""
    positions: dict[str, Array] = {}
    where_of: dict[str, str] = {}
    for entry in entries:
        point, place, where = entry.channel.point, entry.channel.position_m, str(entry.channel.where)
        if points is not None and (body, point) in points.positions_m:
            positions.setdefault(point, points.positions_m[body, point])
            where_of.setdefault(point, points.file)
        if np.any(np.isnan(place)):
            continue
        known = positions.setdefault(point, place)
        if np.any(np.abs(known - place) > _SAME_PLACE_M + 1e-5 * np.abs(known)):
            got = f"{_millimetres(known)} ({where_of[point]}) and {_millimetres(place)} mm"
            step = "Correct it; --length-unit states the unit where a file does not"
            faults.append(Fault(f"the position of point {point} of body {body}", "one", got, where, step))
            positions[point] = place
        where_of.setdefault(point, where)
    lacking = [entry.channel.point for entry in entries if entry.channel.point not in positions]
    if lacking and positions:
        step = "Give them with --points points.csv (body, point, x_mm, y_mm, z_mm)"
        thing = f"points {list_some(lacking, 8)} of body {body}"
        faults.append(Fault(thing, "given with positions, as others are", "none", "", step))
    return positions


def _millimetres(position: Array) -> str:
    return "(" + ", ".join(f"{1e3 * value:.6g}" for value in position) + ")"


def _common_noise(entries: Sequence[Entry], grid: _Grid) -> tuple[list[Entry], Array | None]:
    """Return the noise of the reference (r, L) in runs whose channels were all recorded together.

    Their entries lose it; elsewhere it stays with the entries, as a part of the noise of each channel.
    """
    common, changed = np.zeros((len(grid.takes), len(grid.freq_hz))), list[Entry]()
    for number in range(len(grid.takes)):
        mine = [entry for entry in entries if grid.take_of(entry) == number]
        first = mine[0].common_sd
        together = first is not None and all(
            entry.common_sd is not None and np.array_equal(entry.common_sd, first) for entry in mine
        )
        if together and first is not None:
            common[number, grid.lines_of(mine[0])] = np.nan_to_num(first)
            mine = [replace(entry, common_sd=None) for entry in mine]
        changed += mine
    rank = {id(entry.recording): place for place, entry in enumerate(entries)}
    changed.sort(key=lambda entry: (rank[id(entry.recording)], entry.row))
    return changed, common if np.any(common > 0.0) else None
