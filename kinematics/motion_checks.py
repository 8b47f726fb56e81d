"""Checks of a measurement and of its motion as a whole: common lines, determined motions, phase
convention."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from kinematics.fit.neglected import neglected_notice
from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import Measurement
from stapeskit.faults import Fault, raise_all
from stapeskit.records.mass_record import MassRecord
from stapeskit.records.rigid_motion import RigidMotion, lines_measured
from stapeskit.spatial import dof_indices
from stapeskit.warnings import Notice

_LEAST_LINES = 8
_SURE = 6.0  # standard deviations by which the power has the wrong sign
_LEVER_M = 1.5e-3  # half a footplate, which makes rotations comparable with translations
_RISE, _ALIKE = 0.75 * np.pi, 0.7  # rise of phase that no response shows; likeness of neighbouring lines
_LEAST_LEAD = 0.02  # sine of a lead, twice the phase error of a laser


def uncommon_lines(placed: Measurement) -> list[Notice]:
    """Return the warning that bodies were not measured at all lines of the others."""
    measured = np.array([np.any(np.isfinite(body.value.real), axis=(0, 1)) for body in placed.bodies])
    if np.all(measured):
        return []
    counted = lines_measured([body.body for body in placed.bodies], measured)
    text = f"{counted}: measure all on one grid."
    return [Notice("lines_undetermined", text)]


def check_determined(motion: RigidMotion) -> None:
    """Refuse a body whose motion is determined at no line.

    Raises
    ------
    StapeskitError
        Its channels are too few at every line.
    """
    faults = []
    for number, body in enumerate(motion.bodies):
        if not np.any(np.isfinite(motion.q[:, number].real)):
            step = "Measure more channels at the same frequencies, or fit fewer degrees of freedom with --dof"
            expected = f"measured by channels that determine {', '.join(motion.dof)} at one line or more"
            faults.append(Fault(f"body {body}", expected, "too few channels at every line", "", step))
    raise_all(faults)


def fit_notices(placed: Measurement, fits: Mapping[tuple[int, int], LineFit]) -> list[Notice]:
    """Return what the fits of all bodies and runs call for."""
    notices = []
    for (run, number), fit in fits.items():
        body = placed.bodies[number]
        where = f" in run {placed.runs[run]}" if len(placed.runs) > 1 else ""
        notices += neglected_notice(fit, body, where)
        measured = np.any(np.isfinite(body.value[run].real), axis=0)
        lost = int(np.sum(~fit.solution.good & measured))
        if lost:
            text = f"body {body.body}{where}: {lost} lines have too few channels to determine the motion."
            notices.append(Notice("lines_undetermined", text))
        if fit.beams.weak:
            text = f"body {body.body}: hardly observable from these beams: {fit.beams.weak}."
            notices.append(Notice("unobservable", text))
    return notices


def phase_notices(
    motion: RigidMotion, mass: MassRecord | None = None, structure: str = "stapes", base: str = "base"
) -> list[Notice]:
    """Warn of amplitudes of e^{-iwt}: the structure leads its base, or the phase of a single body rises.

    Notes
    -----
    The force that accelerates the structure, -w^2 M q, passes through a ligament that can only dissipate:
    the power of the base, in proportion to -Im(b^H M q), is positive at every line whatever stiffness and
    damping are. Without a mass matrix the piston motion alone is looked at.
    """
    if len(motion.bodies) == 1:
        return _rise_notices(motion)
    if structure not in motion.bodies or base not in motion.bodies:
        return []
    places, size = dof_indices(motion.dof), len(motion.dof)
    inertia = np.diag([float(name == "y") for name in motion.dof])
    if mass is not None:
        inertia = mass.mass_matrix.matrix[np.ix_(places, places)]
    sd = motion.standard_deviation
    (q, q_sd), (b, b_sd) = (
        (motion.q[:, body].reshape(-1, size), sd[:, body].reshape(-1, size))
        for body in (motion.body(structure), motion.body(base))
    )
    good = np.all(np.isfinite(q) & np.isfinite(b), axis=1)
    q, b = q[good], b[good]
    power = np.einsum("li,ij,lj->l", b.conj(), inertia, q)
    variance = (np.abs(b @ inertia) * q_sd[good]) ** 2 + (np.abs(q @ inertia) * b_sd[good]) ** 2
    total, whole = float(np.sum(power.imag)), float(np.sum(np.abs(power)))
    sure = _SURE * float(np.sqrt(np.sum(variance)))
    if len(q) < _LEAST_LINES or not total > max(sure, _LEAST_LEAD * whole):
        return []
    text = (
        f"{structure} leads {base} by {np.rad2deg(np.arcsin(min(total / whole, 1.0))):.2g} degrees in the "
        "mean, where a passive ligament makes it lag: either these are amplitudes of e^{-iwt} (conjugate "
        "them), or the two bodies are exchanged, or one of them reads with the opposite sign."
    )
    return [Notice("phase_convention", text)]


def _rise_notices(motion: RigidMotion) -> list[Notice]:
    """Warn when the phase of a single body rises over the band: a response lags its reference."""
    lever = np.where(np.array(dof_indices(motion.dof)) < 3, 1.0, _LEVER_M)
    turns, likeness = [], []
    for q, sd in zip(motion.q[:, 0] * lever, motion.standard_deviation[:, 0] * lever, strict=True):
        good = np.all(np.isfinite(q) & np.isfinite(sd), axis=1)
        seen = np.mean(np.abs(q[good]) ** 2, axis=0) > 18.0 * np.mean(sd[good] ** 2, axis=0)
        if np.sum(good) < _LEAST_LINES or not np.any(seen):
            return []
        own = q[good][:, seen]
        steps = np.sum(own[:-1].conj() * own[1:], axis=1)
        size = np.maximum(np.linalg.norm(own, axis=1), 1e-150)
        turns.append(float(np.sum(np.angle(steps))))
        likeness.append(float(np.quantile(np.abs(steps) / (size[1:] * size[:-1]), 0.1)))
    if min(turns) < _RISE or min(likeness) < _ALIKE:
        return []
    text = (
        f"the phase of body {motion.bodies[0]} rises by {np.rad2deg(np.mean(turns)):.0f} degrees over the "
        "band, where a response lags its reference more and more: either these are amplitudes of e^{-iwt} "
        "(conjugate them), or the reference signal comes late."
    )
    return [Notice("phase_convention", text)]
