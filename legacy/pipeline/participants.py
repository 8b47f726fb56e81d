"""The table of participants of a dataset: adds rows and columns, keeps existing ones."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from legacy.pipeline.errors import PipelineError
from legacy.stapeskit.faults import Fault, raise_all
from legacy.stapeskit.tables.text_cells import as_text_cell

PARTICIPANTS = "participants.tsv"
_FIRST, _KEYS, _UNKNOWN = "participant_id", ("age", "sex", "group"), "n/a"


def with_participants(path: Path, participants: Mapping[str, Mapping[str, Any]]) -> str | None:
    """Return the text of a table of participants that holds these, or None when it does so already.

    Parameters
    ----------
    path : Path
        The table; may be missing.
    participants : mapping of str to mapping
        What is known of each, by its ``participant_id``.

    Raises
    ------
    PipelineError
        The table cannot be read as one, or says otherwise of a participant.
    """
    header, *rows = _read(path) if path.exists() else [[_FIRST, *_KEYS]]
    before = [list(header), *map(list, rows)]
    header += [key for key in _KEYS if key not in header]
    rows = [[*row, *[_UNKNOWN] * (len(header) - len(row))] for row in rows]
    known = {row[header.index(_FIRST)]: row for row in rows}
    faults = []
    for name in sorted(participants):
        if name not in known:
            known[name] = [name if column == _FIRST else _UNKNOWN for column in header]
            rows.append(known[name])
        row = known[name]
        for key in _KEYS:
            # a tab or a new line would begin another cell
            text = " ".join(str(participants[name].get(key, _UNKNOWN)).split())
            stated, place = as_text_cell(text), header.index(key)
            if row[place] in ("", _UNKNOWN):
                row[place] = stated
            elif stated != _UNKNOWN and not _is_same(row[place], stated):
                expected, got = f"{stated}, as [study] states", row[place]
                faults.append(Fault(f"{key} of {name}", expected, got, path.name, "Correct one of them"))
    raise_all(PipelineError, faults)
    if path.exists() and before == [header, *rows]:
        return None
    return "".join("\t".join(row) + "\n" for row in [header, *rows])


def _read(path: Path) -> list[list[str]]:
    """Return the rows of the table, its header first."""
    with suppress(UnicodeDecodeError):
        rows = [line.split("\t") for line in path.read_text(encoding="utf-8-sig").splitlines() if line]
        whole = rows and _FIRST in rows[0] and all(len(row) == len(rows[0]) for row in rows)
        if whole and len(set(rows[0])) == len(rows[0]):
            return rows
    expected = f"a table with tabs, a column {_FIRST} and as many cells in every row"
    raise PipelineError.of("the table of participants", expected, "another file", path.name, "Correct it")


def _is_same(cell: str, stated: str) -> bool:
    """Return whether two texts are one value: 61 and 61.0."""
    with suppress(ValueError):
        return float(cell) == float(stated)
    return cell == stated
