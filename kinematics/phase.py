"""Tell e^{+iwt} from e^{-iwt} data by physics: a ligament takes power from its support, it gives none."""

from __future__ import annotations

import numpy as np

from kinematics.mass_record import MassRecord
from kinematics.motion import RigidMotion
from kinematics.motion_files import standard_deviation
from kinematics.notices import Notice
from kinematics.spatial import DOF_NAMES, dof_indices

_STRONG = 6.0
_SHARE = 0.6


def phase_notice(
    motion: RigidMotion, mass: MassRecord | None = None, structure: str = "stapes", base: str = "base"
) -> list[Notice]:
    """Warn when the structure leads its base.

    Parameters
    ----------
    motion : RigidMotion
        Absolute motion.
    mass : MassRecord, optional
        Weighs the degrees of freedom; without it the translations count alone.

    Notes
    -----
    With w^2 M q_s = (K + i w D) (q_s - q_b) the mean power that the base puts in is
    w^3 Im(q_s^H M q_b) / 2, never negative for a passive ligament. Conjugated data turn its sign.
    """
    if structure not in motion.bodies or base not in motion.bodies:
        return []
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
        return []
    sine = (np.imag(product) / np.abs(product))[good]
    error = (np.sqrt(variance) / np.abs(product))[good]
    sure = np.abs(sine) > 3.0 * error
    mean, spread = float(np.mean(sine)), float(np.sqrt(np.mean(error**2) / len(sine)))
    if mean > -_STRONG * spread or np.sum(sine[sure] < 0.0) < _SHARE * np.sum(sure):
        return []
    return [
        Notice(
            "phase_convention",
            f"{structure} leads {base} at {int(np.sum(sine[sure] < 0.0))} of {int(np.sum(sure))} "
            "lines, which no passive ligament does: the data look like amplitudes of e^{-iwt}. "
            "Conjugate them (im or phase_deg with the opposite sign).",
        )
    ]
