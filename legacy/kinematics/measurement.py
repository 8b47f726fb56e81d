"""Vibrometer measurements: what every beam read at every frequency, as displacement amplitudes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.faults import Fault, raise_all
from legacy.stapeskit.frames import RigidTransform
from legacy.stapeskit.warnings import Notice

MIRRORS = {"x": (-1.0, 1.0, 1.0), "y": (1.0, -1.0, 1.0), "z": (1.0, 1.0, -1.0)}


@dataclass(frozen=True)
class BodyChannels:
    """The channels (point and beam) of one body.

    Attributes
    ----------
    points : tuple of str, (channel,)
        Name of the point of each channel.
    positions_mm : ndarray, (channel, 3)
    directions : ndarray, (channel, 3)
        Unit vectors towards the laser head.
    displacement : ndarray, (run, channel, freq), complex
        Component of the displacement along the beam, m, peak, e^{+iwt}; NaN where missing.
    sd : ndarray, (run, channel, freq), or None
        Standard deviation of its real (= imaginary) part, m. None: unknown and equal for all channels in
        the measured quantity. NaN: this value's noise is unknown, the value is not used.
    relative : bool
        ``sd`` is known up to one factor per body, which the residuals give.
    position_sd_mm : ndarray, (channel,)
        Standard deviation per coordinate of the point's position; NaN when not stated.
    reported_directions : ndarray, (channel, 3)
        Directions as they stood in the file, by which a channel is named; ``directions`` without them.
    reported_positions_mm : ndarray, (channel, 3)
        Positions as in the file; ``positions_mm`` without them.
    file_from_here : ndarray, (3, 3)
        From the axes of ``positions_mm`` to those of the file; orthogonal, a reflection with --mirror.

    Raises
    ------
    KinematicsError
        Shapes that do not match, or directions that are no unit vectors.
    """

    body: str
    points: tuple[str, ...]
    positions_mm: Array
    directions: Array
    displacement: ComplexArray
    sd: Array | None = None
    relative: bool = False
    position_sd_mm: Array = field(default_factory=lambda: np.empty(0))
    reported_directions: Array = field(default_factory=lambda: np.empty(0))
    reported_positions_mm: Array = field(default_factory=lambda: np.empty(0))
    file_from_here: Array = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        count = len(self.points)
        if self.reported_directions.size == 0:
            object.__setattr__(self, "reported_directions", self.directions)
        if self.reported_positions_mm.size == 0:
            object.__setattr__(self, "reported_positions_mm", self.positions_mm)
        if self.position_sd_mm.size == 0:
            object.__setattr__(self, "position_sd_mm", np.full(count, np.nan))
        shapes = {
            "positions_mm": (self.positions_mm.shape, (count, 3)),
            "directions": (self.directions.shape, (count, 3)),
            "displacement": (self.displacement.shape[1:2], (count,)),
            "sd": ((count,) if self.sd is None else self.sd.shape[1:2], (count,)),
            "position_sd_mm": (self.position_sd_mm.shape, (count,)),
        }
        faults = [
            Fault(f"the shape of {name} of body {self.body}", str(want), got)
            for name, (got, want) in shapes.items()
            if got != want
        ]
        raise_all(KinematicsError, faults)
        if not np.all(np.abs(np.linalg.norm(self.directions, axis=1) - 1.0) < 1e-3):
            raise KinematicsError.of(f"the beam directions of body {self.body}", "unit vectors", "others")

    def channel_name(self, channel: int) -> str:
        """Return ``body point (direction)`` for messages."""
        return f"{self.body} {self.points[channel]} ({direction_name(self.reported_directions[channel])})"

    def with_run(self, run: int, displacement: ComplexArray, sd: Array | None = None) -> BodyChannels:
        """Return the body with other readings (channel, freq) of one run, and their sd where it has any."""
        value = self.displacement.copy()
        value[run] = displacement
        if self.sd is None or sd is None:
            return replace(self, displacement=value)
        spread = np.array(self.sd)
        spread[run] = sd
        return replace(self, displacement=value, sd=spread)


def direction_name(direction: Array) -> str:
    """Write a direction as ``x``, ``-z`` or three numbers."""
    place = int(np.argmax(np.abs(direction)))
    if abs(abs(direction[place]) - 1.0) < 1e-9:
        return ("-" if direction[place] < 0.0 else "") + "xyz"[place]
    return ", ".join(f"{value:.3f}" for value in direction)


@dataclass(frozen=True)
class Take:
    """One pass of a measurement: an excitation, which repeat of it, and how strong.

    Attributes
    ----------
    run : str
        Excitation.
    repeat : str
        Name of the repeat; a number tells the order in time. Empty when there is one only.
    level : float
        Amplitude of the excitation in any linear unit; NaN when not stated.
    """

    run: str
    repeat: str = ""
    level: float = float("nan")

    @property
    def name(self) -> str:
        """Name that no other take of the measurement has."""
        repeat = f" repeat {self.repeat}" if self.repeat else ""
        level = f" level {self.level:.12g}" if np.isfinite(self.level) else ""
        return f"{self.run}{repeat}{level}"


@dataclass(frozen=True)
class LeftOut:
    """A channel that the user left out: body and point, and its beam (3,) as in the file."""

    body: str
    point: str
    direction: Array


@dataclass(frozen=True)
class RecordNoise:
    """Noise of a reference that the channels recorded with it share, where others have other records.

    Attributes
    ----------
    run : int
        Place among the runs.
    points : tuple of (str, str)
        Body and name of every point of the record; all their channels share it.
    sd : ndarray, (freq,)
        Relative standard deviation of the real (= imaginary) part; the sd of the channels contains it, too.
    """

    run: int
    points: tuple[tuple[str, str], ...]
    sd: Array


@dataclass(frozen=True)
class Measurement:
    """A vibrometer measurement.

    Attributes
    ----------
    frame : str
        Frame of positions and directions, e.g. ``vibrometer``.
    runs : tuple of str
        Excitations.
    freq_hz : ndarray, (freq,)
        Ascending.
    order : int
        Time derivatives in the quantity that was measured (0, 1, 2): its noise is what is level over
        frequency when nothing else is known.
    inputs : mapping of str to Path
        Files by their role.
    takes : tuple of Take, (run,)
        What each entry of ``runs`` (their ``name``) is while repeats and levels are not pooled yet; empty
        in a measurement without any.
    common_sd : ndarray, (run, freq), or None
        Relative standard deviation of the real (= imaginary) part of an error that all channels of a run
        share: noise of the signal that the readings refer to. It is not in the sd of the channels.
    line_spread : float
        By what factor the variance of slowly varying sums over lines exceeds that of independent lines, as
        windows of spectra make it; static faults are judged by such sums.
    record_noise : tuple of RecordNoise
        What channels share that were recorded together while others were not (points scanned one by one).
    said : tuple of str
        What the files say about their coordinates, units, resolution and averages.
    left_out : tuple of LeftOut
        Channels of the files that the user left out.
    """

    frame: str
    runs: tuple[str, ...]
    freq_hz: Array
    bodies: tuple[BodyChannels, ...]
    order: int = 1
    inputs: Mapping[str, Path] = field(default_factory=dict)
    notices: tuple[Notice, ...] = ()
    takes: tuple[Take, ...] = ()
    common_sd: Array | None = None
    line_spread: float = 1.0
    said: tuple[str, ...] = ()
    record_noise: tuple[RecordNoise, ...] = ()
    left_out: tuple[LeftOut, ...] = ()

    def __post_init__(self) -> None:
        faults = []
        for body in self.bodies:
            want = (len(self.runs), len(body.points), len(self.freq_hz))
            if body.displacement.shape != want or (body.sd is not None and body.sd.shape != want):
                faults.append(
                    Fault(f"the data of body {body.body}", f"of shape {want}", body.displacement.shape)
                )
        if np.any(self.freq_hz <= 0.0) or np.any(np.diff(self.freq_hz) <= 0.0):
            faults.append(Fault("freq_hz", "positive and ascending", "another order"))
        if self.common_sd is not None and self.common_sd.shape != (len(self.runs), len(self.freq_hz)):
            shape = f"of shape {(len(self.runs), len(self.freq_hz))}"
            faults.append(Fault("the noise of the reference", shape, self.common_sd.shape))
        if not self.bodies:
            faults.append(Fault("a measurement", "of at least one body", "none"))
        if self.takes and tuple(take.name for take in self.takes) != self.runs:
            faults.append(Fault("runs", "the names of the takes", self.runs))
        raise_all(KinematicsError, faults)

    def mapped(self, to_from_here: RigidTransform) -> Measurement:
        """Return the measurement with positions and directions in another frame."""
        bodies = tuple(
            replace(
                body,
                positions_mm=to_from_here.points(body.positions_mm),
                directions=to_from_here.vectors(body.directions),
                file_from_here=body.file_from_here @ to_from_here.vectors(np.eye(3)),
            )
            for body in self.bodies
        )
        return replace(self, frame=to_from_here.to, bodies=bodies)

    def mirrored(self, axis: str, points_only: bool = False) -> Measurement:
        """Return the measurement with one axis of its left-handed coordinates reversed.

        ``points_only`` leaves the beams as they are, for files whose positions alone are left-handed.

        Raises
        ------
        KinematicsError
            The axis is not x, y or z.
        """
        sign = np.array(mirror_sign(axis))
        bodies = tuple(
            replace(
                body,
                positions_mm=body.positions_mm * sign,
                directions=body.directions * (1.0 if points_only else sign),
                file_from_here=body.file_from_here * sign,
            )
            for body in self.bodies
        )
        return replace(self, bodies=bodies)


def mirror_sign(axis: str) -> tuple[float, float, float]:
    """Return the signs of the coordinates under ``--mirror``.

    Raises
    ------
    KinematicsError
        The axis is not x, y or z.
    """
    if axis not in MIRRORS:
        raise KinematicsError.of("{mirror}", "x, y or z", axis)
    return MIRRORS[axis]


def from_arrays(
    bodies: Mapping[str, Mapping[str, object]],
    freq_hz: Array,
    *,
    frame: str = "footplate",
    order: int = 1,
    runs: tuple[str, ...] = ("1",),
    overwrite: bool = False,
) -> Measurement:
    """Build a measurement from arrays.

    Parameters
    ----------
    bodies : mapping
        By name: ``points``, ``positions_mm`` (c, 3), ``directions`` (c, 3), ``value`` (run, c, freq) or
        (c, freq) in SI peak units of the measured quantity, and optionally ``sd`` of the same shape or
        broadcastable to it, and ``position_sd_mm``.
    freq_hz : ndarray, (freq,)
    frame, order, runs
        As in Measurement.
    overwrite : bool
        Turn complex ``value`` arrays into displacements in place, so that memory holds the data once.
        Displacements (order 0) are never copied.
    """
    factor = (2j * np.pi * np.asarray(freq_hz, dtype=float)) ** order
    channels = []
    for name, parts in bodies.items():
        value = np.asarray(parts["value"], dtype=complex)
        value = value[None] if value.ndim == 2 else value
        if order:
            value = np.divide(value, factor, out=value if overwrite else None)
        sd = parts.get("sd")
        spread = np.asarray(parts.get("position_sd_mm", np.nan), dtype=float)
        channels.append(
            BodyChannels(
                name,
                tuple(parts["points"]),  # type: ignore[arg-type]
                np.asarray(parts["positions_mm"], dtype=float),
                np.asarray(parts["directions"], dtype=float),
                value,
                None
                if sd is None
                else np.broadcast_to(np.asarray(sd, dtype=float) / np.abs(factor), value.shape),
                position_sd_mm=np.broadcast_to(spread, (value.shape[1],)).copy(),
            )
        )
    return Measurement(frame, runs, np.asarray(freq_hz, dtype=float), tuple(channels), order)
