"""The numbers of a cohort as pandas tables, which exports write in their forms."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.pipeline.cohort.compare_ears import ear_table
from legacy.stapeskit.tables.text_cells import as_text_cell

if TYPE_CHECKING:
    import pandas as pd

    from legacy.pipeline.cohort.cohort_laws import CohortLaws

# Intervals have two ends each in cohort.json; in tables each end is a column.
_ENDS = {
    "exponent_interval_95": ("exponent_low_95", "exponent_high_95"),
    "intrinsic_sd_log_interval_95": ("intrinsic_sd_log_low_95", "intrinsic_sd_log_high_95"),
}


def laws_table(content: Mapping[str, Any]) -> pd.DataFrame:
    """Return a row for each law of cohort.json; open ends of intervals are empty."""
    import pandas as pd

    rows = []
    for law in content["laws"]:
        row: dict[str, Any] = {}
        for key, value in law.items():
            ends = _ENDS.get(key)
            row |= {key: value} if ends is None else dict(zip(ends, value, strict=True))
        rows.append(row)
    return pd.DataFrame(rows)


def components_table(cohort: CohortLaws) -> pd.DataFrame:
    """Return a row for each component of variation: its sd and what it changes in each quantity."""
    import pandas as pd

    components, table = cohort.components, cohort.table
    if components is None or table is None:
        return pd.DataFrame(columns=["component", "sd_log"])
    columns = {"component": np.arange(1, len(components.sd) + 1), "sd_log": components.sd}
    return pd.DataFrame(columns | dict(zip(table.entries, components.loadings.T, strict=True)))


def sheets(cohort: CohortLaws, content: Mapping[str, Any]) -> dict[str, pd.DataFrame]:
    """Return every table of a cohort by name."""
    import pandas as pd

    warnings = [{**row, "text": as_text_cell(row["text"])} for row in content["warnings"]]
    excluded = [{name: as_text_cell(text) for name, text in row.items()} for row in content["excluded"]]
    return {
        "ears": ear_table(cohort.ears),
        "laws": laws_table(content),
        "components": components_table(cohort),
        "excluded": pd.DataFrame(excluded, columns=["ear", "reason"]),
        "warnings": pd.DataFrame(warnings, columns=["code", "text"]),
    }
