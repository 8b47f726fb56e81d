"""The files of a cohort."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.cohort.ears import write_cohort_csv
from pipeline.cohort.page import write_cohort_page
from pipeline.cohort.study_of_ears import CohortLaws
from stapeskit.own_files import OutputSet
from stapeskit.provenance import record

COHORT_FILES = ("cohort.csv", "cohort.html", "cohort.json")


def cohort_outputs(folder: Path, inputs: Sequence[Path], force: bool) -> OutputSet:
    """Return the outputs of a cohort, which replace no input and nothing of another origin."""
    return OutputSet("scan2kd", Path(folder), COHORT_FILES, tuple(inputs), force)


def write_cohort(
    folder: Path, cohort: CohortLaws, parameters: Mapping[str, Any], files: Mapping[str, Path] | None = None
) -> None:
    """Write the table, the page and the record of a cohort into an empty folder."""
    failed = dict(cohort.excluded)
    content = cohort.as_json(record(files or {}, parameters))
    write_cohort_csv(folder / "cohort.csv", cohort.ears, failed)
    write_cohort_page(folder / "cohort.html", cohort.ears, failed, cohort)
    (folder / "cohort.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
