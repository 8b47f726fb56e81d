"""Several studies, each in a process of its own, so that none of them can take the others down."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pipeline.cohort.about import about_of
from pipeline.cohort.ears import Ear, read_ear
from pipeline.cohort.files import cohort_outputs, write_cohort
from pipeline.cohort.study_of_ears import study_ears_or_say_why
from pipeline.study import read_study
from stapeskit.faults import StapeskitError, raise_all
from stapeskit.own_files import OutputSet

_PATIENCE_S = 20.0
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True)
class CohortResult:
    """How several studies ended.

    Attributes
    ----------
    out : Path
    ears : tuple of Ear
        Those that were finished.
    faults : mapping of str to str
        By study.
    codes : mapping of str to int
        Exit code of each study that failed.
    files : tuple of Path
    """

    out: Path
    ears: tuple[Ear, ...]
    faults: Mapping[str, str]
    codes: Mapping[str, int]
    files: tuple[Path, ...]


@dataclass
class _Job:
    name: str
    process: subprocess.Popen[str]
    output: dict[str, str] = field(default_factory=dict)
    readers: list[threading.Thread] = field(default_factory=list)


def folder_names(studies: Sequence[Path]) -> list[str]:
    """Name a folder for each study: the stem of its file, or its folder's name where stems coincide."""
    stems = Counter(path.stem for path in studies)
    names = [path.stem if stems[path.stem] == 1 else path.resolve().parent.name for path in studies]
    made: list[str] = []
    for name in names:
        number, unique = 2, name
        while unique in made:
            unique, number = f"{name}-{number}", number + 1
        made.append(unique)
    return made


def run_studies(
    studies: Sequence[Path],
    out: Path,
    jobs: int = 1,
    force: bool = False,
    tell: Callable[[str], None] | None = None,
) -> CohortResult:
    """Run several studies, and compare those that were finished.

    Parameters
    ----------
    studies : sequence of Path
    out : Path
        Gets one subfolder per study, cohort.csv, cohort.html and cohort.json.
    jobs : int
        How many run at a time.
    force : bool
        Make every stage anew, and replace files at the names of outputs that are not known as made here.
    tell : callable, optional
        Gets the lines of progress.

    Raises
    ------
    StapeskitError
        An output of one study is an input of another, or cohort.csv or cohort.html cannot be replaced.
    """
    out = Path(out).absolute()
    names = folder_names(studies)
    outputs = _checked_outputs(dict(zip(names, studies, strict=True)), out, force)
    ends = _run_all(dict(zip(names, studies, strict=True)), out, jobs, force, tell or (lambda _line: None))
    faults = {name: end["fault"] for name, end in ends.items() if end["code"]}
    codes = {name: int(end["code"]) for name, end in ends.items() if end["code"]}
    ears = tuple(
        replace(read_ear(out / name, ends[name]["name"]), about=about_of(read_study(path).study))
        for name, path in zip(names, studies, strict=True)
        if name not in faults
    )
    files: list[Path] = []
    if ears:
        records = {ear.folder: out / ear.folder / "kd.json" for ear in ears}
        with outputs.staged() as fresh:
            cohort = study_ears_or_say_why(ears, faults)
            write_cohort(fresh, cohort, {"studies": [ear.folder for ear in ears]}, records)
        files = [out / name for name in outputs.names]
    return CohortResult(out, ears, faults, codes, tuple(files))


def _checked_outputs(studies: Mapping[str, Path], out: Path, force: bool) -> OutputSet:
    """Return the outputs of the cohort, after a look whether any study would write over what another reads.

    What is wrong with a study file itself is told when its turn comes.
    """
    from pipeline.scan2kd import output_set

    sets: list[OutputSet] = []
    for name, path in studies.items():
        with suppress(StapeskitError):
            sets.append(output_set(Path(path), read_study(path), out / name, force))
    read = tuple(dict.fromkeys(path for one in sets for path in (*studies.values(), *one.inputs)))
    outputs = cohort_outputs(out, read, force)
    raise_all(StapeskitError, [fault for one in sets for fault in replace(one, inputs=read).clashes()])
    outputs.check()
    return outputs


def _run_all(
    studies: Mapping[str, Path], out: Path, jobs: int, force: bool, tell: Callable[[str], None]
) -> dict[str, dict[str, Any]]:
    """Keep ``jobs`` processes at work until all studies have ended; stop them when interrupted."""
    waiting, running = list(studies.items()), list[_Job]()
    ends: dict[str, dict[str, Any]] = {}
    threads = str(max(1, (os.cpu_count() or 1) // jobs))
    environment = os.environ | dict.fromkeys(_THREADS, threads)
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                name, path = waiting.pop(0)
                running.append(_start(name, path, out / name, force, environment, tell))
            for job in [one for one in running if one.process.poll() is not None]:
                running.remove(job)
                ends[job.name] = _end(job)
                tell(f"{job.name}: {'done' if not ends[job.name]['code'] else 'failed'}")
            time.sleep(0.02)
    except KeyboardInterrupt as stop:
        _stop(running)
        done = [name for name, end in ends.items() if not end["code"]]
        if not done:
            raise
        text = f"interrupted; the finished studies stand in {out}: {', '.join(done)}."
        raise KeyboardInterrupt(text) from stop
    except BaseException:
        _stop(running)
        raise
    return {name: ends[name] for name in studies}


def _start(
    name: str,
    study: Path,
    folder: Path,
    force: bool,
    environment: Mapping[str, str],
    tell: Callable[[str], None],
) -> _Job:
    """Start a study in its own session, so that an interruption reaches it once, from here."""
    words = [sys.executable, "-P", "-m", "pipeline.child", str(Path(study).absolute()), str(folder)]
    process = subprocess.Popen(
        [*words, *(["--force"] if force else [])],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=dict(environment) | {"PYTHONPATH": _search_path(environment)},
        start_new_session=True,
    )
    job = _Job(name, process)

    def forward() -> None:
        lines = []
        for line in process.stderr or ():
            lines.append(line)
            tell(f"{name}: {line.rstrip()}")
        job.output["stderr"] = "".join(lines[-20:])

    def keep() -> None:
        job.output["stdout"] = process.stdout.read() if process.stdout else ""

    for work in (forward, keep):
        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        job.readers.append(thread)
    return job


def _search_path(environment: Mapping[str, str]) -> str:
    """Return where the child finds these packages."""
    root = str(Path(__file__).resolve().parents[1])
    return os.pathsep.join([root, *filter(None, [environment.get("PYTHONPATH")])])


def _end(job: _Job) -> dict[str, Any]:
    """Return how a study ended; one that died without a word is named as such."""
    _closed(job)
    with suppress(ValueError, IndexError):
        end: dict[str, Any] = json.loads(job.output["stdout"].strip().splitlines()[-1])
        return end
    code = job.process.returncode
    how = f"signal {-code}" if code < 0 else f"exit code {code}"
    return {"code": 1, "fault": f"the process of this study ended by {how}.\n{job.output['stderr']}".strip()}


def _stop(running: Sequence[_Job]) -> None:
    """Ask the studies at work to clean up and leave, again each second, and end those that do not.

    Once is not enough: an exception that a signal raises within a callback of the import machinery is lost.
    """
    deadline = time.monotonic() + _PATIENCE_S
    left = list(running)
    while left and time.monotonic() < deadline:
        for job in left:
            job.process.terminate()
        pause = time.monotonic() + 1.0
        while left and time.monotonic() < pause:
            time.sleep(0.02)
            left = [job for job in left if job.process.poll() is None]
    for job in left:
        job.process.kill()
    for job in running:
        _closed(job)


def _closed(job: _Job) -> None:
    """Wait for a process to end and close what it wrote to."""
    job.process.wait()
    for thread in job.readers:
        thread.join()
    for stream in (job.process.stdout, job.process.stderr):
        if stream is not None:
            stream.close()
