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
from stapeskit.faults import Fault, list_some, raise_all
from stapeskit.warnings import Notice

DEFAULT_BODY = "body"
"""Name of the body of files that name none and of which nothing else says more."""

DEFAULT_RUN = "1"


@dataclass(frozen=True)
class Entry:
    """One row of one recording, with the body, run and beam that it gets on its way to the measurement."""

    recording: Recording
    row: int
    channel: Channel

    def named(self, **names: str) -> Entry:
        """Return the entry with another body, point or run."""
        return replace(self, channel=replace(self.channel, **names))  # type: ignore[arg-type]


def unused_options(recordings: Sequence[Recording], facts: FileFacts) -> list[Fault]:
    """List options that no file needs, so that nothing is believed to be set that is not."""
    rows = [(one, channel) for one in recordings for channel in one.channels]
    needed = {
        "beam": any(np.any(np.isnan(channel.direction)) for _, channel in rows),
        "amplitude": any(not one.amplitude_stated and not channel.per for one, channel in rows),
        "length_unit": any(not one.length_stated for one in recordings),
        "n_avg": any(one.n_avg is None and one.sd is None for one in recordings),
    }
    want, step = "left out where the files say it, or need none", "Leave it out, or correct the file"
    return [
        Fault(f"--{name.replace('_', '-')}", want, "a value", "", step)
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
    channels = []
    for channel in recording.channels:
        silent = facts.direction is not None and np.any(np.isnan(channel.direction))
        beam = facts.direction if facts.direction is not None and silent else channel.direction
        channels.append(replace(channel, direction=beam, position_m=channel.position_m * length))
    value, sd, n_avg = recording.value, recording.sd, recording.n_avg
    if facts.amplitude == "rms" and not recording.amplitude_stated:
        peak = np.where([bool(channel.per) for channel in channels], 1.0, np.sqrt(2.0))[:, None]
        value, sd = value * peak, None if sd is None else sd * peak
    if facts.n_avg is not None and n_avg is None and sd is None:
        n_avg = np.full(value.shape, float(facts.n_avg))
    return replace(recording, channels=tuple(channels), value=value, sd=sd, n_avg=n_avg)


def with_bodies(
    entries: Sequence[Entry], points: Points | None, facts: FileFacts
) -> tuple[list[Entry], list[Notice]]:
    """Give every row its body: by ``--body``, its file or the points file; one body needs none.

    Raises
    ------
    StapeskitError
        Points of no body, of several, or missing in the points file; rules that mean no point.
    """
    used: set[str] = set()
    assigned: list[Entry] = []
    faults: list[Fault] = []
    without: dict[str, list[str]] = {}
    unlisted: dict[str, list[str]] = {}
    respelled: list[str] = []
    listed_in = "" if points is None else points.file
    for entry in entries:
        file, channel = entry.recording.file, entry.channel
        rules = [
            name for name, items in facts.bodies if any(item.holds(file, channel.point) for item in items)
        ]
        used |= set(rules)
        names = list(dict.fromkeys([*rules, *([channel.body] if channel.body else [])]))
        if not names and points is not None:
            names = points.bodies_of(channel.point)
        if not names:
            without.setdefault(file, []).append(channel.point)
            continue
        if len(names) > 1:
            step, got = "Name each point once, by file: --body base=base.uff:1-9", " and ".join(names)
            faults.append(Fault(f"point {channel.point}", "of one body", got, channel.where, step))
        body, point = names[0], channel.point
        if points is not None:
            try:
                body, point = points.key_of(body, point)
            except KeyError:
                if np.any(np.isnan(channel.position_m)) or channel.body:
                    unlisted.setdefault(body, []).append(point)
        if (body, point) != (names[0], channel.point):
            respelled.append(f"{names[0]} {channel.point} as {body} {point}")
        assigned.append(entry.named(body=body, point=point))
    if without and not assigned and points is None and not facts.body:
        return [entry.named(body=DEFAULT_BODY) for entry in entries], []
    for body, missing in unlisted.items():
        thing, step = f"points {list_some(missing, 8)} of body {body}", f"Add them to {listed_in}"
        faults.append(Fault(thing, "listed in the points file", "no rows of these names", "", step))
    for file, missing in without.items():
        step = "Name them with --body, e.g. --body stapes=1-10 --body base=11-19, or list them in --points"
        faults.append(Fault(f"points {list_some(missing, 12)}", "of a body", "none", file, step))
    known = list_some((entry.channel.point for entry in entries), 20)
    for name in dict.fromkeys(name for name, _ in facts.bodies if name not in used):
        want = f"points that were measured ({known})"
        faults.append(Fault(f"--body {name}", want, "others", "", "Correct the numbers"))
    raise_all(faults)
    notices = []
    if respelled:
        text = f"names were read as {listed_in} spells them: {list_some(respelled, 3)}."
        notices.append(Notice("names_alike", text))
    listed = {body for body, _ in points.positions_m} if points is not None else set()
    absent = listed - {entry.channel.body for entry in assigned}
    if absent:
        text = f"{listed_in} lists points of {', '.join(sorted(absent))}, of which no file has a value."
        notices.append(Notice("bodies_not_measured", text))
    return assigned, notices


def with_runs(entries: Sequence[Entry], facts: FileFacts) -> tuple[list[Entry], list[Notice]]:
    """Give every row its run: by ``--run``, by its file's content, else by what the files share.

    Files without names of runs that measure one point in one direction again are different excitations, each
    named after its file; files of different points are parts of one.
    """
    labelled = []
    file_of: dict[tuple[object, ...], str] = {}
    again = False
    for entry in entries:
        channel, file = entry.channel, entry.recording.file
        stated = next((name for name, of_file in facts.runs if is_file(of_file, file)), "")
        run = f"{stated} {channel.run}".strip()
        labelled.append(entry.named(run=run))
        key = (channel.body, channel.point, channel.beam_key, run, channel.repeat)
        again |= file_of.setdefault(key, file) != file
    if not again:
        return [entry.named(run=entry.channel.run or DEFAULT_RUN) for entry in labelled], []
    named = []
    for entry in labelled:
        run = entry.channel.run
        own = run if facts.runs and run else f"{Path(entry.recording.file).stem} {run}".strip()
        named.append(entry.named(run=own))
    listed = list_some((entry.channel.run for entry in named), 6)
    text = f"the files measure the same points again: they are different runs, {listed}. --run names them."
    return named, [Notice("runs_by_file", text)]
