"""Tables of a cohort for LaTeX (booktabs)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from legacy.pipeline.cohort.cohort_laws import CohortLaws
from legacy.pipeline.cohort.compare_ears import labels, quantities
from legacy.pipeline.cohort.law_labels import law_name
from legacy.stapeskit.page.numbers import plus_minus
from legacy.stapeskit.tables.latex_tables import PACKAGE, escaped, tabular


def _table(caption: str, rows: Sequence[Sequence[str]]) -> str:
    begin = [r"\begin{table}", rf"\caption{{{escaped(caption)}}}"]
    return "\n".join([*begin, *tabular(rows), r"\end{table}", ""])


def write(folder: Path, cohort: CohortLaws, _content: Mapping[str, Any]) -> None:
    """Write cohort.tex."""
    shown = [quantity for quantity in quantities(cohort.ears) if _on_diagonal(quantity.name)]
    rows = [
        [
            name,
            *(
                plus_minus(float(quantity.values[k]), float(quantity.deviations[k]))
                if np.isfinite(quantity.deviations[k])
                else f"{quantity.values[k]:.4g}"
                for quantity in shown
            ),
        ]
        for k, name in enumerate(labels(cohort.ears))
    ]
    header = ["ear", *(f"{quantity.name.replace('_', ' ')} ({quantity.unit})" for quantity in shown)]
    parts = [PACKAGE, _table("Ears with standard deviations, SI units.", [header, *rows])]
    if cohort.primary:
        rows = [
            [
                law_name(law),
                f"{law.law.exponent:.2f}",
                " to ".join(f"{end:.2f}" if np.isfinite(end) else "open" for end in law.law.interval),
                f"{law.law.p_value:.2g}",
                f"{law.q_value:.2g}",
                f"{law.law.sigma:.3f}",
                str(law.law.n),
            ]
            for law in cohort.primary
        ]
        header = ["law", "exponent", "95 % interval", "p", "q", "scatter (ln)", "ears"]
        parts.append(_table("Planned laws.", [header, *rows]))
    (folder / "cohort.tex").write_text("\n".join(parts), encoding="utf-8")


def _on_diagonal(name: str) -> bool:
    letter, *dof = name.split("_")
    return name == "mass" or (letter in "KD" and dof[0] == dof[1])
