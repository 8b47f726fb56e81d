"""Start the page: on this machine alone, and only for who has the token in its address."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from stapeskit.faults import StapeskitError

NEEDED = ("marimo", "ipyniivue", "tomlkit")
"""Packages of the extra."""

INSTALL = "pip install '.[app]', in the source folder of stapeskit"
_KEPT_S = 3600  # how long a page that lost its connection can come back


def app_command(folder: Path, more: Sequence[str] = ()) -> list[str]:
    """Return the command that serves the page of a folder, with further options of ``marimo run``.

    Raises
    ------
    StapeskitError
        The extra is not installed, or there is no such folder.
    """
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        got = f"{', '.join(missing)} missing"
        raise StapeskitError.of("the packages of the app", "installed", got, "", f"Install them: {INSTALL}")
    folder = Path(folder).absolute()
    if not folder.is_dir():
        raise StapeskitError.of("the folder", "an existing folder", folder, "", "Check its name")
    page = Path(__file__).with_name("page.py")
    serve = ["run", str(page), "--host", "127.0.0.1", "--token", "--session-ttl", str(_KEPT_S)]
    # Tracebacks stay in the terminal; what is wrong with an input is shown in the library's own words.
    serve += ["--no-show-tracebacks", "--no-check", *more]
    return [sys.executable, "-m", "marimo", *serve, "--", "--folder", str(folder)]


def start(folder: Path, more: Sequence[str] = ()) -> None:
    """Become the server: a killed launcher leaves nothing behind, and Ctrl-C ends it."""
    command = app_command(folder, more)
    os.chdir(Path(__file__).parents[1])  # a file app.py where the user is must not be taken for this package
    os.execv(sys.executable, command)
