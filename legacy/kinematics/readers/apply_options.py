"""Apply the options about files to their recordings: beams, units, amplitudes, bodies, runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.input_options import InputOptions, is_file
from legacy.kinematics.readers.recording import Recording, Recordings, scaled
from legacy.kinematics.readers.unit_labels import LENGTHS
from legacy.kinematics.tidy.points_csv import Points
from legacy.stapeskit.faults import Fault, list_some, raise_all
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

DEFAULT_RUN = "1"
Entry = tuple[str, Recording]


def apply_stated(files: Sequence[Recordings], options: InputOptions) -> tuple[list[Entry], list[Notice]]:
    """Return (file, recording) with beam, amplitude and length unit applied where the files are silent.

    Raises
    ------
    KinematicsError
        An option that has nothing to say: all files say it themselves.
    """
    entries: list[Entry] = []
    notices: list[Notice] = []
    silent = {
        "{beam}": False,
        "{amplitude}": False,
        "{length_unit}": False,
        "{n_avg}": False,
    }
    for recordings in files:
        notices += recordings.notices
        placed = any(np.all(np.isfinite(r.position_mm)) for r in recordings.recordings)
        absolute = any(not r.per for r in recordings.recordings)
        if not recordings.length_stated and placed:
            silent["{length_unit}"] = True
            if not options.length_unit:
                notices.append(_metres(recordings))
        if not recordings.amplitude_stated and absolute:
            silent["{amplitude}"] = True
            if not options.amplitude:
                text = (
                    f"{recordings.file} does not say whether amplitudes are peak or rms: they were "
                    "taken as peak."
                )
                notices.append(Notice("amplitude_assumed", text))
        for recording in recordings.recordings:
            silent["{beam}"] |= bool(np.any(np.isnan(recording.direction)))
            silent["{n_avg}"] |= recording.n_avg is None and recording.sd is None
            entries.append((recordings.file, _with_stated(recording, recordings, options)))
    step = "Leave it out, or correct the file"
    faults = [
        Fault(option, "left out where the files say it, or need none", "a value", "", step)
        for option, needed in silent.items()
        if option in options.stated_names and not needed
    ]
    raise_all(KinematicsError, faults)
    return entries, notices


def _with_stated(recording: Recording, file: Recordings, options: InputOptions) -> Recording:
    """Return one recording with the stated options applied."""
    if options.direction is not None and np.any(np.isnan(recording.direction)):
        recording = replace(recording, direction=options.direction)
    if options.n_avg is not None and recording.n_avg is None and recording.sd is None:
        recording = replace(recording, n_avg=options.n_avg)
    if options.amplitude == "rms" and not file.amplitude_stated and not recording.per:
        root = np.sqrt(2.0)
        sd = None if recording.sd is None else recording.sd * root
        recording = replace(recording, value=scaled(recording.value, root), sd=sd)
    if options.length_unit and not file.length_stated:
        recording = replace(recording, position_mm=recording.position_mm * LENGTHS[options.length_unit])
    return recording


def _metres(file: Recordings) -> Notice:
    """Report that positions were taken as metres, with their extent."""
    places = np.array([recording.position_mm for recording in file.recordings])
    places = places[np.all(np.isfinite(places), axis=1)]
    extent = " x ".join(f"{span:.4g}" for span in np.ptp(places, axis=0))
    text = (
        f"{file.file} does not say the unit of its positions: taken as metres they extend over {extent} mm. "
        f"Say {named('length_unit')} m, mm or um."
    )
    return Notice("length_unit_assumed", text)


def with_bodies(entries: Sequence[Entry], points: Points | None, options: InputOptions) -> list[Entry]:
    """Give every recording its body: by ``--body``, by its file, or by the points file.

    Raises
    ------
    KinematicsError
        A point of no body or of two, or a rule that holds for no point.
    """
    by_point: dict[str, list[str]] = {}
    for body, point in () if points is None else points.positions:
        by_point.setdefault(point, []).append(body)
    used: set[str] = set()
    assigned: list[Entry] = []
    faults: list[Fault] = []
    without: dict[str, list[str]] = {}
    for file, recording in entries:
        rules = [
            name for name, items in options.bodies if any(item.holds(file, recording.point) for item in items)
        ]
        used |= set(rules)
        names = list(dict.fromkeys([*rules, *([recording.body] if recording.body else [])]))
        if not names:
            names = by_point.get(recording.point, [])
        if len(names) > 1:
            step = f"Name each point once, by file where numbers repeat: {named('body')} base=base.uff:1-9"
            faults.append(
                Fault(f"point {recording.point}", "of one body", " and ".join(names), recording.where, step)
            )
        elif not names:
            without.setdefault(file, []).append(recording.point)
        else:
            assigned.append((file, replace(recording, body=names[0])))
    for file, unassigned in without.items():
        step = (
            f"Name them with {named('body')}, e.g. {named('body')} stapes=1-10 {named('body')} "
            f"base=11-19, or list them in {named('points')}"
        )
        faults.append(Fault(f"points {list_some(unassigned, 12)}", "of a body", "none", file, step))
    known = ", ".join(dict.fromkeys(recording.point for _, recording in entries))
    known = known if len(known) < 120 else f"{known[:117]}..."
    faults += [
        Fault(f"{{body}} {name}", f"points that were measured ({known})", "others", "", "Correct the numbers")
        for name in dict.fromkeys(name for name, _ in options.bodies)
        if name not in used
    ]
    raise_all(KinematicsError, list(dict.fromkeys(faults)))
    return assigned


def with_runs(entries: Sequence[Entry], options: InputOptions) -> tuple[list[Entry], list[Notice]]:
    """Give every recording its run: by ``--run``, by its file, else by what the files share.

    Files without names of runs that measure one point in one direction again are different excitations,
    each named after its file; files of different points are parts of one.
    """
    labelled: list[Entry] = []
    for file, recording in entries:
        files = [name for name, chosen in options.runs if is_file(chosen, file)]
        run = files[0] if files else ""
        if run and recording.run:
            run = f"{run} {recording.run}"
        labelled.append((file, replace(recording, run=run or recording.run)))
    unnamed = {file for file, recording in labelled if not recording.run}
    file_of: dict[tuple[object, ...], str] = {}
    again = False
    for file, recording in labelled:
        key = (
            recording.body,
            recording.point,
            (np.round(recording.direction, 6) + 0.0).tobytes(),  # -0.0 and 0.0 are one direction
            recording.run,
            recording.repeat,
            str(recording.level),
        )
        again |= file_of.setdefault(key, file) != file
    if not again:
        return [
            (file, replace(recording, run=recording.run or DEFAULT_RUN)) for file, recording in labelled
        ], []
    twice = [recording.run for _, recording in labelled if recording.run]
    assigned = []
    for file, recording in labelled:
        run = recording.run or Path(file).stem
        if (
            recording.run
            and not options.runs
            and len({f for f, other in labelled if other.run == recording.run}) > 1
        ):
            run = f"{Path(file).stem} {recording.run}"
        assigned.append((file, replace(recording, run=run)))
    if not unnamed and not twice:
        return assigned, []
    listed = ", ".join(dict.fromkeys(recording.run for _, recording in assigned))
    text = (
        f"the files measure the same points again: they are different runs, {listed}. {named('run')} "
        "names them."
    )
    return assigned, [Notice("runs_by_file", text)]
