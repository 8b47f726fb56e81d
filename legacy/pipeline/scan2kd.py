"""One study from its file to its report: finished stages reused, outputs whole or not at all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from legacy.pipeline.errors import PipelineError
from legacy.pipeline.results import StageRun, StudyResult
from legacy.pipeline.stage_progress import Progress, Step
from legacy.pipeline.stage_records import (
    FOLDER,
    StageRecord,
    StageReport,
    fingerprint,
    read_record,
    read_stage_report,
    stage_report_name,
    write_record,
    write_stage_report,
)
from legacy.pipeline.stages import STAGES, Stage, inputs_of, names_of_outputs
from legacy.pipeline.study import Study, read_study, words
from legacy.pipeline.study_checks import check_inputs
from legacy.pipeline.workspace import Workspace
from legacy.stapeskit.faults import StapeskitError, list_some, translate_option_names
from legacy.stapeskit.own_files import OutputSet, unfinished
from legacy.stapeskit.provenance import Hashes
from legacy.stapeskit.warnings import unique

REPORT, REPORT_FILE = "report", "report.html"
_REPORT_CODE = ("pipeline", "stapeskit/page")


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
    hashes = Hashes()
    old = _records(out)
    outputs = output_set(path, study, out, force, old, hashes)
    outputs.check()
    unchanged: list[str] = []
    with outputs.staged(unchanged) as fresh:
        work = Workspace(out, fresh, hashes)
        with progress.step("study file and vibrometer table"):
            check_inputs(study, work)
        # files of an earlier run that was killed among them may be of two runs: none is reused
        usable: Mapping[str, StageRecord] = {} if force or unfinished(out) else old
        runs: list[StageRun] = []
        reports: dict[str, StageReport] = {}
        for stage in STAGES:
            reports[stage.name] = _stage(stage, study, work, usable.get(stage.name), runs, progress)
        _report(path, name, study, work, reports, usable.get(REPORT), runs, progress)
        mass, kd = work.mass.record.raw, work.kd
        names = _outputs(runs)
        unchanged += names
    shown = tuple(out / file for file in names if not file.startswith(FOLDER))
    notices = unique(
        (*(notice for report in reports.values() for notice in report.notices), *outputs.kept_notices(names))
    )
    return StudyResult(study.anchored(), name, out, mass, kd, tuple(runs), shown, notices)


def _records(out: Path) -> dict[str, StageRecord]:
    """Return the records of finished stages in an output folder, by stage."""
    read = {stage: read_record(out, stage) for stage in (*(stage.name for stage in STAGES), REPORT)}
    return {stage: record for stage, record in read.items() if record is not None}


def output_set(
    path: Path,
    study: Study,
    out: Path,
    force: bool = False,
    records: Mapping[str, StageRecord] | None = None,
    hashes: Hashes | None = None,
) -> OutputSet:
    """Return the files that a study may write into a folder, and those that it reads.

    Parameters
    ----------
    path : Path
        The study file.
    records : mapping of str to StageRecord, optional
        Of finished stages, whose outputs count as known; read from ``out`` when left out.
    hashes : Hashes, optional
        Of the files of this run.
    """
    from legacy.ct_inertia.exports.output_files import LABELS

    records = _records(out) if records is None else records
    known = {
        name: digest
        for record in records.values()
        for name, digest in record.outputs.items()
        if not name.startswith(FOLDER)
    }
    names = (REPORT_FILE, *names_of_outputs(study, out))
    hint = f'Measure corrected labels with labels = "{out / LABELS}" in [scan], which stay as they are'
    return OutputSet(
        "scan2kd",
        out,
        names,
        (path, *inputs_of(study)),
        force,
        known=known,
        hints={LABELS: hint},
        hash_of=(hashes or Hashes()).of,
    )


def _stage(
    stage: Stage,
    study: Study,
    work: Workspace,
    old: StageRecord | None,
    runs: list[StageRun],
    progress: Progress,
) -> StageReport:
    """Reuse a stage or run it."""
    with progress.step(stage.title) as step:
        now = fingerprint(stage.rooms, stage.inputs(study), stage.parameters(study, work), work.hashes)
        reason = _reason(old, now, work)
        stored_report = None if reason else read_stage_report(work.find(stage_report_name(stage.name)))
        if stored_report is not None:
            _reuse(stage.name, old, step, runs)
            return stored_report
        reason = reason or "its sections are not as this program writes them"
        try:
            with translate_option_names(words(stage.table)):
                names, report = stage.run(study, work)
        except PipelineError:
            raise
        except StapeskitError as error:
            raise PipelineError(*error.faults) from error
        work.drop(set(stage.outputs(study, work.out)) - set(names))
        write_stage_report(work.fresh, stage.name, report)
        step.note = "" if old is None else reason
        runs.append(_finish(stage.name, now, (*names, stage_report_name(stage.name)), reason, step, work))
        return report


def _reason(old: StageRecord | None, now: Mapping[str, str], work: Workspace) -> str:
    """Return why a stage must run; empty when it need not."""
    if old is None:
        return "not made before"
    changes = old.changes(now)
    if changes:
        return f"changed: {list_some(changes, 4)}"
    spoiled = old.spoiled(work.out, work.hashes)
    if spoiled:
        named = [name for name in spoiled if not name.startswith(FOLDER)]
        return "missing or edited: " + ", ".join(named or ["its record"])
    return ""


def _report(
    path: Path,
    name: str,
    study: Study,
    work: Workspace,
    reports: Mapping[str, StageReport],
    old: StageRecord | None,
    runs: list[StageRun],
    progress: Progress,
) -> None:
    """Write the report when anything in it changed."""
    from legacy.pipeline.report import write_report

    with progress.step("report") as step:
        parts = {stage: work.hash_of(stage_report_name(stage)) for stage in reports}
        parts |= {name: work.hash_of(name) for name in ("mass.json", "dof.h5", "kd.json")}
        parts |= {"name of the study": name, "name of its file": path.name}
        now = fingerprint(_REPORT_CODE, {"study": path, "truth": study.study.truth}, parts, work.hashes)
        reason = _reason(old, now, work)
        if not reason:
            _reuse(REPORT, old, step, runs)
            return
        write_report(work.fresh / REPORT_FILE, path, name, study, work, reports)
        runs.append(_finish(REPORT, now, (REPORT_FILE,), reason, step, work))


def _reuse(name: str, record: StageRecord | None, step: Step, runs: list[StageRun]) -> None:
    """Note that a stage was reused with the outputs of its record."""
    step.note = "unchanged, reused"
    runs.append(StageRun(name, True, 0.0, "", () if record is None else tuple(record.outputs)))


def _finish(
    name: str, now: Mapping[str, str], files: Sequence[str], reason: str, step: Step, work: Workspace
) -> StageRun:
    """Write the record of a stage that has run, and return how it came about."""
    record = StageRecord(name, now, {file: work.hash_of(file) for file in files}, step.seconds)
    write_record(work.fresh, record)
    return StageRun(name, False, step.seconds, reason, tuple(files))


def _outputs(runs: Sequence[StageRun]) -> list[str]:
    """List the outputs that belong to this run, new and reused."""
    names = [name for run in runs for name in run.outputs]
    order = (REPORT_FILE, "mass.json", "kd.json")
    return sorted(names, key=lambda name: (order.index(name) if name in order else len(order), name))
