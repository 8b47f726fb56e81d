"""The command stapeskit: the sample study, new studies, comparisons, and the other commands by name."""

from __future__ import annotations

import sys

from stapeskit.command import Outcome, run

TYPE_CHECKING = False  # everything is imported on first use, so that the help is quick
if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import NoReturn

_HELP = """\
usage: stapeskit COMMAND ...

From a micro-CT and a 3D laser Doppler vibrometer to mass, stiffness and damping
of a stapes.

  sample DIR     copy a complete simulated study into DIR
  ct2mass        scan to mass matrix
  points2dof     vibrometer file to rigid-body motion
  dof2kd         motion and mass to stiffness and damping
  scan2kd        a whole study, or several

stapeskit COMMAND --help says more; stapeskit --version prints the version.

try it:
  stapeskit sample ear
  scan2kd ear/study.toml --out results
"""
_COMMANDS = {
    "ct2mass": "ct_inertia.cli",
    "points2dof": "kinematics.cli",
    "dof2kd": "fitting.cli",
    "scan2kd": "pipeline.cli",
}


def work(words: list[str]) -> Outcome | None:
    """Run what the first word names.

    Raises
    ------
    StapeskitError
        The word is unknown (the nearest is named), or what the command itself raises.
    """
    word, rest = (words[0], words[1:]) if words else ("--help", [])
    if word in ("--help", "-h", "help"):
        sys.stdout.write(_HELP)
        return None
    if word == "--version":
        from stapeskit import __version__

        sys.stdout.write(f"stapeskit {__version__}\n")
        return None
    if word in _COMMANDS:
        from importlib import import_module

        outcome: Outcome | None = import_module(_COMMANDS[word]).work(rest)
        return outcome
    if word == "sample":
        return _sample(rest)
    from stapeskit.faults import StapeskitError
    from stapeskit.options import unknown

    known = [*_COMMANDS, "sample"]
    step = unknown(word, known).next_step or "Run stapeskit --help to see the commands"
    raise StapeskitError.of("the command", f"one of {', '.join(known)}", word, "", step)


def _sample(words: Sequence[str]) -> None:
    """Copy the sample study into the folder that the words name."""
    from pathlib import Path

    from stapeskit.faults import StapeskitError

    folders = [word for word in words if word != "--force"]
    if {"-h", "--help"} & {*words}:
        sys.stdout.write("usage: stapeskit sample DIR [--force]\n\nCopy a simulated study into DIR.\n")
        return
    if len(folders) != 1 or folders[0].startswith("-"):
        got = " ".join(words) or "nothing"
        step = "Write for example stapeskit sample ear"
        raise StapeskitError.of("stapeskit sample", "given one folder", got, "", step)
    from pipeline.sample import copy_sample

    target = Path(folders[0])
    files = copy_sample(target, force="--force" in words)
    sys.stdout.write(
        f"{len(files)} files of a simulated ear written into {target}. Run it with:\n"
        f"  scan2kd {target / 'study.toml'} --out results\n"
    )


def main() -> NoReturn:
    """Run the command and leave with its exit code."""
    run("stapeskit", work)


if __name__ == "__main__":
    main()
