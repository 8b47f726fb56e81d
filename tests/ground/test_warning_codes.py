"""The codes in the sources and the tables of warnings are the same, each in its room."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from stapeskit.warnings import ROOMS, VERDICTS, page, table

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("room", ROOMS)
def test_every_entry_is_given_by_its_room(room: str) -> None:
    parts = _words(room) | _words("stapeskit")
    entries = [code for code, entry in table().items() if entry.room == room]
    missing = [code for code in entries if code not in parts and not _is_made(code, parts)]
    if room == "stapeskit":  # what two rooms or more say alike is declared here too
        others = [_words(other) for other in ROOMS if other != room]
        missing = [code for code in missing if sum(code in words for words in others) < 2]
    assert missing == []


def _words(room: str) -> set[str]:
    """Return the words of the sources of a room."""
    sources = (path.read_text(encoding="utf-8") for path in (ROOT / room).rglob("*.py"))
    return set(re.findall(r"[a-z0-9_]+", "\n".join(sources)))


def _is_made(code: str, parts: set[str]) -> bool:
    """Return whether a code is put together in the source, as those of faults: ``channel_`` and a kind."""
    if code.endswith("_found"):
        return code.removesuffix("_found") in parts
    return any(
        code.startswith(start) and code[len(start) :] in parts for start in ("channel_", "laser_", "body_")
    )


def test_every_notice_of_the_sources_has_an_entry() -> None:
    known = table()
    written = re.compile(r'(?:Notice|Cause)\(\s*"([a-z0-9]+_[a-z0-9_]+)"')
    for room in ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            for code in written.findall(path.read_text(encoding="utf-8")):
                assert code in known, f"{code} in {path.name}"


def test_entries_say_what_to_do_and_the_page_lists_each_once() -> None:
    lines = page().splitlines()
    for code, entry in table().items():
        assert entry.verdict in VERDICTS
        assert entry.meaning
        assert entry.what_to_do
        assert sum(line.startswith(f"| `{code}` |") for line in lines) == 1
