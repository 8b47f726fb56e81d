"""Warnings as data: a `Notice` where one arises, and an entry for its code in a room's ``warnings.toml``.

``python -m stapeskit.warnings`` prints all entries as a page.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOMS = {
    "ct_inertia": "ct2mass",
    "kinematics": "points2dof",
    "fitting": "dof2kd",
    "pipeline": "scan2kd",
    "stapeskit": "all commands",
}
"""Packages that give warnings, in the order of the page, and their commands."""

VERDICTS = ("information", "check", "do not use")
"""What a warning means for the use of a result."""


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
    """A code: ``was`` lists those of earlier versions whose warnings have this one now."""

    meaning: str
    what_to_do: str
    verdict: str = "check"
    room: str = ""
    was: Sequence[str] = ()


@cache
def table() -> Mapping[str, WarningEntry]:
    """Return every warning by its code, room by room."""
    import tomllib

    root = Path(__file__).resolve().parents[1]
    entries: dict[str, WarningEntry] = {}
    for room in ROOMS:
        found = tomllib.loads((root / room / "warnings.toml").read_text(encoding="utf-8"))
        entries |= {code: WarningEntry(**entry, room=room) for code, entry in found.items()}
    return entries


def from_json(records: Iterable[Mapping[str, str]]) -> tuple[Notice, ...]:
    """Read notices back from a ``warnings`` list."""
    return tuple(Notice(record["code"], record["text"]) for record in records)


def is_among(code: str, names: Iterable[str]) -> bool:
    """Return whether names hold a code or its first words, as ``confirmed`` of a study does."""
    return any(code == name or code.startswith(f"{name}_") for name in names)


def once(notices: Iterable[Notice]) -> tuple[Notice, ...]:
    """Keep the first of each; a warning that was passed on has the stage of its origin before its text."""
    kept: dict[tuple[str, str], Notice] = {}
    for notice in notices:
        text = notice.text.removeprefix("motion: ").removeprefix("mass: ")
        kept.setdefault((notice.code, text), notice)
    return tuple(kept.values())


def page() -> str:
    """Write the table as Markdown, a section for each room."""
    lines = [
        "# Warnings",
        "",
        "Each has a stable code and a text with the numbers of the case, on the terminal, the page and in",
        "the JSON results, and travels with the results of its step. The verdict is **check** (look first)",
        "where no row says **information** (use the numbers) or **do not use**.",
    ]
    for room, command in ROOMS.items():
        entries = sorted((code, entry) for code, entry in table().items() if entry.room == room)
        lines += ["", f"## {command}", "", "| code | meaning | what to do |", "|-|-|-|"]
        for code, entry in entries:
            verdict = "" if entry.verdict == "check" else f"**{entry.verdict}:** "
            lines.append(f"| `{code}` | {verdict}{entry.meaning} | {entry.what_to_do} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    import sys

    sys.stdout.write(page())
