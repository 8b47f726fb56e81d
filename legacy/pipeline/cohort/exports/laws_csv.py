"""The laws of a cohort as comma-separated values."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from legacy.pipeline.cohort.cohort_laws import CohortLaws
from legacy.pipeline.cohort.exports.tables import laws_table


def write(folder: Path, _cohort: CohortLaws, content: Mapping[str, Any]) -> None:
    """Write cohort_laws.csv."""
    laws_table(content).to_csv(folder / "cohort_laws.csv", index=False, lineterminator="\n")
