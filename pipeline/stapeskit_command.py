"""The command stapeskit: the sample study, new studies, comparisons, and the other commands by name."""

from __future__ import annotations

import sys

from stapeskit.command import Outcome, run

TYPE_CHECKING = False  # everything is imported on first use, so that the help is quick
if TYPE_CHECKING:
    from pathlib import Path
    from typing import NoReturn

_HELP = """\
usage: stapeskit COMMAND ...

From a micro-CT and a 3D laser Doppler vibrometer to mass, stiffness and damping
of a stapes.

  sample DIR     copy a complete simulated study into DIR
  new [DIR]      write a study.toml for the files of DIR (--yes: ask nothing)
  app [FOLDER]   the whole chain in one page in the browser
  compare A B    two results side by side: differences, responses
                 (--what-if K*10: of one or both, what a change would do)
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
    if word in _OWN:
        return _OWN[word](rest)
    from stapeskit.faults import StapeskitError
    from stapeskit.options import unknown

    known = [*_COMMANDS, *_OWN]
    step = unknown(word, known).next_step or "Run stapeskit --help to see the commands"
    raise StapeskitError.of("the command", f"one of {', '.join(known)}", word, "", step)


def _sample(words: list[str]) -> None:
    from pipeline.command_options import SampleOptions
    from stapeskit.command_line import parse

    (chosen,) = parse("stapeskit sample", "Copy a whole simulated ear.", [SampleOptions], words)
    from pipeline.sample import copy_sample

    files = copy_sample(chosen.folder, force=chosen.force)
    sys.stdout.write(
        f"{len(files)} files of a simulated ear written into {chosen.folder}. Run it with:\n"
        f"  scan2kd {chosen.folder / 'study.toml'} --out results\n"
    )


def _new(words: list[str]) -> None:
    from pipeline.command_options import NewOptions
    from stapeskit.command import printable
    from stapeskit.command_line import parse

    (chosen,) = parse("stapeskit new", "Write a study.toml for the files of a folder.", [NewOptions], words)
    from pipeline.new_study import needs, new_study

    ask = None if chosen.yes or not sys.stdin.isatty() else lambda text: input(printable(text))
    path = new_study(chosen.folder, ask, force=chosen.force)
    missing = needs(path)
    still = f"Before it can run:\n{missing}\n" if missing else ""
    sys.stdout.write(f"{path} written. {still}Look at it, then run: scan2kd {path}\n")


def _app(words: list[str]) -> None:
    """Serve the page of the app until Ctrl-C; this process becomes the server."""
    from importlib import import_module

    from pipeline.command_options import AppOptions
    from stapeskit.command_line import parse

    text = "The whole chain in one page in the browser; Ctrl-C ends it."
    (chosen,) = parse("stapeskit app", text, [AppOptions], words)
    more = ["--port", str(chosen.port)] if chosen.port else []
    more += ["--headless"] if chosen.no_browser else []
    # The room of the app is above this one: it is imported only when its command is used.
    import_module("app.launch").start(chosen.folder, more)


def _compare(words: list[str]) -> Outcome:
    """Compare two results, or predict the effect of changes on one or both."""
    from pipeline.command_options import CompareOptions
    from stapeskit.command_line import parse

    text = "Two results side by side, or what a change would do to one or both."
    (chosen,) = parse("stapeskit compare", text, [CompareOptions], words)
    from pipeline.compare import compare, read_folders, write_comparison
    from pipeline.what_if import SENTENCE, effect_rows, read_change

    changes, folders = [read_change(change) for change in chosen.what_if], chosen.folders
    inputs = [folder / name for folder in folders for name in ("mass.json", "kd.json", "dof.h5")]
    rows: list[tuple[str, str]] = []
    files: list[Path] = []
    if len(folders) == 2:
        found = compare(*folders)
        files += write_comparison(found, chosen.out, inputs, chosen.force)
        rows += [(f"verdict of {ear.name}", ear.verdict or "not stated") for ear in found.ears]
        rows += [
            (name, f"{first} | {second}; difference {change}, p = {p}")
            for name, first, second, change, p in found.rows()
        ]
        rows += [("mind", found.remark)] if found.remark else []
    if changes:
        for ear, folder in zip(read_folders(folders), folders, strict=True):
            rows += [row for change in changes for row in effect_rows(ear, folder, change)]
        rows.append(("mind", SENTENCE))
    return Outcome("results side by side", rows, (), files)


_OWN = {"sample": _sample, "new": _new, "app": _app, "compare": _compare}


def main() -> NoReturn:
    """Run the command and leave with its exit code."""
    run("stapeskit", work)


if __name__ == "__main__":
    main()
