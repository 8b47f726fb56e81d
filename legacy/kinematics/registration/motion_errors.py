"""All errors that the lines of a motion share: frames, point positions or calibrated geometry, lasers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.kinematics.measurement import Measurement
from legacy.kinematics.registration.calibrate import Calibration
from legacy.kinematics.registration.calibrated_fit import calibration_errors
from legacy.kinematics.registration.laser_errors import LaserErrors
from legacy.kinematics.registration.placement import Placement
from legacy.kinematics.registration.shared_errors import pose_derivatives, position_errors
from legacy.stapeskit.records.motion import SharedErrors


def motion_errors(
    placed: Measurement,
    fits: Mapping[tuple[int, int], LineFit],
    placement: Placement,
    lasers: LaserErrors | None = None,
    calibration: Calibration | None = None,
) -> SharedErrors | None:
    """Return the errors common to all lines, as named parameters with their effect on the motion.

    Parameters
    ----------
    placed : Measurement
        In the footplate frame, as fitted.
    fits : mapping of (run, body) to LineFit
    lasers : LaserErrors, optional
    calibration : Calibration, optional
        Then positions and gains are known as it leaves them.
    """
    runs, bodies = range(len(placed.runs)), range(len(placed.bodies))
    shape = (len(runs), len(bodies), *fits[0, 0].q.shape)
    if calibration is None:
        positions = position_errors(fits, placed.bodies)
        others, spread, slopes = positions.names, np.diag(positions.variances), positions.derivatives
    else:
        others, spread, slopes = calibration_errors(calibration, fits, shape)
    agreement = () if lasers is None else lasers.names
    ends = np.cumsum([len(placement.names), len(others), len(agreement)])
    names = (*placement.names, *others, *agreement)
    if not names:
        return None
    derivatives = np.zeros((len(names), *shape), dtype=complex)
    derivatives[ends[0] : ends[1]] = slopes
    for (run, number), fit in fits.items() if ends[0] else ():
        by_pose = pose_derivatives(fit, placed.bodies[number], placement)
        derivatives[: ends[0], run, number] = np.einsum("kp,kfm->pfm", placement.derivative, by_pose)
    covariance = np.zeros((len(names), len(names)))
    covariance[: ends[0], : ends[0]] = placement.covariance
    covariance[ends[0] : ends[1], ends[0] : ends[1]] = spread
    if lasers is not None:
        derivatives[ends[1] :] = lasers.derivatives
        covariance[ends[1] :, ends[1] :] = lasers.estimate.covariance
        for (owner, point), across in lasers.estimate.across.items():
            name = f"position.{placed.bodies[owner].body}.{point}.x"
            if name in others:
                place = len(placement.names) + others.index(name)
                covariance[ends[1] :, place : place + 3] = across
                covariance[place : place + 3, ends[1] :] = across.T
    return SharedErrors(names, covariance, derivatives)
