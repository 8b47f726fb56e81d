"""The vibrometer measurement as a value: what every beam read, in SI units of the measured quantity.

Shapes: r runs (excitations), c channels (one point and one beam), L frequency lines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import StapeskitError
from stapeskit.frames import RigidTransform
from stapeskit.warnings import Notice

QUANTITIES = {"displacement": 0, "velocity": 1, "acceleration": 2}
"""Measured quantities and their order: time derivatives of the displacement."""

MIRRORS = {"x": (-1.0, 1.0, 1.0), "y": (1.0, -1.0, 1.0), "z": (1.0, 1.0, -1.0)}


@dataclass(frozen=True)
class BodyChannels:
    """The channels of one body.

    Attributes
    ----------
    points : tuple of str, (c,)
        Name of the point of each channel.
    positions_m : ndarray, (c, 3), or None
        None: the files hold none, they are still to be read from elsewhere.
    directions : ndarray, (c, 3)
        Unit vectors towards the laser head.
    value : ndarray, (r, c, L), complex
        Component of the measured quantity along the beam: m, m/s or m/s2, peak, e^{+iwt}; NaN where missing.
    sd : ndarray, (r, c, L), or None
        Standard deviation of the real (= imaginary) part of ``value``, in its unit. None: not stated, to be
        estimated from the residuals. NaN: this value is not used.
    relative : bool
        ``sd`` is known up to one factor per body, which the residuals give (number of averages alone).
    position_sd_m : ndarray, (c,)
        Standard deviation per coordinate of the point's position; NaN where not stated.
    averages : ndarray, (c,)
        Behind an ``sd`` that follows from coherence; 0 for another one.
    file_positions_m, file_directions : ndarray, (c, 3)
        As in the file, by which channels and corrections are named; the current ones without them.
    file_from_here : ndarray, (3, 3)
        From the axes of ``positions_m`` to those of the file; a reflection with --mirror.
    """

    body: str
    points: tuple[str, ...]
    positions_m: Array | None
    directions: Array
    value: ComplexArray
    sd: Array | None = None
    relative: bool = False
    position_sd_m: Array = field(default_factory=lambda: np.empty(0))
    averages: Array = field(default_factory=lambda: np.empty(0))
    file_positions_m: Array | None = None
    file_directions: Array = field(default_factory=lambda: np.empty(0))
    file_from_here: Array = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        if self.file_directions.size == 0:
            object.__setattr__(self, "file_directions", self.directions)
        if self.file_positions_m is None:
            object.__setattr__(self, "file_positions_m", self.positions_m)
        if self.position_sd_m.size == 0:
            object.__setattr__(self, "position_sd_m", np.full(len(self.points), np.nan))
        if self.averages.size == 0:
            object.__setattr__(self, "averages", np.zeros(len(self.points)))

    @property
    def is_noise_stated(self) -> bool:
        """Whether ``sd`` is known in absolute size."""
        return self.sd is not None and not self.relative

    @property
    def arms_m(self) -> Array:
        """Positions (c, 3), m.

        Raises
        ------
        StapeskitError
            The body has none.
        """
        if self.positions_m is None:
            thing, step = f"the points of body {self.body}", "Give them with --points points.csv"
            raise StapeskitError.of(thing, "with positions", "none", next_step=step)
        return self.positions_m

    def channel_name(self, channel: int) -> str:
        """Return ``body point (direction)`` for messages."""
        return f"{self.body} {self.points[channel]} ({direction_name(self.file_directions[channel])})"

    def channel_key(self, channel: int) -> str:
        """Return ``BODY:POINT:BEAM`` without blanks, as channels are named in options."""
        beam = direction_name(self.file_directions[channel])
        return f"{self.body}:{self.points[channel]}:{beam}".replace(" ", "")

    def channels_of(self, point: str) -> list[int]:
        """Return the channels of a point."""
        return [channel for channel, name in enumerate(self.points) if name == point]

    def part(self, channels: Sequence[int]) -> BodyChannels:
        """Return the body with some of its channels."""
        own = list(channels)
        return replace(
            self,
            points=tuple(self.points[channel] for channel in own),
            positions_m=None if self.positions_m is None else self.positions_m[own],
            directions=self.directions[own],
            value=self.value[:, own],
            sd=None if self.sd is None else self.sd[:, own],
            position_sd_m=self.position_sd_m[own],
            averages=self.averages[own],
            file_positions_m=None if self.file_positions_m is None else self.file_positions_m[own],
            file_directions=self.file_directions[own],
        )


def direction_name(direction: Array) -> str:
    """Write a direction as ``x``, ``-z`` or three numbers."""
    place = int(np.argmax(np.abs(direction)))
    if abs(abs(direction[place]) - 1.0) < 1e-9:
        return ("-" if direction[place] < 0.0 else "") + "xyz"[place]
    return ", ".join(f"{value:.3f}" for value in direction)


class Repeat(NamedTuple):
    """Which repeat of which excitation an entry of ``runs`` is; empty where a run has no repeats."""

    run: str
    repeat: str = ""


@dataclass(frozen=True)
class LeftOut:
    """A channel that the user left out: body and point, and its beam (3,) as in the file."""

    body: str
    point: str
    direction: Array


@dataclass(frozen=True)
class Measurement:
    """A vibrometer measurement of one or more bodies on one grid of frequencies.

    Attributes
    ----------
    frame : str
        Frame of positions and directions, e.g. ``vibrometer`` or ``footplate``.
    runs : tuple of str, (r,)
        Excitations.
    freq_hz : ndarray, (L,)
        Ascending, positive.
    quantity : str
        What ``value`` holds, one of `QUANTITIES`: its noise is level over frequency when nothing else is
        known.
    inputs : mapping of str to Path
        Files by their role.
    repeats : tuple of Repeat, (r,)
        What each entry of ``runs`` (their ``name``) is while repeats are not pooled yet; empty without any.
    line_spread : float
        By what factor the variance of slowly varying sums over lines exceeds that of independent lines, as
        windows of spectra make it.
    statements : tuple of str
        What the files say about their coordinates, units, resolution and averages.
    left_out : tuple of LeftOut
        Channels of the files that the user left out.
    """

    frame: str
    runs: tuple[str, ...]
    freq_hz: Array
    bodies: tuple[BodyChannels, ...]
    quantity: str = "velocity"
    inputs: Mapping[str, Path] = field(default_factory=dict)
    notices: tuple[Notice, ...] = ()
    repeats: tuple[Repeat, ...] = ()
    line_spread: float = 1.0
    statements: tuple[str, ...] = ()
    left_out: tuple[LeftOut, ...] = ()

    @property
    def order(self) -> int:
        """Time derivatives in the measured quantity: 0, 1 or 2."""
        return QUANTITIES[self.quantity]

    @property
    def per_displacement(self) -> ComplexArray:
        """Factor (L,) from displacement to the measured quantity, (i w)^order."""
        return np.asarray((2j * np.pi * self.freq_hz) ** self.order)

    def mapped(self, to_from_here: RigidTransform) -> Measurement:
        """Return the measurement with positions and directions in another frame."""
        moved = self._turned(to_from_here.rotation, 1e-3 * to_from_here.translation_mm)
        return replace(moved, frame=to_from_here.to)

    def mirrored(self, axis: str) -> Measurement:
        """Return the measurement with one axis, x, y or z, of its left-handed coordinates reversed."""
        return self._turned(np.diag(MIRRORS[axis]), np.zeros(3))

    def _turned(self, turn: Array, shift_m: Array) -> Measurement:
        """Return the measurement in axes that are turned or mirrored (3, 3), then shifted."""
        bodies = tuple(
            replace(
                body,
                positions_m=None if body.positions_m is None else body.positions_m @ turn.T + shift_m,
                directions=body.directions @ turn.T,
                file_from_here=body.file_from_here @ turn.T,
            )
            for body in self.bodies
        )
        return replace(self, bodies=bodies)
