"""The three stages of a study: scan -> motion -> fit. Each calls its room and writes into a folder."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import PipelineError
from pipeline.options import faults_in_study_words, fit_options, input_options, mass_options, motion_options
from pipeline.records import Told
from pipeline.study import Ldv, Study
from stapeskit.faults import Fault, StapeskitError, raise_all

if TYPE_CHECKING:
    from kinematics.measurement import Measurement
    from kinematics.registration.fiducials import Fiducials
    from kinematics.registration.icp_refine import Cloud
    from kinematics.registration.placement import Placement
    from kinematics.report.stapes_surface import Scenery
    from stapeskit.records.mass_record import MassRecord

_OWN = ("pipeline/stages.py", "pipeline/options.py")
MOTION_FILES, KD_FILE = ("dof.csv", "dof.h5", "dof.channels.csv"), "kd.json"


@dataclass(frozen=True)
class Workspace:
    """Where outputs stand during a run: new ones in ``fresh``, reused ones in ``out``."""

    out: Path
    fresh: Path

    def find(self, name: str) -> Path:
        """Return the present place of an output."""
        made = self.fresh / name
        return made if made.exists() else self.out / name


class Scan:
    """Scan to mass matrix and frames (`ct2mass`)."""

    name = "scan"
    table = "scan"
    title = "scan: bodies, frames, mass matrix"
    rooms = ("stapeskit", "ct_inertia", *_OWN)

    @staticmethod
    def inputs(study: Study) -> dict[str, Path | None]:
        """Return the files by role, the data files of headers among them."""
        from ct_inertia.readers.companions import with_data_files

        scan = study.scan
        names = ("labels", "calibration", "landmarks", "plate_fiducials")
        return with_data_files({"scan": scan.file} | {name: getattr(scan, name) for name in names})

    @staticmethod
    def parameters(study: Study, _work: Workspace) -> dict[str, Any]:
        """Return what else the outputs depend on."""
        return study.scan.model_dump(mode="json", exclude=set(_FILES))

    @staticmethod
    def run(study: Study, work: Workspace) -> tuple[list[str], Told]:
        """Write mass.json, surfaces and labels; return their names and what there is to tell."""
        from ct_inertia.ct2mass import ct2mass
        from ct_inertia.exports.mass_json import mass_json, write_outputs
        from ct_inertia.exports.output_files import labels_name
        from ct_inertia.report.sections import Pictured, mass_sections
        from stapeskit.provenance import Hashes

        options = mass_options(study.scan)
        hashes = Hashes(options.inputs.values())
        result = ct2mass(options)
        content = mass_json(result, hashes=hashes, labels_file=labels_name(work.out, options.labels))
        labelled = None if result.bodies is None else result.bodies.labels
        sections, notices = mass_sections(content, Pictured(result.stapes, result.plate, labelled))
        content["warnings"] = [*content["warnings"], *(notice.as_json() for notice in notices)]
        names = write_outputs(result, work.fresh, content)
        return names, Told(tuple(sections), (*result.notices, *notices))


class Motion:
    """Vibrometer points to rigid motion (`points2dof`)."""

    name = "motion"
    table = "ldv"
    title = "motion: points to degrees of freedom"
    rooms = ("stapeskit", "kinematics", *_OWN)

    @staticmethod
    def inputs(study: Study) -> dict[str, Path | None]:
        """Return the files by role."""
        from kinematics.readers import inputs_of

        names = ("fiducials", "plate_points", "bone_points", "mapping", "channels", "steps")
        beside = [path.with_name(path.name + ".toml") for path in study.ldv.files]
        return {
            **inputs_of(study.ldv.files, study.ldv.points),
            **{name: getattr(study.ldv, name) for name in names},
            **{path.name: path for path in beside if path.is_file()},
        }

    @staticmethod
    def parameters(study: Study, work: Workspace) -> dict[str, Any]:
        """Return what else the outputs depend on: of the scan only its frames, shape and mass distribution.

        The motion of the points does not depend on the density, so that another density reuses it.
        """
        from stapeskit.provenance import content_hash

        here = work.find("mass.json").parent
        mass = json.loads((here / "mass.json").read_text(encoding="utf-8"))
        values = mass["inertial_parameters"]["values_si"]
        names = ("scan_from_footplate", "scan_from_plate", "z_is", "anterior_from")
        labels = mass.get("labels_file") or "labels.nrrd"
        frames = {key: mass["frames"].get(key) for key in names}
        return {
            **study.ldv.model_dump(mode="json", exclude=set(_FILES)),
            "frames of the scan": [frames, mass["frames"].get("pose_covariance")],
            "mass distribution": [f"{value / values[0]:.7g}" for value in values],
            "surfaces": [
                content_hash(path) if path.exists() else None
                for path in (here / name for name in ("stapes.ply", "plate.ply", labels))
            ],
        }

    @staticmethod
    def run(study: Study, work: Workspace) -> tuple[list[str], Told]:
        """Write dof.csv, dof.h5 and dof.channels.csv; return their names and what there is to tell."""
        from kinematics.faults.verdicts import write_channels
        from kinematics.points2dof import points2dof
        from kinematics.report.sections import sections
        from stapeskit.provenance import record
        from stapeskit.records.mass_record import read_mass_record
        from stapeskit.records.motion_files import write_motion

        mass = read_mass_record(work.find("mass.json"))
        measurement, fiducials = read_measurement(study)
        placement = _placement(study, work, measurement, fiducials, mass)
        parameters = study.ldv.model_dump(mode="json", exclude=set(_FILES))
        provenance = record(Motion.inputs(study), {**parameters, "frames": "of the scan"})
        result = points2dof(measurement, placement, motion_options(study.ldv), mass, provenance)
        write_motion(work.fresh, "dof", result.motion)
        write_channels(work.fresh / "dof.channels.csv", result.channels)
        drawn = sections(result, _scenery(work, mass))
        return list(MOTION_FILES), Told(tuple(drawn), result.notices)


class Fit:
    """Motion and mass matrix to stiffness and damping (`dof2kd`)."""

    name = "fit"
    table = "fit"
    title = "fit: stiffness and damping"
    rooms = ("stapeskit", "fitting", *_OWN)

    @staticmethod
    def inputs(_study: Study) -> dict[str, Path | None]:
        """Return the files by role: none of the user's own."""
        return {}

    @staticmethod
    def parameters(study: Study, work: Workspace) -> dict[str, Any]:
        """Return what the outputs depend on: the files of the stages before, without their dates."""
        from stapeskit.provenance import content_hash

        mass = json.loads(work.find("mass.json").read_text(encoding="utf-8"))
        keys = ("frames", "inertial_parameters", "mass_matrix", "found", "warnings")
        return {
            **study.fit.model_dump(mode="json"),
            "mass.json": {key: mass.get(key) for key in keys},
            "dof.h5": content_hash(work.find("dof.h5")),
        }

    @staticmethod
    def run(study: Study, work: Workspace) -> tuple[list[str], Told]:
        """Write kd.json; return its name and what there is to tell."""
        from fitting.dof2kd import footplate_outline
        from fitting.kd import fit_kd
        from fitting.montecarlo import monte_carlo, monte_carlo_json, monte_carlo_section
        from fitting.report.kd_json import kd_json
        from fitting.report.sections import kd_sections
        from stapeskit.provenance import record
        from stapeskit.records.mass_record import read_mass_record
        from stapeskit.records.motion_files import read_motion

        mass_file, motion_file = work.find("mass.json"), work.find("dof.h5")
        mass, motion = read_mass_record(mass_file), read_motion(motion_file)
        options = fit_options(study.fit)
        fit = fit_kd(motion, mass.mass_matrix, options)
        refits = options.monte_carlo
        content = kd_json(fit, record({"motion": motion_file, "mass": mass_file}, options.parameters()))
        sections = kd_sections(fit, footplate_outline(mass))
        if refits:
            scatter = monte_carlo(fit, refits)
            content["monte_carlo"] = monte_carlo_json(fit, scatter)
            sections.append(monte_carlo_section(fit, scatter))
        text = json.dumps(content, indent=1) + "\n"
        (work.fresh / KD_FILE).write_text(text, encoding="utf-8")
        return [KD_FILE], Told(tuple(sections), fit.notices)


STAGES = (Scan, Motion, Fit)
_FILES = (
    "file",
    "calibration",
    "labels",
    "landmarks",
    "plate_fiducials",
    "points",
    "fiducials",
    "plate_points",
    "bone_points",
    "mapping",
    "channels",
    "steps",
)


def names_of_outputs(study: Study, out: Path) -> tuple[str, ...]:
    """Return the names that a study may write into its folder, the report apart."""
    from ct_inertia.exports.output_files import labels_name, result_names

    return (*result_names(labels_name(out, study.scan.labels)), *MOTION_FILES, KD_FILE)


def inputs_of(study: Study) -> tuple[Path, ...]:
    """Return every file and folder that a study names."""
    return tuple(path for stage in STAGES for path in stage.inputs(study).values() if path is not None)


def read_measurement(study: Study) -> tuple[Measurement, Fiducials | None]:
    """Read the vibrometer's table and the fiducials of a study.

    Raises
    ------
    KinematicsError
        What is wrong with them, row by row.
    """
    from kinematics.readers import read_measurement as read_files
    from kinematics.registration.fiducials import read_fiducials

    ldv = study.ldv
    fiducials = None if ldv.fiducials is None else read_fiducials(ldv.fiducials)
    tied = fiducials is not None or ldv.plate_points is not None
    frame = "vibrometer" if tied else ldv.frame or "footplate"
    measurement = read_files(ldv.files, ldv.points, frame, input_options(ldv))
    for axis, points_only in ((ldv.mirror, False), (ldv.mirror_points, True)):
        if axis is not None:
            measurement = measurement.mirrored(axis, points_only)
            fiducials = None if fiducials is None else fiducials.mirrored(axis)
    return measurement, fiducials


def _clouds(ldv: Ldv) -> dict[str, Cloud]:
    """Read the points on surfaces that a study names."""
    from kinematics.registration.surface_points import mirrored, read_surface_points

    named = {"plate": ldv.plate_points, "bone": ldv.bone_points}
    clouds = {kind: read_surface_points(path, kind) for kind, path in named.items() if path is not None}
    for axis in (ldv.mirror, ldv.mirror_points):
        if axis is not None:
            clouds = {kind: mirrored(cloud, axis) for kind, cloud in clouds.items()}
    return clouds


def _placement(
    study: Study, work: Workspace, measurement: Measurement, fiducials: Fiducials | None, mass: MassRecord
) -> Placement:
    from kinematics.registration.align import tie
    from kinematics.registration.scan_surfaces import ScanSurfaces

    clouds = _clouds(study.ldv)
    frame = study.ldv.frame or "footplate"
    surfaces = ScanSurfaces.beside(work.find("mass.json"), mass)
    return tie(measurement, fiducials, frame, mass, surfaces, clouds.get("plate"), clouds.get("bone"))


def check_inputs(study: Study) -> None:
    """Find what can be found wrong before the long work on the scan begins.

    Raises
    ------
    PipelineError
        Every fault of the options and of the vibrometer's files.
    """
    faults: list[Fault] = []
    checks: tuple[tuple[str, Callable[[], object]], ...] = (
        ("scan", lambda: mass_options(study.scan)),
        ("ldv", lambda: motion_options(study.ldv)),
        ("ldv", lambda: input_options(study.ldv)),
        ("fit", lambda: fit_options(study.fit)),
        ("ldv", lambda: _check_measurement(study)),
        ("ldv", lambda: _clouds(study.ldv)),
    )
    for table, check in checks:
        try:
            check()
        except StapeskitError as fault:
            faults += faults_in_study_words(fault.faults, table)
    raise_all(PipelineError, dict.fromkeys(faults))


def _check_measurement(study: Study) -> None:
    measurement, _ = read_measurement(study)
    bodies = [body.body for body in measurement.bodies]
    file = ", ".join(path.name for path in study.ldv.files)
    faults = [
        Fault(
            f"the body {name}",
            f"among those of the vibrometer table, {', '.join(bodies)}",
            "no row of it",
            file,
            f"Name the bodies with {key}",
        )
        for key, name in (("fit.structure", study.fit.structure), ("fit.base", study.fit.base))
        if name not in bodies
    ]
    wanted = [name for name in study.fit.dof if name not in study.ldv.dof]
    if wanted:
        faults.append(
            Fault("fit.dof", f"among ldv.dof, {', '.join(study.ldv.dof)}", ", ".join(wanted), "study")
        )
    raise_all(PipelineError, faults)


def _scenery(work: Workspace, mass: MassRecord) -> Scenery:
    """Return the stapes in footplate axes, to be drawn behind the points."""
    from ct_inertia.surface.surface import read_surface
    from kinematics.report.stapes_surface import scenery_of

    surface = read_surface(work.find("stapes.ply"))
    return scenery_of(mass.raw["frames"], mass.raw.get("found", {}), surface.vertices_mm, surface.faces)


def results(work: Workspace) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Return the content of mass.json and kd.json."""
    mass, kd = (json.loads(work.find(name).read_text(encoding="utf-8")) for name in ("mass.json", "kd.json"))
    return mass, kd
