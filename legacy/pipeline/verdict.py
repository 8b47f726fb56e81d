"""The verdict on a study: believe, check or do not use, each with its reasons."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from legacy.stapeskit.warnings import VERDICTS, Notice, table

BELIEVE = "believe"
_INFORMATION, CHECK, DO_NOT_USE = VERDICTS
_ORDER = (BELIEVE, CHECK, DO_NOT_USE)
# Above this share of its value a standard deviation leaves a diagonal entry of K or D nearly unknown; a
# stiffness whose standard deviation exceeds it is undetermined.
_MOST_RELATIVE_SD, _UNDETERMINED = 0.3, 1.0
# Pairs of codes that forbid the use together; each alone calls for a check. Residuals beyond the noise widen
# the standard deviations, which covers noise that was stated too small and a body that bends a little. Where
# K and D change over the band as well, the one pair of matrices is wrong, and widening does not cover that.
_TOGETHER = (("misfit", "frequency_dependent"), ("flexible", "frequency_dependent"))


@dataclass(frozen=True)
class Reason:
    """One reason.

    Attributes
    ----------
    level : {"believe", "check", "do not use"}
        What it alone would make of the study.
    code : str
        Of the warning; empty where a number is the reason.
    """

    level: str
    code: str
    text: str


@dataclass(frozen=True)
class Verdict:
    """Believe, check or do not use."""

    level: str
    reasons: tuple[Reason, ...]


def _level(code: str, codes: Collection[str]) -> str:
    """Return the verdict that a warning leads to, given all codes of a study."""
    if any(code in pair and set(pair) <= set(codes) for pair in _TOGETHER):
        return DO_NOT_USE
    level = table()[code].verdict if code in table() else CHECK
    return BELIEVE if level == _INFORMATION else level


def verdict(kd: Mapping[str, Any], notices: Iterable[Notice]) -> Verdict:
    """Judge a study by its warnings and by what its K and D do.

    Parameters
    ----------
    kd : mapping
        Content of kd.json.
    """
    notices = list(notices)
    codes = {notice.code for notice in notices}
    reasons = [Reason(_level(notice.code, codes), notice.code, notice.text) for notice in notices]
    if not kd["stable"] and "unstable" not in codes:
        reasons.append(Reason(DO_NOT_USE, "", "The system of M, K and D is unstable."))
    if not all(kd["passive"].values()) and "not_passive" not in codes:
        reasons.append(
            Reason(CHECK, "", "K or D is not positive semidefinite: energy would come from nowhere.")
        )
    undetermined, imprecise = (
        _find_uncertain(kd, "K", _UNDETERMINED),
        [*_find_uncertain(kd, "K"), *_find_uncertain(kd, "D")],
    )
    if undetermined:
        text = f"Undetermined, with a standard deviation above the value: {', '.join(undetermined)}."
        reasons.append(Reason(DO_NOT_USE, "", text))
    if rest := [name for name in imprecise if name not in undetermined]:
        reasons.append(Reason(CHECK, "", f"Known to no better than 30 percent: {', '.join(rest)}."))
    shown = tuple(reason for reason in reasons if reason.level != BELIEVE)
    shown = tuple(sorted(shown, key=lambda reason: -_ORDER.index(reason.level)))
    level = max((reason.level for reason in shown), key=_ORDER.index, default=BELIEVE)
    return Verdict(level, shown)


def _find_uncertain(kd: Mapping[str, Any], letter: str, share: float = _MOST_RELATIVE_SD) -> list[str]:
    """Return the entries on the diagonal whose standard deviation is above a share of their value."""
    key = {"K": "stiffness", "D": "damping"}[letter]
    names = []
    for place, dof in enumerate(kd["dof"]):
        value, sd = kd[f"{key}_si"][place][place], kd[f"{key}_sd_si"][place][place]
        if sd is not None and sd > share * abs(value):
            names.append(f"{letter}({dof})")
    return names
