"""A workbook of a cohort: a sheet each for ears, laws, components, excluded ears and warnings."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from legacy.pipeline.cohort.cohort_laws import CohortLaws
from legacy.pipeline.cohort.exports.tables import sheets

_NO_GUESSES = {"strings_to_formulas": False, "strings_to_urls": False, "strings_to_numbers": False}
# Letters of the widest column.
_WIDEST = 60


def write(folder: Path, cohort: CohortLaws, content: Mapping[str, Any]) -> None:
    """Write cohort.xlsx; texts stay texts, whatever they begin with."""
    import pandas as pd

    with pd.ExcelWriter(
        folder / "cohort.xlsx", engine="xlsxwriter", engine_kwargs={"options": _NO_GUESSES}
    ) as book:
        date = content["provenance"].get("date")
        created = datetime.fromisoformat(date) if date else datetime.now(UTC)
        book.book.set_properties({"title": "Cohort", "created": created})
        for name, table in sheets(cohort, content).items():
            table.to_excel(book, sheet_name=name, index=False, freeze_panes=(1, 1))
            for place, column in enumerate(table.columns):
                longest = max([len(str(column)), *(len(str(value)) for value in table[column].head(50))])
                book.sheets[name].set_column(place, place, min(longest, _WIDEST) + 2)
