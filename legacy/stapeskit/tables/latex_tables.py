r"""Tables for LaTeX (booktabs); ``stapeskit/page/parts/page.js`` writes the same from a page."""

from __future__ import annotations

import re
from collections.abc import Sequence

_FORMULAS = {
    **{"α": "alpha", "β": "beta", "γ": "gamma", "ω": "omega", "ζ": "zeta", "σ": "sigma", "χ": "chi"},
    **{"φ": "varphi", "µ": "mu", "μ": "mu", "±": "pm", "×": "times", "·": "cdot", "√": "surd"},
}
_SIGNS = {sign: rf"$\{name}$" for sign, name in _FORMULAS.items()} | {
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"},
    **{"°": r"$^\circ$", "−": "$-$", "–": "--"},
    **{sign: rf"\{sign}" for sign in "&%$#_{}"},
}
_LOWERED = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
_RAISED = re.compile("[⁰¹²³⁴⁵⁶⁷⁸⁹⁻]+")
PACKAGE = r"% needs \usepackage{booktabs}"


def escaped(text: str) -> str:
    r"""Return a text as LaTeX prints it.

    Examples
    --------
    >>> print(escaped("50 % of (1.4 ± 0.1)·10⁻³ mm²"))
    50 \% of (1.4 $\pm$ 0.1)$\cdot$10$^{-3}$ mm$^{2}$
    """
    plain = "".join(_SIGNS.get(sign, sign) for sign in text)
    return _RAISED.sub(lambda power: f"$^{{{power.group().translate(_LOWERED)}}}$", plain)


def tabular(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table whose first row is its header; the first column holds names."""
    first, *others = [" & ".join(map(escaped, row)) + r" \\" for row in rows]
    columns = "l" + "r" * (max(map(len, rows)) - 1)
    begin, end = rf"\begin{{tabular}}{{{columns}}}", r"\end{tabular}"
    return [begin, r"\toprule", first, r"\midrule", *others, r"\bottomrule", end]
