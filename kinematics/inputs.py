"""The files of a measurement: those beside it that belong to it, and every cheap check of all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from kinematics.fit.reference import parse_reference
from kinematics.measurement import LeftOut, Measurement
from kinematics.options import NONE, MotionOptions
from kinematics.place.fiducials import Fiducials, read_fiducials
from kinematics.place.placement import check_frame, fit_fiducials
from kinematics.readers.assemble import read_measurement
from kinematics.readers.stated_by_user import FileFacts
from stapeskit.faults import Fault, StapeskitError, collect_faults, list_some, raise_all
from stapeskit.records.mass_record import MassRecord

_MOST_CHECKED_BYTES = 4_000_000  # of text: so much is read whole in a quarter of a second


@dataclass(frozen=True)
class Found:
    """Options and mass with what was found beside the measurement; ``taken`` holds what was, by role."""

    options: MotionOptions
    mass: Path | None
    taken: dict[str, Path]


def with_companions(options: MotionOptions, mass: Path | str | None = None) -> Found:
    """Add the files beside the first vibrometer file that were not given; ``none`` turns one off.

    Raises
    ------
    StapeskitError
        Several folders hold a mass.json, and none was chosen.

    Notes
    -----
    Fiducials are not looked for where a frame is given. A file that is itself given as measurement is none.
    """
    folder = options.file[0].absolute().parent
    measured = {path.absolute() for path in options.file}
    given: dict[str, Any] = {
        "points": options.points,
        "fiducials": options.fiducials or options.frame,
        "mass": mass,
    }
    taken: dict[str, Path] = {}
    for role, name in {"points": "points.csv", "fiducials": "fiducials.csv", "mass": "mass.json"}.items():
        found = [folder / name] if (folder / name).is_file() else []
        if role == "mass" and not found:
            found = sorted(folder.glob(f"*_mass/{name}"))
        if given[role] is None and len(found) > 1:
            got = ", ".join(str(path.relative_to(folder)) for path in found)
            step = "Choose one with --mass FILE, or none with --mass none"
            raise StapeskitError.of("the mass.json beside the measurement", "a single one", got, "", step)
        if given[role] is None and found and found[0] not in measured:
            taken[role] = found[0]
    update: dict[str, Any] = {role: path for role, path in taken.items() if role != "mass"}
    chosen = None if mass in (None, NONE) else Path(mass)
    return Found(replace(options, **update), taken.get("mass", chosen), taken)


def read_inputs(options: MotionOptions, mass: MassRecord | None) -> tuple[Measurement, Fiducials | None]:
    """Read every file of a measurement; their faults come together."""
    faults: list[Fault] = []
    fiducials = _read_fiducials(options, faults)
    with collect_faults(faults):
        if fiducials is not None or options.fiducials_file is None:
            check_frame(fiducials, options.frame or "footplate", mass)
    with collect_faults(faults):
        measurement = _read_channels(options)
        for body in measurement.bodies:
            _ = body.arms_m
    raise_all(faults)
    if options.mirror is not None:
        measurement = measurement.mirrored(options.mirror)
        fiducials = None if fiducials is None else fiducials.mirrored(options.mirror)
    return measurement, fiducials


def _read_fiducials(options: MotionOptions, faults: list[Fault]) -> Fiducials | None:
    with collect_faults(faults):
        return None if options.fiducials_file is None else read_fiducials(options.fiducials_file)
    return None


def _read_channels(options: MotionOptions) -> Measurement:
    """Read the vibrometer files, without the channels that the user leaves out."""
    facts = file_facts(options)
    measurement = read_measurement(options.file, options.points_file, options.source_frame, facts)
    return without_channels(measurement, options.leave_out)


def without_channels(measurement: Measurement, names: Sequence[str]) -> Measurement:
    """Return the measurement without the channels BODY:POINT:BEAM, or points BODY:POINT, of these names.

    Raises
    ------
    StapeskitError
        A name is that of no channel, or no channel of a body is left.
    """
    wanted = {name.replace(" ", "") for name in names}
    known: dict[str, None] = {}
    faults: list[Fault] = []
    bodies, left_out = [], [*measurement.left_out]
    for body in measurement.bodies:
        keys = [body.channel_key(channel) for channel in range(len(body.points))]
        points = [key.rpartition(":")[0] for key in keys]
        known |= dict.fromkeys([*points, *keys])
        kept = [k for k in range(len(keys)) if keys[k] not in wanted and points[k] not in wanted]
        gone = sorted({*range(len(keys))} - {*kept})
        left_out += [LeftOut(body.body, body.points[k], body.file_directions[k]) for k in gone]
        if not kept:
            faults.append(Fault(f"--leave-out of body {body.body}", "some of its channels", "all of them"))
        bodies.append(body.part(kept) if gone else body)
    for name in sorted(wanted - {*known}):
        near = [key for key in known if key.startswith(name.split(":")[0] + ":")] or known
        want = f"BODY:POINT or BODY:POINT:BEAM, as {list_some(near, 12)}"
        faults.append(Fault(f"--leave-out {name}", want, name))
    raise_all(faults)
    return replace(measurement, bodies=tuple(bodies), left_out=tuple(left_out))


def check_inputs(options: MotionOptions) -> None:
    """Look at everything that is cheap to look at, without a fit: files, columns, units, names, fiducials.

    Raises
    ------
    StapeskitError
        Every fault that shows.
    """
    from kinematics.readers.formats import format_of
    from kinematics.readers.points import read_points
    from kinematics.readers.text import TEXT_ENDINGS

    faults: list[Fault] = []
    fiducials = _read_fiducials(options, faults)
    with collect_faults(faults):
        if fiducials is not None:
            fit_fiducials(fiducials)
    small = [path for path in options.file if path.is_file() and path.suffix.lower() in TEXT_ENDINGS]
    size = sum(path.stat().st_size for path in small)
    if len(small) == len(options.file) and size < _MOST_CHECKED_BYTES and options.channels is None:
        with collect_faults(faults):
            measurement = _read_channels(options)
            names = tuple(body.body for body in measurement.bodies)
            if options.reference:
                parse_reference(options.reference, names, options.dof)
    else:
        for path in options.file:
            with collect_faults(faults):
                format_of(path)
        with collect_faults(faults):
            if options.points_file is not None:
                read_points(options.points_file)
    raise_all(faults)


def file_facts(options: MotionOptions) -> FileFacts:
    """Return what the options say about the files."""
    return FileFacts(**{entry.name: getattr(options, entry.name) for entry in fields(FileFacts)})
