"""Lines of a text as files have them, and foreign text made fit for a message."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from legacy.kinematics.errors import KinematicsError

_LINE = re.compile(r"\r\n|\n|\r")
# Letters of a quoted text in a message.
_MOST = 60


def lines_of(text: str) -> list[str]:
    """Split at line feeds and carriage returns only: other separators of Unicode are letters in Latin-1."""
    lines = _LINE.split(text)
    return lines[:-1] if lines and not lines[-1] else lines


def plain_text(text: str) -> str:
    """Make foreign text fit for a message: on one line, printable, shortened."""
    plain = "".join(letter if letter.isprintable() else "?" for letter in text.strip())
    return plain if len(plain) <= _MOST else plain[: _MOST - 3] + "..."


def shown(text: str) -> str:
    """Quote a text for a message: on one line, printable, shortened."""
    return f'"{plain_text(text)}"'


@contextmanager
def openable(path: Path) -> Iterator[None]:
    """Turn an error of the system on opening or reading a file into a fault.

    Raises
    ------
    KinematicsError
        Such a file, by name.
    """
    try:
        yield
    except OSError as fault:
        name = Path(fault.filename).name if isinstance(fault.filename, str) else Path(path).name
        got = fault.strerror or type(fault).__name__
        step = "Check the permissions and the disk it lies on"
        raise KinematicsError.of("the vibrometer file", "readable", got, name, step) from fault
