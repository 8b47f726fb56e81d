"""The table of fault kinds, `KINDS`: each a set of tangents, with the owners that can have it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from kinematics.joint import tangents
from kinematics.joint.expected import Layout
from kinematics.joint.tangents import Geometry, Parameters
from stapeskit.arrays import Array

SHARE = {"channel": 1.0, "point": 0.3, "laser": 1.0, "body": 0.3}
"""Share of the alarm probability of the tests of each owner: two thirds of the faults of notes and complaints
are of single channels or lasers."""


@dataclass(frozen=True)
class Kind:
    """A kind of fault: tangents, owners (of `SHARE`), word in dof.channels.csv, whether it needs a course."""

    tangents: tuple[int, ...]
    owners: tuple[str, ...]
    verdict: str
    courses: bool = False


_BEAMS = ("channel", "point", "laser")

KINDS: dict[str, Kind] = {
    "gain": Kind((tangents.GAIN,), _BEAMS, "gain"),
    "phase": Kind((tangents.GAIN, tangents.PHASE), _BEAMS, "gain"),
    "delay": Kind((tangents.DELAY,), _BEAMS, "gain", True),
    "drift": Kind(
        (tangents.GAIN, tangents.PHASE, tangents.GAIN_DRIFT, tangents.PHASE_DRIFT), _BEAMS, "drift", True
    ),
    "direction": Kind((tangents.BEAM_U, tangents.BEAM_V), ("channel", "laser"), "direction"),
    "position": Kind(tangents.SHIFT, ("point",), "position"),
    "axes": Kind(tangents.TURN, ("body",), "direction"),
}
"""Kinds by name. A new kind is one entry here and one sentence in sentences.py."""


@dataclass(frozen=True)
class Place:
    """Channels that can have a fault together: one channel, a point, a laser or the body."""

    owner: str
    channels: tuple[int, ...]

    def kinds(self, groups: int, parallel: bool) -> list[str]:
        """List the kinds that so many groups of lines, and beams that are parallel or not, can show."""
        alone = self.owner == "point" and len(self.channels) == 1
        return [
            name
            for name, kind in KINDS.items()
            if self.owner in kind.owners
            and not (alone and name != "position")
            and not (kind.courses and groups < 4)
            and not (parallel and name in ("direction", "axes"))
        ]


def places(layout: Layout, live: Sequence[int]) -> list[Place]:
    """List channels, points and lasers in use, and the body where nothing is left out."""
    lasers = layout.by_laser(live)
    found = [Place("channel", (int(channel),)) for channel in live]
    found += [Place("point", tuple(own)) for own in layout.by_point(live).values()]
    found += [Place("laser", tuple(own)) for own in lasers.values() if len(own) > 2]
    if len(live) == len(layout.points) and lasers:
        found.append(Place("body", tuple(int(channel) for channel in live)))
    return found


@dataclass(frozen=True)
class Finding:
    """A fault that may explain a misfit, or does.

    Attributes
    ----------
    kind : str
        Of `KINDS`, or ``label_swap``, ``noise``, ``elsewhere`` (moves unlike the others), ``flexible``.
    place : Place
        Its owner is ``points``, ``beams`` or ``lasers`` of exchanged names.
    values, sd : ndarray, (k,)
        Size, by the tangents of the kind; of noise its factor.
    log_p : float
        Natural logarithm of the probability of data like these without it.
    evidence : float
        Log likelihood that it gains, less what its numbers cost.
    fall : float
        Of chi2.
    count : int
        Numbers that it takes from the data: values that are left out, or its size.
    geometry : Geometry or None
        With exchanged names back in place.
    shown_by : str
        Of a laser: the other body whose values show it; empty where those of this body do.
    elsewhere : tuple of int
        Its channels on bodies that do not show it, out of those of all bodies.
    """

    kind: str
    place: Place
    values: Array = field(default_factory=lambda: np.zeros(0))
    sd: Array = field(default_factory=lambda: np.zeros(0))
    log_p: float = 0.0
    evidence: float = 0.0
    fall: float = 0.0
    count: int = 0
    geometry: Geometry | None = None
    shown_by: str = ""
    elsewhere: tuple[int, ...] = ()

    @property
    def owner(self) -> str:
        """What has the fault."""
        return self.place.owner

    @property
    def channels(self) -> tuple[int, ...]:
        """All channels of it."""
        return self.place.channels

    @property
    def treatment(self) -> str:
        """How a finding is taken out of the data, one of `TREATMENTS`.

        An estimate from the values of a single channel or point adds nothing to the motion: these are left
        out, unless only their sign is reversed.
        """
        if self.kind in ("label_swap", "noise", "flexible"):
            return self.kind
        if self.owner in ("laser", "body") and self.kind in KINDS:
            return "estimate"
        return "sign" if self.kind == "gain" and self.verdict == "sign" else "elsewhere"

    @property
    def verdict(self) -> str:
        """Word in dof.channels.csv."""
        if self.kind in ("gain", "phase", "drift") and is_reversed(self.values):
            return "sign"
        if self.kind == "elsewhere":
            return "flexible"
        return KINDS[self.kind].verdict if self.kind in KINDS else self.kind


TREATMENTS = {
    "label_swap": "exchanged back",
    "noise": "given its larger noise",
    "flexible": "left as it is",
    "estimate": "corrected by the estimate",
    "sign": "sign reversed",
    "elsewhere": "left out",
}
"""What is done about findings, in words."""


def is_reversed(values: Array) -> bool:
    """Return whether a factor 1 + values[0] has the wrong sign and the right size, within a third."""
    return bool(abs(values[0] + 2.0) < 0.35)


def free(kind: str, own: Sequence[int], channels: int) -> Parameters:
    """Return the free parameters of a kind at some of so many channels."""
    return Parameters.of(channels, [(own, tangent, np.inf) for tangent in KINDS[kind].tangents])
