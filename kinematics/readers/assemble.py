"""Assemble the recordings of one or several files to one measurement, with all checks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinematics.measurement import BodyChannels, Measurement, Repeat
from kinematics.readers.facts import FileFacts, is_file, unknown_files
from kinematics.readers.formats import read_file
from kinematics.readers.lines import common_grid, grid_faults
from kinematics.readers.noise import with_noise
from kinematics.readers.points import Points, read_points
from kinematics.readers.recording import QUANTITY_OF_ORDER, Channel, Recording
from kinematics.readers.units import LENGTHS
from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError, collect_faults, list_some, raise_all
from stapeskit.units import FARTHEST_MM, HIGHEST_HZ, LARGEST, LOWEST_HZ
from stapeskit.warnings import Notice, unique

DEFAULT_RUN = "1"

_SAME_PLACE_M = 1e-6  # positions written with four digits
_LEAST_FILLED = 0.01  # a run for each of 100 lines fills 1 in 100; what fills less has columns exchanged
_ANY_PLACES = 4_000_000  # 64 MB of values, of which any share may be empty
_MOST_BODIES = 1000  # more rigid bodies were in no study: the column of bodies holds points


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
    if not faults and facts.series is not None and not any(recording.from_series for recording in recordings):
        faults.append(Fault("--channels", "left out: no file holds time series", facts.series.channels.name))
    raise_all(faults)
    inputs = {"ldv" if number == 0 else f"ldv {number + 1}": path for number, path in enumerate(paths)}
    if points is not None:
        inputs["points"] = Path(points)
    return replace(assemble(recordings, listed, facts, frame), inputs=inputs)


@dataclass(frozen=True)
class _Entry:
    """One row of one recording on its way into the measurement."""

    recording: Recording
    row: int
    channel: Channel


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
    raise_all([*unknown_files(facts, [one.file for one in recordings]), *_unused(recordings, facts)])
    notices = [notice for one in recordings for notice in (*one.notices, *_assumptions(one, facts))]
    recordings = [with_noise(_with_facts(one, facts)) for one in recordings]
    raise_all(_value_faults(recordings))
    entries = [_Entry(one, row, channel) for one in recordings for row, channel in enumerate(one.channels)]
    entries, added = _with_bodies(entries, points, facts)
    notices += added
    entries, added = _with_runs(entries, facts)
    notices += added
    raise_all(_direction_faults(entries))
    notices += _reference_notices(entries)
    grid, places, added = common_grid([one.freq_hz for one in recordings])
    notices += added
    line_of = dict(zip(map(id, recordings), places, strict=True))
    takes = list(dict.fromkeys((entry.channel.run, entry.channel.repeat) for entry in entries))
    _check_filled(entries, len(takes), len(grid))
    order = Counter(entry.channel.order for entry in entries).most_common(1)[0][0]
    faults: list[Fault] = []
    bodies = []
    for name in dict.fromkeys(entry.channel.body for entry in entries):
        mine = [entry for entry in entries if entry.channel.body == name]
        with collect_faults(faults):
            body, added = _body(name, mine, points, takes, line_of, grid, order)
            bodies.append(body)
            notices += added
    present = np.array([np.any(~np.isnan(body.value.real), axis=(0, 1)) for body in bodies])
    raise_all([*faults, *(grid_faults(grid, present, [body.body for body in bodies]) if not faults else [])])
    repeats = tuple(Repeat(run, repeat) for run, repeat in takes)
    several = len({run for run, _ in takes}) < len(takes)
    return Measurement(
        frame,
        tuple(repeat.name if several else repeat.run for repeat in repeats),
        grid,
        tuple(bodies),
        QUANTITY_OF_ORDER[order],
        notices=unique(notices),
        repeats=repeats if several else (),
        common_sd=_common_noise(entries, takes, line_of, len(grid)),
        line_spread=max(one.line_spread for one in recordings),
        statements=tuple(f"{one.file}: {one.statement}" for one in recordings if one.statement),
    )


def _unused(recordings: Sequence[Recording], facts: FileFacts) -> list[Fault]:
    """List options that no file needs, so that nothing is believed to be set that is not."""
    rows = [(one, channel) for one in recordings for channel in one.channels]
    needed = {
        "beam": any(np.any(np.isnan(channel.direction)) for _, channel in rows),
        "amplitude": any(not one.amplitude_stated and not channel.per for one, channel in rows),
        "length_unit": any(not one.length_stated for one, _ in rows),
        "n_avg": any(one.n_avg is None and one.sd is None for one, _ in rows),
    }
    step = "Leave it out, or correct the file"
    return [
        Fault(
            f"--{name.replace('_', '-')}",
            "left out where the files say it, or need none",
            "a value",
            "",
            step,
        )
        for name, need in needed.items()
        if getattr(facts, name) and not need
    ]


def _assumptions(recording: Recording, facts: FileFacts) -> list[Notice]:
    """Report what is assumed because neither the file nor the user says it."""
    notices = []
    placed = recording.points_m[np.all(np.isfinite(recording.points_m), axis=1)]
    if not recording.length_stated and len(placed) and not facts.length_unit:
        extent = " x ".join(f"{1e3 * span:.4g}" for span in np.ptp(placed, axis=0))
        text = (
            f"{recording.file} does not say the unit of its positions: taken as metres they extend over "
            f"{extent} mm. "
            "State --length-unit m, mm or um."
        )
        notices.append(Notice("length_unit_assumed", text))
    absolute = any(not channel.per for channel in recording.channels)
    if not recording.amplitude_stated and absolute and not facts.amplitude:
        text = f"{recording.file} does not say whether amplitudes are peak or rms: they were taken as peak."
        notices.append(Notice("amplitude_assumed", text))
    return notices


def _with_facts(recording: Recording, facts: FileFacts) -> Recording:
    """Return a recording with beam, averages, amplitude and length unit applied where the file is silent."""
    length = LENGTHS[facts.length_unit] if facts.length_unit and not recording.length_stated else 1.0
    channels, value, sd = list(recording.channels), recording.value, recording.sd
    for row, channel in enumerate(channels):
        if facts.direction is not None and np.any(np.isnan(channel.direction)):
            channel = replace(channel, direction=facts.direction)
        channels[row] = replace(channel, position_m=channel.position_m * length) if length != 1.0 else channel
    if facts.amplitude == "rms" and not recording.amplitude_stated:
        peak = np.where([bool(channel.per) for channel in channels], 1.0, np.sqrt(2.0))[:, None]
        value, sd = value * peak, None if sd is None else sd * peak
    n_avg = recording.n_avg
    if facts.n_avg is not None and n_avg is None and sd is None:
        n_avg = np.full(value.shape, facts.n_avg)
    return replace(recording, channels=tuple(channels), value=value, sd=sd, n_avg=n_avg)


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


def _with_bodies(
    entries: Sequence[_Entry], points: Points | None, facts: FileFacts
) -> tuple[list[_Entry], list[Notice]]:
    """Give every row its body: by ``--body``, its file or the points file; one body needs none."""
    used: set[str] = set()
    assigned: list[_Entry] = []
    faults: list[Fault] = []
    without: dict[str, list[str]] = {}
    respelled: dict[str, str] = {}
    unlisted: dict[str, list[str]] = {}
    for entry in entries:
        file, channel = entry.recording.file, entry.channel
        rules = [
            name for name, items in facts.bodies if any(item.holds(file, channel.point) for item in items)
        ]
        used |= set(rules)
        names = list(dict.fromkeys([*rules, *([channel.body] if channel.body else [])]))
        if not names and points is not None:
            names = points.bodies_of(channel.point)
        if len(names) > 1:
            step = "Name each point once, by file where numbers repeat: --body base=base.uff:1-9"
            got = " and ".join(names)
            faults.append(Fault(f"point {channel.point}", "of one body", got, channel.where, step))
        elif not names:
            without.setdefault(file, []).append(channel.point)
            continue
        body, point = names[0], channel.point
        if points is not None:
            try:
                key = points.key_of(body, point)
            except KeyError:
                if np.any(np.isnan(channel.position_m)) or channel.body:
                    unlisted.setdefault(body, []).append(point)
                key = (body, point)
            if key != (body, point):
                respelled[f"{body} {point}"] = f"{key[0]} {key[1]}"
            body, point = key
        assigned.append(replace(entry, channel=replace(channel, body=body, point=point)))
    for body, names in unlisted.items():
        step = f"Add them to {points.file if points else ''}, or write both names alike"
        thing = f"points {list_some(names, 8)} of body {body}"
        faults.append(Fault(thing, "listed in the points file", "no rows of these names", "", step))
    if without and not assigned and not faults and points is None and not facts.body:
        only = [replace(entry, channel=replace(entry.channel, body="body")) for entry in entries]
        return only, []
    for file, names in without.items():
        step = "Name them with --body, e.g. --body stapes=1-10 --body base=11-19, or list them in --points"
        faults.append(Fault(f"points {list_some(names, 12)}", "of a body", "none", file, step))
    known = list_some((entry.channel.point for entry in entries), 20)
    for name in dict.fromkeys(name for name, _ in facts.bodies):
        if name not in used:
            want = f"points that were measured ({known})"
            faults.append(Fault(f"--body {name}", want, "others", "", "Correct the numbers"))
    raise_all(faults)
    bodies = {entry.channel.body for entry in assigned}
    if len(bodies) > _MOST_BODIES:
        step = "Check which column names the body and which the point"
        raise StapeskitError.of("the bodies", f"at most {_MOST_BODIES}", len(bodies), "", step)
    if not respelled:
        return assigned, _unmeasured(assigned, points)
    listed = list_some((f"{old} as {new}" for old, new in respelled.items()), 3)
    text = f"names were read as {points.file if points else ''} spells them: {listed}."
    return assigned, [Notice("names_respelled", text), *_unmeasured(assigned, points)]


def _unmeasured(entries: Sequence[_Entry], points: Points | None) -> list[Notice]:
    """Report bodies of the points file that were not measured."""
    if points is None:
        return []
    absent = {body for body, _ in points.positions_m} - {entry.channel.body for entry in entries}
    if not absent:
        return []
    text = f"{points.file} lists points of {', '.join(sorted(absent))}, of which no file has a value."
    return [Notice("bodies_not_measured", text)]


def _with_runs(entries: Sequence[_Entry], facts: FileFacts) -> tuple[list[_Entry], list[Notice]]:
    """Give every row its run: by ``--run``, by its file's content, else by what the files share.

    Files without names of runs that measure one point in one direction again are different excitations, each
    named after its file; files of different points are parts of one.
    """
    labelled = []
    for entry in entries:
        stated = [name for name, file in facts.runs if is_file(file, entry.recording.file)]
        run = " ".join([*stated[:1], *([entry.channel.run] if entry.channel.run else [])])
        labelled.append(replace(entry, channel=replace(entry.channel, run=run)))
    file_of: dict[tuple[object, ...], str] = {}
    again = False
    for entry in labelled:
        channel = entry.channel
        key = (channel.body, channel.point, channel.beam_key, channel.run, channel.repeat)
        again |= file_of.setdefault(key, entry.recording.file) != entry.recording.file
    if not again:
        named = [replace(e, channel=replace(e.channel, run=e.channel.run or DEFAULT_RUN)) for e in labelled]
        return named, []
    named = []
    for entry in labelled:
        stem, run = Path(entry.recording.file).stem, entry.channel.run
        run = run if facts.runs and run else f"{stem} {run}".strip()
        named.append(replace(entry, channel=replace(entry.channel, run=run)))
    listed = list_some((entry.channel.run for entry in named), 6)
    text = f"the files measure the same points again: they are different runs, {listed}. --run names them."
    return named, [Notice("runs_by_file", text)]


def _direction_faults(entries: Sequence[_Entry]) -> list[Fault]:
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


def _reference_notices(entries: Sequence[_Entry]) -> list[Notice]:
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
        "deviations; "
        "stiffness and damping do not depend on it."
    )
    return [Notice("per_reference", text)]


def _check_filled(entries: Sequence[_Entry], takes: int, lines: int) -> None:
    """Refuse readings that share so few runs and lines that arrays of all of them would be almost empty."""
    channels = len({(e.channel.body, e.channel.point, e.channel.beam_key) for e in entries})
    readings = sum(e.recording.value.shape[1] for e in entries)
    if takes * channels * lines > max(_ANY_PLACES, readings / _LEAST_FILLED):
        got = f"{readings} readings of {channels} channels in {lines} lines and {takes} runs"
        step = "Check which columns hold the frequency and the run: one has a new value in almost every row"
        raise StapeskitError.of("the readings", "at lines and in runs that channels share", got, "", step)


def _body(
    name: str,
    entries: Sequence[_Entry],
    points: Points | None,
    takes: Sequence[tuple[str, str]],
    line_of: dict[int, NDArray[np.intp]],
    grid: Array,
    order: int,
) -> tuple[BodyChannels, list[Notice]]:
    """Fill the arrays of one body; report positions that differ and channels that are there twice."""
    keys = list(dict.fromkeys((entry.channel.point, entry.channel.beam_key) for entry in entries))
    place_of, take_of = {key: n for n, key in enumerate(keys)}, {take: n for n, take in enumerate(takes)}
    shape = (len(takes), len(keys), len(grid))
    value, sd = np.full(shape, np.nan + 1j * np.nan), np.full(shape, np.nan)
    known = {entry.recording.relative for entry in entries if entry.recording.sd is not None}
    relative = False not in known
    filled: dict[tuple[int, int], list[_Entry]] = {}
    first: dict[int, Channel] = {}
    faults: list[Fault] = []
    for entry in entries:
        channel, one = entry.channel, entry.recording
        row = place_of[channel.point, channel.beam_key]
        take = take_of[channel.run, channel.repeat]
        lines = line_of[id(one)]
        first.setdefault(row, channel)
        own = ~np.isnan(one.value[entry.row].real)
        for other in filled.setdefault((take, row), []):
            if np.any(own & ~np.isnan(value[take, row, lines].real)):
                step = "Name different excitations with --run NAME=FILE, or leave one of the two out"
                got = f"two that share frequencies ({other.channel.where} and {channel.where})"
                faults.append(Fault(f"the channel {channel.name}", "there once in a run", got, "", step))
                break
        filled[take, row].append(entry)
        lines = lines[own]
        factor = (2j * np.pi * one.freq_hz[own]) ** (order - channel.order) if order != channel.order else 1.0
        value[take, row, lines] = one.value[entry.row, own] * factor
        if one.sd is not None and one.relative == relative:
            sd[take, row, lines] = one.sd[entry.row, own] * np.abs(factor)
    positions = _positions(name, entries, points, faults)
    raise_all(faults)
    notices = []
    unused = int(np.sum(np.isnan(sd) & ~np.isnan(value.real)))
    if known and unused:
        text = f"{unused} values of body {name} have no standard deviation and were not used."
        notices.append(Notice("sd_missing", text))
    names = tuple(point for point, _ in keys)
    at = np.array([positions.get(point, np.full(3, np.nan)) for point in names])
    spread = [np.nan if points is None else points.sd_m.get((name, point), np.nan) for point in names]
    body = BodyChannels(
        name,
        names,
        None if not positions else at,
        np.array([first[row].direction for row in range(len(keys))]),
        value,
        sd if known else None,
        relative,
        np.array(spread, dtype=float),
    )
    return body, notices


def _positions(
    body: str, entries: Sequence[_Entry], points: Points | None, faults: list[Fault]
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


def _common_noise(
    entries: Sequence[_Entry],
    takes: Sequence[tuple[str, str]],
    line_of: dict[int, NDArray[np.intp]],
    lines: int,
) -> Array | None:
    """Return the noise of the reference (r, L) in runs whose channels were all recorded together."""
    common = np.zeros((len(takes), lines))
    for number, take in enumerate(takes):
        mine = [entry for entry in entries if (entry.channel.run, entry.channel.repeat) == take]
        rows = [None if e.recording.common_sd is None else e.recording.common_sd[e.row] for e in mine]
        first = rows[0]
        if first is not None and all(row is not None and np.array_equal(row, first) for row in rows):
            common[number, line_of[id(mine[0].recording)]] = first
    return common if np.any(common > 0.0) else None
