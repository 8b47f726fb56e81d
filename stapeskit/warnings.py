"""Warnings as data: a stable code and a text, carried in results, reports and on the terminal."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Notice:
    """One warning: ``code`` is stable and machine readable, ``text`` is one sentence for a person."""

    code: str
    text: str

    def as_json(self) -> dict[str, str]:
        """Return the form in which a notice stands in every JSON file."""
        return {"code": self.code, "text": self.text}


def from_json(records: Iterable[dict[str, str]]) -> tuple[Notice, ...]:
    """Read notices back from a ``warnings`` list."""
    return tuple(Notice(record["code"], record["text"]) for record in records)


def unique(notices: Iterable[Notice]) -> tuple[Notice, ...]:
    """Drop repeated notices, keeping the first of each and their order."""
    return tuple(dict.fromkeys(notices))
