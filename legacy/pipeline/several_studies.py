"""Several studies: a folder for each, and the cohort of those that were finished."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from legacy.pipeline.cohort.cohort_files import LOG_FILE, cohort_names, cohort_outputs, write_cohort
from legacy.pipeline.cohort.cohort_laws import cohort_laws_or_notice
from legacy.pipeline.cohort.compare_ears import Ear, read_ear
from legacy.pipeline.cohort.ear_description import about_of
from legacy.pipeline.cohort_log import CohortLog
from legacy.pipeline.runners import Where, runner_of
from legacy.pipeline.runners.study_process import AGAIN, End, Task
from legacy.pipeline.study import read_study
from legacy.stapeskit.faults import StapeskitError, raise_all
from legacy.stapeskit.own_files import OutputSet
from legacy.stapeskit.warnings import Notice


@dataclass(frozen=True)
class CohortChoices:
    """Choices of a cohort in addition to its studies.

    Attributes
    ----------
    planned : tuple of (response, predictor)
        Empty: the default family.
    exports : tuple of str
        Names of `pipeline.cohort.exports.EXPORTS`.
    """

    mix: bool = False
    covariates: tuple[str, ...] = ()
    planned: tuple[tuple[str, str], ...] = ()
    exports: tuple[str, ...] = ()

    def for_laws(self) -> dict[str, object]:
        """Return the arguments of `cohort_laws`."""
        planned = {"planned": self.planned} if self.planned else {}
        return {"mix": self.mix, "covariates": self.covariates, **planned}


@dataclass(frozen=True)
class CohortResult:
    """How several studies ended.

    Attributes
    ----------
    ears : tuple of Ear
        Those that were finished.
    faults : mapping of str to str
        By study.
    codes : mapping of str to int
        Exit code of each study that failed.
    notices : tuple of Notice
        About the cohort; those of an ear are in its own files.
    """

    out: Path
    ears: tuple[Ear, ...]
    faults: Mapping[str, str]
    codes: Mapping[str, int]
    files: tuple[Path, ...]
    notices: tuple[Notice, ...]


def folder_names(studies: Sequence[Path]) -> list[str]:
    """Name a folder for each study: the stem of its file, or its folder's name where stems coincide.

    Leading dots are left out: ``..`` would be another folder, and hidden ones are the program's. The ending
    ``_study`` of names in the manner of BIDS is left out too. Files of the cohort keep their names. Names
    that differ in capitals alone are one folder to Windows and macOS, and count as the same.
    """
    own = [
        path.stem.removesuffix("_study") if path.stem.startswith("sub-") else path.stem for path in studies
    ]
    times = Counter(own)
    names = [
        name if times[name] == 1 else path.resolve().parent.name
        for name, path in zip(own, studies, strict=True)
    ]
    unique_names: list[str] = []
    used_names = {name.casefold() for name in cohort_names()}
    for name in names:
        plain = name.lstrip(".") or "study"
        number, unique = 2, plain
        while unique.casefold() in used_names:
            unique, number = f"{plain}-{number}", number + 1
        used_names.add(unique.casefold())
        unique_names.append(unique)
    return unique_names


def run_studies(
    studies: Sequence[Path],
    out: Path,
    jobs: int = 1,
    force: bool = False,
    tell: Callable[[str], None] | None = None,
    scheduler: str | None = None,
    choices: CohortChoices | None = None,
) -> CohortResult:
    """Run several studies, and compare those that were finished.

    Parameters
    ----------
    out : Path
        Gets one subfolder per study and the files of the cohort.
    jobs : int
        How many run at a time on this machine.
    force : bool
        Make every stage anew, and replace files at the names of outputs that are not known as made here.
    tell : callable, optional
        Gets the lines of progress.
    scheduler : str, optional
        Address of a cluster that runs the studies (pipeline.runners.RUNNERS).
    choices : CohortChoices, optional

    Raises
    ------
    StapeskitError
        An output of one study is an input of another, an output of the cohort cannot be replaced, or the
        scheduler does not answer.
    """
    out, choices = Path(out).absolute(), choices or CohortChoices()
    named = dict(zip(folder_names(studies), (Path(path).absolute() for path in studies), strict=True))
    outputs = _check_outputs(named, out, force, choices.exports)
    with CohortLog(out, len(named), tell) as log:
        ends = _run_all(named, out, force, log, Where(jobs, scheduler or "", log.path.parent))
        faults = {name: end.fault for name, end in ends.items() if end.code}
        codes = {name: end.code for name, end in ends.items() if end.code}
        ears = tuple(
            replace(read_ear(out / name, ends[name].name), about=about_of(read_study(path).study))
            for name, path in named.items()
            if name not in faults
        )
        files, notices = list[Path](), tuple[Notice, ...]()
        if ears:
            records = {ear.folder: out / ear.folder / "kd.json" for ear in ears}
            with outputs.staged() as fresh:
                cohort = cohort_laws_or_notice(ears, faults, **choices.for_laws())
                written = write_cohort(
                    fresh, cohort, {"studies": [ear.folder for ear in ears]}, records, faults, choices.exports
                )
                log.tell("", f"laws and page: {len(cohort.laws)} laws over {len(ears)} ears")
                shutil.copyfile(log.path, fresh / LOG_FILE)
            files, notices = [out / name for name in (*written, LOG_FILE)], cohort.notices
    return CohortResult(out, ears, faults, codes, tuple(files), notices)


def _check_outputs(studies: Mapping[str, Path], out: Path, force: bool, exports: Sequence[str]) -> OutputSet:
    """Return the outputs of the cohort, after a look whether any study would write over what another reads.

    A fault of a study file itself is reported when the study runs.
    """
    from legacy.pipeline.scan2kd import output_set

    sets: list[OutputSet] = []
    for name, path in studies.items():
        with suppress(StapeskitError):
            sets.append(output_set(path, read_study(path), out / name, force))
    read = tuple(dict.fromkeys(path for ear in sets for path in (*studies.values(), *ear.inputs)))
    outputs = cohort_outputs(out, read, force, exports)
    raise_all(StapeskitError, [fault for ear in sets for fault in replace(ear, inputs=read).clashes()])
    outputs.check()
    return outputs


def _run_all(
    studies: Mapping[str, Path], out: Path, force: bool, log: CohortLog, where: Where
) -> dict[str, End]:
    """Run all studies, here or on a cluster; an interruption names those that were finished."""
    tasks = [Task(name, path, out / name, force) for name, path in studies.items()]
    ends: dict[str, End] = {}

    def ended(name: str, end: End) -> None:
        ends[name] = end
        log.ended(name, end)

    try:
        runner_of(where.address)(tasks, where, log.tell, ended)
    except KeyboardInterrupt as stop:
        finished = [name for name, end in ends.items() if not end.code]
        if not finished:
            raise
        text = f"interrupted; the finished studies are in {out}: {', '.join(finished)}."
        raise KeyboardInterrupt(text) from stop
    return {name: ends.get(name) or End(2, fault=f"its runner gave it up. {AGAIN}.") for name in studies}
