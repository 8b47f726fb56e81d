"""What errors of axes, laser directions, gains and point positions do to the observation rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.fit.laser_groups import group_lasers
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, raise_all
from legacy.stapeskit.frames import rotation_from_vector
from legacy.stapeskit.option_names import named
from legacy.stapeskit.spatial import cross, point_rows, shifted_point_rows

Index = NDArray[np.intp]


@dataclass(frozen=True)
class GeometryPriors:
    """Standard deviations of the geometry before the fit.

    Attributes
    ----------
    axes_sd_deg : float
        Rotation between the axes of all beams and those of the positions, about each axis.
    beam_sd_deg : float
        Direction of each laser on its own, about each axis across it.
    gain_sd_percent : float
        Gain of each laser; 0: exact. Positions take their own stated sd.

    Raises
    ------
    KinematicsError
        A number is negative, not finite, or beyond 20 degrees or percent.
    """

    axes_sd_deg: float = 1.0
    beam_sd_deg: float = 0.5
    gain_sd_percent: float = 1.0

    def __post_init__(self) -> None:
        options = {
            named("axes_sd"): self.axes_sd_deg,
            named("beam_sd"): self.beam_sd_deg,
            named("gain_sd"): self.gain_sd_percent,
        }
        raise_all(
            KinematicsError,
            [
                Fault(name, "a number from 0 to 20 (degrees, percent of gain)", f"{value:g}")
                for name, value in options.items()
                if not 0.0 <= value <= 20.0
            ],
        )


@dataclass(frozen=True)
class Change:
    """One parameter's change of the rows of one body: channels (n,) and d(row)/d(parameter) (n, 6)."""

    parameter: int
    channels: Index
    rows: Array


@dataclass(frozen=True)
class GeometryModel:
    """The parameters of a geometry and what they do.

    Attributes
    ----------
    names : tuple of str, (k,)
        ``axes.alpha`` ..., ``laser1.a`` ..., ``gain.laser1``, ``position.<body>.<point>.x`` ...
    prior_sd : ndarray, (k,)
        rad, 1 and m.
    lasers : tuple of ndarray
        By body: the laser (from 0) of each channel.
    laser_directions : ndarray, (laser, 3)
        Mean reported direction of each.
    """

    measurement: Measurement
    names: tuple[str, ...]
    prior_sd: Array
    lasers: tuple[Index, ...]
    laser_directions: Array
    _places: dict[tuple[str, int, str], int]

    @classmethod
    def of(cls, measurement: Measurement, priors: GeometryPriors) -> GeometryModel:
        """List the parameters of a measurement; those with a prior sd of zero are left out."""
        lasers, means = group_lasers([body.directions for body in measurement.bodies])
        names: list[str] = []
        sd: list[float] = []
        places: dict[tuple[str, int, str], int] = {}

        def add(key: tuple[str, int, str], labels: Sequence[str], size: float) -> None:
            if size > 0.0:
                places[key] = len(names)
                names.extend(labels)
                sd.extend([size] * len(labels))

        add(
            ("axes", 0, ""),
            [f"axes.{name}" for name in ("alpha", "beta", "gamma")],
            np.deg2rad(priors.axes_sd_deg),
        )
        for number in range(len(means)):
            labels = [f"laser{number + 1}.{name}" for name in "ab"]
            add(("laser", number, ""), labels, np.deg2rad(priors.beam_sd_deg))
        for number in range(len(means)):
            add(("gain", number, ""), [f"gain.laser{number + 1}"], priors.gain_sd_percent / 100.0)
        for number, body in enumerate(measurement.bodies):
            for point, spread in zip(body.points, body.position_sd_mm, strict=True):
                if np.isfinite(spread) and ("position", number, point) not in places:
                    labels = [f"position.{body.body}.{point}.{axis}" for axis in "xyz"]
                    add(("position", number, point), labels, float(spread) * 1e-3)
        return cls(measurement, tuple(names), np.array(sd), lasers, means, places)

    def moved(self, values: Array) -> Measurement:
        """Return the measurement with the geometry of the parameters; gains divide the readings."""
        return replace(
            self.measurement,
            bodies=tuple(self.body(number, values) for number in range(len(self.measurement.bodies))),
        )

    def body(self, number: int, values: Array) -> BodyChannels:
        """Return one body of ``moved``."""
        body = self.measurement.bodies[number]
        positions = body.positions_mm.copy()
        for channel, point in enumerate(body.points):
            place = self._places.get(("position", number, point))
            if place is not None:
                positions[channel] += values[place : place + 3] * 1e3
        gain = 1.0 + self.gains(number, values)
        return replace(
            body,
            positions_mm=positions,
            directions=self._directions(number, values),
            displacement=body.displacement / gain[:, None],
            sd=None if body.sd is None else body.sd / gain[:, None],
        )

    def gains(self, number: int, values: Array) -> Array:
        """Return the relative gain error (channel,) of a body's channels."""
        gains = np.zeros(len(self.lasers[number]))
        for laser in range(len(self.laser_directions)):
            place = self._places.get(("gain", laser, ""))
            if place is not None:
                gains[self.lasers[number] == laser] = values[place]
        return gains

    def _transverse_axes(self, laser: int) -> Array:
        """Return two unit vectors (2, 3) across a laser's mean direction."""
        mean = self.laser_directions[laser]
        first = np.cross(mean, np.eye(3)[int(np.argmin(np.abs(mean)))])
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(mean, first)])

    def _directions(self, number: int, values: Array) -> Array:
        directions = self.measurement.bodies[number].directions.copy()
        for laser in range(len(self.laser_directions)):
            place = self._places.get(("laser", laser, ""))
            if place is not None:
                mine = self.lasers[number] == laser
                turn = rotation_from_vector(values[place : place + 2] @ self._transverse_axes(laser))
                directions[mine] = directions[mine] @ turn.T
        place = self._places.get(("axes", 0, ""))
        if place is not None:
            directions = directions @ rotation_from_vector(values[place : place + 3]).T
        return directions

    def changes(self, number: int, values: Array) -> list[Change]:
        """Return what each parameter does to the rows (channel, 6) of a body, at some values.

        Notes
        -----
        Row [d, p x d]: a turn w of a direction gives [w x d, p x (w x d)], a shift u of a position
        [0, u x d], a gain g the row itself (of a model divided by 1 + g). Second orders of turns of
        a degree are left out of the derivative.
        """
        body = self.body(number, values)
        arms, directions = body.positions_mm * 1e-3, body.directions
        every = np.arange(len(body.points))
        changes: list[Change] = []

        def turned(parameter: int, channels: Index, axis: Array) -> None:
            step = cross(axis, directions[channels])
            changes.append(Change(parameter, channels, point_rows(arms[channels], step)))

        whole = np.eye(3)
        place = self._places.get(("axes", 0, ""))
        if place is not None:
            whole = rotation_from_vector(values[place : place + 3])
            for axis in range(3):
                turned(place + axis, every, np.eye(3)[axis])
        for laser in range(len(self.laser_directions)):
            channels = every[self.lasers[number] == laser]
            place = self._places.get(("laser", laser, ""))
            if place is not None and len(channels):
                for step, axis in enumerate(self._transverse_axes(laser) @ whole.T):
                    turned(place + step, channels, axis)
            place = self._places.get(("gain", laser, ""))
            if place is not None and len(channels):
                rows = point_rows(arms[channels], directions[channels]) / (1.0 + values[place])
                changes.append(Change(place, channels, rows))
        for (kind, owner, point), place in self._places.items():
            if kind == "position" and owner == number:
                channels = np.array([c for c, name in enumerate(body.points) if name == point])
                for axis in range(3):
                    rows = shifted_point_rows(directions[channels], np.eye(3)[axis])
                    changes.append(Change(place + axis, channels, rows))
        return changes
