"""The measurement that one or several files hold.

Notes
-----
The reader is chosen by the table `kinematics.readers.formats.FORMATS`. A tidy table alone takes the
short way through `kinematics.tidy.ldv_csv`; with other files it becomes recordings like them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.measurement import Measurement
from legacy.kinematics.readers.input_options import SERIES, InputOptions
from legacy.kinematics.readers.recording import Recording, Recordings
from legacy.kinematics.readers.text import openable
from legacy.stapeskit.faults import Fault, Place, collect_faults, raise_all

if TYPE_CHECKING:
    from legacy.kinematics.readers.formats import Format


def read_measurement(
    paths: Sequence[Path],
    points: Path | None = None,
    frame: str = "vibrometer",
    options: InputOptions | None = None,
) -> Measurement:
    """Read one or several vibrometer files as one measurement.

    Parameters
    ----------
    paths : sequence of Path
        Files and folders of any known kind.
    points : Path, optional
        CSV with the positions, and with the bodies of points whose files do not name them.
    frame : str
        The frame in which positions and directions are given.
    options : InputOptions, optional

    Raises
    ------
    KinematicsError
        What is wrong with the files; the faults of all of them together.
    """
    from legacy.kinematics.readers.assemble_measurement import assemble
    from legacy.kinematics.readers.formats import TIDY
    from legacy.kinematics.readers.recognise_format import format_of
    from legacy.kinematics.tidy.ldv_csv import read_ldv

    # the folder "." has no name, by which messages, runs and bodies call a file
    paths = [path if path.name else path.resolve() for path in map(Path, paths)]
    options = options or InputOptions()
    _check_names(paths)
    formats: list[Format] = []
    unknown: list[Fault] = []
    for path in paths:
        with collect_faults(unknown), openable(path):
            formats.append(format_of(path, options.mapping is not None))
    raise_all(KinematicsError, unknown)
    if [entry.name for entry in formats] == [TIDY]:
        _refuse_options(options, paths[0])
        measurement = read_ldv(paths[0], points, frame)
        return replace(measurement, inputs=inputs_of(paths, points))
    raise_all(KinematicsError, _find_unused_options(options, formats))
    files: list[Recordings] = []
    faults: list[Fault] = []
    for path, entry in zip(paths, formats, strict=True):
        with collect_faults(faults), openable(path):
            if entry.name == TIDY:
                files.append(_as_recordings(read_ldv(path, points, frame), path))
            else:
                files.append(entry.read(path, options))
    listed = None
    if points is not None:
        from legacy.kinematics.tidy.points_csv import read_points

        with collect_faults(faults):
            listed = read_points(points)
    if options.series is not None and not faults and not any(recordings.from_series for recordings in files):
        faults.append(Fault(SERIES, "left out: no file holds time series", "them"))
    raise_all(KinematicsError, dict.fromkeys(faults))
    statements = tuple(
        f"{recordings.file}: {_units_of(recordings, options)}"
        for recordings in files
        if recordings.frame_units
    )
    return replace(assemble(files, listed, options, frame), inputs=inputs_of(paths, points), said=statements)


def _units_of(recordings: Recordings, options: InputOptions) -> str:
    """Return the axes and units of a file, with the unit of length that was stated for it."""
    if recordings.length_stated or not options.length_unit:
        return recordings.frame_units
    return recordings.frame_units.replace("as metres", f"as {options.length_unit}, as stated")


def inputs_of(paths: Sequence[Path], points: Path | None) -> dict[str, Path]:
    """Return the files by their role: ``ldv``, ``ldv 2`` ... and ``points``."""
    roles = {"ldv" if number == 0 else f"ldv {number + 1}": path for number, path in enumerate(paths)}
    return roles if points is None else {**roles, "points": Path(points)}


def _check_names(paths: Sequence[Path]) -> None:
    names = [path.name for path in paths]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        step = "Rename one of them: runs and bodies are identified by the names of files"
        raise KinematicsError.of(
            "the names of the vibrometer files", "different", ", ".join(twice) + " twice", "", step
        )


def _find_unused_options(options: InputOptions, formats: Sequence[Format]) -> list[Fault]:
    """List options on time series and variables that no file needs."""
    faults = []
    listed = options.series is not None and options.series.channels is not None
    if options.series is not None and options.series.channels is not None:
        if not any(entry.series == "channels" for entry in formats):
            want = "left out: no file holds time series that need it"
            faults.append(Fault("{channels}", want, options.series.channels.name))
    elif options.series is not None and not any(entry.series == "described" for entry in formats):
        faults.append(Fault(SERIES, "given with {channels} FILE", "alone"))
    if options.mapping is not None and (listed or not any("mapping" in entry.options for entry in formats)):
        want = "left out: no MATLAB or HDF5 file with spectra and no wide table is read"
        faults.append(Fault("{mapping}", want, options.mapping.name))
    return faults


def _refuse_options(options: InputOptions, path: Path) -> None:
    columns = {
        "{body}": "column body says it",
        "{run}": "column run says it",
        "{beam}": "columns of the direction say it",
        "{amplitude}": "units of its columns say it",
        "{length_unit}": "columns x_mm, y_mm, z_mm say it",
        "{n_avg}": "column n_avg says it",
        "{mapping}": "header says it",
        "{channels}": "columns say it (those of time series have time_s)",
        SERIES: "columns say it (those of time series have time_s)",
    }
    step = "Leave it out"
    raise_all(
        KinematicsError,
        [
            Fault(name, f"left out for a tidy table, whose {columns[name]}", "it", path.name, step)
            for name in options.stated_names
        ],
    )


def _as_recordings(measurement: Measurement, path: Path) -> Recordings:
    """Turn a tidy table into recordings, to be joined with other files."""
    rate = (2j * np.pi * measurement.freq_hz) ** measurement.order
    recordings = []
    for body in measurement.bodies:
        for run, name in enumerate(measurement.runs):
            take = measurement.takes[run] if measurement.takes else None
            for channel, point in enumerate(body.points):
                value = body.displacement[run, channel] * rate
                there = ~np.isnan(value.real)
                if not np.any(there):
                    continue
                sd = None if body.sd is None else (body.sd[run, channel] * np.abs(rate))[there]
                recordings.append(
                    Recording(
                        point,
                        measurement.freq_hz[there],
                        value[there],
                        measurement.order,
                        Place(path.name, detail=f"point {point}"),
                        run="" if name == "1" else name if take is None else take.run,
                        body=body.body,
                        position_mm=body.positions_mm[channel],
                        direction=body.reported_directions[channel],
                        sd=sd,
                        relative=body.relative,
                        repeat="" if take is None else take.repeat,
                        level=float("nan") if take is None else take.level,
                    )
                )
    return Recordings(
        tuple(recordings), measurement.notices, "as its columns say", path.name, amplitude_stated=True
    )
