"""The command ``scan2kd``: study files in, reports out."""

from __future__ import annotations

import sys

from legacy.stapeskit.process import run

TYPE_CHECKING = False  # everything is imported on first use, so that Ctrl-C is handled from the beginning
if TYPE_CHECKING:
    from typing import Any, NoReturn

    from legacy.pipeline.results import StudyResult
    from legacy.pipeline.several_studies import CohortResult
    from legacy.stapeskit.command import Outcome
    from legacy.stapeskit.option_parser import ParsedOptions, Parser

_DESCRIPTION = """\
From micro-CT scan and vibrometer table to mass, stiffness and damping of a
stapes.

A study file names the scan, the vibrometer's table and the choices of the fit
of one ear. scan2kd --template prints one to start from."""

_EPILOG = """\
Finished stages are reused when their inputs, settings and code are unchanged.
Exit code 0: done; 2: the input is at fault, with what to do; 1: a bug.

examples:
  scan2kd --template > study.toml
  scan2kd study.toml
  scan2kd ears/*.toml --jobs 2 --out cohort
  scan2kd ears/*.toml --scheduler tcp://10.0.0.1:8786 --covariates age,sex"""


def parser() -> Parser:
    """Return the parser of the command."""
    from legacy.pipeline.command_options import StudyOptions
    from legacy.stapeskit.option_parser import Parser

    return Parser("scan2kd", _DESCRIPTION, _EPILOG, StudyOptions)


def work(arguments: list[str]) -> tuple[ParsedOptions, Outcome] | None:
    """Run the command on its arguments."""
    options = parser().parse(arguments)
    if options.template:
        from legacy.pipeline.template import TEMPLATE

        sys.stdout.write(TEMPLATE)
        return None
    if len(options.studies) == 1 and options.bids is None:
        return options, _run_one(options)
    return options, _run_several(options)


def _run_one(options: ParsedOptions) -> Outcome:
    from pathlib import Path

    from legacy.pipeline.report_summary import key_results
    from legacy.pipeline.scan2kd import run_study
    from legacy.pipeline.stage_progress import Progress
    from legacy.stapeskit.command import Outcome

    path = options.studies[0]
    out = Path(f"{path.stem}_out") if options.out is None else options.out
    result = run_study(path, out, options.force, Progress(options.quiet))
    return Outcome(
        f"scan2kd: {result.name}",
        key_results(result.mass, result.kd),
        result.notices,
        [out / file.relative_to(result.out) for file in result.files],
        _as_json(result),
    )


def _as_json(result: StudyResult) -> dict[str, Any]:
    keys = ("dof", "stiffness_si", "stiffness_sd_si", "damping_si", "damping_sd_si", "modes", "stable")
    return {
        "schema": "stapeskit.scan2kd/1",
        "study": result.name,
        "out": str(result.out),
        "mass_kg": result.mass["mass_kg"],
        **{key: result.kd[key] for key in keys},
        "stages": [
            {
                "name": stage.name,
                "reused": stage.reused,
                "seconds": round(stage.seconds, 3),
                "reason": stage.reason,
            }
            for stage in result.stages
        ],
        "files": [str(file) for file in result.files],
        "warnings": [notice.as_json() for notice in result.notices],
    }


def _run_several(options: ParsedOptions) -> Outcome:
    from pathlib import Path

    from legacy.pipeline.cohort.cohort_laws import planned_law
    from legacy.pipeline.several_studies import CohortChoices, run_studies
    from legacy.stapeskit.command import Outcome

    def tell(line: str) -> None:
        if not options.quiet:
            sys.stderr.write(f"{line}\n")

    studies, out = options.studies, Path("cohort_out")
    if options.bids is not None:
        from legacy.pipeline.bids import derivatives, read_dataset, write_dataset

        studies = write_dataset(studies, options.bids) if studies else read_dataset(options.bids)
        out = derivatives(options.bids)
    out = options.out or out
    planned = tuple(planned_law(text) for text in options.laws)
    choices = CohortChoices(options.mix, options.covariates, planned, options.export)
    result = run_studies(studies, out, options.jobs, options.force, tell, options.scheduler, choices)
    if result.faults:
        raise _failure(result)
    return Outcome(
        f"scan2kd: {len(result.ears)} studies",
        [(ear.folder, _line(ear.kd)) for ear in result.ears],
        result.notices,
        [out / file.name for file in result.files],
        {
            "schema": "stapeskit.cohort/1",
            "out": str(result.out),
            "studies": [{"name": ear.name, "folder": str(result.out / ear.folder)} for ear in result.ears],
            "files": [str(file) for file in result.files],
            "warnings": [notice.as_json() for notice in result.notices],
        },
    )


def _failure(result: CohortResult) -> Exception:
    """Return the error that lists the studies which failed; a bug stays a bug."""
    from legacy.stapeskit.faults import StapeskitError

    listed = [f"{name}: {fault}" for name, fault in result.faults.items()]
    finished = (
        f"{len(result.ears)} of {len(result.ears) + len(result.faults)} studies are finished in {result.out}."
    )
    if 1 in result.codes.values():
        return RuntimeError("\n".join([*listed, finished]))
    return StapeskitError(*listed, finished)


def _line(kd: Any) -> str:
    """Return the stiffness and the modes of an ear with units and standard deviations."""
    from legacy.stapeskit.page.numbers import plus_minus
    from legacy.stapeskit.page.quantities import diagonal_unit

    values = []
    for place, dof in enumerate(kd["dof"]):
        value, sd = (kd[name][place][place] for name in ("stiffness_si", "stiffness_sd_si"))
        values.append(f"K({dof}) {diagonal_unit('K', dof).with_sd(value, sd)}")
    modes = [plus_minus(mode["frequency_hz"], mode["frequency_sd_hz"]) for mode in kd["modes"]]
    return f"{', '.join(values)}; modes {', '.join(modes)} Hz"


def main() -> NoReturn:
    """Run the command and leave with its exit code."""
    run("scan2kd", work)


if __name__ == "__main__":
    main()
