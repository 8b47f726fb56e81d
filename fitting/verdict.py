"""The ONE verdict on a result: believe, check, or do not use, with its reasons, causes first."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from stapeskit.faults import list_some
from stapeskit.warnings import ROOMS, VERDICTS, Notice, table

BELIEVE = "believe"
INFORMATION, CHECK, DO_NOT_USE = VERDICTS
LEVELS = (BELIEVE, CHECK, DO_NOT_USE)

# Residuals beyond the noise widen the sd, which covers noise that was stated too small. Where K and D change
# over the band as well, the one pair of matrices is wrong, and widening does not cover that.
_TOGETHER = (("misfit", "frequency_dependent"), ("flexible", "frequency_dependent"))
# What a wrong input makes; its cause is listed before it.
_OUTCOMES = (
    "frequency_dependent", "misfit", "implausible_stiffness", "constraint_active", "not_passive", "unstable",
    "not_converged", "weak_identifiability", "undetermined",
)  # fmt: skip


@dataclass(frozen=True)
class Reason:
    """One reason of a verdict: what it alone would make of the study."""

    level: str
    code: str
    text: str


@dataclass(frozen=True)
class Verdict:
    """Believe, check or do not use, with reasons by weight; codes that the user confirmed do not count."""

    level: str
    reasons: tuple[Reason, ...]
    confirmed: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """The verdict in one line, the same on every terminal and page."""
        if not self.reasons:
            return f"{self.level}: no warning speaks against it"
        codes = list_some(
            dict.fromkeys(reason.code for reason in self.reasons if reason.level == self.level), 5
        )
        return f"{self.level}: {codes}"

    def as_json(self) -> dict[str, Any]:
        """Return the block ``verdict`` of kd.json."""
        reasons = [
            {"code": reason.code, "text": reason.text, "level": reason.level} for reason in self.reasons
        ]
        return {
            "level": self.level,
            "sentence": self.sentence,
            "reasons": reasons,
            "confirmed": list(self.confirmed),
        }


def judge(notices: Iterable[Notice], confirmed: Sequence[str] = (), unused: Sequence[str] = ()) -> Verdict:
    """Return the verdict that warnings lead to.

    Parameters
    ----------
    confirmed : sequence of str
        Codes, or their first words (``handedness``), that the user has checked: they no longer count.
    unused : sequence of str
        Codes, or their first words, that follow from what the study does not use.
    """
    left, checked = [], []
    for notice in dict.fromkeys(notices):
        if _is_among(notice.code, confirmed):
            checked.append(notice.code)
        elif not _is_among(notice.code, unused):
            left.append(notice)
    codes = {notice.code for notice in left}
    reasons = [Reason(_level(notice.code, codes), notice.code, notice.text) for notice in left]
    reasons = [reason for reason in reasons if reason.level != BELIEVE]
    reasons.sort(key=lambda reason: (-LEVELS.index(reason.level), *_rank(reason.code)))
    level = max((reason.level for reason in reasons), key=LEVELS.index, default=BELIEVE)
    return Verdict(level, tuple(reasons), tuple(dict.fromkeys(checked)))


def _is_among(code: str, names: Sequence[str]) -> bool:
    return any(code == name or code.startswith(f"{name}_") for name in names)


def _level(code: str, codes: set[str]) -> str:
    """Return the level of the verdict by one warning, given all codes of a study."""
    if any(code in pair and set(pair) <= codes for pair in _TOGETHER):
        return DO_NOT_USE
    level = table()[code].verdict if code in table() else CHECK
    return BELIEVE if level == INFORMATION else level


def _rank(code: str) -> tuple[int, int]:
    """Return the order of a code: what others follow from comes first, room by room of the chain."""
    room = table()[code].room if code in table() else "fitting"
    order = ("stapeskit", "ct_inertia", "kinematics", "fitting", "pipeline")
    assert set(order) == set(ROOMS)  # noqa: S101
    return (1 + _OUTCOMES.index(code) if code in _OUTCOMES else 0, order.index(room))


def unused_codes(motion_provenance: Mapping[str, Any]) -> tuple[str, ...]:
    """Return warnings that do not concern a motion whose marks are all in scan coordinates.

    It does not use the plate, and its registration would not fit if scan or vibrometer alone were mirrored.
    """
    all_in_scan = motion_provenance.get("registered_in") == ["scan"]
    return ("plate", "handedness_unconfirmed") if all_in_scan else ()
