"""Apply what the user states where files are silent: bodies, runs, beams, averages, units."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from kinematics.readers.points import Points
from kinematics.readers.recording import Channel, Recording
from kinematics.readers.units import LENGTHS
from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, StapeskitError, list_some, raise_all
from stapeskit.frames import axis_vector
from stapeskit.warnings import Notice

DEFAULT_BODY = "body"
"""Name of the body of files that name none and of which nothing else says more."""

DEFAULT_RUN = "1"

_SPAN = re.compile(r"(\d{1,9})\s*-\s*(\d{1,9})")


@dataclass(frozen=True)
class FileFacts:
    """What the user states where files are silent: options of ``points2dof``, by their names.

    See `kinematics.options.MotionOptions`; empty or None where nothing is stated.
    """

    body: tuple[str, ...] = ()
    run: tuple[str, ...] = ()
    beam: str = ""
    amplitude: str | None = ""
    length_unit: str | None = ""
    n_avg: float | None = None
    mapping: Path | None = None
    channels: Path | None = None
    averages: int = 30
    period_s: float | None = None

    @cached_property
    def direction(self) -> Array | None:
        """Unit vector (3,) of ``beam``; None without one. As `direction_of`."""
        return direction_of(self.beam) if self.beam else None

    @cached_property
    def bodies(self) -> tuple[tuple[str, tuple[tuple[str, str], ...]], ...]:
        """The rules of ``body``: a name, and pairs of file and points; refused where one cannot be read."""
        return tuple(_rule(text) for text in self.body)

    @cached_property
    def runs(self) -> tuple[tuple[str, str], ...]:
        """Names and files of ``run``; refused where one is no NAME=FILE."""
        rules = [tuple(part.strip() for part in text.partition("=")[::2]) for text in self.run]
        raise_all(Fault("--run", "NAME=FILE", "=".join(rule)) for rule in rules if not all(rule))
        return tuple((name, file) for name, file in rules)

    def bodies_of(self, channel: Channel) -> list[str]:
        """Return the bodies whose rules mean a channel."""
        return [name for name, items in self.bodies if any(_means(*item, channel) for item in items)]


def _rule(text: str) -> tuple[str, tuple[tuple[str, str], ...]]:
    """Read ``NAME=POINTS``."""
    name, _, points = (part.strip() for part in text.partition("="))
    chosen: list[tuple[str, str]] = []
    file = ""
    for item in points.split(","):
        head, colon, rest = item.strip().rpartition(":")
        file, item = (head.strip(), rest.strip()) if colon else (file, item.strip())
        span = _SPAN.fullmatch(item)
        if not item or not name or (span and int(span[1]) > int(span[2])):
            step = "Write it like --body stapes=1-10,12 or --body base=base.uff"
            raise StapeskitError.of("--body", "NAME= and numbers, ranges or names", text, "", step)
        chosen.append((file, item))
    return name, tuple(chosen)


def _means(file: str, item: str, channel: Channel) -> bool:
    """Return whether a channel is meant; a name without a file may be that of a file."""
    if file and not is_file(file, channel.file):
        return False
    if span := _SPAN.fullmatch(item):
        return channel.point.isdecimal() and int(span[1]) <= int(channel.point) <= int(span[2])
    as_file = not file and not item.isdigit() and is_file(item, channel.file)
    return channel.point == item or as_file


def is_file(item: str, file: str) -> bool:
    """Return whether a file is named by its name, with or without the ending."""
    return item in (file, file.rsplit(".", 1)[0])


def direction_of(text: str, where: Place | str = "", thing: str = "--beam") -> Array:
    """Read ``-z`` or ``0,0.34,0.94`` as a unit vector (3,).

    Raises
    ------
    StapeskitError
        Neither a name of an axis nor three numbers that are not all zero.
    """
    axis = axis_vector(text.strip())
    if axis is not None:
        return axis
    try:
        numbers = np.array([float(part) for part in text.split(",")])
        length = float(np.linalg.norm(numbers))
    except ValueError:
        numbers, length = np.zeros(0), 0.0
    if numbers.shape != (3,) or not 0.0 < length < np.inf:
        raise StapeskitError.of(thing, "x, -y ... or three numbers X,Y,Z", text, where)
    return np.asarray(numbers / length)


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
        Points of no body, of several, or missing in the points file; a part of a rule that means no point.
    """
    faults: list[Fault] = []
    assigned: list[Channel] = []
    bare: dict[str, list[str]] = {}
    unlisted: dict[str, list[str]] = {}
    respelled: list[str] = []
    several = points is not None or bool(facts.body) or any(channel.body for channel in channels)
    for channel in channels:
        names = list(dict.fromkeys([*facts.bodies_of(channel), *filter(None, [channel.body])]))
        if not names and points is not None:
            names = points.bodies_of(channel.point)
        if not names and several:
            bare.setdefault(channel.file, []).append(channel.point)
            continue
        if len(names) > 1:
            step, got = "Name each point once, by file: --body base=base.uff:1-9", " and ".join(names)
            faults.append(Fault(f"point {channel.point}", "of one body", got, channel.where, step))
        key = ([*names, DEFAULT_BODY][0], channel.point)
        found = key if points is None else points.key_of(*key)
        if found is None and (channel.body or np.any(np.isnan(channel.position_m))):
            unlisted.setdefault(key[0], []).append(channel.point)
        elif found not in (key, None):
            respelled.append(f"{' '.join(key)} as {' '.join(found)}")
        body, point = found or key
        assigned.append(replace(channel, body=body, point=point))
    for body, missing in unlisted.items():
        thing, step = f"points {list_some(missing, 8)} of body {body}", "Add them to it"
        faults.append(Fault(thing, "listed in the points file", "no rows of these names", "", step))
    for file, missing in bare.items():
        step = "Name them with --body, e.g. --body stapes=1-10 --body base=11-19, or list them in --points"
        faults.append(Fault(f"points {list_some(missing, 12)}", "of a body", "none", file, step))
    known = list_some((channel.point for channel in channels), 20)
    files = list_some((channel.file for channel in channels), 20)
    for name, items in facts.bodies:
        unmet = [item for item in items if not any(_means(*item, channel) for channel in channels)]
        if unmet:
            got = ", ".join(":".join(filter(None, item)) for item in unmet)
            want, step = f"points or files that were measured ({known}; {files})", "Correct the names"
            faults.append(Fault(f"--body {name}", want, got, "", step))
    raise_all(faults)
    if not respelled or points is None:
        return assigned, []
    text = f"names were read as {points.file} spells them: {list_some(respelled, 3)}."
    return assigned, [Notice("file_read", text)]


def with_runs(channels: Sequence[Channel], facts: FileFacts) -> tuple[list[Channel], list[Notice]]:
    """Give every channel its run: by ``--run``, by its file's content, else by what the files share.

    Files without names of runs that measure one point in one direction again are different excitations, each
    named after its file; files of different points are parts of one.

    Raises
    ------
    StapeskitError
        A rule names no file.
    """
    given = list(dict.fromkeys(channel.file for channel in channels))
    raise_all(
        Fault(f"the file of --run {name}={file}", f"one of {', '.join(given)}", file, "", "Correct its name")
        for name, file in facts.runs
        if not any(is_file(file, other) for other in given)
    )
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
