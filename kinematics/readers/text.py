"""Lines of a text as files have them, and foreign text made fit for a message."""

from __future__ import annotations

import re

_LINE = re.compile(r"\r\n|\n|\r")
_MOST = 60


def lines_of(text: str) -> list[str]:
    """Split at line feeds and carriage returns only: other marks stand for letters in Latin-1."""
    lines = _LINE.split(text)
    return lines[:-1] if lines and not lines[-1] else lines


def shown(text: str) -> str:
    """Quote a text for a message: on one line, printable, shortened."""
    plain = "".join(letter if letter.isprintable() else "?" for letter in text.strip())
    return f'"{plain if len(plain) <= _MOST else plain[: _MOST - 3] + "..."}"'
