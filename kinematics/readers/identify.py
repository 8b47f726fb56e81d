"""Give every channel its body and run, and apply what the user states about files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
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


def unused_options(recordings: Sequence[Recording], facts: FileFacts) -> list[Fault]:
    """List the options that were given but that no file needs."""
    needed = {
        "beam": any(np.any(np.isnan(one.directions)) for one in recordings),
        "amplitude": any(not one.amplitude_stated and one.frf is None for one in recordings),
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
    notices, file = [], recording.file
    placed = recording.points_m[np.all(np.isfinite(recording.points_m), axis=1)]
    if not recording.length_stated and len(placed) and not facts.length_unit:
        extent = " x ".join(f"{1e3 * span:.4g}" for span in np.ptp(placed, axis=0))
        text = (
            f"{file} does not say the unit of its positions: taken as metres they extend over {extent} mm. "
            "State --length-unit m, mm or um."
        )
        notices.append(Notice("length_unit_assumed", text))
    if not recording.amplitude_stated and recording.frf is None and not facts.amplitude:
        text = f"{file} does not say whether amplitudes are peak or rms: they were taken as peak."
        notices.append(Notice("amplitude_assumed", text))
    return notices


def with_facts(recording: Recording, facts: FileFacts) -> Recording:
    """Return a recording with beam, averages, amplitude and length unit applied where the file is silent."""
    length = LENGTHS[facts.length_unit] if facts.length_unit and not recording.length_stated else 1.0
    silent = np.any(np.isnan(recording.directions), axis=1)
    channels = tuple(
        replace(
            channel,
            direction=channel.direction if facts.direction is None or not without else facts.direction,
            position_m=channel.position_m * length,
        )
        for channel, without in zip(recording.channels, silent.tolist(), strict=True)
    )
    value, sd, n_avg = recording.value, recording.sd, recording.n_avg
    if facts.amplitude == "rms" and not recording.amplitude_stated:
        peak = np.where([bool(channel.per) for channel in channels], 1.0, np.sqrt(2.0))[:, None]
        value, sd = value * peak, None if sd is None else sd * peak
    if facts.n_avg is not None and n_avg is None and sd is None:
        n_avg = np.full(value.shape, float(facts.n_avg))
    return replace(recording, channels=channels, value=value, sd=sd, n_avg=n_avg)


def with_bodies(
    channels: Sequence[Channel], points: Points | None, facts: FileFacts
) -> tuple[list[Channel], list[Notice]]:
    """Give every channel its body: by ``--body``, its file or the points file; one body needs none.

    Raises
    ------
    StapeskitError
        Points of no body, of several, or missing in the points file; rules that mean no point.
    """
    rules = [_rules_of(channel, facts) for channel in channels]
    stated = [
        list(dict.fromkeys([*names, *([channel.body] if channel.body else [])]))
        or ([] if points is None else points.bodies_of(channel.point))
        for channel, names in zip(channels, rules, strict=True)
    ]
    if points is None and not facts.body and not any(stated):
        return [replace(channel, body=DEFAULT_BODY) for channel in channels], []
    faults: list[Fault] = []
    assigned: list[Channel] = []
    without: dict[str, list[str]] = {}
    unlisted: dict[str, list[str]] = {}
    respelled: list[str] = []
    listed_in = "" if points is None else points.file
    for channel, names in zip(channels, stated, strict=True):
        if not names:
            without.setdefault(channel.file, []).append(channel.point)
            continue
        if len(names) > 1:
            step, got = "Name each point once, by file: --body base=base.uff:1-9", " and ".join(names)
            faults.append(Fault(f"point {channel.point}", "of one body", got, channel.where, step))
        key = (names[0], channel.point)
        found = key if points is None else points.key_of(*key)
        if found is None and (channel.body or np.any(np.isnan(channel.position_m))):
            unlisted.setdefault(names[0], []).append(channel.point)
        elif found not in (key, None):
            respelled.append(f"{' '.join(key)} as {' '.join(found)}")
        body, point = found or key
        assigned.append(replace(channel, body=body, point=point))
    for body, missing in unlisted.items():
        thing, step = f"points {list_some(missing, 8)} of body {body}", f"Add them to {listed_in}"
        faults.append(Fault(thing, "listed in the points file", "no rows of these names", "", step))
    for file, missing in without.items():
        step = "Name them with --body, e.g. --body stapes=1-10 --body base=11-19, or list them in --points"
        faults.append(Fault(f"points {list_some(missing, 12)}", "of a body", "none", file, step))
    known = list_some((channel.point for channel in channels), 20)
    used = {name for names in rules for name in names}
    for name in dict.fromkeys(name for name, _ in facts.bodies if name not in used):
        want = f"points that were measured ({known})"
        faults.append(Fault(f"--body {name}", want, "others", "", "Correct the numbers"))
    raise_all(faults)
    notices = []
    if respelled:
        text = f"names were read as {listed_in} spells them: {list_some(respelled, 3)}."
        notices.append(Notice("file_read", text))
    listed = {body for body, _ in points.positions_m} if points is not None else set()
    if absent := listed - {channel.body for channel in assigned}:
        text = f"{listed_in} lists points of {', '.join(sorted(absent))}, of which no file has a value."
        notices.append(Notice("file_read", text))
    return assigned, notices


def _rules_of(channel: Channel, facts: FileFacts) -> list[str]:
    return [
        name for name, items in facts.bodies if any(item.holds(channel.file, channel.point) for item in items)
    ]


def with_runs(channels: Sequence[Channel], facts: FileFacts) -> tuple[list[Channel], list[Notice]]:
    """Give every channel its run: by ``--run``, by its file's content, else by what the files share.

    Files without names of runs that measure one point in one direction again are different excitations, each
    named after its file; files of different points are parts of one.
    """
    labelled = []
    for channel in channels:
        stated = next((name for name, file in facts.runs if is_file(file, channel.file)), "")
        labelled.append(replace(channel, run=f"{stated} {channel.run}".strip()))
    files: dict[tuple[object, ...], set[str]] = {}
    for channel in labelled:
        files.setdefault(channel.key, set()).add(channel.file)
    if all(len(names) == 1 for names in files.values()):
        return [replace(channel, run=channel.run or DEFAULT_RUN) for channel in labelled], []
    named = [
        channel
        if facts.runs and channel.run
        else replace(channel, run=f"{Path(channel.file).stem} {channel.run}".strip())
        for channel in labelled
    ]
    listed = list_some((channel.run for channel in named), 6)
    text = f"the files measure the same points again: they are different runs, {listed}. --run names them."
    return named, [Notice("file_read", text)]
