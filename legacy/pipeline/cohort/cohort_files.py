"""The files of a cohort."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from legacy.pipeline.cohort.cohort_laws import CohortLaws
from legacy.pipeline.cohort.cohort_page import write_cohort_page
from legacy.pipeline.cohort.compare_ears import write_cohort_csv
from legacy.pipeline.cohort.exports import EXPORTS
from legacy.stapeskit.own_files import OutputSet
from legacy.stapeskit.provenance import record

COHORT_FILES = ("cohort.csv", "cohort.html", "cohort.json")
LOG_FILE = "cohort.log"


def cohort_names(exports: Iterable[str] = tuple(EXPORTS)) -> list[str]:
    """Return the names of the files of a cohort with these exports, by default all."""
    return [*COHORT_FILES, LOG_FILE, *(name for export in exports for name in EXPORTS[export].files)]


def cohort_outputs(
    folder: Path, inputs: Sequence[Path], force: bool, exports: Sequence[str] = ()
) -> OutputSet:
    """Return the outputs of a cohort, which replace no input and nothing of another origin."""
    names = cohort_names(exports)
    others = [name for name in cohort_names() if name not in names]
    return OutputSet("scan2kd", Path(folder), tuple(names), tuple(inputs), force, leftovers=tuple(others))


def write_cohort(
    folder: Path,
    cohort: CohortLaws,
    parameters: Mapping[str, Any],
    files: Mapping[str, Path] | None = None,
    failed: Mapping[str, str] | None = None,
    exports: Sequence[str] = (),
) -> list[str]:
    """Write the table, the page, the record and the exports of a cohort into an empty folder.

    Parameters
    ----------
    parameters : mapping
        For the provenance.
    files : mapping of str to Path, optional
        What the cohort was made from.
    failed : mapping of str to str, optional
        Studies without a result, by folder, and why.
    exports : sequence of str
        Names of `EXPORTS`.

    Returns
    -------
    list of str
        Names of the files.
    """
    failed = failed or {}
    content = cohort.as_json(record(files or {}, parameters, {}))
    write_cohort_csv(folder / "cohort.csv", cohort.ears, failed)
    write_cohort_page(folder / "cohort.html", cohort.ears, failed, cohort)
    (folder / "cohort.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    for name in exports:
        EXPORTS[name].write(folder, cohort, content)
    return [*COHORT_FILES, *(name for export in exports for name in EXPORTS[export].files)]
