"""Several studies: a folder for each, each in a process of its own, and the cohort of those that finished."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pipeline.cohort.cohort import Cohort, cohort_of
from pipeline.cohort.ears import Ear, read_ear
from pipeline.cohort.laws import planned_laws
from pipeline.cohort.logs import PREDICTORS, responses_of
from pipeline.cohort.page import FILES, write_cohort
from pipeline.study import Study, read_study
from stapeskit.faults import Fault, StapeskitError, raise_all
from stapeskit.outputs import Outputs
from stapeskit.warnings import Notice


@dataclass(frozen=True)
class End:
    """How one study ended: its exit code, and what went wrong."""

    code: int
    fault: str = ""


@dataclass(frozen=True)
class SeveralResult:
    """How several studies ended."""

    cohort: Cohort  # of those that finished
    ends: Mapping[str, End]  # by study
    files: tuple[Path, ...]  # of the cohort


Runner = Callable[[Mapping[str, Path], Path, bool, Callable[[str, End], None]], None]
"""Runs studies by name into subfolders of a folder (every stage again where forced), reports each end."""


def run_here(jobs: int, figures: Path | None = None) -> Runner:
    """Return the runner that uses processes of this machine, ``jobs`` at a time.

    Where it is interrupted, studies at work are ended and those that wait are not begun. Each study gets a
    subfolder of ``figures``.
    """

    def run(studies: Mapping[str, Path], out: Path, force: bool, ended: Callable[[str, End], None]) -> None:
        at_work = set[subprocess.Popen[bytes]]()
        with ThreadPoolExecutor(jobs) as pool:
            orders = ((pool.submit(run_one, path, out / name, force, figures, at_work), name)
                      for name, path in studies.items())  # fmt: skip
            names = dict(orders)
            try:
                for future in as_completed(names):
                    ended(names[future], future.result())
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                for process in set(at_work):
                    process.terminate()
                raise

    return run


def run_one(
    study: Path,
    out: Path,
    force: bool,
    figures: Path | None,
    at_work: set[subprocess.Popen[bytes]] | None = None,
) -> End:
    """Run one study in its own process, so that a crash or a lack of memory costs this ear alone.

    ``figures`` is the folder of all studies' figures, ``at_work`` holds the process while it runs.
    """
    words = [sys.executable, "-P", "-m", "pipeline.cli", str(study), "--out", str(out), "--quiet"]
    words += [] if figures is None else ["--figures", str(figures / out.name)]
    environment = dict(os.environ)
    root = str(Path(__file__).resolve().parents[1])
    environment["PYTHONPATH"] = os.pathsep.join([root, *filter(None, [environment.get("PYTHONPATH")])])
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        environment.setdefault(name, "1")
    known = set() if at_work is None else at_work
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as errors:
        process = subprocess.Popen(
            [*words, *(["--force"] if force else [])],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            env=environment,
        )
        known.add(process)
        code = process.wait()
        known.discard(process)
        errors.seek(0)
        text = errors.read()
    if code >= 0:
        return End(code, text.strip() if code else "")
    killed = f"its process was ended by signal {-code}, most often because memory ran out"
    return End(2, f"{killed}. Run fewer studies at a time with --jobs, and run it again.")


def folder_names(studies: Sequence[Path]) -> list[str]:
    """Name a folder for each study: the stem of its file, or its folder's name where stems coincide.

    Names that differ in capitals alone are one folder to Windows and macOS, and count as the same; names of
    the cohort's own files are not used.
    """
    times = Counter(path.stem for path in studies)
    used = {name.casefold() for name in FILES}
    names = []
    for path in studies:
        plain = (path.stem if times[path.stem] == 1 else path.resolve().parent.name).lstrip(".") or "study"
        name, number = plain, 2
        while name.casefold() in used:
            name, number = f"{plain}-{number}", number + 1
        used.add(name.casefold())
        names.append(name)
    return names


def read_studies(paths: Sequence[Path], check: Callable[[Study], None] = lambda _: None) -> dict[str, Study]:
    """Read several study files, by the names of their folders, and check each.

    Raises
    ------
    StapeskitError
        Every fault of all of them, with the folder that each lies in; or a study is given twice.
    """
    studies, faults = dict[str, Study](), list[Fault]()
    for name, path in zip(folder_names(paths), map(Path, paths), strict=True):
        try:
            studies[name] = read_study(path)
            check(studies[name])
        except StapeskitError as error:
            faults += [replace(fault, where=str(path.parent / str(fault.where))) for fault in error.faults]
    times = Counter(study.path.resolve() for study in studies.values())
    twice = [path for path, count in times.items() if count > 1]
    faults += [Fault("a study", "given once", "the same again", str(path)) for path in twice]
    raise_all(faults)
    return studies


def check_choices(studies: Mapping[str, Study], choices: Mapping[str, Any]) -> None:
    """Look at the options of a cohort before its ears are computed, as far as the studies say.

    Raises
    ------
    StapeskitError
        A planned law is of no quantity that these ears will have.
    """
    most = max(len(study.fit.dof) for study in studies.values())
    planned_laws(responses_of(most), PREDICTORS, choices.get("laws", ()))


def run_studies(
    paths: Sequence[Path],
    out: Path,
    runner: Runner,
    *,
    force: bool = False,
    choices: Mapping[str, Any] | None = None,
    report: Callable[[str], None] = lambda _line: None,
) -> SeveralResult:
    """Run several studies into subfolders, and compare those that finished.

    Parameters
    ----------
    runner : callable
        `run_here`, or `pipeline.cluster.run_on_dask`.
    choices : mapping, optional
        Arguments of `pipeline.cohort.cohort.cohort_of`.
    report : callable
        Gets a line as each study ends.

    Raises
    ------
    StapeskitError
        As `read_studies` and `check_choices`; a study would write over what another one reads, or an output
        of the cohort cannot be replaced.
    """
    out = Path(out).absolute()
    studies = read_studies(paths)
    check_choices(studies, choices or {})
    named = {name: study.path for name, study in studies.items()}
    outputs = _outputs(studies, out, force)
    ends: dict[str, End] = {}

    def ended(name: str, end: End) -> None:
        ends[name] = end
        outcome = end.fault.splitlines()[-1] if end.fault else "done"
        report(f"{name}: {outcome} ({len(ends)} of {len(named)})")

    runner(named, out, force, ended)
    failed = {name: end.fault for name, end in ends.items() if end.code}
    ears = []
    for name, study in studies.items():
        if name not in failed:
            try:
                ears.append(read_ear(out / name, study.name, study.about.of_ear()))
            except (OSError, LookupError, ValueError, TypeError) as error:
                failed[name] = f"its results cannot be read: {error}"
    found = _cohort(ears, failed, choices or {})
    records = {ear.folder: out / ear.folder / "kd.json" for ear in ears}
    with outputs.staged() as stage:
        write_cohort(stage, found, {"studies": list(named)}, records, failed)
    return SeveralResult(found, ends, outputs.paths())


def _cohort(ears: Sequence[Ear], failed: Mapping[str, str], choices: Mapping[str, Any]) -> Cohort:
    """Fit every law, or return a cohort without laws and with the reason as its warning."""
    try:
        return cohort_of(ears, failed, **choices)
    except StapeskitError as error:
        notice = Notice("laws_left_open", f"No laws: {' '.join(str(error).split())}")
        return Cohort(tuple(ears), tuple(failed.items()), notices=(notice,))


def _outputs(studies: Mapping[str, Study], out: Path, force: bool) -> Outputs:
    """Return the outputs of the cohort; refuse studies that would write over what another reads."""
    inputs = {path.resolve() for study in studies.values() for path in study.inputs().values()}
    step = "Choose another place with --out"
    raise_all(
        Fault(f"the folder {out / name}", "apart from the inputs", path, "", step)
        for name in studies
        for path in inputs
        if path.is_relative_to((out / name).resolve())
    )
    outputs = Outputs("scan2kd cohort", out, FILES, inputs, force)
    outputs.check()
    return outputs
