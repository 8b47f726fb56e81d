"""The verdict on a study: believe, check or do not use, each with its reasons."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from stapeskit.warnings import Notice

BELIEVE, CHECK, DO_NOT_USE = "believe", "check", "do not use"
_ORDER = (BELIEVE, CHECK, DO_NOT_USE)
# Above this share of its value a standard deviation leaves a diagonal entry of K or D nearly unknown.
_MOST_RELATIVE_SD = 0.3


@dataclass(frozen=True)
class Reason:
    """One reason.

    Attributes
    ----------
    level : {"believe", "check", "do not use"}
        What it alone would make of the study.
    code : str
        Of the warning; empty where a number is the reason.
    text : str
    """

    level: str
    code: str
    text: str


@dataclass(frozen=True)
class Verdict:
    """Believe, check or do not use."""

    level: str
    reasons: tuple[Reason, ...]


@cache
def levels() -> dict[str, str]:
    """Return what each listed warning code makes of a study."""
    text = Path(__file__).with_name("verdict.toml").read_text(encoding="utf-8")
    table = tomllib.loads(text)
    listed = dict.fromkeys(table["information"], BELIEVE)
    return listed | dict.fromkeys(table["do_not_use"], DO_NOT_USE)


def verdict(kd: Mapping[str, Any], notices: Iterable[Notice]) -> Verdict:
    """Judge a study by its warnings and by what its K and D do.

    Parameters
    ----------
    kd : mapping
        Content of kd.json.
    notices : iterable of Notice
    """
    reasons = [Reason(levels().get(notice.code, CHECK), notice.code, notice.text) for notice in notices]
    codes = {reason.code for reason in reasons}
    if not kd["stable"] and "unstable" not in codes:
        reasons.append(Reason(DO_NOT_USE, "", "The system of M, K and D is unstable."))
    if not all(kd["passive"].values()) and "not_passive" not in codes:
        reasons.append(
            Reason(CHECK, "", "K or D is not positive semidefinite: energy would come from nowhere.")
        )
    vague = [
        f"{letter}({dof})"
        for letter, key in (("K", "stiffness"), ("D", "damping"))
        for place, dof in enumerate(kd["dof"])
        if not _known(kd[f"{key}_si"][place][place], kd[f"{key}_sd_si"][place][place])
    ]
    if vague:
        reasons.append(Reason(CHECK, "", f"Known to no better than 30 percent: {', '.join(vague)}."))
    shown = tuple(reason for reason in reasons if reason.level != BELIEVE)
    shown = tuple(sorted(shown, key=lambda reason: -_ORDER.index(reason.level)))
    level = max((reason.level for reason in shown), key=_ORDER.index, default=BELIEVE)
    return Verdict(level, shown)


def _known(value: float, sd: float | None) -> bool:
    return sd is None or sd <= _MOST_RELATIVE_SD * abs(value)
