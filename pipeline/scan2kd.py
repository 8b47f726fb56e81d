"""One study from its file to its report: finished stages reused, outputs whole or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pipeline.errors import PipelineError
from pipeline.options import faults_in_study_words, in_study_words, section_in_study_words
from pipeline.progress import Progress
from pipeline.records import (
    FOLDER,
    StageRecord,
    Told,
    fingerprint,
    read_record,
    read_told,
    told_name,
    write_record,
    write_told,
)
from pipeline.stages import STAGES, Workspace, check_inputs, inputs_of, names_of_outputs, results
from pipeline.study import Study, read_study
from stapeskit.faults import StapeskitError
from stapeskit.own_files import OutputSet
from stapeskit.provenance import content_hash
from stapeskit.warnings import Notice, unique

REPORT, REPORT_FILE = "report", "report.html"
_REPORT_CODE = ("pipeline", "stapeskit/page/page.py")


@dataclass(frozen=True)
class StageRun:
    """How a stage came about: made or reused, and why."""

    name: str
    reused: bool
    seconds: float
    reason: str


@dataclass(frozen=True)
class StudyResult:
    """A finished study.

    Attributes
    ----------
    study : Study
    name : str
        Its name, or the stem of its file.
    out : Path
    mass, kd : mapping
        Content of mass.json and kd.json.
    stages : tuple of StageRun
    files : tuple of Path
    notices : tuple of Notice
    """

    study: Study
    name: str
    out: Path
    mass: Mapping[str, Any]
    kd: Mapping[str, Any]
    stages: tuple[StageRun, ...]
    files: tuple[Path, ...]
    notices: tuple[Notice, ...]


def run_study(path: Path, out: Path, force: bool = False, progress: Progress | None = None) -> StudyResult:
    """Run a study.

    Parameters
    ----------
    path : Path
        The study file.
    out : Path
        The output folder; made when missing.
    force : bool
        Make every stage anew, and replace files at the names of outputs that are not known as made here.
    progress : Progress, optional

    Raises
    ------
    StapeskitError
        Anything wrong with the study file or with what it names. The output folder is then as it was.
    """
    progress = progress or Progress(quiet=True)
    path, out = Path(path), Path(out).absolute()
    study = read_study(path)
    name = study.study.name or path.stem
    old = {stage: read_record(out, stage) for stage in (*(one.name for one in STAGES), REPORT)}
    known: dict[Path, str] = {}
    outputs = output_set(path, study, out, force)
    outputs.check()
    kept: list[str] = []
    with outputs.staged(kept) as fresh:
        work = Workspace(out, fresh)
        with progress.step("study file and vibrometer table"):
            check_inputs(study)
        runs: list[StageRun] = []
        told: dict[str, Told] = {}
        for stage in STAGES:
            told[stage.name] = _stage(
                stage, study, work, None if force else old[stage.name], known, runs, progress
            )
        _report(path, name, study, work, told, None if force else old[REPORT], runs, progress)
        mass, kd = results(work)
        names = _outputs(work, old, runs)
        kept += names
    shown = tuple(out / one for one in names if not one.startswith(FOLDER))
    notices = unique(
        (*(notice for one in told.values() for notice in one.notices), *outputs.kept_notices(names))
    )
    return StudyResult(study, name, out, mass, kd, tuple(runs), shown, notices)


def output_set(path: Path, study: Study, out: Path, force: bool = False) -> OutputSet:
    """Return the files that a study may write into a folder, beside those that it reads.

    What the records of its stages hold counts as known, too.
    """
    from ct_inertia.exports.output_files import LABELS

    records = [read_record(out, stage) for stage in (*(one.name for one in STAGES), REPORT)]
    known = {
        name: found
        for record in records
        for name, found in (() if record is None else record.outputs.items())
        if not name.startswith(FOLDER)
    }
    names = (REPORT_FILE, *names_of_outputs(study, out))
    hint = f'Measure corrected labels with labels = "{out / LABELS}" in [scan], which stay as they are'
    return OutputSet(
        "scan2kd", out, names, (path, *inputs_of(study)), force, known=known, hints={LABELS: hint}
    )


def _stage(
    stage: Any,
    study: Study,
    work: Workspace,
    old: StageRecord | None,
    known: dict[Path, str],
    runs: list[StageRun],
    progress: Progress,
) -> Told:
    """Reuse a stage or run it."""
    with progress.step(stage.title) as step:
        now = fingerprint(stage.rooms, stage.inputs(study), stage.parameters(study, work), known)
        reason = _reason(old, now, work)
        if not reason:
            step.note = "unchanged, reused"
            runs.append(StageRun(stage.name, True, 0.0, ""))
            return read_told(work.find(told_name(stage.name)))
        try:
            names, told = stage.run(study, work)
        except PipelineError:
            raise
        except StapeskitError as fault:
            raise PipelineError(*faults_in_study_words(fault.faults, stage.table)) from fault
        told = Told(
            tuple(section_in_study_words(one, stage.table) for one in told.sections),
            tuple(replace(n, text=in_study_words(n.text, stage.table)) for n in told.notices),
        )
        write_told(work.fresh, stage.name, told)
        hashes = {one: content_hash(work.fresh / one) for one in (*names, told_name(stage.name))}
        write_record(work.fresh, StageRecord(stage.name, now, hashes, step.seconds))
        step.note = "" if old is None else reason
        runs.append(StageRun(stage.name, False, step.seconds, reason))
        return told


def _reason(old: StageRecord | None, now: Mapping[str, str], work: Workspace) -> str:
    """Say why a stage must run, or return nothing."""
    if old is None:
        return "not made before"
    changes = old.changes(now)
    if changes:
        return "changed: " + ", ".join(changes[:4]) + (" ..." if len(changes) > 4 else "")
    spoiled = [name for name in old.spoiled(work.out) if not name.startswith(FOLDER)]
    if spoiled or old.spoiled(work.out):
        return "missing or edited: " + ", ".join(spoiled or ["its record"])
    return ""


def _report(
    path: Path,
    name: str,
    study: Study,
    work: Workspace,
    told: Mapping[str, Told],
    old: StageRecord | None,
    runs: list[StageRun],
    progress: Progress,
) -> None:
    """Put the report together when anything in it changed."""
    from pipeline.report import write_report

    with progress.step("report") as step:
        parts = {one: content_hash(work.find(told_name(one))) for one in told}
        parts |= {one: content_hash(work.find(one)) for one in ("mass.json", "dof.h5", "kd.json")}
        now = fingerprint(_REPORT_CODE, {"study": path}, parts, {})
        reason = _reason(old, now, work)
        if not reason:
            step.note = "unchanged, reused"
            runs.append(StageRun(REPORT, True, 0.0, ""))
            return
        write_report(work.fresh / REPORT_FILE, path, name, study, work, told)
        hashes = {REPORT_FILE: content_hash(work.fresh / REPORT_FILE)}
        write_record(work.fresh, StageRecord(REPORT, now, hashes, step.seconds))
        runs.append(StageRun(REPORT, False, step.seconds, reason))


def _outputs(work: Workspace, old: Mapping[str, StageRecord | None], runs: list[StageRun]) -> list[str]:
    """List the outputs that belong to this run, new and reused."""
    names: list[str] = []
    for run in runs:
        record = old[run.name] if run.reused else read_record(work.fresh, run.name)
        names += [] if record is None else list(record.outputs)
    order = (REPORT_FILE, "mass.json", "kd.json")
    return sorted(names, key=lambda one: (order.index(one) if one in order else len(order), one))
