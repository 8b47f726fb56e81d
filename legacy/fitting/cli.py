"""The command dof2kd."""

from __future__ import annotations

from legacy.stapeskit.process import run

TYPE_CHECKING = False  # everything is imported on first use, so that Ctrl-C is handled from the beginning
if TYPE_CHECKING:
    from typing import NoReturn

    from legacy.stapeskit.command import Outcome
    from legacy.stapeskit.option_parser import ParsedOptions, Parser

_EPILOG = """DOF: dof.csv or dof.h5 of points2dof. M.csv: square, SI, no header, order of
--dof, or 6 x 6.
Writes kd.json and kd.html (named after --out). Example:
  dof2kd dof.csv --mass stapes_mass/mass.json --band 400,5000 --exclude 45-55

Before measuring: dof2kd --plan plan.toml gives the standard deviations to
expect of K, D and the modes, which error limits them, and what another
direction, a wider band, less noise or better points, lasers or density would
bring (plan.json and plan.html, named after --out).
Every key has a default; plan.toml, e.g.:
"""


def parser() -> Parser:
    """Return the parser of the command."""
    from legacy.fitting.options import KDFiles, KDOptions
    from legacy.fitting.plan.plan_options import PLAN_EXAMPLE
    from legacy.stapeskit.option_parser import Parser

    return Parser(
        "dof2kd",
        "Stiffness and damping from rigid-body motion and mass matrix.",
        _EPILOG + PLAN_EXAMPLE,
        KDFiles,
        KDOptions,
    )


def work(arguments: list[str]) -> tuple[ParsedOptions, Outcome]:
    """Parse, fit or plan, write, and return the outcome."""
    options = parser().parse(arguments)
    if options.plan is not None:
        return options, _plan(options)
    from pathlib import Path

    from legacy.fitting.fit_files import fit_files
    from legacy.fitting.options import KDOptions
    from legacy.fitting.report.at_a_glance import summary_rows
    from legacy.stapeskit.command import Outcome
    from legacy.stapeskit.progress import stage_on_terminal

    with stage_on_terminal(not options.quiet and not options.json) as progress:
        result = fit_files(
            options.motion,
            options.mass,
            options.make(KDOptions),
            options.out or Path("kd.json"),
            force=options.force,
            config=options.config,
            progress=progress,
            export=options.export,
        )
    return options, Outcome(
        "stiffness and damping",
        summary_rows(result.fit),
        result.fit.notices,
        result.files,
        dict(result.content),
    )


def _plan(options: ParsedOptions) -> Outcome:
    """Report what a planned measurement can reach."""
    from pathlib import Path

    from legacy.fitting.fit_files import plan_files
    from legacy.fitting.plan.plan import summary_rows
    from legacy.stapeskit.command import Outcome

    expectation, content, files = plan_files(
        options.plan, options.out or Path("plan.json"), force=options.force, config=options.config
    )
    return Outcome(
        "what the plan can reach", summary_rows(expectation), expectation.notices, list(files), content
    )


def main() -> NoReturn:
    """Run the command and leave with its exit code."""
    run("dof2kd", work)


if __name__ == "__main__":
    main()
