"""Warnings as data: a stable code and a text, carried in results, reports and on the terminal.

A warning is a `Notice` where it arises and an entry of ``warnings.toml``, which says what its code means;
``python -m stapeskit.warnings`` prints it as a page.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOMS = ("ct_inertia", "kinematics", "fitting", "pipeline", "stapeskit")
"""In the order of the page."""
VERDICTS = ("information", "check", "do not use")
"""What a warning means for the use of a study."""


@dataclass(frozen=True)
class Notice:
    """One warning: ``code`` is stable and machine readable, ``text`` is one sentence for a person."""

    code: str
    text: str

    def as_json(self) -> dict[str, str]:
        """Return the form of a notice in every JSON file."""
        return {"code": self.code, "text": self.text}


@dataclass(frozen=True)
class WarningEntry:
    """What a code means.

    Attributes
    ----------
    room : str
        The package that gives the warning, one of `ROOMS`.
    verdict : str
        On a study that has the warning, one of `VERDICTS`.
    """

    meaning: str
    room: str
    what_to_do: str
    verdict: str = "check"


@cache
def table() -> dict[str, WarningEntry]:
    """Return every warning by its code, in the order of ``warnings.toml``."""
    import tomllib

    entries = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
    return {code: WarningEntry(**entry) for code, entry in entries.items()}


def from_json(records: Iterable[dict[str, str]]) -> tuple[Notice, ...]:
    """Read notices back from a ``warnings`` list."""
    return tuple(Notice(record["code"], record["text"]) for record in records)


def unique(notices: Iterable[Notice]) -> tuple[Notice, ...]:
    """Drop repeated notices, keeping the first of each and their order."""
    return tuple(dict.fromkeys(notices))


def page() -> str:
    """Write the table as Markdown, a section for each room."""
    commands = {
        "ct_inertia": "ct2mass",
        "kinematics": "points2dof",
        "fitting": "dof2kd",
        "pipeline": "scan2kd",
        "stapeskit": "all commands",
    }
    lines = [
        "# Warnings",
        "",
        "Every warning has a stable code and a text. Both are on the terminal, in the report and in the JSON "
        'results (`"warnings": [{"code", "text"}]`). The text gives the numbers of the case; this page says '
        "what the code means and what can be done. Warnings of a step travel with its results into the next. "
        "The last column is the verdict on a study that has the warning: `information` (the numbers can be "
        "used), `check` (look before you use them), or `do not use`.",
        "",
        "Options are written as on the command line; `scan2kd --template` shows their keys in a study file.",
    ]
    for room in ROOMS:
        lines += [
            "",
            f"## {room} ({commands[room]})",
            "",
            "| code | meaning | what to do | study |",
            "|---|---|---|---|",
        ]
        entries = sorted((code, entry) for code, entry in table().items() if entry.room == room)
        lines += [
            f"| `{code}` | {entry.meaning} | {entry.what_to_do} | {entry.verdict} |"
            for code, entry in entries
        ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    import sys

    sys.stdout.write(page())
