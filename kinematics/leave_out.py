"""Leave channels out that the user names: BODY:POINT, or BODY:POINT:BEAM."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kinematics.measurement import BodyChannels, LeftOut, Measurement, direction_name
from kinematics.readers.facts import direction_of
from stapeskit.faults import Fault, StapeskitError, list_some, raise_all

_SAME_BEAM = 1e-3


def without_channels(measurement: Measurement, rules: Sequence[str]) -> Measurement:
    """Return the measurement without the channels that rules name.

    Raises
    ------
    StapeskitError
        A rule names a body, point or beam that was not measured, or no channel of a body is left.
    """
    dropped: dict[str, set[int]] = {body.body: set() for body in measurement.bodies}
    faults: list[Fault] = []
    for rule in rules:
        try:
            body, channels = _channels_of(measurement, rule)
            dropped[body.body].update(channels)
        except StapeskitError as error:
            faults += error.faults
    raise_all(faults)
    bodies = []
    left_out = [*measurement.left_out]
    for body in measurement.bodies:
        gone = sorted(dropped[body.body])
        left_out += [LeftOut(body.body, body.points[k], body.file_directions[k]) for k in gone]
        if len(gone) == len(body.points):
            faults.append(Fault(f"--leave-out of body {body.body}", "some of its channels", "all of them"))
        bodies.append(_kept(body, np.setdiff1d(np.arange(len(body.points)), gone)) if gone else body)
    raise_all(faults)
    return replace(measurement, bodies=tuple(bodies), left_out=tuple(left_out))


def _channels_of(measurement: Measurement, rule: str) -> tuple[BodyChannels, list[int]]:
    name, _, rest = rule.partition(":")
    point, _, beam = rest.partition(":")
    bodies = {body.body: body for body in measurement.bodies}
    if name not in bodies or not point:
        step = "Write BODY:POINT or BODY:POINT:BEAM"
        raise StapeskitError.of(f"--leave-out {rule}", f"of a body {list_some(bodies)}", name, "", step)
    body = bodies[name]
    channels = body.channels_of(point)
    if beam and channels:
        wanted = direction_of(beam)
        own = [k for k in channels if np.linalg.norm(body.file_directions[k] - wanted) < _SAME_BEAM]
        listed = "; ".join(direction_name(body.file_directions[k]) for k in channels)
        if not own:
            raise StapeskitError.of(f"--leave-out {rule}", f"one of the beams {listed}", beam)
        return body, own
    if not channels:
        known = list_some(dict.fromkeys(body.points), 12)
        raise StapeskitError.of(f"--leave-out {rule}", f"a point of {name} ({known})", point)
    return body, channels


def _kept(body: BodyChannels, kept: np.ndarray) -> BodyChannels:
    return replace(
        body,
        points=tuple(body.points[k] for k in kept),
        positions_m=None if body.positions_m is None else body.positions_m[kept],
        directions=body.directions[kept],
        value=body.value[:, kept],
        sd=None if body.sd is None else body.sd[:, kept],
        position_sd_m=body.position_sd_m[kept],
        file_positions_m=None if body.file_positions_m is None else body.file_positions_m[kept],
        file_directions=body.file_directions[kept],
    )
