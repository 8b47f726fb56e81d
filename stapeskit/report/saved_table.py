"""Save the numbers of a table as CSV by a link of the page: value, sd, lower, upper, unit."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from urllib.parse import quote

from stapeskit.report.quantities import Quantity
from stapeskit.tables import as_text_cell


def numeric_columns(head: Sequence[str], rows: Sequence[Sequence[object]]) -> list[list[object]]:
    """Return head and rows of a CSV file; columns of quantities become value, sd, lower, upper, unit."""
    parts = ("value", "sd", "lower", "upper", "unit")
    wide = [any(isinstance(row[place], Quantity) for row in rows) for place in range(len(head))]
    names: list[object] = []
    for name, is_wide in zip(head, wide, strict=True):
        before = "" if sum(wide) == 1 or not name else f"{name} "
        names += [f"{before}{part}" for part in parts] if is_wide else [name or "name"]
    listed = [names]
    for row in rows:
        cells: list[object] = []
        for cell, is_wide in zip(row, wide, strict=True):
            if isinstance(cell, Quantity):
                cells += cell.numbers()
            else:
                cells += [cell, "", "", "", ""] if is_wide else [cell]
        listed.append(cells)
    return listed


def csv_link(rows: Iterable[Sequence[object]]) -> str:
    """Return rows as a CSV file within a link: it needs no script and no network."""
    stream = io.StringIO()
    csv.writer(stream).writerows(
        [[as_text_cell(cell) if isinstance(cell, str) else cell for cell in row] for row in rows]
    )
    return "data:text/csv;charset=utf-8," + quote("\ufeff" + stream.getvalue(), safe=" ,;:+-()/")
