"""Find the commands in pyproject.toml and run one of them in this process, as its user would."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import re
import runpy
import sys
import tomllib
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Ran:
    """How a command ended.

    Attributes
    ----------
    code : int
        Exit code.
    out, err : str
        What it printed.
    """

    code: int
    out: str
    err: str


def entry_point(command: str) -> Callable[[], object]:
    """Return the function that [project.scripts] of pyproject.toml names for a command."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    module, _, function = project["scripts"][command].partition(":")
    return getattr(importlib.import_module(module), function)


def page(name: str) -> Path:
    """Return the module of the given file name that writes a page; several names stand for its renames."""
    names = [*name.split("|")]
    found = [
        path
        for path in sorted(ROOT.rglob("*.py"))
        if path.stem in names and not {".venv", "tests"} & set(path.relative_to(ROOT).parts)
    ]
    if len(found) != 1:
        raise LookupError(f"one module must be named {name}; got {len(found)}. Name it in scenes.py.")
    return found[0]


def run(command: str, arguments: list[str]) -> Ran:
    """Run a command of the project, or ``page:NAME``, in the current folder."""
    out, err = io.StringIO(), io.StringIO()
    before = sys.argv
    sys.argv = [command, *arguments]
    code = 0
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), small_figures():
            if command.startswith("page:"):
                module = page(command.removeprefix("page:")).relative_to(ROOT).with_suffix("")
                runpy.run_module(".".join(module.parts), run_name="__main__")
            else:
                entry_point(command)()
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except BaseException:
        code = 1
        err.write(traceback.format_exc())
    finally:
        sys.argv = before
    return Ran(code, out.getvalue(), err.getvalue())


@contextlib.contextmanager
def small_figures() -> Iterator[None]:
    """Save empty figures meanwhile: pages are not compared, and drawing takes most of their time."""
    from matplotlib.figure import Figure

    save = Figure.savefig

    def nothing_drawn(figure: Figure, *arguments: object, **options: object) -> object:
        options.pop("bbox_inches", None)
        return save(Figure(figsize=figure.get_size_inches(), dpi=figure.dpi), *arguments, **options)

    if os.environ.get("GOLDEN_DRAW") == "1":
        yield
        return
    Figure.savefig = nothing_drawn  # type: ignore[method-assign]
    try:
        yield
    finally:
        Figure.savefig = save  # type: ignore[method-assign]


def terminal_codes(err: str) -> list[str]:
    """Return the codes of the warnings on the terminal, in order."""
    return re.findall(r"^warning \[(\w+)\]", err, re.MULTILINE)
