"""Checks of a measurement and a motion as a whole: common lines, places of the points, determined motions."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, raise_all
from legacy.stapeskit.option_names import named
from legacy.stapeskit.records.motion import RigidMotion
from legacy.stapeskit.warnings import Notice

# A stapes is about 3.5 mm high and 3 mm long.
_FARTHEST_MM = 8.0


def uncommon_lines(placed: Measurement) -> list[Notice]:
    """Return the warning that bodies were not measured at all lines of the others."""
    measured = [_measured_lines(body) for body in placed.bodies]
    counts = [int(np.sum(lines)) for lines in measured]
    if all(count == len(placed.freq_hz) for count in counts):
        return []
    listed = ", ".join(f"{body.body} at {n}" for body, n in zip(placed.bodies, counts, strict=True))
    common = int(np.sum(np.all(measured, axis=0)))
    text = (
        f"of {len(placed.freq_hz)} frequencies, {listed} were measured, {common} of them on all bodies; "
        "lines are matched within 1e-6."
    )
    text += _column_offset(placed.freq_hz, measured, [body.body for body in placed.bodies])
    return [Notice("frequencies_differ", text)]


def _column_offset(freq_hz: Array, measured: Sequence[NDArray[np.bool_]], names: Sequence[str]) -> str:
    """Describe an offset or a factor between the frequencies of two bodies; empty without one.

    Parameters
    ----------
    freq_hz : ndarray, (freq,)
    measured : sequence of ndarray (freq,), bool
        Where each body was measured.
    names : sequence of str
        Of the bodies.
    """
    for one, two in combinations(range(len(names)), 2):
        first, second = freq_hz[measured[one]], freq_hz[measured[two]]
        if len(first) != len(second) or len(first) < 3 or np.array_equal(first, second):
            continue
        shift, ratio = second - first, second / first
        close = 1e-5 * float(np.median(np.diff(first)))
        if np.ptp(shift) < close:
            how = f"plus {np.mean(shift):.6g} Hz"
        elif np.ptp(ratio) < 1e-6 * float(np.mean(ratio)):
            how = f"times {np.mean(ratio):.6g}"
        else:
            continue
        return f" The frequencies of {names[two]} are those of {names[one]} {how} throughout: check freq_hz."
    return ""


def _measured_lines(body: BodyChannels) -> NDArray[np.bool_]:
    """Return the lines (freq,) at which any channel of any run was measured."""
    measured = np.zeros(body.displacement.shape[2], dtype=bool)
    for at in np.ndindex(body.displacement.shape[:2]):
        measured |= np.isfinite(body.displacement[at].real)
        if np.all(measured):
            break
    return measured


def check_determined(motion: RigidMotion) -> None:
    """Refuse a body whose motion is determined at no line.

    Raises
    ------
    KinematicsError
        Its channels are too few at every line.
    """
    faults = []
    for number, body in enumerate(motion.bodies):
        if not np.any(np.isfinite(motion.q[:, number].real)):
            step = f"Measure more channels at the same frequencies, or fit fewer with {named('dof')}"
            expected = f"measured by channels that determine {', '.join(motion.dof)} at one line or more"
            faults.append(Fault(f"body {body}", expected, "too few channels at every line", "", step))
    raise_all(KinematicsError, faults)


def far_away(placed: Measurement) -> list[Notice]:
    """Return the warning that the points of the stapes lie where no stapes reaches, as in a foreign frame."""
    for body in placed.bodies:
        distance = float(np.linalg.norm(np.mean(body.positions_mm, axis=0)))
        if body.body == "stapes" and distance > _FARTHEST_MM:
            text = (
                f"the points of body stapes lie {distance:.3g} mm from the footplate centre in the mean, "
                "farther than a stapes reaches: their coordinates look like those of another frame. Tie it "
                f"to the footplate with {named('fiducials')}, or name it with {named('frame')}; the "
                "motion is about a point far from the bone."
            )
            return [Notice("far_from_footplate", text)]
    return []
