"""The ONE verdict that warnings lead to: believe, check or do not use; causes before what follows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from stapeskit.faults import list_some
from stapeskit.warnings import VERDICTS, Notice, is_among, table

BELIEVE = "believe"
INFORMATION, CHECK, DO_NOT_USE = VERDICTS
LEVELS = (BELIEVE, CHECK, DO_NOT_USE)

_CHAIN = ("stapeskit", "ct_inertia", "kinematics", "fitting", "pipeline")  # rooms in their order
# Residuals beyond the noise widen the sd, which covers noise that was stated too small. Where K and D change
# over the band as well, the one pair of matrices is wrong, and widening does not cover that.
_TOGETHER = (("misfit", "frequency_dependent"), ("flexible", "frequency_dependent"))
OF_MODEL, WEAK = ("frequency_dependent", "misfit"), ("weak_identifiability", "undetermined")
"""Codes of a model that does not hold, and of entries that the data leave open."""
_OF_RESULT = {"not_passive", "unstable"}  # properties of K and D themselves
# What a wrong input makes; its cause is listed before it.
_OUTCOMES = (
    *OF_MODEL, "implausible_stiffness", "not_passive", "unstable", "not_converged", *WEAK,
)  # fmt: skip
# Causes with a name, the first of which counts, and what follows from each: of motion that is another than
# its file says, everything; of a load that is left out, that the model does not hold, K and D are wrong and
# the misfit widens them; of one wrong reading or unknown, that the model does not hold.
_CAUSES = {
    **dict.fromkeys(
        ("bodies_exchanged", "phase_convention", "unit_slip", "other_mass_file"),
        (*_OUTCOMES, "cause_found", "fluid_found", "inplane_assumed", "law_ambiguous"),
    ),
    **dict.fromkeys(
        (
            "channel_label_swap", "channel_sign", "channel_direction", "channel_position", "channel_gain",
            "channel_drift", "channels_scattered", "stated_errors_exceeded", "sample_moved", "flexible",
        ),
        OF_MODEL,
    ),
    "inplane_neglected": (
        *OF_MODEL, *WEAK, "implausible_stiffness", "not_passive", "unstable", "cause_found", "fluid_found",
        "law_ambiguous",
    ),
    "cause_found": (*OF_MODEL, *WEAK),
}  # fmt: skip
_CORRECTED = "corrected"  # what was wrong with single channels is out of the motion

_MISREAD = ("bodies_exchanged", "phase_convention", "unit_slip")  # a motion is another than its file says


@dataclass(frozen=True)
class Reason:
    """One reason of a verdict: what it alone would make of the study."""

    code: str
    text: str
    level: str
    follows_from: str = ""  # code of the cause that it is a consequence of


@dataclass(frozen=True)
class Verdict:
    """Believe, check or do not use, with reasons by weight; codes that the user confirmed do not count.

    A cause has the weight of what follows from it and comes first.
    """

    level: str
    reasons: tuple[Reason, ...]
    confirmed: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """The verdict in one line, the same on every terminal and page."""
        if not self.reasons:
            return f"{self.level}: no warning speaks against it"
        heavy = [reason for reason in self.reasons if reason.level == self.level]
        return f"{self.level}: {list_some(dict.fromkeys(one.follows_from or one.code for one in heavy), 5)}"

    def as_json(self) -> dict[str, Any]:
        """Return the block ``verdict`` of kd.json."""
        return {**asdict(self), "sentence": self.sentence}


def follow_from_misreading(notices: Iterable[Notice], confirmed: Sequence[str] = ()) -> set[str]:
    """Return the codes that say nothing more where the motion is not what its file says.

    The set is empty where the user confirms the motion; properties of K and D are not in it.
    """
    codes = {notice.code for notice in notices if not is_among(notice.code, confirmed)}
    return {follows for code in codes if code in _MISREAD for follows in _CAUSES[code]} - _OF_RESULT


def judge(
    notices: Iterable[Notice],
    confirmed: Sequence[str] = (),
    unused: Sequence[str] = (),
    apart: Sequence[str] = (),
) -> Verdict:
    """Return the verdict that warnings lead to.

    Parameters
    ----------
    confirmed : sequence of str
        Codes, or their first words (``handedness``), that the user has checked: they no longer count.
    unused : sequence of str
        Codes, or their first words, that follow from what the study does not use.
    apart : sequence of str
        Codes that follow from no further unknown.
    """
    listed = list(dict.fromkeys(notices))
    checked = [notice.code for notice in listed if is_among(notice.code, confirmed)]
    left = [notice for notice in listed if not is_among(notice.code, (*confirmed, *unused))]
    codes = {notice.code for notice in left}
    causes = [code for code in _CAUSES if code in codes]
    if _CORRECTED in codes:
        causes = [code for code in causes if not code.startswith("channel_")]
    cause = next(iter(causes), "")
    alone = apart if cause == "cause_found" else ()
    found = [_reason(notice, codes, "" if notice.code in alone else cause) for notice in left]
    reasons = [reason for reason in found if reason.level != BELIEVE]
    weights = [LEVELS.index(reason.level) for reason in reasons]
    made = max((weight for weight, one in zip(weights, reasons, strict=True) if one.follows_from), default=0)
    order = [
        (-max(weight, made if reason.code == cause else 0), reason.code != cause, *_rank(reason))
        for weight, reason in zip(weights, reasons, strict=True)
    ]
    reasons = [reasons[place] for place in sorted(range(len(reasons)), key=order.__getitem__)]
    return Verdict(LEVELS[max(weights, default=0)], tuple(reasons), tuple(dict.fromkeys(checked)))


def _reason(notice: Notice, codes: set[str], cause: str) -> Reason:
    """Return a warning as a reason, with the cause that it follows from."""
    level = _level(notice.code, codes)
    if notice.code == cause or notice.code not in _CAUSES.get(cause, ()):
        return Reason(notice.code, notice.text, level)
    return Reason(notice.code, f"Follows from {cause}: {notice.text}", level, cause)


def _level(code: str, codes: set[str]) -> str:
    """Return the level of the verdict by one warning, given all codes of a study."""
    if any(code in pair and set(pair) <= codes for pair in _TOGETHER):
        return DO_NOT_USE
    level = table()[code].verdict if code in table() else CHECK
    return BELIEVE if level == INFORMATION else level


def _rank(reason: Reason) -> tuple[int, int]:
    """Return the order of a reason: what others follow from comes first, room by room of the chain."""
    room = table()[reason.code].room if reason.code in table() else "fitting"
    late = bool(reason.follows_from) or reason.code in _OUTCOMES
    return (1 + (*_OUTCOMES, reason.code).index(reason.code) if late else 0, _CHAIN.index(room))


def unused_codes(motion_provenance: Mapping[str, Any]) -> tuple[str, ...]:
    """Return warnings that do not concern a motion whose marks are all in scan coordinates.

    It does not use the plate, and its registration would not fit if scan or vibrometer alone were mirrored.
    """
    all_in_scan = motion_provenance.get("registered_in") == ["scan"]
    return ("plate", "handedness_unconfirmed") if all_in_scan else ()
