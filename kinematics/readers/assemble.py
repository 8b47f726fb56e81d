"""Assemble the recordings of one or several files to one measurement, with all checks."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from kinematics.measurement import BodyChannels, Measurement, Repeat
from kinematics.readers.formats import format_of, read_file
from kinematics.readers.in_si import on_one_grid, twice_faults
from kinematics.readers.lines import check_filled
from kinematics.readers.points import Points, read_points
from kinematics.readers.recording import QUANTITY_OF_ORDER, Recording, Row
from kinematics.readers.stated_by_user import FileFacts, with_bodies, with_runs
from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, StapeskitError, collect_faults, list_some, raise_all
from stapeskit.warnings import Notice, once

_SAME_PLACE_M = 1e-6  # positions written with four digits
_MOST_HIDDEN = 0.5  # share of values up to which the noise of a usual channel is known


def read_measurement(
    paths: Sequence[Path],
    points: Path | None = None,
    frame: str = "vibrometer",
    facts: FileFacts | None = None,
) -> Measurement:
    """Read one or several vibrometer files as one measurement.

    ``points`` is a CSV with positions, and with the bodies of points whose files do not name them.

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
    recordings, faults, listed = list[Recording](), list[Fault](), None
    for path in paths:
        with collect_faults(faults):
            recordings.append(read_file(path, facts))
    if points is not None:
        with collect_faults(faults):
            listed = read_points(points)
    raise_all(faults)
    if facts.channels is not None and not any(format_of(path).series for path in paths):
        got = facts.channels.name
        raise StapeskitError.of("--channels", "left out: no file holds time series", got)
    inputs = {"ldv" if number == 1 else f"ldv {number}": path for number, path in enumerate(paths, 1)}
    return replace(assemble(recordings, listed, facts, frame), inputs=inputs)


def assemble(
    recordings: Sequence[Recording],
    points: Points | None = None,
    facts: FileFacts | None = None,
    frame: str = "vibrometer",
) -> Measurement:
    """Assemble the recordings of one or several files, settled, to one measurement.

    ``points`` give the body of a point, and its position where the files have none; a position that both have
    must be the same.

    Notes
    -----
    Files that repeat points of each other are different runs, named after them; others are parts of one run.

    Raises
    ------
    StapeskitError
        A point without body or direction, a position that differs between files, one channel twice, responses
        to different quantities, or an option that applies to nothing; one sentence a kind.
    """
    facts = facts or FileFacts()
    raise_all(facts.unused(recordings))
    rows, about_lines = on_one_grid([row for one in recordings for row in one.rows])
    rows, about_bodies = with_bodies(rows, points, facts)
    rows, about_runs = with_runs(rows, facts)
    raise_all(_row_faults(rows))
    raise_all(twice_faults(rows))
    order = Counter(row.order for row in rows).most_common(1)[0][0]
    rows = [_as_order(row, order) for row in rows]
    takes = list(dict.fromkeys(Repeat(row.run, row.repeat) for row in rows))
    freq_hz = rows[0].freq_hz
    channels = len({(row.body, row.beam) for row in rows})
    check_filled(len(takes) * channels, len(freq_hz), len(rows) * len(freq_hz))
    notices = [notice for one in recordings for notice in one.notices]
    notices += [*about_bodies, *about_runs, *about_lines]
    if units := sorted({row.per for row in rows} - {""}):
        text = (
            f"the values are responses per {' or '.join(units)}: so are all motions and their standard "
            "deviations; stiffness and damping do not depend on it."
        )
        notices.append(Notice("file_read", text))
    faults, bodies = list[Fault](), list[BodyChannels]()
    for name in dict.fromkeys(row.body for row in rows):
        with collect_faults(faults):
            bodies.append(_body([row for row in rows if row.body == name], takes, points, notices))
    raise_all(faults)
    if len({body.body.lower() for body in bodies}) < len(bodies):
        listed = ", ".join(body.body for body in bodies)
        text = f"bodies whose names differ in case only were taken as different: {listed}."
        notices.append(Notice("file_read", text))
    several = len({run for run, _ in takes}) < len(takes)
    return Measurement(
        frame,
        tuple(f"{run} repeat {repeat}" if several and repeat else run for run, repeat in takes),
        freq_hz,
        tuple(bodies),
        QUANTITY_OF_ORDER[order],
        notices=once(notices),
        repeats=tuple(takes) if several else (),
        line_spread=max(one.line_spread for one in recordings),
        statements=tuple(f"{one.file}: {one.statement}" for one in recordings if one.statement),
    )


def _row_faults(rows: Sequence[Row]) -> list[Fault]:
    """Refuse rows without direction, and responses to different quantities in one run."""
    silent = defaultdict[str, list[str]](list)
    kinds = defaultdict[str, dict[str, str]](dict)
    for row in rows:
        if np.any(np.isnan(row.direction)):
            silent[row.body].append(row.point)
        kind = f"responses per {row.per}" if row.per else "amplitudes"
        kinds[row.run].setdefault(kind, f"{kind} ({row.where or row.file})")
    want, step = "given with the direction of the beam", "State it with --beam z, -y or X,Y,Z"
    faults = [
        Fault(f"points {list_some(names, 8)} of body {body}", want, "none", "", step)
        for body, names in silent.items()
    ]
    step = "Export all points as responses to one reference, or all as amplitudes"
    return faults + [
        Fault("the values of one run", "of one unit", " and ".join(found.values()), f"run {run}", step)
        for run, found in kinds.items()
        if len(found) > 1
    ]


def _as_order(row: Row, order: int) -> Row:
    """Return the row as displacement, velocity or acceleration."""
    if row.order == order:
        return row
    factor = (2j * np.pi * row.freq_hz) ** (order - row.order)
    sd = None if row.sd is None else row.sd * np.abs(factor)
    return replace(row, value=row.value * factor, sd=sd)


def _body(
    rows: Sequence[Row], takes: Sequence[Repeat], points: Points | None, notices: list[Notice]
) -> BodyChannels:
    """Arrange the rows of one body by run, channel and line; add what is missing and what is not used.

    Where some sd are absolute, values whose sd lacks a factor have none. Where the last digit of coherence
    hides the noise of most values, that of the body is known up to a factor.
    """
    name, first = rows[0].body, dict[object, Row]()
    for row in rows:
        first.setdefault(row.beam, row)
    channel_of = {beam: channel for channel, beam in enumerate(first)}
    value = np.full((len(takes), len(first), len(rows[0].freq_hz)), np.nan, dtype=complex)
    spread, listed = np.full(value.shape, np.nan), np.zeros((*value.shape[:2], 1), dtype=bool)
    noisy = [row for row in rows if row.sd is not None and not np.all(np.isnan(row.sd))]
    relative = all(row.relative for row in noisy)
    for row in rows:
        own = ~np.isnan(row.value.real)
        place = takes.index((row.run, row.repeat)), channel_of[row.beam]
        value[place][own], listed[place] = row.value[own], True
        if row.sd is not None and row.relative == relative:
            spread[place][own] = np.asarray(row.sd)[own]
    positions, missing = _positions(rows, points), np.isnan(value)
    gaps = missing & listed & ~np.all(missing, axis=1, keepdims=True)
    lacking = [row.name for row, one in zip(first.values(), gaps.swapaxes(0, 1), strict=True) if np.any(one)]
    hidden = float(np.mean([row.hidden for row in noisy if row.relative == relative])) if noisy else 0.0
    coarse = 0.0 if relative or hidden > _MOST_HIDDEN else 100.0 * hidden
    unused = int(np.sum(np.isnan(spread) & ~missing)) if noisy else 0
    exact = int(np.sum(spread == 0.0))
    texts = (
        (len(lacking), "file_read", f"{np.sum(gaps)} readings of {len(lacking)} channels "
         f"({list_some(lacking, 6)}) have no value at lines that other channels of the body have: they count "
         "as missing."),
        (coarse, "file_read", f"the coherence of {coarse:.2g} % of the values of body {name} is 1 within its "
         "last digit: their noise may be smaller than stated."),
        (unused, "file_read", f"{unused} values of body {name} have no standard deviation: not used."),
        (exact, "noise_level", f"{exact} values of body {name} have a noise of 0: they are exact to 1e-12 of "
         "the largest."),
    )  # fmt: skip
    notices += [Notice(code, text) for count, code, text in texts if count]
    sd_m = {} if points is None else points.sd_m
    return BodyChannels(
        name,
        tuple(row.point for row in first.values()),
        np.array([positions[row.point] for row in first.values()]) if positions else None,
        np.array([row.direction for row in first.values()]),
        value,
        spread if noisy else None,
        relative or hidden > _MOST_HIDDEN,
        np.array([sd_m.get((name, row.point), np.nan) for row in first.values()], dtype=float),
        averages=np.array([row.averages for row in first.values()]),
    )


def _positions(rows: Sequence[Row], points: Points | None) -> dict[str, Array]:
    """Return the positions of the points of a body, m: of the points file, else of the files.

    Raises
    ------
    StapeskitError
        A point with two, or some points without any.
    """
    body, faults, found = rows[0].body, list[Fault](), dict[str, tuple[Array, Place | str]]()
    if points is not None:
        listed = points.positions_m.items()
        found = {point: (place, points.file) for (name, point), place in listed if name == body}
    for row in rows:
        place, where = row.position_m, row.where
        if np.any(np.isnan(place)):
            continue
        known, source = found.setdefault(row.point, (place, where))
        if np.any(np.abs(known - place) > _SAME_PLACE_M + 1e-5 * np.abs(known)):
            got = f"{(1e3 * known).tolist()} ({source}) and {(1e3 * place).tolist()} mm"
            thing = f"the position of point {row.point} of body {body}"
            step = "Correct it; --length-unit states the unit where a file does not"
            faults.append(Fault(thing, "one", got, where, step))
            found[row.point] = (place, where)
    measured = dict.fromkeys(row.point for row in rows)
    lacking = [point for point in measured if point not in found]
    if lacking and len(lacking) < len(measured):
        step = "Give them with --points points.csv (body, point, x_mm, y_mm, z_mm)"
        thing = f"points {list_some(lacking, 8)} of body {body}"
        faults.append(Fault(thing, "given with positions, as others are", "none", "", step))
    raise_all(faults)
    return {point: found[point][0] for point in measured if point in found}
