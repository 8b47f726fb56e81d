"""The laws of a cohort as a table of comma-separated values."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.cohort.cohort_laws import CohortLaws

# Columns of intervals have two ends each in cohort.json; in tables each end is a column.
_INTERVALS = {
    "exponent_interval_95": ("exponent_low_95", "exponent_high_95"),
    "intrinsic_sd_log_interval_95": ("intrinsic_sd_log_low_95", "intrinsic_sd_log_high_95"),
}


def law_rows(content: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return a row for each law of cohort.json; open ends of intervals are empty."""
    rows = []
    for law in content["laws"]:
        row: dict[str, Any] = {}
        for key, value in law.items():
            ends = _INTERVALS.get(key)
            row |= {key: value} if ends is None else dict(zip(ends, value, strict=True))
        rows.append(row)
    return rows


def write(folder: Path, _cohort: CohortLaws, content: Mapping[str, Any]) -> None:
    """Write cohort_laws.csv."""
    import pandas as pd

    table = pd.DataFrame(law_rows(content))
    table.to_csv(folder / "cohort_laws.csv", index=False, lineterminator="\n")
