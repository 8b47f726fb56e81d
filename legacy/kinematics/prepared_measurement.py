"""A measurement before its first fit: units checked, repeats pooled, placed, screened, calibrated."""

from __future__ import annotations

from dataclasses import dataclass, replace

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.faults.alternatives import slip_notices
from legacy.kinematics.faults.screening import Screened, empty_faults, is_whole, screen_values
from legacy.kinematics.fit.beams import BeamSet
from legacy.kinematics.fit_and_search import beam_sets
from legacy.kinematics.fit_options import Options
from legacy.kinematics.measurement import Measurement
from legacy.kinematics.motion_checks import uncommon_lines
from legacy.kinematics.registration.calibrate import Calibration
from legacy.kinematics.registration.calibrated_fit import calibrate_with_noise
from legacy.kinematics.registration.placement import Placement
from legacy.kinematics.repeats.pooling import Pooled, pool_repeats, separate_repeats
from legacy.stapeskit.faults import raise_all
from legacy.stapeskit.warnings import Notice


@dataclass(frozen=True)
class PreparedMeasurement:
    """A measurement that can be fitted.

    Attributes
    ----------
    repeats : Pooled
        With the readings that are fitted, as they were placed in the file.
    placed : Measurement
        In the footplate frame, without channels that say nothing.
    screens : tuple of Screened
        By body.
    beams : tuple of BeamSet
        By body.
    calibration : Calibration or None
        The geometry as estimated, when that was asked for.
    """

    repeats: Pooled
    placed: Measurement
    screens: tuple[Screened, ...]
    beams: tuple[BeamSet, ...]
    calibration: Calibration | None
    notices: tuple[Notice, ...]


def prepare_measurement(
    measurement: Measurement, placement: Placement, options: Options
) -> PreparedMeasurement:
    """Prepare a measurement for the fit.

    Parameters
    ----------
    measurement : Measurement
        Positions and directions in the source frame of ``placement``.

    Raises
    ------
    KinematicsError
        A body has no usable value, or its beams cannot observe the degrees of freedom.
    """
    whole = all(is_whole(body) for body in measurement.bodies)
    if not whole:
        raise_all(KinematicsError, empty_faults(measurement))
    slips = slip_notices(measurement)
    repeats = pool_repeats(measurement) if options.repeats == "pool" else separate_repeats(measurement)
    placed = repeats.measurement.mapped(placement.transform)
    beams = beam_sets(placed, options.dof)
    screens = [
        Screened(body, tuple({} for _ in placed.runs), ())
        if whole
        else screen_values(body, placed.runs, options.dof)
        for body in placed.bodies
    ]
    placed = replace(placed, bodies=tuple(screen.body for screen in screens))
    calibration = None
    if options.calibrate is not None:
        calibration = calibrate_with_noise(placed, options.dof, options.calibrate, options.robust)
        placed = calibration.measurement
        screens = [replace(screen, body=body) for screen, body in zip(screens, placed.bodies, strict=True)]
        beams = beam_sets(placed, options.dof)
    notices = [*repeats.measurement.notices, *placement.notices, *slips]
    notices += [] if calibration is None else calibration.notices
    for screen in screens:
        notices += screen.notices
    notices += [] if whole else uncommon_lines(placed)
    return PreparedMeasurement(repeats, placed, tuple(screens), tuple(beams), calibration, tuple(notices))
