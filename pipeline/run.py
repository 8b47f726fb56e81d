"""Run one study: mass, motion, stiffness and damping, report; stages that would not change are reused.

Each stage's files appear as soon as it ends, so that a later stage that fails costs nothing of them. A
result file carries what it was made from (hashes of inputs, parameters, versions): a stage whose files are
as it left them and would be made from the same again is not repeated.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.study import Study, in_keys, read_study
from stapeskit.command import no_progress
from stapeskit.faults import Fault, StapeskitError, collect_faults, raise_all
from stapeskit.outputs import Outputs
from stapeskit.provenance import record, sha256, versions
from stapeskit.records.mass_file import read_mass_json
from stapeskit.records.mass_record import MassRecord
from stapeskit.results import Result
from stapeskit.warnings import Notice, once

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from ct_inertia.report.pictured import Pictured
    from ct_inertia.results import MassResult
    from fitting.result import KDFit
    from kinematics.results import MotionResult
    from stapeskit.command import Progress

FILES = {
    "scan": ("mass.json", "stapes.ply", "labels.seg.nrrd"),
    "motion": ("dof.csv", "dof.h5", "dof.channels.csv"),
    "fit": ("kd.json", "kd.mat", "kd.csv"),
    "report": ("report.html",),
}
"""Files that each stage may write."""

Tell = Callable[[Sequence[Notice]], None]


@dataclass(frozen=True, repr=False)
class StudyResult(Result):
    """A finished study: mass, motion, stiffness and damping, and the folder that they are in."""

    study: Study
    out: Path
    measured: MassRecord
    moved: MotionResult
    fit: KDFit
    measured_now: MassResult | None = None  # in memory; none where its files are those of an earlier run
    reused: tuple[str, ...] = ()  # stages that were not repeated

    @property
    def title(self) -> str:
        """What this is."""
        return f"Study {self.name}"

    @property
    def name(self) -> str:
        """Name of the ear."""
        return self.study.name

    @property
    def about(self) -> dict[str, Any]:
        """What the study states of the ear."""
        return self.study.about.of_ear()

    @property
    def mass(self) -> Mapping[str, Any]:
        """Content of mass.json."""
        return self.measured.raw

    @cached_property
    def pictured(self) -> Pictured:
        """Surfaces and slices that the report draws."""
        from ct_inertia.report.pictured import pictured_from

        if self.measured_now is not None:
            return self.measured_now.pictured
        return pictured_from(self.out, self.mass, self.study.scan.file)

    @cached_property
    def kd(self) -> dict[str, Any]:
        """Content of kd.json."""
        return self.fit.content()

    @property
    def notices(self) -> tuple[Notice, ...]:
        """Every warning of all stages, once."""
        return once([*self.measured.notices, *self.moved.notices, *self.fit.notices])

    def summary(self) -> Sequence[tuple[str, str]]:
        """Return verdict, mass, K, D and modes."""
        from pipeline.report import summary_rows

        return summary_rows(self)

    def to_frame(self) -> DataFrame:
        """Return the table of K and D."""
        return self.fit.to_frame()

    def plot(self) -> Figure:
        """Draw measured and fitted responses."""
        return self.fit.plot()

    def write(self, folder: Path | str, *, force: bool = False) -> tuple[Path, ...]:
        """Write report.html into another folder.

        Raises
        ------
        StapeskitError
            A file of another origin has its name.
        """
        from pipeline.report import study_page

        outputs = Outputs(
            "scan2kd report", Path(folder), FILES["report"], self.study.inputs().values(), force
        )
        with outputs.staged() as stage:
            study_page(self).write(stage / FILES["report"][0])
        return (outputs.folder / FILES["report"][0],)


def scan2kd(study: Path | str, *, out: Path | str | None = None, force: bool = False) -> StudyResult:
    """Run a study: scan to mass, points to motion, motion to stiffness and damping, and the report.

    Parameters
    ----------
    out : path, optional
        Folder of the results; default ``<study name>_out`` in the current folder.
    force : bool
        Repeat every stage, and replace files that are not known as written by scan2kd.

    Raises
    ------
    StapeskitError
        What is wrong with the study file or the files that it names. What finished stages have written stays.

    Examples
    --------
    >>> result = scan2kd("study.toml")  # doctest: +SKIP
    """
    path = Path(study)
    return run_study(path, Path(f"{path.stem}_out") if out is None else Path(out), force=force)


def run_study(
    path: Path,
    out: Path,
    *,
    force: bool = False,
    progress: Progress = no_progress,
    tell: Tell = lambda _notices: None,
) -> StudyResult:
    """Run a study into a folder; see `scan2kd`.

    ``progress`` gets the stage at work, ``tell`` the warnings of each stage as it ends, also where a later
    stage fails.
    """
    from ct_inertia.ct2mass import measure_mass
    from fitting.dof2kd import fit_of
    from fitting.mass import inertia_of
    from kinematics.points2dof import measure_motion
    from pipeline.report import study_page

    study = read_study(Path(path))
    out = Path(out).absolute()
    read = list(study.inputs().values())
    outputs = {stage: Outputs(f"scan2kd {stage}", out, names, read, force) for stage, names in FILES.items()}
    check_study(study, outputs.values())
    mass, reused = None, []

    mass_file = out / FILES["scan"][0]
    same = not force and outputs["scan"].unchanged()
    if same and _is_made_from(json.loads(mass_file.read_text(encoding="utf-8"))["provenance"], study.scan):
        measured = read_mass_json(mass_file)
        reused.append("scan")
    else:
        with study.scan.as_keys():
            mass = measure_mass(study.scan, progress)
        mass = replace(mass, notices=in_keys(mass.notices, type(study.scan)))
        with outputs["scan"].staged() as stage:
            mass.write_into(stage, report=False)
            for path in stage.iterdir():  # of ct2mass: surfaces and voxels that few have a use for here
                if path.name not in FILES["scan"]:
                    path.unlink()
        measured = read_mass_json(mass_file)
    tell(measured.notices)

    with study.ldv.as_keys():
        moved = measure_motion(study.ldv, measured, progress)
    motion = replace(moved.motion, notices=in_keys(moved.notices, type(study.ldv)))
    moved = replace(moved, motion=motion)
    tell(moved.notices)
    with outputs["motion"].staged() as stage:
        moved.write_into(stage, report=False)

    progress("fitting stiffness and damping")
    inertia = inertia_of(measured, study.fit.dof)
    inputs = {"motion": out / "dof.h5", "mass": mass_file, "study": study.path}
    provenance = record(inputs, study.fit.given())
    with study.fit.as_keys():
        fit = fit_of(moved.motion, inertia, study.fit, provenance, "dof.h5", confirmed=study.about.confirmed)
    fit = replace(fit, notices=in_keys(fit.notices, type(study.fit)))
    tell(fit.notices)
    with outputs["fit"].staged() as stage:
        fit.write_into(stage, report=False)

    progress("drawing the report")
    result = StudyResult(study, out, measured, moved, fit, mass, tuple(reused))
    with outputs["report"].staged() as stage:
        study_page(result).write(stage / FILES["report"][0])
    return result


def check_study(study: Study, outputs: Iterable[Outputs] = ()) -> None:
    """Look at everything that is cheap to look at, before anything is computed: outputs, headers, tables.

    Raises
    ------
    StapeskitError
        Every fault that shows without computing: files, columns, units, names of bodies and fiducials.
    """
    from ct_inertia.ct2mass import check_inputs as check_scan
    from kinematics.inputs import check_inputs as check_measurement

    faults: list[Fault] = []
    for each in outputs:
        with collect_faults(faults):
            each.check()
    with collect_faults(faults), study.scan.as_keys():
        check_scan(study.scan)
    with collect_faults(faults), study.ldv.as_keys():
        check_measurement(study.ldv)
    with collect_faults(faults):
        _check_plate(study)
    raise_all(faults)


def _check_plate(study: Study) -> None:
    """Refuse coordinates of a plate that nothing will show: a mesh is of the stapes alone."""
    from kinematics.place.fiducials import read_fiducials

    if study.scan.is_mesh and study.scan.plate_fiducials is None:
        file = study.ldv.fiducials_file
        frame = str(study.ldv.frame) if file is None else read_fiducials(file).frame
        if frame == "plate":
            expected = "scan or footplate where the scan is a mesh, which has no plate"
            step = "Mark the fiducials in the scan (frame scan), or give scan.plate_fiducials"
            where = "" if file is None else file.name
            raise StapeskitError.of("the frame of the measurement", expected, frame, where, step)


def _is_made_from(provenance: Mapping[str, Any], options: Any) -> bool:
    """Return whether a result of these inputs, parameters and versions would be the same again."""
    stated = provenance.get("inputs") or {}
    inputs: dict[str, Path] = dict(options.inputs)
    given, before = options.given(), provenance.get("parameters") or {}
    places = {str(path) for path in inputs.values()}
    moved = {name for name, value in given.items() if str(value) in places}  # their content is compared below
    if provenance.get("versions") != versions() or before.keys() != given.keys():
        return False
    if any(before[name] != given[name] for name in given.keys() - moved):
        return False
    if not set(inputs) <= set(stated):
        return False
    beside = next(iter(inputs.values())).parent  # where files that a header names are
    paths = {role: inputs.get(role, beside / entry["file"]) for role, entry in stated.items()}
    hashes = {role: f"sha256:{sha256(path)}" for role, path in paths.items() if path.exists()}
    return all(hashes.get(role) == entry.get("hash") for role, entry in stated.items())
