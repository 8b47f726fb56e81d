"""Read a measurement and tie it to the footplate: the one way of command, study and notebook."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.input_options import InputOptions

if TYPE_CHECKING:
    from legacy.kinematics.fit_options import Options
    from legacy.kinematics.measurement import Measurement
    from legacy.kinematics.options import LdvOptions
    from legacy.kinematics.registration.fiducials import Fiducials
    from legacy.kinematics.registration.icp_refine import Cloud
    from legacy.kinematics.results import MotionResult
    from legacy.stapeskit.records.measured_mass import MassInput, MeasuredMass


def files_by_role(files: Sequence[Path], named: Mapping[str, Path | None]) -> dict[str, Path | None]:
    """Return every file that is read, by its role, those that belong to a vibrometer file included.

    Parameters
    ----------
    files : sequence of Path
        Of the vibrometer.
    named : mapping of str to Path or None
        The others by the names of their options: ``LdvOptions.input_files``.
    """
    from legacy.kinematics.readers.measurement_files import inputs_of
    from legacy.kinematics.readers.recognise_format import companion_files

    roles: dict[str, Path | None] = {**inputs_of(files, None), **named}
    for other in (other for path in files for other in companion_files(path)):
        role, number = other.name, 2
        while role in roles and roles[role] != other:
            role, number = f"{other.name} {number}", number + 1
        roles[role] = other
    return roles


@dataclass(frozen=True)
class MotionInputs:
    """The files of a measurement and the coordinates that they are in.

    Attributes
    ----------
    files : tuple of Path
        Vibrometer files and folders.
    frame : str or None
        ``footplate`` (default), ``plate`` or ``scan``: of coordinates that nothing ties to the footplate.
    mirror, mirror_points : str or None
        Axis ``x``, ``y`` or ``z`` of left-handed coordinates to reverse: of positions and beams, or of
        positions alone.
    reading : InputOptions
        What the vibrometer files do not say themselves.
    leave_out : tuple of str
        Channels that are not used, BODY:POINT or BODY:POINT:BEAM.
    """

    files: tuple[Path, ...]
    points: Path | None = None
    fiducials: Path | None = None
    plate_points: Path | None = None
    bone_points: Path | None = None
    frame: str | None = None
    mirror: str | None = None
    mirror_points: str | None = None
    reading: InputOptions = field(default_factory=InputOptions)
    leave_out: tuple[str, ...] = ()

    @property
    def by_role(self) -> dict[str, Path | None]:
        """Every file that is read, by its role; see `files_by_role`."""
        series = self.reading.series
        named = {
            "points": self.points,
            "fiducials": self.fiducials,
            "plate_points": self.plate_points,
            "bone_points": self.bone_points,
            "mapping": self.reading.mapping,
            "channels": None if series is None else series.channels,
            "steps": None if series is None else series.steps,
        }
        return files_by_role(self.files, named)

    @property
    def source_frame(self) -> str:
        """The frame that positions and directions are given in."""
        tied = self.fiducials is not None or self.plate_points is not None
        return "vibrometer" if tied else self.frame or "footplate"


@dataclass(frozen=True)
class MeasurementInputs:
    """What was read: readings, fiducials, and points on surfaces by kind (``plate``, ``bone``)."""

    measurement: Measurement
    fiducials: Fiducials | None = None
    clouds: Mapping[str, Cloud] = field(default_factory=dict)

    def mirrored(self, axis: str, points_only: bool = False) -> MeasurementInputs:
        """Return all of it with one axis of left-handed coordinates reversed."""
        from legacy.kinematics.registration.surface_points import mirrored

        return MeasurementInputs(
            self.measurement.mirrored(axis, points_only),
            None if self.fiducials is None else self.fiducials.mirrored(axis),
            {kind: mirrored(cloud, axis) for kind, cloud in self.clouds.items()},
        )


def read_inputs(inputs: MotionInputs) -> MeasurementInputs:
    """Read every file of a measurement, each once.

    Raises
    ------
    KinematicsError
        What is wrong with the files, row by row, or a channel to be left out that they do not hold.
    """
    from legacy.kinematics.exclude_channels import without_channels
    from legacy.kinematics.readers.measurement_files import read_measurement
    from legacy.kinematics.registration.fiducials import read_fiducials
    from legacy.kinematics.registration.surface_points import read_surface_points
    from legacy.stapeskit.faults import Fault, collect_faults, raise_all

    faults: list[Fault] = []
    fiducials: Fiducials | None = None
    clouds: dict[str, Cloud] = {}
    if inputs.fiducials is not None:
        with collect_faults(faults):
            fiducials = read_fiducials(inputs.fiducials)
    for kind, path in (("plate", inputs.plate_points), ("bone", inputs.bone_points)):
        if path is not None:
            with collect_faults(faults):
                clouds[kind] = read_surface_points(path, kind)
    with collect_faults(faults):
        measurement = read_measurement(inputs.files, inputs.points, inputs.source_frame, inputs.reading)
    raise_all(KinematicsError, dict.fromkeys(faults))
    read = MeasurementInputs(without_channels(measurement, inputs.leave_out), fiducials, clouds)
    for axis, points_only in ((inputs.mirror, False), (inputs.mirror_points, True)):
        if axis is not None:
            read = read.mirrored(axis, points_only)
    return read


def motion_of(
    inputs: MotionInputs,
    read: MeasurementInputs,
    options: Options,
    mass: MeasuredMass | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> MotionResult:
    """Tie a measurement to the footplate and fit the motion of its bodies.

    Parameters
    ----------
    read : MeasurementInputs
        From `read_inputs`.
    mass : MeasuredMass, optional
        Frames and surfaces of the scan.
    provenance : mapping, optional
        Carried along in the result.

    Raises
    ------
    KinematicsError
        What `align_to_scan` and `points2dof` refuse.
    """
    from legacy.kinematics.points2dof import points2dof
    from legacy.kinematics.registration.align_to_scan import align_to_scan
    from legacy.kinematics.registration.scan_surfaces import ScanSurfaces
    from legacy.kinematics.results import MotionResult
    from legacy.stapeskit.results import extend_result

    record = None if mass is None else mass.record
    surfaces = None if mass is None else ScanSurfaces.of(mass)
    placement = align_to_scan(
        read.measurement,
        read.fiducials,
        inputs.frame or "footplate",
        record,
        surfaces,
        read.clouds.get("plate"),
        read.clouds.get("bone"),
    )
    result = points2dof(read.measurement, placement, options, record, provenance)
    read_files = (*inputs.by_role.values(), None if mass is None else mass.file)
    files = tuple(Path(path).absolute() for path in read_files if path is not None)
    return extend_result(MotionResult, result, mass=record, surfaces=surfaces, files=files)


def motion_inputs(options: LdvOptions) -> MotionInputs:
    """Return the files that the options name, and the coordinates that they are in.

    Raises
    ------
    KinematicsError
        What the options say about the files cannot be read.
    """
    from legacy.kinematics.readers.from_options import input_options

    return MotionInputs(
        files=options.ldv,
        points=options.points,
        fiducials=options.fiducials,
        plate_points=options.plate_points,
        bone_points=options.bone_points,
        frame=options.frame,
        mirror=options.mirror,
        mirror_points=options.mirror_points,
        reading=input_options(options),
        leave_out=options.leave_out,
    )


def measure(
    options: LdvOptions,
    inputs: MotionInputs,
    given_mass: MassInput | None = None,
    command: list[str] | None = None,
) -> MotionResult:
    """Read, tie and fit what the options describe.

    Parameters
    ----------
    inputs : MotionInputs
        From `motion_inputs`.
    given_mass : path, MeasuredMass, or result of ct2mass, optional
    command : list of str, optional
        The words of the command, for the provenance.

    Raises
    ------
    KinematicsError
        What `read_inputs` and `motion_of` refuse, or a file that changes while it is read.
    """
    from legacy.kinematics.calibrated import calibrated
    from legacy.kinematics.fit_options import fit_options
    from legacy.stapeskit.input_changes import refuse_changes
    from legacy.stapeskit.provenance import record
    from legacy.stapeskit.records.measured_mass import measured_mass

    chosen = fit_options(options)
    mass_file = Path(given_mass) if isinstance(given_mass, str | Path) else None
    with refuse_changes((*inputs.by_role.values(), mass_file), KinematicsError):
        mass = None if given_mass is None else measured_mass(given_mass)
        read = read_inputs(inputs)
        files = {**inputs.by_role, "mass": None if mass is None else mass.provenance_input}
        tied = inputs.source_frame == "vibrometer"
        parameters = {**options.parameters(), "frame": None if tied else inputs.source_frame}
        provenance = record(files, parameters, calibrated.version(), command)
    return motion_of(inputs, read, chosen, mass, provenance)
