"""Errors of lasers, beams and positions that all lines share: what is stated of them, and their estimate.

Shapes: c channels of all bodies side by side, p errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.fit.lasers import laser_numbers
from kinematics.joint.estimate import joint
from kinematics.joint.expected import ChannelError
from kinematics.joint.pack import Packed
from kinematics.joint.tangents import BEAM_U, BEAM_V, DELAY, GAIN, PHASE, SHIFT, TURN, Geometry, Parameters
from kinematics.measurement import Measurement, direction_name
from stapeskit.arrays import Array

LASER_KINDS = {"laser_gain": GAIN, "laser_phase": PHASE, "laser_delay": DELAY}
SHOWN = {
    "laser_gain": ("gain of laser", 100.0, "%"),
    "laser_phase": ("phase of laser", 180.0 / np.pi, "°"),
    "laser_delay": ("delay of laser", 1e6, "µs"),
    "beam": ("beam of laser", 180.0 / np.pi, "°"),
    "axes": ("turn of all beams about", 180.0 / np.pi, "°"),
    "position": ("position", 1e6, "µm"),
}
"""Words for each kind of error, the factor from SI to the unit in which it is shown, and this unit."""

UNLIKELY = 1e-3
"""Probability of an estimate below which errors are larger than stated."""
_LEAST_GAINED = 0.1  # share of the prior variance below which the data say nothing


@dataclass(frozen=True)
class Lasers:
    """The laser of each channel (c,), from 0, and the mean direction of the beams of each (lasers, 3)."""

    of_channel: NDArray[np.intp]
    directions: Array

    @classmethod
    def of(cls, placed: Measurement) -> Lasers:
        """Tell the lasers of a measurement by the directions of its beams."""
        directions = np.concatenate([body.directions for body in placed.bodies])
        laser = laser_numbers(directions)
        mean = np.array([directions[laser == number].mean(axis=0) for number in range(laser.max() + 1)])
        return cls(laser, mean / np.linalg.norm(mean, axis=1)[:, None])

    def own(self, number: int) -> tuple[int, ...]:
        """Return the channels of a laser."""
        return tuple(np.flatnonzero(self.of_channel == number).tolist())

    def errors(self, sd: Mapping[str, float]) -> list[ChannelError]:
        """Return gain, phase and delay of every laser with the sd that is stated; none of a single laser."""
        count = len(self.directions)
        return [
            ChannelError(f"{kind}.{number + 1}", self.own(number), tangent, sd[kind])
            for kind, tangent in LASER_KINDS.items()
            for number in range(count)
            if count > 1 and sd.get(kind, 0.0) > 0.0
        ]


def body_starts(placed: Measurement) -> list[int]:
    """Return the number of the first channel of each body, and that of all channels."""
    return [0, *np.cumsum([len(body.points) for body in placed.bodies]).tolist()]


def position_errors(placed: Measurement) -> list[ChannelError]:
    """Return the stated errors of the positions of all points, along x, y, z."""
    found = []
    for start, body in zip(body_starts(placed), placed.bodies, strict=False):
        for point in dict.fromkeys(body.points):
            own = body.channels_of(point)
            sd = float(body.position_sd_m[own[0]])
            channels = tuple(start + channel for channel in own)
            for axis, shift in zip("xyz" if sd > 0.0 else "", SHIFT, strict=False):
                found.append(ChannelError(f"position.{body.body}.{point}.{axis}", channels, shift, sd))
    return found


def beam_errors(lasers: Lasers, axes_sd_rad: float, beam_sd_rad: float) -> list[ChannelError]:
    """Return the turns of all beams together, and that of each laser."""
    every = tuple(range(len(lasers.of_channel)))
    turns = [
        ChannelError(f"axes.{axis}", every, turn, axes_sd_rad) for axis, turn in zip("xyz", TURN, strict=True)
    ]
    return turns + [
        ChannelError(f"beam.{number + 1}.{letter}", lasers.own(number), tangent, beam_sd_rad)
        for number in range(len(lasers.directions))
        for letter, tangent in (("u", BEAM_U), ("v", BEAM_V))
    ]


@dataclass(frozen=True)
class ErrorEstimate:
    """Errors as the redundancy of the beams shows them, the motion at every line left free.

    Attributes
    ----------
    errors : tuple of ChannelError, (p,)
    values : ndarray, (p,)
        1, rad, s and m.
    covariance : ndarray, (p, p)
        After the data.
    lasers : Lasers
    """

    errors: tuple[ChannelError, ...]
    values: Array
    covariance: Array
    lasers: Lasers

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each error."""
        return tuple(error.name for error in self.errors)

    @cached_property
    def prior_sd(self) -> Array:
        """Standard deviation (p,) that is stated."""
        return np.array([error.sd for error in self.errors])

    @property
    def sd(self) -> Array:
        """Standard deviation (p,) after the data."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def p_value(self) -> float:
        """Probability of an estimate so far from 0.

        If what is stated holds, the estimate has the covariance before less that after the data.
        """
        from scipy.special import chdtrc

        scale = np.outer(self.prior_sd, self.prior_sd)
        gained, vectors = np.linalg.eigh(np.eye(len(scale)) - self.covariance / scale)
        seen = gained > _LEAST_GAINED
        along = vectors.T @ (self.values / self.prior_sd)
        return float(chdtrc(seen.sum(), np.sum(along[seen] ** 2 / gained[seen]))) if seen.any() else 1.0

    def rows(self) -> list[tuple[str, float, float, float, str]]:
        """Return words, estimate, sd, stated sd and unit of every error, in shown units."""
        found = []
        for error, *sizes in zip(self.errors, self.values, self.sd, self.prior_sd, strict=True):
            words, factor, unit = SHOWN[error.kind]
            which = error.name.partition(".")[2]
            beams = ""
            if "laser" in words:
                beams = f" ({direction_name(self.lasers.directions[int(which.partition('.')[0]) - 1])})"
            value, sd, stated = (factor * float(size) for size in sizes)
            found.append((f"{words} {which}{beams}", value, sd, stated, unit))
        return found

    def largest(self) -> str:
        """Return in words the estimated error that is largest relative to its stated sd."""
        name, value, sd, stated, unit = self.rows()[int(np.argmax(np.abs(self.values) / self.prior_sd))]
        return f"{name}, by {value:+.3g} +- {sd:.2g} {unit} (stated sd {stated:.2g} {unit})"


def estimate_errors(
    placed: Measurement, lasers: Lasers, errors: Sequence[ChannelError], packs: Mapping[int, Packed]
) -> ErrorEstimate:
    """Estimate errors together with the motion of all bodies, within what is stated of them.

    Parameters
    ----------
    packs : mapping of int to Packed
        Values by body; bodies that are missing say nothing.

    Notes
    -----
    Maximum a posteriori by `kinematics.joint`, the motion projected out. Where the noise is small against the
    motion, the information that the noise of the estimated motion itself adds is negligible.
    """
    stated = np.array([error.sd for error in errors])
    if not packs:
        return ErrorEstimate(tuple(errors), 0.0 * stated, np.diag(stated**2), lasers)
    unit = si_units(placed, [error.tangent for error in errors])
    found = joint(side_by_side(placed, packs), parameters_of(placed, errors))
    return ErrorEstimate(tuple(errors), found.values * unit, found.covariance * np.outer(unit, unit), lasers)


def parameters_of(placed: Measurement, errors: Sequence[ChannelError]) -> Parameters:
    """Return the parameters (p,) of errors out of the channels of all bodies."""
    unit = si_units(placed, [error.tangent for error in errors])
    entries = [(error.channels, error.tangent, error.sd / by) for error, by in zip(errors, unit, strict=True)]
    return Parameters.of(body_starts(placed)[-1], entries)


def si_units(placed: Measurement, tangents: Sequence[int]) -> Array:
    """Return the factors (p,) from parameters to SI: delays are phases at the mean frequency."""
    mean_omega = 2.0 * np.pi * float(np.mean(placed.freq_hz))
    return np.where(np.asarray(tangents) == DELAY, 1.0 / mean_omega, 1.0)


def side_by_side(placed: Measurement, packs: Mapping[int, Packed]) -> Packed:
    """Return the values of several bodies as those of one, so that parameters may belong to all of them.

    Every group of lines keeps its own motion, which only the channels of its own body see.
    """
    starts = body_starts(placed)
    groups = sum(len(packed.y) for packed in packs.values())
    y = np.zeros((groups, starts[-1], max(packed.y.shape[2] for packed in packs.values())), dtype=complex)
    w = np.zeros(y.shape[:2])
    geometry = Geometry(
        np.concatenate([body.arms_m - body.arms_m.mean(axis=0) for body in placed.bodies]),
        np.concatenate([body.directions for body in placed.bodies]),
        np.ones((1, starts[-1]), dtype=complex),
    )
    first = 0
    for number, packed in packs.items():
        own = slice(first, first + len(packed.y)), slice(starts[number], starts[number + 1])
        y[(*own, slice(packed.y.shape[2]))], w[own] = packed.y, packed.w
        geometry.positions_m[own[1]] = packed.geometry.positions_m
        geometry.directions[own[1]] = packed.geometry.directions
        first += len(packed.y)

    def joined(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(packed, name) for packed in packs.values()])

    nothing = np.zeros((groups, starts[-1], 0), dtype=complex), np.zeros(groups, dtype=np.intp)
    scale = np.max([packed.scale for packed in packs.values()], axis=0)
    live = [starts[number] + packed.live for number, packed in packs.items()]
    return Packed(
        y, w, joined("columns"), joined("tau"), joined("rho"), *nothing, geometry, np.eye(6), scale,
        np.concatenate(live),
    )  # fmt: skip
