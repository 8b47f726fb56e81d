"""Tell e^{+iwt} from e^{-iwt} data, and a body with the wrong sign, by physics: a ligament gives no power."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinematics.mass_record import MassRecord
from kinematics.motion import RigidMotion
from kinematics.motion_files import standard_deviation
from kinematics.notices import Notice
from kinematics.spatial import DOF_NAMES, dof_indices

Array = NDArray[np.float64]
_STRONG = 6.0
_SHARE = 0.6
_MODEL = 0.05
_LOW = 0.15
_OPPOSED = -0.5


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
    body
    with the wrong sign, which then also moves against its base at low frequencies, where the ligament
    carries it
    along. Each line counts by the inverse of its noise variance and of 0.05^2, which stands for what M and
    the frame
    leave uncertain.
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
    deviations = float(np.sum(weight * unit.imag) / np.sqrt(np.sum(weight)))
    sure = np.abs(unit.imag) > 3.0 * error
    freq = np.broadcast_to(motion.freq_hz, good.shape)[good]
    low = freq <= np.quantile(freq, _LOW)
    cosine = float(np.sum((weight * unit.real)[low]) / np.sum(weight[low]))
    return PhaseTest(deviations, int(np.sum(unit.imag[sure] < 0.0)), int(np.sum(sure)), cosine)


def phase_notice(
    motion: RigidMotion, mass: MassRecord | None = None, structure: str = "stapes", base: str = "base"
) -> list[Notice]:
    """Warn when the structure leads its base, with what is likely wrong; see phase_test."""
    test = phase_test(motion, mass, structure, base)
    if test is None or not test.reversed:
        return []
    said = (
        f"{structure} leads {base} at {test.leading} of {test.sure} lines ({-test.deviations:.0f} standard "
        "deviations), which no passive ligament does"
    )
    if test.opposed:
        return [
            Notice(
                "body_sign",
                f"{said}, and moves against it at the lowest lines, where the ligament carries it along: one "
                "of the two bodies has the wrong sign. Check on which side the laser head was, and turn the "
                "sign or the directions of one body.",
            )
        ]
    return [
        Notice(
            "phase_convention",
            f"{said}: the data look like amplitudes of e^{{-iwt}}. "
            "Conjugate them (im or phase_deg with the opposite sign).",
        )
    ]
