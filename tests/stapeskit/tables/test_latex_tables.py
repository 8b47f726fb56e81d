"""Texts and tables for LaTeX."""

from __future__ import annotations

from legacy.stapeskit.tables.latex_tables import escaped, tabular


def test_special_signs_are_printed():
    assert escaped("a_b 5 % ± 1·10⁻³") == r"a\_b 5 \% $\pm$ 1$\cdot$10$^{-3}$"


def test_a_table_has_a_header_and_a_column_of_names():
    assert tabular([("law", "n"), ("K11 & mass", "8")]) == [
        r"\begin{tabular}{lr}",
        r"\toprule",
        r"law & n \\",
        r"\midrule",
        r"K11 \& mass & 8 \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]
