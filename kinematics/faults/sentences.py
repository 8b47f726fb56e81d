"""Describe findings in words, with corrections in the coordinates of the user's file."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kinematics.faults.fault_kinds import Finding, is_reversed
from kinematics.joint.tangents import normals
from kinematics.measurement import BodyChannels, direction_name
from stapeskit.arrays import Array
from stapeskit.faults import list_some

STEPS = {
    "gain": "Check range and scale of this channel; divide its values by the factor, or leave it out",
    "sign": "Reverse its direction or the sign of its values",
    "direction": "Check the direction, or leave the channel out",
    "position": "Check the coordinates, or leave the point out",
    "noise": "Check focus and reflection; state its sd, leave it out, or fit with --robust t4",
    "label_swap": "Exchange these names",
    "drift": "Measure again: the sensitivity changed during the sweep",
    "flexible": "The body bends, or rows and points do not belong together (another body, a row too many, "
    "exchanged beams): compare both, use lower frequencies or fewer points",
    "zeros": "Nothing was recorded: measure again",
}
"""What to do about each verdict."""

_DETERMINED = 0.5  # sd of a shift over the size of the body, or of a turn in rad, beyond which it is unknown


def describe(finding: Finding, body: BodyChannels) -> str:
    """Return the size of a finding in words."""
    return SENTENCES[finding.kind](finding, body)


def culprit(finding: Finding, body: BodyChannels) -> str:
    """Name what is at fault: the body, the beams of one laser, a point, or channels."""
    if finding.owner == "body":
        return f"body {body.body}"
    first = finding.channels[0]
    if finding.owner == "laser":
        beam = direction_name(body.file_directions[first])
        return f"all {len(finding.channels)} beams along ({beam}) of body {body.body}"
    if finding.owner == "point":
        return f"point {body.points[first]} of body {body.body}"
    return f"channel {list_some((body.channel_name(channel) for channel in finding.channels), most=6)}"


def with_sd(value: float, sd: float, unit: str = "", digits: int = 3) -> str:
    """Write a size with its standard deviation; one that is not larger than that is undetermined."""
    if not sd < abs(value):
        return "by an amount that these data do not determine"
    return f"{value:.{digits}g} +- {sd:.2g}{unit and ' ' + unit}"


def _factor(finding: Finding, _body: BodyChannels) -> str:
    values, sd = finding.values, finding.sd
    factor = 1.0 + values[0] + 1j * (values[1] if len(values) > 1 else 0.0)
    if abs(factor) < 3.0 * sd[0]:
        return f"does not respond to the motion (factor {abs(factor):.2f} +- {sd[0]:.2g})"
    if len(values) == 1 or is_reversed(values):
        return f"factor {factor.real:.4g} +- {sd[0]:.2g}"
    turn, turn_sd = np.rad2deg(np.angle(factor)), np.rad2deg(sd[1] / abs(factor))
    return f"factor {abs(factor):.4g} +- {sd[0]:.2g}, phase {turn:.2g} +- {turn_sd:.2g} deg"


def _delay(finding: Finding, _body: BodyChannels) -> str:
    value, sd = finding.values[0] * 1e6, finding.sd[0] * 1e6
    return f"late by {with_sd(value, sd, 'us')}"


def _drift(finding: Finding, _body: BodyChannels) -> str:
    mean = 1.0 + finding.values[0] + 1j * finding.values[1]
    half = finding.values[2] + 1j * finding.values[3]
    ends = []
    for end in (mean - half, mean + half):
        turn = np.rad2deg(np.angle(end))
        ends.append(f"{abs(end):.3f}" + (f" at {turn:.1f} deg" if abs(turn) > 0.2 else ""))
    return f"factor {ends[0]} at the first line, {ends[1]} at the last"


def _direction(finding: Finding, body: BodyChannels) -> str:
    channel = finding.channels[0]
    slope, sd = float(np.linalg.norm(finding.values)), float(np.max(finding.sd))
    text = f"beam off by {with_sd(float(np.rad2deg(np.arctan(slope))), float(np.rad2deg(sd)), 'deg')}"
    if sd < slope:
        beam = body.directions[channel]
        u, v = normals(beam[None])
        right = beam + finding.values[0] * u[0] + finding.values[1] * v[0]
        right = body.file_from_here @ (right / np.linalg.norm(right))
        text += f": dir_x, dir_y, dir_z {', '.join(f'{value:.4f}' for value in right)} would be right"
    return text


def _axes(finding: Finding, body: BodyChannels) -> str:
    turn = body.file_from_here @ finding.values
    angle = float(np.linalg.norm(turn))
    about = ", ".join(f"{value:.2g}" for value in turn / max(angle, 1e-300))
    size = with_sd(float(np.rad2deg(angle)), float(np.rad2deg(np.max(finding.sd))), "deg")
    return f"all beams turned together by {size} about ({about})"


def _position(finding: Finding, body: BodyChannels) -> str:
    reach = float(np.sqrt(np.mean(np.sum((body.arms_m - body.arms_m.mean(axis=0)) ** 2, axis=1))))
    known = (finding.sd > 0.0) & (finding.sd < _DETERMINED * reach)
    axes = np.abs(body.file_from_here)
    shift = body.file_from_here @ np.where(known, finding.values, 0.0)
    sd = np.sqrt(axes**2 @ np.where(known, finding.sd, 0.0) ** 2)
    size = float(np.linalg.norm(shift))
    if not size > 0.0:
        return "point off by a distance that these data do not determine"
    text = f"point off by {with_sd(1e3 * size, 1e3 * float(shift**2 @ sd**2) ** 0.5 / size, 'mm')}"
    file: Array = body.arms_m if body.file_positions_m is None else body.file_positions_m
    right = []
    for axis, name in enumerate(("x_mm", "y_mm", "z_mm")):
        if float(axes[axis] ** 2 @ ~known) > 0.1:
            right.append(f"{name} not determined")
        else:
            right.append(
                f"{name} {1e3 * (file[finding.channels[0], axis] + shift[axis]):.4g} +- {1e3 * sd[axis]:.2g}"
            )
    return f"{text}; {', '.join(right)} would be right"


def _exchange(finding: Finding, body: BodyChannels) -> str:
    half = len(finding.channels) // 2
    first, second = finding.channels[0], finding.channels[half]
    if finding.owner == "points":
        return f"points {body.points[first]} and {body.points[second]} exchanged"
    beams = " and ".join(f"({direction_name(body.file_directions[c])})" for c in (first, second))
    at = f" of point {body.points[first]}" if finding.owner == "beams" else ""
    return f"beams {beams}{at} exchanged"


def _noise(finding: Finding, _body: BodyChannels) -> str:
    return f"noise {finding.values[0]:.3g} +- {finding.sd[0]:.2g} times as large as expected"


def _elsewhere(finding: Finding, body: BodyChannels) -> str:
    points = list_some(dict.fromkeys(body.points[channel] for channel in finding.channels))
    cause = "it bends, its rows are wrong, or single values are far off"
    return f"does not move with the others (point {points}): {cause}"


SENTENCES: dict[str, Callable[[Finding, BodyChannels], str]] = {
    "gain": _factor,
    "phase": _factor,
    "delay": _delay,
    "drift": _drift,
    "direction": _direction,
    "position": _position,
    "axes": _axes,
    "label_swap": _exchange,
    "noise": _noise,
    "elsewhere": _elsewhere,
    "flexible": lambda _finding, _body: "does not move as a rigid body",
    "zeros": lambda _finding, _body: "reads zero throughout",
}
"""What describes each kind of finding."""
