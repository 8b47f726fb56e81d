"""The command ``stapeskit``: what there is, the sample study, and the four commands by one name."""

from __future__ import annotations

import sys

from legacy.stapeskit.process import run

TYPE_CHECKING = False  # everything is imported on first use, so that Ctrl-C is handled from the beginning
if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any, NoReturn

    from legacy.stapeskit.command import Outcome
    from legacy.stapeskit.faults import Fault

_HELP = """\
usage: stapeskit COMMAND ...

From a micro-CT scan and a laser vibrometer measurement of a stapes to its mass
matrix M and to stiffness K and damping D of its annular ligament.

the whole chain:
  scan2kd       study file to M, K, D and one report

its three steps:
  ct2mass       scan to mass matrix and frames
  points2dof    vibrometer readings to rigid-body motion
  dof2kd        motion and mass matrix to stiffness and damping

to begin, and to publish:
  sample DIR    copy a complete simulated study into DIR
  figures PAGE DIR
                write the figures of a page as PDF and SVG, its tables as CSV
                and LaTeX into DIR
  completion    print the completion for bash, zsh or fish

Each of the four is also a separate command: stapeskit scan2kd is scan2kd.
scan2kd --help and so on list their options; stapeskit --version says which
version this is.

try it:
  stapeskit sample ear
  scan2kd ear/study.toml --out results
"""
COMMANDS = {
    "ct2mass": "legacy.ct_inertia.cli",
    "points2dof": "legacy.kinematics.cli",
    "dof2kd": "legacy.fitting.cli",
    "scan2kd": "legacy.pipeline.cli",
}
_USAGE = {
    "sample": """\
usage: stapeskit sample DIR [--force]

Copy a complete simulated study (scan, measurement, study file, truth) into DIR.
""",
    "figures": """\
usage: stapeskit figures PAGE DIR [--force]

Write the figures of a page (report.html, dof.html or kd.html) as SVG or PNG and
its tables as CSV and LaTeX into DIR.
""",
    "completion": """\
usage: stapeskit completion bash|zsh|fish

Print what completes the commands in a shell:  eval "$(stapeskit completion bash)"
""",
}


def work(arguments: list[str]) -> tuple[Any, Outcome] | None:
    """Run what the first word names.

    Raises
    ------
    StapeskitError
        The word is unknown (the nearest is named), or what the command itself raises.
    """
    word, rest = (arguments[0], arguments[1:]) if arguments else ("--help", [])
    if word in ("--help", "-h", "help"):
        sys.stdout.write(_HELP)
        return None
    if word == "--version":
        from legacy.stapeskit import __version__

        sys.stdout.write(f"stapeskit {__version__}\n")
        return None
    if word in COMMANDS:
        from importlib import import_module

        result: tuple[Any, Outcome] | None = import_module(COMMANDS[word]).work(rest)
        return result
    if word in _USAGE and {"-h", "--help"} & {*rest}:
        sys.stdout.write(_USAGE[word])
        return None
    if word in _USAGE:
        {"sample": _sample, "figures": _figures, "completion": _completion}[word](rest)
        return None
    from legacy.stapeskit.faults import StapeskitError

    raise StapeskitError(_unknown(word))


def _unknown(word: str) -> Fault:
    from legacy.stapeskit.faults import Fault
    from legacy.stapeskit.option_names import suggestion

    hint = suggestion(word, [*COMMANDS, *_USAGE]) or "Run stapeskit --help to see the commands"
    return Fault("the command", f"one of {', '.join((*COMMANDS, *_USAGE))}", word, "stapeskit", hint)


def _sample(words: Sequence[str]) -> None:
    """Copy the sample study into the folder that the words name."""
    from pathlib import Path

    from legacy.stapeskit.faults import StapeskitError

    folders = [word for word in words if word != "--force"]
    if len(folders) != 1 or folders[0].startswith("-"):
        got = " ".join(words) or "nothing"
        raise StapeskitError.of(
            "stapeskit sample", "given one folder", got, "", "Write for example stapeskit sample ear"
        )
    from legacy.pipeline.sample_study import copy_sample

    target = Path(folders[0])
    files = copy_sample(target, force="--force" in words)
    sys.stdout.write(
        f"{len(files)} files of a simulated ear written into {target}. Run it with:\n"
        f"  scan2kd {target / 'study.toml'} --out results\n"
    )


def _figures(words: Sequence[str]) -> None:
    """Write the figures and tables of the page that the words name."""
    from pathlib import Path

    from legacy.stapeskit.faults import StapeskitError

    names = [word for word in words if word != "--force"]
    if len(names) != 2 or any(name.startswith("-") for name in names):
        step = "Write for example stapeskit figures results/report.html figures"
        got = " ".join(words) or "nothing"
        raise StapeskitError.of("stapeskit figures", "given a page and a folder", got, "", step)
    from legacy.pipeline.figure_files import write_figures

    files = write_figures(Path(names[0]), Path(names[1]), force="--force" in words)
    sys.stdout.write(f"{len(files)} files written into {names[1]}\n")


def _completion(words: Sequence[str]) -> None:
    """Print the completion for a shell."""
    from legacy.pipeline.completion import SHELLS, completion
    from legacy.stapeskit.faults import StapeskitError

    if len(words) != 1 or words[0] not in SHELLS:
        got = " ".join(words) or "nothing"
        raise StapeskitError.of("stapeskit completion", f"one of {', '.join(SHELLS)}", got)
    from legacy.pipeline.options_page import COMMANDS as TABLES
    from legacy.stapeskit.options import declared

    common = [option.flag for table in TABLES["every command"] for option in declared(table)]
    flags: dict[str, Sequence[str]] = {
        command: [
            option.flag for table in TABLES[command] for option in declared(table) if not option.positional
        ]
        + common
        for command in COMMANDS
    }
    sys.stdout.write(completion(words[0], {"stapeskit": [*COMMANDS, *_USAGE], **flags}))


def main() -> NoReturn:
    """Run the command and leave with its exit code."""
    run("stapeskit", work)


if __name__ == "__main__":
    main()
