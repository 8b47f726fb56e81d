"""The figures of the planned laws as vector graphics."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from legacy.pipeline.cohort.cohort_laws import CohortLaws


def write(folder: Path, cohort: CohortLaws, _content: Mapping[str, Any]) -> None:
    """Write cohort_laws.svg and cohort_exponents.svg."""
    from legacy.pipeline.cohort.law_figures import exponents_figure, laws_figure

    # The date would make equal cohorts different files.
    for name, drawing in (("laws", laws_figure(cohort)), ("exponents", exponents_figure(cohort.primary))):
        drawing.savefig(folder / f"cohort_{name}.svg", format="svg", metadata={"Date": None})
