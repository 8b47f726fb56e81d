"""``--calibrate``: estimate axes, beams, gains and positions together with the motion, within their sd."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinematics.joint.estimate import joint, system
from kinematics.joint.pack import Readings, pack
from kinematics.joint.tangents import BEAM_U, BEAM_V, DELAY, GAIN, PHASE, SHIFT, TURN, Geometry, Parameters
from kinematics.measurement import Measurement
from kinematics.place.lasers import SHOWN, lasers_of, merged
from kinematics.place.shared_errors import Parameter, tangent_rows
from stapeskit.arrays import Array
from stapeskit.warnings import Notice

AXES_SD_DEG = 1.0
"""Turn between beams and positions: holders are set by eye."""
BEAM_SD_DEG = 0.5
"""Direction of each laser: that of a head on its mount."""

_INFORMED = 0.9  # sd over that before, below which the data have informed a parameter
_UNLIKELY = 1e-3
_UNITS = {"position": ("µm", 1e6), "axes": ("°", 180.0 / np.pi), "beam": ("°", 180.0 / np.pi)}


@dataclass(frozen=True)
class Calibration:
    """The geometry that motion and priors agree on.

    Attributes
    ----------
    names : tuple of str, (p,)
        ``calibration.axes.x``, ``calibration.beam.1.u``, ``calibration.laser_gain.1``,
        ``calibration.position.BODY.POINT.x`` ...
    values, prior_sd : ndarray, (p,)
        rad, 1, s and m; zero is the geometry as given.
    covariance : ndarray, (p, p)
        After the data, the motion at every line left free.
    measurement : Measurement
        With the new geometry.
    parameters : tuple of Parameter
        Their effect on the motion.
    p_value : float
        Of an estimate so far from what was stated.
    """

    names: tuple[str, ...]
    values: Array
    prior_sd: Array
    covariance: Array
    measurement: Measurement
    parameters: tuple[Parameter, ...]
    p_value: float

    @property
    def sd(self) -> Array:
        """Standard deviation (p,) after the data."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def rows(self) -> list[tuple[str, float, float, float, str]]:
        """Return name, estimate, sd, stated sd and unit of every parameter, in shown units."""
        found = []
        for name, *sizes in zip(self.names, self.values, self.sd, self.prior_sd, strict=True):
            kind = name.split(".")[1]
            unit, factor = _UNITS.get(kind) or (SHOWN[kind][2], SHOWN[kind][1])
            value, sd, prior = (factor * float(size) for size in sizes)
            found.append((name.removeprefix("calibration."), value, sd, prior, unit))
        return found

    def notices(self) -> list[Notice]:
        """Return what the data determine, and whether they go beyond what was stated."""
        seen = self.sd < _INFORMED * self.prior_sd
        text = (
            f"calibration: the data determine {int(seen.sum())} of {len(seen)} parameters of the geometry. "
            "No residual shows a shift of all points of a body together, nor a turn of positions and beams "
            "together, nor one gain common to all lasers: those rest on fiducials and references alone."
        )
        notices = [Notice("calibrated", text)]
        if self.p_value < _UNLIKELY:
            worst = int(np.argmax(np.abs(self.values) / self.prior_sd))
            name, value, sd, prior, unit = self.rows()[worst]
            text = (
                "calibration: the data pull the geometry beyond what the stated errors allow (p "
                f"{self.p_value:.1g}), most {name} by {value:+.3g} +- {sd:.2g} {unit} (stated {prior:.2g}). "
                "Check sd_mm, the directions of the beams, and the channels with a verdict."
            )
            notices.append(Notice("calibration_beyond_priors", text))
        return notices


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
        Standard deviations by the names of `kinematics.place.lasers.KINDS`.

    Notes
    -----
    Maximum a posteriori by `kinematics.joint`, the motion projected out. Where the noise is small against the
    motion, the information that the noise of the estimated motion itself adds is negligible.
    """
    names, entries, powers = _entries(placed, laser_sd, float(np.mean(readings[0].freq_hz)))
    packed = merged([pack(one) for one in readings])
    parameters = Parameters.of(packed.w.shape[1], entries)
    found = joint(packed, parameters)
    information = system(found.state, parameters)[1]
    values = found.values * powers
    covariance = found.covariance * np.outer(powers, powers)
    measurement = _moved(placed, parameters, found.values, readings[0])
    starts = np.concatenate([[0], np.cumsum([len(body.points) for body in placed.bodies])])
    effects = []
    for name, mask, tangent in zip(names, parameters.mask, parameters.tangent.tolist(), strict=True):
        rows = {}
        for number, body in enumerate(measurement.bodies):
            own = np.flatnonzero(mask[starts[number] : starts[number + 1]])
            if len(own):
                rows[number] = tangent_rows(body, own.tolist(), tangent)
        effects.append(Parameter(name, rows, int(tangent == DELAY)))
    return Calibration(
        tuple(names),
        values,
        parameters.sd * powers,
        covariance,
        measurement,
        tuple(effects),
        _chance(found.values, information, parameters.sd),
    )


def _entries(
    placed: Measurement, laser_sd: Mapping[str, float], mean_hz: float
) -> tuple[list[str], list[tuple[list[int], int, float]], Array]:
    """Return names, (channels, tangent, sd) of all parameters, and the factors of their values to SI."""
    of_channel, directions = lasers_of(placed)
    laser = np.concatenate(of_channel)
    every = list(range(len(laser)))
    names: list[str] = []
    entries: list[tuple[list[int], int, float]] = []
    units: list[float] = []

    def add(name: str, own: list[int], tangent: int, sd: float, unit: float = 1.0) -> None:
        if sd > 0.0 and own:
            names.append(f"calibration.{name}")
            entries.append((own, tangent, sd))
            units.append(unit)

    for axis, turn in zip("xyz", TURN, strict=True):
        add(f"axes.{axis}", every, turn, float(np.deg2rad(AXES_SD_DEG)))
    lag = 2.0 * np.pi * mean_hz
    for number in range(len(directions)):
        own = np.flatnonzero(laser == number).tolist()
        for letter, beam in (("u", BEAM_U), ("v", BEAM_V)):
            add(f"beam.{number + 1}.{letter}", own, beam, float(np.deg2rad(BEAM_SD_DEG)))
        if len(directions) > 1:
            add(f"laser_gain.{number + 1}", own, GAIN, laser_sd.get("laser_gain", 0.0))
            add(f"laser_phase.{number + 1}", own, PHASE, laser_sd.get("laser_phase", 0.0))
            add(f"laser_delay.{number + 1}", own, DELAY, lag * laser_sd.get("laser_delay", 0.0), 1.0 / lag)
    start = 0
    for body in placed.bodies:
        for point in dict.fromkeys(body.points):
            channels = body.channels_of(point)
            for axis, shift in zip("xyz", SHIFT, strict=True):
                own = [start + channel for channel in channels]
                add(
                    f"position.{body.body}.{point}.{axis}", own, shift, float(body.position_sd_m[channels[0]])
                )
        start += len(body.points)
    return names, entries, np.array(units)


def _moved(placed: Measurement, parameters: Parameters, values: Array, readings: Readings) -> Measurement:
    """Return the measurement with positions, directions and values as the parameters make them."""
    bodies = []
    start = 0
    rho = placed.freq_hz / float(np.mean(readings.freq_hz))
    for body in placed.bodies:
        count = len(body.points)
        own = Parameters(parameters.mask[:, start : start + count], parameters.tangent, parameters.sd)
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
        start += count
    return replace(placed, bodies=tuple(bodies))


def _chance(values: Array, information: Array, prior_sd: Array) -> float:
    """Return the probability of an estimate so far from 0 by its priors, in directions that the data show."""
    from scipy.special import chdtrc

    strength, vectors = np.linalg.eigh(information * np.outer(prior_sd, prior_sd))
    share = strength / (1.0 + np.maximum(strength, 0.0))  # of the prior variance that the data take away
    seen: NDArray[np.bool_] = share > 1.0 - _INFORMED**2
    along = vectors.T @ (values / prior_sd)
    chi2 = float(np.sum(along[seen] ** 2 / share[seen]))
    return float(chdtrc(int(seen.sum()), chi2)) if seen.any() else 1.0
