"""Leave points or single beams out of a measurement, by the names that the user's files give them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.measurement import BodyChannels, LeftOut, Measurement, direction_name
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, list_some, raise_all
from legacy.stapeskit.option_names import suggestion

# Beams are written with three decimals in messages; two different lasers are farther apart.
_SAME_BEAM = 2e-3
_LISTED = 8


@dataclass(frozen=True)
class _Choice:
    """The body and the channels that one BODY:POINT[:BEAM] means, or why it means none."""

    body: int = -1
    channels: tuple[int, ...] = ()
    fault: Fault | None = None


def without_channels(measurement: Measurement, names: Sequence[str]) -> Measurement:
    """Return a measurement without some of its channels.

    Parameters
    ----------
    names : sequence of str
        BODY:POINT for all beams of a point, BODY:POINT:BEAM for one: x, -z ... or X,Y,Z as in the file.

    Raises
    ------
    KinematicsError
        A name means no channel, or nothing is left of a body; all faults together.
    """
    if not names:
        return measurement
    choices = [_choice(measurement, name) for name in names]
    raise_all(KinematicsError, [choice.fault for choice in choices if choice.fault is not None])
    bodies, left_out, faults = [], [], []
    for number, body in enumerate(measurement.bodies):
        gone = {channel for choice in choices if choice.body == number for channel in choice.channels}
        left_out += [
            LeftOut(body.body, body.points[channel], body.reported_directions[channel])
            for channel in sorted(gone)
        ]
        if len(gone) == len(body.points):
            step = "Leave the rows of this body out of the file if it is not wanted"
            faults.append(Fault("{leave_out}", f"fewer than all channels of body {body.body}",
                                f"all {len(gone)}", "", step))  # fmt: skip
        bodies.append(_without(body, gone) if gone else body)
    raise_all(KinematicsError, faults)
    return replace(measurement, bodies=tuple(bodies), left_out=(*measurement.left_out, *left_out))


def _without(body: BodyChannels, gone: set[int]) -> BodyChannels:
    keep = np.array([channel not in gone for channel in range(len(body.points))])
    return replace(
        body,
        points=tuple(point for point, kept in zip(body.points, keep, strict=True) if kept),
        positions_mm=body.positions_mm[keep],
        directions=body.directions[keep],
        displacement=body.displacement[:, keep],
        sd=None if body.sd is None else body.sd[:, keep],
        position_sd_mm=body.position_sd_mm[keep],
        reported_directions=body.reported_directions[keep],
        reported_positions_mm=body.reported_positions_mm[keep],
    )


def _choice(measurement: Measurement, name: str) -> _Choice:
    """Return what a name means; names of bodies and points may hold colons themselves."""
    names = [body.body for body in measurement.bodies]
    possible = [k for k, body in enumerate(names) if name.startswith(body + ":")]
    if not possible:
        expected = f"BODY:POINT[:BEAM] with a body of the files: {list_some(names, _LISTED)}"
        return _fault(
            expected, name, suggestion(name.split(":")[0], names) or f"Bodies are {list_some(names, _LISTED)}"
        )
    for k in possible:
        body, rest = measurement.bodies[k], name[len(names[k]) + 1 :]
        channels = _of_point(body, rest)
        if channels:
            return _Choice(k, channels)
        point, _, beam = rest.rpartition(":")
        channels = _of_point(body, point)
        if channels:
            wanted = _direction(beam)
            along = () if wanted is None else _select_along(body, channels, wanted)
            if along:
                return _Choice(k, along)
            beams = [direction_name(body.reported_directions[c]).replace(" ", "") for c in channels]
            expected = f"a beam at point {point} of body {names[k]}: {list_some(beams, _LISTED, '; ')}"
            return _fault(expected, name, f"Write {names[k]}:{point} for all of them")
    body = measurement.bodies[possible[0]]
    points = list(dict.fromkeys(body.points))
    step = suggestion(name[len(body.body) + 1 :], points) or f"Points are {list_some(points, _LISTED)}"
    return _fault(f"a point of body {body.body}", name, step)


def _fault(expected: str, name: str, step: str) -> _Choice:
    return _Choice(fault=Fault("{leave_out}", expected, name, "", step))


def _of_point(body: BodyChannels, point: str) -> tuple[int, ...]:
    return tuple(channel for channel, name in enumerate(body.points) if name == point)


def _direction(beam: str) -> Array | None:
    """Return a beam (3,) from x, -z or X,Y,Z; None when it is neither."""
    sign, axis = (-1.0, beam[1:]) if beam.startswith("-") else (1.0, beam.removeprefix("+"))
    if axis.lower() in ("x", "y", "z"):
        return sign * np.eye(3)["xyz".index(axis.lower())]
    parts = beam.split(",")
    try:
        direction = np.array([float(part) for part in parts])
    except ValueError:
        return None
    return direction if direction.shape == (3,) and bool(np.all(np.isfinite(direction))) else None


def _select_along(body: BodyChannels, channels: Sequence[int], wanted: Array) -> tuple[int, ...]:
    return tuple(
        channel
        for channel in channels
        if float(np.max(np.abs(body.reported_directions[channel] - wanted))) < _SAME_BEAM
    )
