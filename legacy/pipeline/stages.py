"""The table of stages: scan -> motion -> fit. Each reads a folder and writes a folder; see `run_stage`."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from legacy.pipeline.stage_records import StageReport
from legacy.pipeline.study import Study, read_study, words
from legacy.pipeline.workspace import Workspace
from legacy.stapeskit.faults import translate_option_names
from legacy.stapeskit.input_changes import InputStates, refuse_changes

if TYPE_CHECKING:
    from legacy.kinematics.measure_motion import MeasurementInputs

MOTION_FILES, KD_FILE = ("dof.csv", "dof.h5", "dof.channels.csv"), "kd.json"
_OWN_CODE = ("pipeline/stages.py", "pipeline/workspace.py")


@dataclass(frozen=True)
class Stage:
    """One step of a study.

    Attributes
    ----------
    table : str
        Table of the study file that holds its options.
    rooms : tuple of str
        Packages and files whose code its outputs depend on; a function of pipeline that it calls stands in
        one of `_OWN_CODE`.
    inputs : callable
        From a study to the user's files by role.
    outputs : callable
        From a study and its output folder to the names of the files that it may write.
    parameters : callable
        From a study and a workspace to what else its outputs depend on, JSON-able: its options, and of the
        results of stages before it what it reads, or their hash. What is not here or in ``inputs`` can
        change without a new run.
    run : callable
        From a study and a workspace, which has the results of the stages before, to the names of the files
        written and what the report shows of them.
    """

    name: str
    title: str
    table: str
    rooms: tuple[str, ...]
    inputs: Callable[[Study], Mapping[str, Path | None]]
    outputs: Callable[[Study, Path], tuple[str, ...]]
    parameters: Callable[[Study, Workspace], dict[str, Any]]
    run: Callable[[Study, Workspace], tuple[list[str], StageReport]]


def run_stage(name: str, study_file: Path, folder_in: Path, folder_out: Path) -> list[str]:
    """Run one stage anywhere: read the results of the stages before from a folder, write into another.

    Parameters
    ----------
    name : str
        ``scan``, ``motion`` or ``fit``.

    Returns
    -------
    list of str
        Names of the files that were written.

    Raises
    ------
    StapeskitError
        The study, or a file that it names, is at fault.
    """
    stage = next(stage for stage in STAGES if stage.name == name)
    with translate_option_names(words(stage.table)):
        names, _ = stage.run(read_study(study_file), Workspace(Path(folder_in), Path(folder_out)))
    return names


def inputs_of(study: Study) -> tuple[Path, ...]:
    """Return every file and folder that a study names."""
    named = [study.study.truth, *(path for stage in STAGES for path in stage.inputs(study).values())]
    return tuple(path for path in named if path is not None)


def names_of_outputs(study: Study, out: Path) -> tuple[str, ...]:
    """Return the names that a study may write into its folder, without the report."""
    return tuple(name for stage in STAGES for name in stage.outputs(study, out))


def measurement_of(study: Study, work: Workspace) -> MeasurementInputs:
    """Return readings, fiducials and surface points of a study, read once a run, and again after a change.

    Raises
    ------
    StapeskitError
        What is wrong with the files.
    """
    from legacy.kinematics.measure_motion import motion_inputs, read_inputs

    inputs = motion_inputs(study.ldv)
    files = tuple(inputs.by_role.values())

    def read() -> tuple[InputStates, MeasurementInputs]:
        with refuse_changes(files) as states:
            return states, read_inputs(inputs)

    states, measurement = work.once("measurement", read)
    if states != InputStates.of(files):
        # it was read before the scan; the hashes of this stage are those of now
        states, measurement = read()
        work.keep("measurement", (states, measurement))
    return measurement


def _scan_outputs(study: Study, out: Path) -> tuple[str, ...]:
    from legacy.ct_inertia.exports.output_files import labels_name, result_names

    return result_names(labels_name(out, study.scan.labels))


def _run_scan(study: Study, work: Workspace) -> tuple[list[str], StageReport]:
    """Write mass.json, surfaces and labels."""
    from legacy.ct_inertia.exports.mass_json import mass_json
    from legacy.ct_inertia.exports.output_files import SCAN_CROP, labels_name
    from legacy.ct_inertia.exports.scan_crop import EarlyCrop
    from legacy.ct_inertia.exports.write_result import write_outputs
    from legacy.ct_inertia.report.sections import report_sections
    from legacy.ct_inertia.results import mass_of

    options = study.scan
    crop = EarlyCrop(options, work.fresh / SCAN_CROP, work.hashes.of)
    result = mass_of(options, found=crop.begin)
    content = mass_json(result, hashes=work.hashes, labels_file=labels_name(work.out, options.labels))
    sections = report_sections(result, content)
    names = write_outputs(result, work.fresh, content, crop)
    work.keep("mass", result.measured_mass(content))
    return names, StageReport(tuple(sections), result.notices)


def _motion_inputs(study: Study) -> Mapping[str, Path | None]:
    from legacy.kinematics.measure_motion import files_by_role

    return files_by_role(study.ldv.files, study.ldv.input_files())


def _motion_parameters(study: Study, work: Workspace) -> dict[str, Any]:
    """Return what the motion depends on; of the scan only its frames, shape and mass distribution.

    The motion of the points does not depend on the density, so that another density reuses it.
    """
    from legacy.stapeskit.provenance import frames_hash

    mass = work.mass.record.raw
    values = mass["inertial_parameters"]["values_si"]
    labels = mass.get("labels_file") or "labels.nrrd"
    surfaces = ("stapes.ply", "plate.ply", labels)
    return {
        **study.ldv.parameters(),
        "frames of the scan": [frames_hash(mass), mass["frames"].get("anterior_from")],
        "mass distribution": [f"{value / values[0]:.7g}" for value in values],
        "surfaces": [work.hash_of(name) if work.find(name).exists() else None for name in surfaces],
    }


def _run_motion(study: Study, work: Workspace) -> tuple[list[str], StageReport]:
    """Write dof.csv, dof.h5 and dof.channels.csv."""
    from legacy.kinematics.calibrated import calibrated
    from legacy.kinematics.fit_options import fit_options
    from legacy.kinematics.measure_motion import motion_inputs, motion_of
    from legacy.kinematics.motion_outputs import write_outputs
    from legacy.kinematics.report.sections import sections
    from legacy.stapeskit.provenance import FRAMES_HASH, frames_hash, record

    inputs = motion_inputs(study.ldv)
    parameters = {**study.ldv.parameters(), "frames": "of the scan"}
    provenance = record(inputs.by_role, parameters, calibrated.version(), hashes=work.hashes)
    provenance[FRAMES_HASH] = frames_hash(work.mass.record.raw)
    read = measurement_of(study, work)
    result = motion_of(inputs, read, fit_options(study.ldv), work.mass, provenance)
    scenery = result.scenery
    names = write_outputs(work.fresh, "dof", result, scenery, False, hash_of=work.hashes.of)
    work.keep("motion", result.motion)
    return names, StageReport(tuple(sections(result, scenery, interactive=True)), result.notices)


def _fit_parameters(study: Study, work: Workspace) -> dict[str, Any]:
    """Return what the fit depends on: the results of the stages before, without their dates."""
    keys = ("frames", "inertial_parameters", "mass_matrix", "found", "warnings")
    return {
        **study.fit.parameters(),
        "mass.json": {key: work.mass.record.raw.get(key) for key in keys},
        "dof.h5": work.hash_of("dof.h5"),
    }


def _run_fit(study: Study, work: Workspace) -> tuple[list[str], StageReport]:
    """Write kd.json."""
    from legacy.fitting.calibrated import calibrated
    from legacy.fitting.file_chain import check_chain
    from legacy.fitting.recorded_fit import kd_of
    from legacy.stapeskit.provenance import input_record, record

    options = study.fit
    mass, mass_file = work.mass.record, work.find("mass.json")
    files: dict[str, Path | Mapping[str, Any] | None] = {
        "motion": work.find("dof.h5"),
        "mass": input_record(mass_file, hashes=work.hashes, document=mass.raw),
    }
    provenance = record(files, options.parameters(), calibrated.version(), hashes=work.hashes)
    chain = check_chain(work.motion, "dof.h5", mass, mass_file)
    fit = kd_of(work.motion, mass.mass_matrix, options, mass, provenance, chain=chain)
    text = json.dumps(fit.content(), indent=1) + "\n"
    (work.fresh / KD_FILE).write_text(text, encoding="utf-8")
    work.keep("kd", json.loads(text))
    return [KD_FILE], StageReport(
        tuple(fit.sections()), tuple(notice for notice in fit.notices if notice not in chain)
    )


STAGES = (
    Stage(
        "scan",
        "scan: bodies, frames, mass matrix",
        "scan",
        ("stapeskit", "ct_inertia", *_OWN_CODE),
        lambda study: study.scan.inputs,
        _scan_outputs,
        lambda study, _work: study.scan.parameters(),
        _run_scan,
    ),
    Stage(
        "motion",
        "motion: points to degrees of freedom",
        "ldv",
        ("stapeskit", "kinematics", *_OWN_CODE),
        _motion_inputs,
        lambda _study, _out: MOTION_FILES,
        _motion_parameters,
        _run_motion,
    ),
    Stage(
        "fit",
        "fit: stiffness and damping",
        "fit",
        ("stapeskit", "fitting", *_OWN_CODE),
        lambda _study: {},
        lambda _study, _out: (KD_FILE,),
        _fit_parameters,
        _run_fit,
    ),
)
