"""Assemble the recordings of one or several files to one measurement, with all checks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinematics.measurement import BodyChannels, Measurement, Repeat
from kinematics.readers.facts import FileFacts, unknown_files
from kinematics.readers.formats import companion_files, format_of, read_file
from kinematics.readers.gather import twice_faults
from kinematics.readers.identify import assumptions, unused_options, with_bodies, with_facts, with_runs
from kinematics.readers.lines import check_filled, common_grid, grid_faults
from kinematics.readers.noise import with_noise
from kinematics.readers.points import Points, read_points
from kinematics.readers.recording import QUANTITY_OF_ORDER, Channel, Recording
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, StapeskitError, collect_faults, list_some, raise_all
from stapeskit.warnings import Notice, unique

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
    if facts.mapping is not None and not faults and not any(format_of(path, True).mapped for path in paths):
        want = "left out: no MATLAB or HDF5 file and no wide table is read"
        faults.append(Fault("--mapping", want, facts.mapping.name))
    if facts.channels is not None and not faults and not any(one.from_series for one in recordings):
        faults.append(Fault("--channels", "left out: no file holds time series", facts.channels.name))
    raise_all(faults)
    inputs = {"ldv" if number == 1 else f"ldv {number}": path for number, path in enumerate(paths, 1)}
    for path in paths:
        inputs |= companion_files(path, facts)
    if points is not None:
        inputs["points"] = Path(points)
    return replace(assemble(recordings, listed, facts, frame), inputs=inputs)


@dataclass(frozen=True)
class _Stack:
    """The channels of all files on one grid of lines: P rows, L lines.

    ``sd`` and ``common_sd`` are NaN where none is stated; ``stated`` (P,) says whether the file of a row
    states noise, ``relative`` (P,) whether that is known up to one factor.
    """

    freq_hz: Array
    channels: tuple[Channel, ...]
    value: ComplexArray
    sd: Array
    common_sd: Array
    stated: NDArray[np.bool_]
    relative: NDArray[np.bool_]


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
    stack, about_lines = _stacked([with_noise(with_facts(one, facts)) for one in recordings])
    channels, about_bodies = with_bodies(stack.channels, points, facts)
    channels, about_runs = with_runs(channels, facts)
    raise_all([*_direction_faults(channels), *_reference_faults(channels)])
    raise_all(twice_faults(channels, stack.value, _ONE_RUN))
    stack, order = _of_one_quantity(replace(stack, channels=tuple(channels)))
    takes = list(dict.fromkeys((channel.run, channel.repeat) for channel in channels))
    different = len({(channel.body, channel.point, channel.beam_key) for channel in channels})
    check_filled(len(takes) * different, len(stack.freq_hz), stack.value.size, "")
    stack, common_sd = _reference_noise(stack, takes)
    notices += [*about_bodies, *about_runs, *_reference_notices(channels), *about_lines]
    faults: list[Fault] = []
    bodies = []
    for name in dict.fromkeys(channel.body for channel in channels):
        with collect_faults(faults):
            body, missing = _body(name, stack, takes, points)
            bodies.append(body)
            notices += missing
    raise_all(faults)
    present = np.array([np.any(~np.isnan(body.value.real), axis=(0, 1)) for body in bodies])
    raise_all(grid_faults(stack.freq_hz, present, [body.body for body in bodies]))
    repeats = tuple(Repeat(run, repeat) for run, repeat in takes)
    several = len({run for run, _ in takes}) < len(takes)
    return Measurement(
        frame,
        tuple(repeat.name if several else repeat.run for repeat in repeats),
        stack.freq_hz,
        tuple(bodies),
        QUANTITY_OF_ORDER[order],
        notices=unique(notices),
        repeats=repeats if several else (),
        common_sd=common_sd if np.any(common_sd > 0.0) else None,
        line_spread=max(one.line_spread for one in recordings),
        statements=tuple(f"{one.file}: {one.statement}" for one in recordings if one.statement),
    )


def _stacked(recordings: Sequence[Recording]) -> tuple[_Stack, list[Notice]]:
    """Join the lines of all files, and set their channels below each other."""
    freq_hz, places, notices = common_grid([one.freq_hz for one in recordings])
    counts = [len(one.channels) for one in recordings]
    shape = (sum(counts), len(freq_hz))
    check_filled(*shape, sum(one.value.size for one in recordings), "")
    value, sd, common = np.full(shape, np.nan, dtype=complex), np.full(shape, np.nan), np.full(shape, np.nan)
    start = 0
    for one, lines, count in zip(recordings, places, counts, strict=True):
        rows = slice(start, start + count)
        for matrix, part in ((value, one.value), (sd, one.sd), (common, one.common_sd)):
            if part is not None:
                matrix[rows, lines] = part
        start += count
    return _Stack(
        freq_hz,
        tuple(channel for one in recordings for channel in one.channels),
        value,
        sd,
        common,
        np.repeat([one.sd is not None for one in recordings], counts),
        np.repeat([one.relative for one in recordings], counts),
    ), notices


def _of_one_quantity(stack: _Stack) -> tuple[_Stack, int]:
    """Return all values as the most common quantity, and its order."""
    orders = np.array([channel.order for channel in stack.channels])
    order = Counter(orders.tolist()).most_common(1)[0][0]
    value, sd = stack.value, stack.sd
    for other in set(orders.tolist()) - {order}:
        rows, factor = orders == other, (2j * np.pi * stack.freq_hz) ** (order - other)
        value[rows] *= factor
        sd[rows] *= np.abs(factor)
    return stack, order


def _reference_noise(stack: _Stack, takes: Sequence[tuple[str, str]]) -> tuple[_Stack, Array]:
    """Return the noise of the reference of runs, (r, L), whose channels were all recorded together.

    Where they were not, the noise of their references is added to that of the channels.
    """
    common_sd = np.zeros((len(takes), len(stack.freq_hz)))
    if np.all(np.isnan(stack.common_sd)):
        return stack, common_sd
    sd = stack.sd.copy()
    for number, take in enumerate(takes):
        rows = np.array([(channel.run, channel.repeat) == take for channel in stack.channels])
        noise = np.nan_to_num(stack.common_sd[rows])
        if np.all(noise == noise[0]):
            common_sd[number] = noise[0]
        else:
            sd[rows] = np.hypot(sd[rows], noise * np.abs(stack.value[rows]))
    return replace(stack, sd=sd), common_sd


def _direction_faults(channels: Sequence[Channel]) -> list[Fault]:
    without: dict[str, list[str]] = {}
    for channel in channels:
        if np.any(np.isnan(channel.direction)):
            without.setdefault(channel.body, []).append(channel.point)
    want = "given with the direction of the beam"
    step = "State the direction towards the laser head with --beam z, -y or X,Y,Z"
    return [
        Fault(f"points {list_some(names, 8)} of body {body}", want, "none", "", step)
        for body, names in without.items()
    ]


def _reference_faults(channels: Sequence[Channel]) -> list[Fault]:
    """Refuse responses to different quantities in one run."""
    by_run: dict[str, dict[str, str]] = {}
    for channel in channels:
        kind = f"responses per {channel.per}" if channel.per else "amplitudes"
        by_run.setdefault(channel.run, {}).setdefault(kind, str(channel.where) or channel.file)
    step = "Export all points as responses to one reference, or all as amplitudes"
    return [
        Fault(
            "the values of one run",
            "of one unit",
            " and ".join(f"{kind} ({where})" for kind, where in kinds.items()),
            f"run {run}",
            step,
        )
        for run, kinds in by_run.items()
        if len(kinds) > 1
    ]


def _reference_notices(channels: Sequence[Channel]) -> list[Notice]:
    """Report the quantity that the motion refers to."""
    units = sorted({channel.per for channel in channels} - {""})
    text = (
        f"the values are responses per {' or '.join(units)}: so are all motions and their standard "
        "deviations; stiffness and damping do not depend on it."
    )
    return [Notice("file_read", text)] if units else []


def _body(
    name: str, stack: _Stack, takes: Sequence[tuple[str, str]], points: Points | None
) -> tuple[BodyChannels, list[Notice]]:
    """Fill the arrays of one body."""
    rows = [row for row, channel in enumerate(stack.channels) if channel.body == name]
    mine = [stack.channels[row] for row in rows]
    first: dict[tuple[str, tuple[float, ...]], Channel] = {}
    for channel in mine:
        first.setdefault((channel.point, channel.beam_key), channel)
    row_of = {key: number for number, key in enumerate(first)}
    shape = (len(takes), len(first), len(stack.freq_hz))
    value, sd = np.full(shape, np.nan + 1j * np.nan), np.full(shape, np.nan)
    known = np.any(stack.stated[rows])
    relative = not np.any(stack.stated[rows] & ~stack.relative[rows])
    for row, channel in zip(rows, mine, strict=True):
        own = ~np.isnan(stack.value[row].real)
        place = takes.index((channel.run, channel.repeat)), row_of[channel.point, channel.beam_key]
        value[place][own] = stack.value[row, own]
        if stack.relative[row] == relative:
            sd[place][own] = stack.sd[row, own]
    positions = _positions(name, mine, points)
    notices = []
    unused = int(np.sum(np.isnan(sd) & ~np.isnan(value.real)))
    if known and unused:
        text = f"{unused} values of body {name} have no standard deviation and were not used."
        notices.append(Notice("file_read", text))
    names = tuple(point for point, _ in first)
    listed = {} if points is None else points.sd_m
    body = BodyChannels(
        name,
        names,
        np.array([positions[point] for point in names]) if positions else None,
        np.array([channel.direction for channel in first.values()]),
        value,
        sd if known else None,
        bool(relative),
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
        found = {
            point: (place, points.file) for (name, point), place in points.positions_m.items() if name == body
        }
    for channel in channels:
        place, where = channel.position_m, str(channel.where)
        if np.any(np.isnan(place)):
            continue
        known, source = found.setdefault(channel.point, (place, where))
        if np.any(np.abs(known - place) > _SAME_PLACE_M + 1e-5 * np.abs(known)):
            got = f"{(1e3 * known).tolist()} ({source}) and {(1e3 * place).tolist()} mm"
            step = "Correct it; --length-unit states the unit where a file does not"
            faults.append(
                Fault(f"the position of point {channel.point} of body {body}", "one", got, where, step)
            )
            found[channel.point] = (place, where)
    measured = dict.fromkeys(channel.point for channel in channels)
    lacking = [point for point in measured if point not in found]
    if lacking and len(lacking) < len(measured):
        step = "Give them with --points points.csv (body, point, x_mm, y_mm, z_mm)"
        thing = f"points {list_some(lacking, 8)} of body {body}"
        faults.append(Fault(thing, "given with positions, as others are", "none", "", step))
    raise_all(faults)
    return {point: found[point][0] for point in measured if point in found}
