"""Which channels belong together, and the errors of lasers and positions that are expected of every file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kinematics.joint.tangents import DELAY, GAIN, PHASE, SHIFT, Parameters
from stapeskit.arrays import Array


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
        Standard deviation that is stated of it: 1, rad, s or m.
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
    """

    points: tuple[str, ...]
    laser: NDArray[np.intp]

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


@dataclass(frozen=True)
class Priors:
    """Prior standard deviations of the errors of lasers and positions.

    Attributes
    ----------
    laser_gain, laser_phase_rad, laser_delay_s : float
        Of each laser against the others: data sheets of vibrometers state 1 % and 0.5 degrees, cables and
        filters differ by 1 us.
    position_m : ndarray, (c,)
        Per coordinate of each point; NaN or 0 where none is expected.
    """

    laser_gain: float = 0.01
    laser_phase_rad: float = float(np.deg2rad(0.5))
    laser_delay_s: float = 1e-6
    position_m: Array = field(default_factory=lambda: np.empty(0))


def expected_errors(layout: Layout, live: Sequence[int], priors: Priors) -> Parameters:
    """Return the expected errors of the channels in use, with their standard deviations."""
    entries: list[tuple[list[int], int, float]] = []
    if priors.position_m.size:
        for own in layout.by_point(live).values():
            sd = float(priors.position_m[own[0]])
            entries += [(own, tangent, sd) for tangent in SHIFT if sd > 0.0]
    sizes = ((GAIN, priors.laser_gain), (PHASE, priors.laser_phase_rad), (DELAY, priors.laser_delay_s))
    for own in layout.by_laser(live).values():
        entries += [(own, tangent, sd) for tangent, sd in sizes if sd > 0.0]
    return Parameters.of(len(layout.points), entries)
