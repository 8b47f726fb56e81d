"""Warn of two bodies under wrong labels, and of e^{-iwt} data: no passive ligament could join them so."""

from __future__ import annotations

import numpy as np

from kinematics.faults.mislabelled.body_labels import TURN, compare_labels
from kinematics.faults.mislabelled.body_sizes import size_notices
from kinematics.faults.mislabelled.two_bodies import LEVER_M, Pair
from stapeskit.records.mass_record import MassRecord
from stapeskit.records.motion import RigidMotion
from stapeskit.records.motion_files import standard_deviation
from stapeskit.spatial import dof_indices
from stapeskit.warnings import Notice

# A rise of the phase that no response shows, and how alike neighbouring lines must be to count it.
_RISE, _ALIKE = 0.75 * np.pi, 0.7


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

    Parameters
    ----------
    motion : RigidMotion
        Absolute motion, or motion per unit of any reference.
    mass : MassRecord, optional
        Weighs the degrees of freedom; without it the translations count alone.
    derivatives : int
        Time derivatives in what was measured.
    structure, base : str
        Bodies that one ligament joins.
    rigid : bool
        All bodies move rigidly: the size of a motion that is not known well is not judged.
    """
    if len(motion.bodies) == 1:
        return _alone(motion)
    pair = Pair.of(motion, structure, base, mass, derivatives)
    lag = None if pair is None else pair.lag()
    if pair is None or lag is None:
        return []
    labels = compare_labels(pair)
    signed = lag.reversed and lag.opposed
    if labels is not None and labels.believed and not (signed and labels.kind == "sign"):
        return [labels.notice()]
    sizes = size_notices(pair) if rigid else []
    if sizes:
        return sizes
    if not lag.reversed:
        return []
    said = (
        f"{structure} leads {base} at {lag.leading} of {lag.sure} lines ({-lag.deviations:.0f} standard "
        "deviations), which no passive ligament does"
    )
    if labels is not None and labels.rather("bodies", 0.5) and not labels.rather("sign", 0.5):
        text = (
            f"; {base} would lag {structure} as a passive ligament makes it: the two names look exchanged. "
            "Exchange them, unless the data are amplitudes of e^{-iwt} (then conjugate them)."
        )
        return [Notice("label_swap", said + text)]
    if signed and (labels is None or labels.rather("sign", 1.0)):
        text = (
            ", and moves against it at the lowest lines, where the ligament carries it along: one of the two "
            f"bodies has the wrong sign. {TURN.capitalize()}"
        )
        return [Notice("body_sign", said + text)]
    said += ": the data look like amplitudes of e^{-iwt}. "
    return [Notice("phase_convention", f"{said}Conjugate them (im or phase_deg with the opposite sign).")]


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
