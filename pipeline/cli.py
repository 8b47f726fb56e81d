"""The command scan2kd."""

from __future__ import annotations

from stapeskit.command import Outcome, run

TYPE_CHECKING = False  # everything is imported on first use, so that the help is quick
if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path
    from typing import NoReturn

    from pipeline.command_options import CohortOptions, RunOptions
    from stapeskit.warnings import Notice

_EPILOG = """STUDY: study.toml; left out, the one of the current folder. Several studies
get a subfolder of --out each, and cohort.csv, cohort.json, cohort.html.

  scan2kd --template > study.toml     every key with its meaning
  scan2kd study.toml --check          look at everything cheap, compute nothing
"""


def work(words: list[str]) -> Outcome | None:
    """Run one study or several, check one, or print the template."""
    from pathlib import Path

    from pipeline.command_options import CohortOptions, RunOptions
    from stapeskit.command_line import parse

    chosen, cohort = parse(
        "scan2kd",
        "From a scan and a vibrometer file to mass, stiffness and damping.",
        [RunOptions, CohortOptions],
        words,
        _EPILOG,
    )
    if chosen.template:
        import sys

        from pipeline.study import study_template

        sys.stdout.write(study_template())
        return None
    paths = chosen.studies or (Path("study.toml"),)
    if not chosen.studies and not paths[0].is_file():
        from stapeskit.faults import StapeskitError

        step = "Name a study, or make one for the files of this folder with stapeskit new"
        raise StapeskitError.of("this folder", "one with a study.toml", "none", "", step)
    if chosen.check:
        return _check(paths, chosen, cohort)
    try:
        return _one(paths[0], chosen) if len(paths) == 1 else _several(paths, chosen, cohort)
    except KeyboardInterrupt:
        kept = "what finished stages have written stays, and the same command goes on from there"
        raise KeyboardInterrupt(kept) from None


def _check(paths: Sequence[Path], chosen: RunOptions, cohort: CohortOptions) -> Outcome:
    from pipeline.run import check_study
    from pipeline.several import check_choices, read_studies

    studies = read_studies(paths, check_study)
    if len(studies) > 1:
        check_choices(studies, vars(cohort))
    ready = "files, nothing to mend before it runs"
    rows = [(name, f"{len(study.inputs())} {ready}") for name, study in studies.items()]
    return Outcome("checked", rows, json=chosen.as_json, quiet=chosen.quiet)


def _one(study: Path, chosen: RunOptions) -> Outcome:
    import os
    import sys
    from pathlib import Path

    from pipeline.report import summary_rows, write_figures
    from pipeline.run import FILES, run_study
    from stapeskit.command import progress_line
    from stapeskit.warnings import once

    reported: list[Notice] = []

    def tell(notices: Sequence[Notice]) -> None:
        fresh = once([*reported, *notices])[len(reported) :]
        reported.extend(fresh)
        for notice in () if chosen.quiet else fresh:
            sys.stderr.write(f"warning [{notice.code}] {notice.text}\n")

    out = chosen.out or Path(f"{study.stem}_out")
    with progress_line(not chosen.quiet and not chosen.as_json) as progress:
        result = run_study(study, out, force=chosen.force, progress=progress, tell=tell)
        if chosen.figures is not None:
            write_figures(result, chosen.figures, chosen.force)
    near = Path(os.path.relpath(result.out)) if result.out.is_relative_to(Path.cwd()) else result.out
    files = [near / name for names in FILES.values() for name in names if (near / name).exists()]
    content = {"schema": "stapeskit.scan2kd/1", "out": str(result.out), "mass": result.mass, "kd": result.kd}
    return Outcome(result.title, summary_rows(result), (), files, content, chosen.as_json, chosen.quiet)


def _several(studies: Sequence[Path], chosen: RunOptions, cohort: CohortOptions) -> Outcome:
    import sys
    from pathlib import Path

    from pipeline.cluster import run_on_dask
    from pipeline.several import run_here, run_studies
    from stapeskit.faults import StapeskitError

    def report(line: str) -> None:
        if not chosen.quiet:
            sys.stderr.write(f"{line}\n")

    figures = None if chosen.figures is None else chosen.figures.absolute()
    on_dask = chosen.scheduler != ""
    runner = run_on_dask(chosen.scheduler, figures) if on_dask else run_here(chosen.jobs, figures)
    out = chosen.out or Path("cohort_out")
    result = run_studies(studies, out, runner, force=chosen.force, choices=vars(cohort), report=report)
    failed = {name: end for name, end in result.ends.items() if end.code}
    if len(failed) == len(result.ends):
        raise StapeskitError(*(f"{name}: {end.fault}" for name, end in failed.items()))
    rows = [*result.cohort.summary(), ("failed", ", ".join(failed) or "none")]
    content = {
        "schema": "stapeskit.cohort/1",
        "out": str(out),
        "ends": {name: {"code": end.code, "fault": end.fault} for name, end in result.ends.items()},
    }
    title, notices = result.cohort.title, result.cohort.notices
    return Outcome(title, rows, notices, result.files, content, chosen.as_json, chosen.quiet)


def main() -> NoReturn:
    """Run the command and leave with its exit code."""
    run("scan2kd", work)


if __name__ == "__main__":
    main()
