"""Warn of two bodies under wrong labels, and of e^{-iwt} data: no passive ligament could join them so."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legacy.kinematics.faults.alternatives import Proposal, proposed
from legacy.kinematics.faults.proposals.body_labels import REACH, rms, scaled
from legacy.kinematics.faults.proposals.two_bodies import (
    LEVER_M,
    Pair,
    joins_better,
    log_evidence,
    unrelated_evidence,
)
from legacy.stapeskit.records.mass_record import MassRecord
from legacy.stapeskit.records.motion import RigidMotion
from legacy.stapeskit.records.motion_files import standard_deviation
from legacy.stapeskit.spatial import dof_indices
from legacy.stapeskit.warnings import Notice

# A rise of the phase that no response shows, and how alike neighbouring lines must be to count it.
_RISE, _ALIKE = 0.75 * np.pi, 0.7
# Log likelihood that another size must gain, besides the logarithm of the number of those tried: odds of
# 20 000. What it must gain over motions that no ligament joins: odds of 150. What a size that is no ratio of
# ranges may gain over it: odds of 20.
_MARGIN, _BEYOND, _BESIDE = 10.0, 5.0, 3.0
# Sizes that compete with these: none, any, and the opposite sign.
_COMPETING = (0.0, -1.0, *np.geomspace(0.08, 12.5, 41))


def phase_notice(
    motion: RigidMotion,
    mass: MassRecord | None = None,
    derivatives: int = 0,
    structure: str = "stapes",
    base: str = "base",
    rigid: bool = True,
) -> list[Notice]:
    """Warn when no passive ligament could join two bodies as they are labelled, and say what would.

    Both bodies conjugated, or exchanged, turn the direction of power round; one body conjugated, the bodies
    exchanged, runs of one of them exchanged or its frequencies shifted leave no single ligament for all
    lines and runs. A body alone is judged by the course of its phase.

    The motion is absolute, or per unit of any reference; ``mass`` and ``derivatives`` as of ``Pair.of``.
    Where a body bends (not ``rigid``) the size of its motion is not known well, and is not judged.
    """
    if len(motion.bodies) == 1:
        return _alone(motion)
    pair = Pair.of(motion, structure, base, mass, derivatives)
    lag = None if pair is None else pair.lag()
    if pair is None or lag is None:
        return []
    labels = compare_labels(pair)
    signed = lag.reversed and lag.opposed
    if labels is not None and labels.believed and not (signed and labels.best.name == "sign"):
        return [labels.notice()]
    sizes = size_notices(pair) if rigid else []
    if sizes or not lag.reversed:
        return sizes
    if labels is not None and labels.rather("bodies", 0.5) and not labels.rather("sign", 0.5):
        found = "bodies by lag"
    elif signed and (labels is None or labels.rather("sign", 1.0)):
        found = "sign by lag"
    else:
        found = "convention"
    words = {"structure": structure, "base": base, "lead": -lag.deviations}
    return [Proposal(found, pair, {**words, "leading": lag.leading, "sure": lag.sure}).notice()]


@dataclass(frozen=True)
class Comparison:
    """How well one ligament explains the motion of two bodies, labelled in different ways.

    Attributes
    ----------
    given, misfit : float
        Misfits of the labels as given and of those that explain most, in units of noise and of 2 % of the
        motion.
    best : Proposal
        The labels that explain most; without a name where those as given do.
    least : dict of str to float
        Misfits of the kinds that were tried.
    """

    given: float
    misfit: float
    best: Proposal
    least: dict[str, float]

    @property
    def believed(self) -> bool:
        """Whether other labels explain the data to twice the noise, and what those as given do not."""
        # The farthest shift that was tried is no minimum of the misfit.
        return joins_better(self.given, self.misfit) and self.best.words.get("lines") != REACH

    def rather(self, kind: str, share: float) -> bool:
        """Return whether a kind leaves less than a share of what the labels as given leave."""
        return self.least[kind] < share * self.given

    def notice(self) -> Notice:
        """Return the warning that says which labels explain the data."""
        structure, base = self.best.value.names
        lag = self.best.value.lag()
        words = {
            "structure": structure,
            "base": base,
            "leading": structure if lag is not None and lag.deviations < 0.0 else base,
            "conjugated": ", and their phases conjugated (e^{-iwt})" if lag and lag.reversed else "",
        }
        before = (
            f"no ligament joins {structure} and {base} as they are labelled (misfit {self.given:.3g} times "
            f"noise and 2 %, {self.misfit:.2g} otherwise)"
        )
        return replace(self.best, words={**words, **self.best.words}).notice(before)


def compare_labels(pair: Pair) -> Comparison | None:
    """Compare ways to label two bodies by the misfit of one ligament; None with too few lines."""
    given = pair.misfit()
    if given is None:
        return None
    least, best, smallest = dict[str, float](), Proposal("", pair, {}), given
    for labels in proposed("pair", pair, given):
        misfit = labels.value.misfit()
        if misfit is None:
            continue
        least[labels.name] = min(misfit, least.get(labels.name, np.inf))
        if misfit < smallest:
            best, smallest = labels, misfit
    return Comparison(given, smallest, best, least)


def size_notices(pair: Pair) -> list[Notice]:
    """Warn when the readings of a body have another size than a ligament could make, and say which.

    Notes
    -----
    A size is believed that the data make likelier than that as given, than any other size by much, and than
    no ligament: motions that have nothing to do with each other, or by any constant matrix.
    """
    given = log_evidence(pair) if len(pair.complete_lines()) else -np.inf
    if not np.isfinite(given):
        return []
    sizes = list(proposed("size", pair))
    evidence = [log_evidence(size.value) for size in sizes]
    best = int(np.argmax(evidence))
    likeliest, most = sizes[best], evidence[best]
    if not most - given >= _MARGIN + np.log(len(sizes)):
        return []
    if most < _BEYOND + max(unrelated_evidence(pair), log_evidence(likeliest.value, related=False)):
        return []
    others = [scaled(pair, factor, likeliest.words.get("run")) for factor in _COMPETING]
    others.append(replace(pair, base=pair.base.conj()))
    if max(map(log_evidence, others)) > most + _BESIDE:
        return []
    alike = [k for k in range(len(sizes)) if k != best and evidence[k] > most - _BESIDE]
    numbers = " or ".join(f"{sizes[k].words['factor']:.4g}" for k in (best, *alike))
    structure, base = pair.names
    before = (
        f"no ligament joins {structure} and {base} as they are labelled, but one would (log likelihood ratio "
        f"{most - given:.0f}) with {base} {numbers} times as large"
    )
    return [likeliest.notice(before)]


def rms_would_show(pair: Pair) -> bool:
    """Return whether either body would be found in rms while the other is in peak values."""
    return all(size_notices(slip) for slip, _words in rms(pair))


def _alone(motion: RigidMotion) -> list[Notice]:
    """Warn when the phase of a single body rises over the band, which a response to its reference does not.

    Notes
    -----
    Phase steps between lines are weighted with the power in them. Responses lag more and more with the
    frequency; a rise by more than 135 degrees needs conjugated data, or a reference that comes late.
    """
    turns, sure = [], []
    for run in range(len(motion.runs)):
        q = motion.q[run, 0]
        sd = standard_deviation(motion)[run, 0]
        good = np.all(np.isfinite(q) & np.isfinite(sd), axis=1)
        if np.sum(good) < 8:
            return []
        q, sd = q[good], sd[good]
        size = np.sqrt(np.mean(np.abs(q) ** 2, axis=0))
        places = np.flatnonzero(size > 3.0 * np.sqrt(2.0 * np.mean(sd**2, axis=0)))
        if not places.size:
            return []
        even = q[:, places] * np.where(np.array(dof_indices(motion.dof))[places] < 3, 1.0, LEVER_M)
        steps = np.sum(even[:-1].conj() * even[1:], axis=1)
        turns.append(float(np.sum(np.angle(steps))))
        power = np.maximum(np.sum(np.abs(even) ** 2, axis=1), 1e-300)
        sure.append(float(np.quantile(np.abs(steps) / np.sqrt(power[1:] * power[:-1]), 0.1)))
    if min(turns) < _RISE or min(sure) < _ALIKE:
        return []
    return [
        Notice(
            "phase_convention",
            f"body {motion.bodies[0]} alone cannot show its phase convention for certain, but its phase "
            f"rises by {np.rad2deg(np.mean(turns)):.0f} degrees over the band, where a response lags its "
            "reference more and more: either these are amplitudes of e^{-iwt} (conjugate them), or the "
            "reference signal comes late.",
        )
    ]
