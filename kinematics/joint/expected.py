"""The errors of lasers, positions and beams that are stated or expected, and which channels share them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinematics.joint.tangents import BEAM_U, BEAM_V, DELAY, GAIN, PHASE, SHIFT, TURN, Parameters
from kinematics.measurement import BodyChannels, direction_name
from stapeskit.arrays import Array

LASER_KINDS = {"laser_gain": GAIN, "laser_phase": PHASE, "laser_delay": DELAY}
LASER_SD = {"laser_gain": 0.01, "laser_phase": float(np.deg2rad(0.5)), "laser_delay": 1e-6}
"""Of each laser against the others, at a gain sd of 1 %: data sheets state 1 % and 0.5 degrees, cables and
filters differ by 1 us."""
AXES_SD_DEG = 1.0
"""Prior sd of the turn between beams and positions: holders are set by eye, to about a degree."""
BEAM_SD_DEG = 0.5
"""Prior sd of the direction of each laser: play of a head on its mount, a few millimetres in half a metre."""
ONE_LASER_DEG = 8.0
"""Beams of one head lie closer: 10 mm of a middle ear over 100 mm make 6 degrees. Heads of a 3D vibrometer
stand tens of degrees apart."""
_MOST_HEADS = 6  # parallel groups of beams up to here are heads, however close
_MOST_PAIRED, _CELL_RAD = 1000, 0.04  # more directions than this are first gathered in cells of this width


@dataclass(frozen=True)
class ChannelError:
    """An error that channels share.

    Attributes
    ----------
    name : str
        ``laser_gain.1``, ``position.BODY.POINT.x``, ``axes.x``, ``beam.1.u`` ...: a reading is the true value
        times 1 + gain, e^(i phase) and e^(-i w delay).
    channels : tuple of int
        Out of those of all bodies side by side.
    tangent : int
        Of `kinematics.joint.tangents`.
    sd : float
        Its stated standard deviation; the unit follows the tangent: none, rad, s or m.
    """

    name: str
    channels: tuple[int, ...]
    tangent: int
    sd: float

    @property
    def kind(self) -> str:
        """First part of the name."""
        return self.name.partition(".")[0]


@dataclass(frozen=True)
class Layout:
    """Which channels belong together.

    Attributes
    ----------
    points : tuple of str, (c,)
        Name of the point of each channel.
    laser : ndarray, (c,), int
        Number of its laser.
    errors : tuple of ChannelError
        That are expected of lasers and positions.
    """

    points: tuple[str, ...]
    laser: NDArray[np.intp]
    errors: tuple[ChannelError, ...] = ()

    def by_point(self, live: Sequence[int]) -> dict[str, list[int]]:
        """Return the channels in use of each point."""
        own: dict[str, list[int]] = {}
        for channel in live:
            own.setdefault(self.points[channel], []).append(int(channel))
        return own

    def by_laser(self, live: Sequence[int]) -> dict[int, list[int]]:
        """Return the channels in use of each laser; empty where there is one only."""
        groups: dict[int, list[int]] = {}
        for channel in live:
            groups.setdefault(int(self.laser[channel]), []).append(int(channel))
        return groups if len(groups) > 1 else {}

    def expected(self, live: Sequence[int]) -> Parameters:
        """Return the expected errors of the channels in use; of lasers where there are several."""
        used, several = set(live), bool(self.by_laser(live))
        entries = [
            ([channel for channel in error.channels if channel in used], error.tangent, error.sd)
            for error in self.errors
            if several or error.kind not in LASER_KINDS
        ]
        return Parameters.of(len(self.points), [entry for entry in entries if entry[0]])


def body_starts(bodies: Sequence[BodyChannels]) -> list[int]:
    """Return the number of the first channel of each body, and that of all channels."""
    return [0, *np.cumsum([len(body.points) for body in bodies]).tolist()]


def laser_numbers(directions: Array) -> NDArray[np.intp]:
    """Number the laser of each channel from 0, in the order of first use; directions (c, 3) of all bodies.

    Notes
    -----
    Beams in few exactly parallel groups of at least three are one head a group (heads far away, or reported
    axes). Otherwise beams that are linked by steps below 8 degrees belong together.
    """
    rounded = np.round(directions, 3) + 0.0
    distinct, owner, number = np.unique(rounded, axis=0, return_inverse=True, return_counts=True)
    owner = owner.reshape(-1)
    if len(distinct) > _MOST_HEADS or np.min(number, initial=3) < 3:
        from scipy.sparse.csgraph import connected_components

        if len(distinct) > _MOST_PAIRED:
            cells, cell = np.unique(np.round(distinct / _CELL_RAD), axis=0, return_inverse=True)
            distinct, owner = cells, cell.reshape(-1)[owner]
        distinct = distinct / np.linalg.norm(distinct, axis=1)[:, None]
        near = distinct @ distinct.T > np.cos(np.deg2rad(ONE_LASER_DEG))
        owner = connected_components(near)[1][owner]
    first = list(dict.fromkeys(owner.tolist()))
    return np.array([first.index(label) for label in owner.tolist()], dtype=np.intp)


def lasers_of(bodies: Sequence[BodyChannels]) -> tuple[list[tuple[int, ...]], tuple[str, ...]]:
    """Group channels by laser; return the channels of each and the mean direction of its beams."""
    directions = np.concatenate([body.directions for body in bodies])
    number = laser_numbers(directions)
    lasers = [tuple(np.flatnonzero(number == k).tolist()) for k in range(number.max() + 1)]
    mean = [directions[list(own)].mean(axis=0) for own in lasers]
    return lasers, tuple(direction_name(one / np.linalg.norm(one)) for one in mean)


def stated_errors(
    bodies: Sequence[BodyChannels], laser_sd: Mapping[str, float] = LASER_SD, calibrate: bool = False
) -> list[ChannelError]:
    """Return what is stated of lasers (not of a single one) and positions; to calibrate also axes and beams.

    ``laser_sd`` is by the names of `LASER_KINDS`: 1, rad and s; those that are exact are left out.
    """
    lasers, _ = lasers_of(bodies)
    errors = []
    if calibrate:
        every, sd = tuple(range(body_starts(bodies)[-1])), float(np.deg2rad(AXES_SD_DEG))
        errors += [ChannelError(f"axes.{k}", every, turn, sd) for k, turn in zip("xyz", TURN, strict=True)]
        errors += [
            ChannelError(f"beam.{number}.{letter}", own, tangent, float(np.deg2rad(BEAM_SD_DEG)))
            for number, own in enumerate(lasers, 1)
            for letter, tangent in (("u", BEAM_U), ("v", BEAM_V))
        ]
    errors += [
        ChannelError(f"{kind}.{number}", own, tangent, laser_sd[kind])
        for kind, tangent in LASER_KINDS.items()
        for number, own in enumerate(lasers, 1)
        if len(lasers) > 1 and laser_sd.get(kind, 0.0) > 0.0
    ]
    for start, body in zip(body_starts(bodies), bodies, strict=False):
        for point in dict.fromkeys(body.points):
            own = body.channels_of(point)
            sd = float(body.position_sd_m[own[0]])
            channels = tuple(start + channel for channel in own)
            for axis, shift in zip("xyz" if sd > 0.0 else "", SHIFT, strict=False):
                errors.append(ChannelError(f"position.{body.body}.{point}.{axis}", channels, shift, sd))
    return errors
