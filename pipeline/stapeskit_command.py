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
_OWN = {
    "sample": "sample DIR [--force]",
    "new": "new [DIR] [--yes] [--force]",
    "app": "app [FOLDER] [--no-browser] [--port NUMBER]",
    "compare": "compare A [B] [--what-if K*10|D*2|mass+5mg@head ...] [--out DIR] [--force]",
}
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
        if {"-h", "--help"} & {*rest}:
            sys.stdout.write(f"usage: stapeskit {_OWN[word]}\n\nstapeskit --help says what it does.\n")
            return None
        return {"sample": _sample, "new": _new, "app": _app, "compare": _compare}[word](rest)
    from stapeskit.faults import StapeskitError
    from stapeskit.options import unknown

    known = [*_COMMANDS, *_OWN]
    step = unknown(word, known).next_step or "Run stapeskit --help to see the commands"
    raise StapeskitError.of("the command", f"one of {', '.join(known)}", word, "", step)


def _folders(
    words: Sequence[str], command: str, counts: tuple[int, ...], flags: tuple[str, ...]
) -> list[str]:
    """Return the words that are no flags, when there are as many as the command takes."""
    from stapeskit.faults import StapeskitError

    folders = [word for word in words if word not in flags]
    if len(folders) not in counts or any(word.startswith("-") for word in folders):
        got = " ".join(words) or "nothing"
        raise StapeskitError.of(f"stapeskit {command}", f"written as: stapeskit {_OWN[command]}", got)
    return folders


def _sample(words: Sequence[str]) -> None:
    """Copy the sample study into the folder that the words name."""
    from pathlib import Path

    from pipeline.sample import copy_sample

    target = Path(_folders(words, "sample", (1,), ("--force",))[0])
    files = copy_sample(target, force="--force" in words)
    sys.stdout.write(
        f"{len(files)} files of a simulated ear written into {target}. Run it with:\n"
        f"  scan2kd {target / 'study.toml'} --out results\n"
    )


def _new(words: Sequence[str]) -> None:
    """Write a study.toml for the files of a folder; ask what no file says, unless --yes."""
    from pathlib import Path

    from pipeline.new_study import needs, new_study

    folders = _folders(words, "new", (0, 1), ("--yes", "--force"))
    ask = None if "--yes" in words or not sys.stdin.isatty() else input
    path = new_study(Path(*folders), ask, force="--force" in words)
    missing = needs(path)
    still = f"Before it can run:\n{missing}\n" if missing else ""
    sys.stdout.write(f"{path} written. {still}Look at it, then run: scan2kd {path}\n")


def _app(words: Sequence[str]) -> None:
    """Serve the page of the app until Ctrl-C; this process becomes the server."""
    from importlib import import_module
    from pathlib import Path

    rest, given = _taken(words, "app", ("--port",))
    folders = _folders(rest, "app", (0, 1), ("--no-browser",))
    more: list[str] = []
    for port in given["--port"][-1:]:
        if not (port.isascii() and port.isdigit() and 0 < int(port) < 65536):
            from stapeskit.faults import StapeskitError

            raise StapeskitError.of("--port", "a number from 1 to 65535", port)
        more = ["--port", port]
    if "--no-browser" in rest:
        more.append("--headless")
    # The room of the app is above this one: it is imported only when its command is used.
    import_module("app.launch").start(Path(*folders), more)


def _compare(words: Sequence[str]) -> Outcome:
    """Compare two results, or predict the effect of changes on one or both."""
    from pathlib import Path

    from pipeline.compare import compare, read_folders, write_comparison
    from pipeline.what_if import SENTENCE, effect, read_change

    rest, given = _taken(words, "compare", ("--out", "--what-if"))
    out = Path(given["--out"][-1] if given["--out"] else "compare_out")
    changes = [read_change(change) for change in given["--what-if"]]
    folders = [Path(word) for word in _folders(rest, "compare", (1, 2) if changes else (2,), ("--force",))]
    inputs = [folder / name for folder in folders for name in ("mass.json", "kd.json", "dof.h5")]
    rows: list[tuple[str, str]] = []
    files: list[Path] = []
    if len(folders) == 2:
        found = compare(folders[0], folders[1])
        files += write_comparison(found, out, inputs, "--force" in rest)
        rows += [(f"verdict of {ear.name}", ear.verdict or "not stated") for ear in found.ears]
        rows += [
            (name, f"{first} | {second}; difference {change}, p = {p}")
            for name, first, second, change, p in found.rows()
        ]
    if changes:
        read = list(zip(read_folders(folders), folders, strict=True))
        effects = [effect(ear, folder, change) for ear, folder in read for change in changes]
        files += write_comparison(effects, out, inputs, "--force" in rest)
        rows += [(f"{one.name}, {place}", text) for one in effects for place, text in one.rows()]
        rows.append(("mind", SENTENCE))
    return Outcome("results side by side", rows, (), files)


def _taken(
    words: Sequence[str], command: str, options: tuple[str, ...]
) -> tuple[list[str], dict[str, list[str]]]:
    """Return the words without options and their values, and the values of each option."""
    from stapeskit.faults import StapeskitError

    rest, given = list[str](), {option: list[str]() for option in options}
    waiting = iter(words)
    for word in waiting:
        option, equal, value = word.partition("=")
        if option in given:
            value = value if equal else next(waiting, "")
            if not value or value.startswith("--"):
                wanted = f"followed by its value: stapeskit {_OWN[command]}"
                raise StapeskitError.of(option, wanted, value or "nothing")
            given[option].append(value)
        else:
            rest.append(word)
    return rest, given


def main() -> NoReturn:
    """Run the command and leave with its exit code."""
    run("stapeskit", work)


if __name__ == "__main__":
    main()
