"""Detect e^{-iwt} data and a body with the wrong sign by physics: a ligament gives no power."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kinematics.faults.mislabelled.exchanged_bodies import Ligament, ligament_test
from stapeskit.records.mass_record import MassRecord
from stapeskit.records.motion import RigidMotion
from stapeskit.records.motion_files import standard_deviation
from stapeskit.spatial import DOF_NAMES, dof_indices
from stapeskit.warnings import Notice

# Standard deviations, and share of the lines, by which a lead of the structure is believed.
_STRONG, _SHARE = 6.0, 0.6
# Relative error of M and of the frame that the sine of a lag may hold.
_MODEL = 0.015
# The share of the lines that are the lowest, and a mean cosine there that no following body has.
_LOW, _OPPOSED = 0.15, -0.5
# A rise of the phase that no response shows, and how alike neighbouring lines must be to count it.
_RISE, _ALIKE = 0.75 * np.pi, 0.7
# Weighs rotations against translations of a body alone: about half the length of a footplate.
_LEVER_M = 1e-3
_TURN = "check on which side the laser head was, and turn the sign or the directions of one body."
_SIGN = f"where the ligament carries it along: one of the two bodies has the wrong sign. {_TURN.capitalize()}"


@dataclass(frozen=True)
class PhaseTest:
    """Whether the structure lags its base, as a passive ligament makes it.

    Attributes
    ----------
    deviations : float
        Weighted mean of the sine of the lag over its standard deviation: negative when the structure leads.
    leading, sure : int
        Lines at which the structure leads, of those whose lag differs from zero by three standard deviations.
    low_cosine : float
        Mean cosine of the lag over the lowest lines: near 1 when the structure follows its base there.
    """

    deviations: float
    leading: int
    sure: int
    low_cosine: float

    @property
    def reversed(self) -> bool:
        """Whether the structure clearly leads its base."""
        return self.deviations < -_STRONG and self.leading >= _SHARE * max(self.sure, 1)

    @property
    def opposed(self) -> bool:
        """Whether the two bodies move against each other at the lowest lines as well."""
        return self.low_cosine < _OPPOSED


def phase_test(
    motion: RigidMotion, mass: MassRecord | None = None, structure: str = "stapes", base: str = "base"
) -> PhaseTest | None:
    """Test the lag of the structure behind its base; None without both bodies or with fewer than three lines.

    Parameters
    ----------
    motion : RigidMotion
        Absolute motion, or motion per unit of any reference.
    mass : MassRecord, optional
        Weighs the degrees of freedom; without it the translations count alone.

    Notes
    -----
    With w^2 M q_s = (K + i w D) (q_s - q_b) the mean power that the base puts in is
    w^3 Im(q_s^H M q_b) / 2, never negative for a passive ligament. Conjugated data turn its sign. So does a
    body with the wrong sign, which then also moves against its base at low frequencies, where the ligament
    carries it along. Each line counts by the inverse of its noise variance and of 0.015^2, which stands for
    what M and the frame leave uncertain, and by the size of q_s - q_b: the lag comes of the losses that this
    causes.
    """
    if structure not in motion.bodies or base not in motion.bodies:
        return None
    places = dof_indices(motion.dof)
    if mass is None:
        matrix = np.diag([1.0 if name in DOF_NAMES[:3] else 0.0 for name in motion.dof])
    else:
        matrix = mass.mass_matrix.matrix[np.ix_(places, places)]
    one, two = motion.bodies.index(structure), motion.bodies.index(base)
    moved = motion.q[:, one] @ matrix
    product = np.sum(moved.conj() * motion.q[:, two], axis=-1)
    sd = standard_deviation(motion)
    variance = np.sum((np.abs(moved) * sd[:, two]) ** 2, axis=-1)
    variance = variance + np.sum((np.abs(motion.q[:, two] @ matrix) * sd[:, one]) ** 2, axis=-1)
    good = np.isfinite(product) & np.isfinite(variance) & (variance > 0.0) & (np.abs(product) > 0.0)
    if np.sum(good) < 3:
        return None
    unit = product[good] / np.abs(product[good])
    error = np.sqrt(variance[good]) / np.abs(product[good])
    weight = 1.0 / (error**2 + _MODEL**2)
    strain = np.sum(moved.conj() * (motion.q[:, two] - motion.q[:, one]), axis=-1)[good]
    shape = np.minimum(np.abs(strain / product[good]), 1.0)
    deviations = float(np.sum(weight * shape * unit.imag) / np.sqrt(np.sum(weight * shape**2)))
    sure = np.abs(unit.imag) > 3.0 * error
    freq = np.broadcast_to(motion.freq_hz, good.shape)[good]
    low = freq <= np.quantile(freq, _LOW)
    cosine = float(np.sum((weight * unit.real)[low]) / np.sum(weight[low]))
    return PhaseTest(deviations, int(np.sum(unit.imag[sure] < 0.0)), int(np.sum(sure)), cosine)


def phase_notice(
    motion: RigidMotion, mass: MassRecord | None = None, structure: str = "stapes", base: str = "base"
) -> list[Notice]:
    """Warn when no passive ligament could join two bodies as they are labelled, and say what would.

    Both bodies conjugated, or exchanged, turn the direction of power round; one body conjugated, the bodies
    exchanged, runs of one of them exchanged or its frequencies shifted leave no single ligament for all
    lines and runs. A body alone is judged by the course of its phase.
    """
    if len(motion.bodies) == 1:
        return _alone(motion)
    test = phase_test(motion, mass, structure, base)
    if test is None:
        return []
    ligament = ligament_test(motion, structure, base)
    signed = test.reversed and test.opposed
    if ligament is not None and ligament.best.kind not in (("right", "sign") if signed else ("right",)):
        return [_relabelled(motion, mass, structure, base, ligament)]
    if not test.reversed:
        return []
    said = (
        f"{structure} leads {base} at {test.leading} of {test.sure} lines ({-test.deviations:.0f} standard "
        "deviations), which no passive ligament does"
    )
    if ligament is not None and ligament.rather("bodies", 0.5) and not ligament.rather("sign", 0.5):
        return [
            Notice(
                "label_swap",
                f"{said}; {base} would lag {structure} as a passive ligament makes it: the two names look "
                "exchanged. Exchange them, unless the data are amplitudes of e^{-iwt} (then conjugate them).",
            )
        ]
    if signed and (ligament is None or ligament.rather("sign", 1.0)):
        return [Notice("body_sign", f"{said}, and moves against it at the lowest lines, {_SIGN}")]
    return [
        Notice(
            "phase_convention",
            f"{said}: the data look like amplitudes of e^{{-iwt}}. "
            "Conjugate them (im or phase_deg with the opposite sign).",
        )
    ]


def _relabelled(
    motion: RigidMotion, mass: MassRecord | None, structure: str, base: str, ligament: Ligament
) -> Notice:
    """Describe which labels make the data those of a passive ligament."""
    label = ligament.best
    left = (
        f"no ligament joins {structure} and {base} as they are labelled (misfit "
        f"{ligament.right:.3g} times noise and 2 %, {ligament.misfit[label]:.2g} otherwise)"
    )
    if label.kind == "sign":
        return Notice("body_sign", f"{left}, but one would with the sign of one of them turned: {_TURN}")
    if label.kind == "amplitude":
        rms, peak = (base, structure) if label.factor > 1.0 else (structure, base)
        return Notice(
            "unit_slip",
            f"{left}, but one would with {base} {label.factor:.4g} times as large: {rms} looks given in rms "
            f"and {peak} in peak values. Name the columns of {rms} amp_rms or give all in peak values.",
        )
    if label.kind == "range":
        run = motion.runs[label.order[0]]
        return Notice(
            "unit_slip",
            f"{left}, but one would with {base} {label.factor:.4g} times as large in run {run} alone: one of "
            "the two bodies looks measured in another range or unit there. Check the ranges of the "
            f"vibrometer, and correct the values of that body in run {run}.",
        )
    if label.kind == "conjugate":
        test = phase_test(_conjugated(motion, base, label.factor), mass, structure, base)
        which = structure if test is not None and test.deviations < 0.0 else base
        return Notice(
            "phase_convention",
            f"{left}: the data of {which} alone look like amplitudes of e^{{-iwt}}. Conjugate them (im or "
            "phase_deg with the opposite sign).",
        )
    if label.kind == "bodies":
        test = phase_test(motion, mass, base, structure)
        also = ", and their phases conjugated (e^{-iwt})" if test is not None and test.reversed else ""
        text = f"the names {structure} and {base} look exchanged{also}. Exchange them"
    elif label.kind == "runs":
        listed = ", ".join(
            f"{motion.runs[order]} as {motion.runs[run]}"
            for run, order in enumerate(label.order)
            if run != order
        )
        text = (
            f"runs of {base} look exchanged ({listed}), or those of {structure} the other way. Correct the "
            "column run"
        )
    else:
        step = float(np.median(np.diff(motion.freq_hz)))
        text = (
            f"the frequencies of {base} look shifted against those of {structure} by about "
            f"{-label.shift * step:.3g} Hz ({abs(label.shift)} lines). Check freq_hz"
        )
    return Notice("label_swap", f"{left}: {text}.")


def _conjugated(motion: RigidMotion, body: str, factor: float) -> RigidMotion:
    q = motion.q.copy()
    number = motion.bodies.index(body)
    q[:, number] = factor * q[:, number].conj()
    return replace(motion, q=q)


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
        even = q[:, places] * np.where(np.array(dof_indices(motion.dof))[places] < 3, 1.0, _LEVER_M)
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
