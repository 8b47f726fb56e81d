"""Cases that were once found, as files: tests/fuzz/corpus/NAME holds the files and the words."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from tests.fuzz.case import Case

FOLDER = Path(__file__).resolve().parent / "corpus"
_WORDS = "case.json"
_EMPTY = "folders"


def save(case: Case, name: str) -> Path:
    """Write a case into the corpus and return its folder."""
    folder = FOLDER / name
    for file, content in case.files.items():
        if not file.endswith("/"):
            path = folder / "in" / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
    words = {
        "name": case.name,
        "arguments": case.arguments,
        "declared": case.declared,
        _EMPTY: [file for file in case.files if file.endswith("/")],
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / _WORDS).write_text(json.dumps(words, indent=1) + "\n", encoding="utf-8")
    return folder


def saved() -> Iterator[tuple[str, Case]]:
    """Read the corpus."""
    for path in sorted(FOLDER.glob(f"*/{_WORDS}")):
        words = json.loads(path.read_text(encoding="utf-8"))
        inside = path.parent / "in"
        files = {
            file.relative_to(inside).as_posix(): file.read_bytes()
            for file in sorted(inside.rglob("*"))
            if file.is_file()
        }
        files.update(dict.fromkeys(words[_EMPTY], b""))
        yield path.parent.name, Case(words["name"], files, tuple(words["arguments"]), words["declared"])
