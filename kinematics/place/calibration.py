"""``--calibrate``: estimate axes, beams, gains and positions together with the motion, within their sd."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kinematics.joint.expected import ChannelError
from kinematics.joint.pack import Readings, pack
from kinematics.joint.tangents import Geometry, Parameters
from kinematics.measurement import Measurement
from kinematics.place.channel_errors import (
    UNLIKELY,
    ErrorEstimate,
    Lasers,
    beam_errors,
    body_starts,
    estimate_errors,
    parameters_of,
    position_errors,
    si_units,
)
from stapeskit.warnings import Notice

AXES_SD_DEG = 1.0
"""Turn between beams and positions: holders are set by eye."""
BEAM_SD_DEG = 0.5
"""Direction of each laser: that of a head on its mount."""

_INFORMED = 0.9  # sd over that before, below which the data have informed a parameter


@dataclass(frozen=True)
class Calibration:
    """The geometry that motion and stated errors agree on.

    Attributes
    ----------
    estimate : ErrorEstimate
        Zero is the geometry as given.
    measurement : Measurement
        With the new geometry.
    """

    estimate: ErrorEstimate
    measurement: Measurement

    def notices(self) -> list[Notice]:
        """Return what the data determine, and whether they go beyond what was stated."""
        found = self.estimate
        seen = found.sd < _INFORMED * found.prior_sd
        text = (
            f"calibration: the data determine {int(seen.sum())} of {len(seen)} parameters of the geometry. "
            "No residual shows a shift of all points of a body together, nor a turn of positions and beams "
            "together, nor one gain common to all lasers: those rest on fiducials and references alone."
        )
        notices = [Notice("calibrated", text)]
        if found.p_value < UNLIKELY:
            text = (
                "calibration: the data pull the geometry beyond what the stated errors allow (p "
                f"{found.p_value:.1g}), most the {found.largest()}. Check sd_mm, the directions of the "
                "beams, and the channels with a verdict."
            )
            notices.append(Notice("calibration_beyond_priors", text))
        return notices


def geometry_errors(placed: Measurement, lasers: Lasers, laser_sd: Mapping[str, float]) -> list[ChannelError]:
    """Return all errors that a calibration estimates."""
    return [
        *beam_errors(lasers, float(np.deg2rad(AXES_SD_DEG)), float(np.deg2rad(BEAM_SD_DEG))),
        *lasers.errors(laser_sd),
        *position_errors(placed),
    ]


def calibrate(
    placed: Measurement, readings: Sequence[Readings], laser_sd: Mapping[str, float]
) -> Calibration:
    """Estimate the geometry of a measurement together with the motion of all bodies.

    Parameters
    ----------
    placed : Measurement
        In the footplate frame.
    readings : sequence of Readings
        Of every body.
    laser_sd : mapping of str to float
        Standard deviations by the names of `kinematics.place.channel_errors.LASER_KINDS`.
    """
    lasers = Lasers.of(placed)
    errors = geometry_errors(placed, lasers, laser_sd)
    found = estimate_errors(placed, lasers, errors, {k: pack(one) for k, one in enumerate(readings)})
    return Calibration(found, _moved(placed, found))


def _moved(placed: Measurement, found: ErrorEstimate) -> Measurement:
    """Return the measurement with positions, directions and values as the estimate makes them."""
    parameters = parameters_of(placed, found.errors)
    values = found.values / si_units(placed, parameters.tangent.tolist())
    rho = placed.freq_hz / float(np.mean(placed.freq_hz))
    starts = body_starts(placed)
    bodies = []
    for number, body in enumerate(placed.bodies):
        count = len(body.points)
        own = Parameters(
            parameters.mask[:, starts[number] : starts[number + 1]], parameters.tangent, parameters.sd
        )
        as_given = Geometry(body.arms_m, body.directions, np.ones((1, count), dtype=complex))
        moved = as_given.moved(own, values, np.zeros(len(rho)), rho)
        factor = moved.factor.T
        bodies.append(
            replace(
                body,
                positions_m=moved.positions_m,
                directions=moved.directions,
                value=body.value / factor,
                sd=None if body.sd is None else body.sd / np.abs(factor),
            )
        )
    return replace(placed, bodies=tuple(bodies))
