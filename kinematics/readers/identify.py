"""Assign each row of the recordings its body and run, and apply what the user states about files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kinematics.readers.facts import FileFacts, is_file
from kinematics.readers.points import Points
from kinematics.readers.recording import Channel, Recording
from kinematics.readers.units import LENGTHS
from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError, list_some, raise_all
from stapeskit.warnings import Notice

DEFAULT_BODY = "body"
"""Name of the body of files that name none and of which nothing else says more."""

DEFAULT_RUN = "1"

_MOST_BODIES = 1000  # more rigid bodies were in no study: the column of bodies holds points


@dataclass(frozen=True)
class Entry:
    """One row of one recording on its way into the measurement.

    Attributes
    ----------
    channel : Channel
        With the body, run and beam that it gets on the way.
    common_sd : ndarray, (L,), or None
        Relative noise of its reference; None where nothing is known, or where the whole run shares it.
    """

    recording: Recording
    row: int
    channel: Channel
    common_sd: Array | None = None


def unused_options(recordings: Sequence[Recording], facts: FileFacts) -> list[Fault]:
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


def assumptions(recording: Recording, facts: FileFacts) -> list[Notice]:
    """Report what is assumed because neither the file nor the user says it."""
    notices = []
    placed = recording.points_m[np.all(np.isfinite(recording.points_m), axis=1)]
    if not recording.length_stated and len(placed) and not facts.length_unit:
        extent = " x ".join(f"{1e3 * span:.4g}" for span in np.ptp(placed, axis=0))
        text = (
            f"{recording.file} does not say the unit of its positions: taken as metres they extend over "
            f"{extent} mm. State --length-unit m, mm or um."
        )
        notices.append(Notice("length_unit_assumed", text))
    absolute = any(not channel.per for channel in recording.channels)
    if not recording.amplitude_stated and absolute and not facts.amplitude:
        text = f"{recording.file} does not say whether amplitudes are peak or rms: they were taken as peak."
        notices.append(Notice("amplitude_assumed", text))
    return notices


def with_facts(recording: Recording, facts: FileFacts) -> Recording:
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


def with_bodies(
    entries: Sequence[Entry], points: Points | None, facts: FileFacts
) -> tuple[list[Entry], list[Notice]]:
    """Give every row its body: by ``--body``, its file or the points file; one body needs none."""
    used: set[str] = set()
    assigned: list[Entry] = []
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
        only = [replace(entry, channel=replace(entry.channel, body=DEFAULT_BODY)) for entry in entries]
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
        return assigned, unmeasured(assigned, points)
    listed = list_some((f"{old} as {new}" for old, new in respelled.items()), 3)
    text = f"names were read as {points.file if points else ''} spells them: {listed}."
    return assigned, [Notice("names_alike", text), *unmeasured(assigned, points)]


def unmeasured(entries: Sequence[Entry], points: Points | None) -> list[Notice]:
    """Report bodies of the points file that were not measured."""
    if points is None:
        return []
    absent = {body for body, _ in points.positions_m} - {entry.channel.body for entry in entries}
    if not absent:
        return []
    text = f"{points.file} lists points of {', '.join(sorted(absent))}, of which no file has a value."
    return [Notice("bodies_not_measured", text)]


def with_runs(entries: Sequence[Entry], facts: FileFacts) -> tuple[list[Entry], list[Notice]]:
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
