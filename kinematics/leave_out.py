"""Leave channels out that the user names: BODY:POINT, or BODY:POINT:BEAM."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kinematics.measurement import LeftOut, Measurement, direction_name
from kinematics.readers.facts import direction_of
from stapeskit.faults import Fault, StapeskitError, collect_faults, list_some, raise_all

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
        with collect_faults(faults):
            name, channels = _channels_of(measurement, rule)
            dropped[name].update(channels)
    raise_all(faults)
    bodies = []
    left_out = [*measurement.left_out]
    for body in measurement.bodies:
        gone = dropped[body.body]
        left_out += [LeftOut(body.body, body.points[k], body.file_directions[k]) for k in sorted(gone)]
        if len(gone) == len(body.points):
            faults.append(Fault(f"--leave-out of body {body.body}", "some of its channels", "all of them"))
        bodies.append(body.part([k for k in range(len(body.points)) if k not in gone]) if gone else body)
    raise_all(faults)
    return replace(measurement, bodies=tuple(bodies), left_out=tuple(left_out))


def _channels_of(measurement: Measurement, rule: str) -> tuple[str, list[int]]:
    """Return the body and the channels that a rule names."""
    name, point, beam = [*rule.split(":", 2), "", ""][:3]
    body = next((one for one in measurement.bodies if one.body == name), None)
    if body is None or not point:
        known = ", ".join(one.body for one in measurement.bodies)
        raise StapeskitError.of(
            f"--leave-out {rule}", f"BODY:POINT or BODY:POINT:BEAM, BODY of {known}", rule
        )
    channels = body.channels_of(point)
    if not channels:
        known = list_some(dict.fromkeys(body.points), 12)
        raise StapeskitError.of(f"--leave-out {rule}", f"a point of {name} ({known})", point)
    if not beam:
        return name, channels
    wanted = direction_of(beam, thing=f"--leave-out {rule}")
    own = [k for k in channels if np.linalg.norm(body.file_directions[k] - wanted) < _SAME_BEAM]
    if not own:
        listed = "; ".join(direction_name(body.file_directions[k]) for k in channels)
        raise StapeskitError.of(f"--leave-out {rule}", f"one of the beams {listed}", beam)
    return name, own
