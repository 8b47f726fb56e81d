"""Describe a finding: its verdict, its size, and the entry of the user's file that would be right."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.fault_kinds import across
from kinematics.faults.fault_model import FaultFit
from kinematics.faults.findings import Finding
from kinematics.measurement import BodyChannels

Array = NDArray[np.float64]
# A factor this near to -1 is a wrong sign.
_SIGN = 0.35
_ALONG = 0.999
# A coordinate is determined when its sd is below this share of the rms distance of the points, and the
# undetermined directions hold less than this of its axis.
_DETERMINED, _OF_AXIS = 0.5, 0.1


def describe(finding: Finding, body: BodyChannels) -> tuple[str, str]:
    """Return the verdict of a finding and its estimate in words, with what the data hardly tell from it."""
    verdict, estimate = _described(finding, body)
    others = []
    for rival in finding.rivals if verdict != "flexible" else ():
        name, size = _described(rival, body)
        where = (
            ""
            if sorted(rival.channels) == sorted(finding.channels)
            else f" of {channel_list(rival.channels, body)}"
        )
        others.append(f"{name}{where} ({size})")
    if verdict in ("position", "drift") and len(finding.channels) == 1 and _parallel(body):
        others.append("a beam off its direction, which reads motion that parallel beams do not see")
    return verdict, "; not told apart from ".join([estimate, " or ".join(others)]) if others else estimate


def channel_list(channels: Sequence[int], body: BodyChannels) -> str:
    """Name channels: one by its point and beam, several by their points."""
    if len(channels) == 1:
        return f"channel {body.channel_name(channels[0])}"
    points = list(dict.fromkeys(body.points[c] for c in channels))
    return f"point{'s' if len(points) > 1 else ''} {' and '.join(points)} of body {body.body}"


def with_sd(value: float, sd: float, unit: str = "", digits: int = 3) -> str:
    """Write a size with its standard deviation; one that is not larger than that is not determined."""
    if not sd < abs(value):
        return "a size that these data do not determine"
    return f"{value:.{digits}g} +- {sd:.2g}{unit and ' ' + unit}"


def _parallel(body: BodyChannels) -> bool:
    """Tell whether all beams of a body are parallel."""
    return bool(np.all(np.abs(body.directions @ body.directions[0]) > _ALONG))


def _described(finding: Finding, body: BodyChannels) -> tuple[str, str]:
    """Return verdict and estimate of a finding without its rivals."""
    if finding.text:
        return finding.kind, finding.text
    if finding.kind == "noise":
        return "noise", f"noise {finding.size:.3g} times that of its sd"
    if finding.kind == "flexible" or finding.fit is None:
        return "flexible", f"non-rigid motion {100.0 * finding.size:.2g} % of the motion"
    return SENTENCES[finding.kind](finding.fit, body)


def _sd(fit: FaultFit) -> Array:
    return np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))


def _factor(fit: FaultFit, _body: BodyChannels) -> tuple[str, str]:
    """Describe a real factor, or a complex one."""
    p, sd = fit.parameters, _sd(fit)
    factor = 1.0 + p[0] + 1j * (p[1] if len(p) > 1 else 0.0)
    if abs(factor + 1.0) < _SIGN:
        return "sign", f"factor {factor.real:.3f} +- {sd[0]:.2g}"
    if not np.max(sd) < np.linalg.norm(p):
        return "gain", "a factor that these data do not determine"
    if len(p) == 1:
        return "gain", f"factor {factor.real:.4g} +- {sd[0]:.2g}"
    turn = np.rad2deg(np.angle(factor))
    return "gain", f"factor {abs(factor):.4g} +- {sd[0]:.2g}, phase {turn:.2g} deg"


def _delay(fit: FaultFit, _body: BodyChannels) -> tuple[str, str]:
    lag = with_sd(float(np.rad2deg(fit.parameters[0])), float(np.rad2deg(_sd(fit)[0])), "deg")
    return "gain", f"delayed, phase lag {lag} at mid-band"


def _drift(fit: FaultFit, _body: BodyChannels) -> tuple[str, str]:
    mean = 1.0 + fit.parameters[0] + 1j * fit.parameters[1]
    half = fit.parameters[2] + 1j * fit.parameters[3]
    first, last = _written(mean - half), _written(mean + half)
    return "drift", f"factor {first} at the first line, {last} at the last"


def _written(value: complex) -> str:
    turn = np.rad2deg(np.angle(value))
    return f"{abs(value):.3f}" + (f" at {turn:.1f} deg" if abs(turn) > 0.2 else "")


def _direction(fit: FaultFit, body: BodyChannels) -> tuple[str, str]:
    """Describe the turn of parallel beams, and the direction that would be right in the user's file."""
    p, slope = fit.parameters, float(np.linalg.norm(fit.parameters))
    # Along the way it points: the other way across may be open without the angle being so.
    spread = float(np.sqrt(np.maximum(p @ fit.covariance @ p, 0.0))) / slope if slope > 0.0 else np.inf
    angle = float(np.rad2deg(np.arctan(slope)))
    text = f"beam off by {with_sd(angle, float(np.rad2deg(spread / (1.0 + slope**2))), 'deg')}"
    channel = fit.fault.channels[0]
    beam = body.directions[channel]
    same_axes = np.allclose(body.file_from_here @ beam, body.reported_directions[channel], atol=1e-6)
    if same_axes and float(np.max(_sd(fit))) < slope:
        right = beam + np.stack(across(beam), axis=1) @ p
        right = body.file_from_here @ (right / np.linalg.norm(right))
        text += f": dir_x, dir_y, dir_z {', '.join(f'{value:.4f}' for value in right)} would be right"
    return "direction", text


def _axes(fit: FaultFit, body: BodyChannels) -> tuple[str, str]:
    turned = ", ".join(f"{value:.2g}" for value in body.file_from_here @ np.rad2deg(fit.parameters))
    return "direction", f"all beams turned together by ({turned}) deg"


def _position(fit: FaultFit, body: BodyChannels) -> tuple[str, str]:
    """Describe the shift of a point, and the coordinates that would be right in the user's file.

    Notes
    -----
    Directions whose sd is no small part of the body are not determined: of the shift only the others are
    believed. Parallel beams never show a shift along themselves.
    """
    points = np.unique(body.positions_mm, axis=0)
    reach = float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1))))
    values, vectors = np.linalg.eigh(fit.covariance * 1e6)
    seen = (values > 0.0) & (values < (_DETERMINED * reach) ** 2)
    vectors = body.file_from_here @ vectors
    shift = body.file_from_here @ fit.parameters * 1e3
    shift = vectors[:, seen] @ (vectors[:, seen].T @ shift)
    size = float(np.linalg.norm(shift))
    if not size > 0.0:
        return "position", "point off by a distance that these data do not determine"
    covariance = (vectors[:, seen] * values[seen]) @ vectors[:, seen].T
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    along = float(np.sqrt(np.maximum(shift @ covariance @ shift, 0.0))) / size
    text = f"point off by {with_sd(size, along, 'mm')}"
    if "+-" not in text:
        return "position", text
    reported = body.reported_positions_mm[fit.fault.channels[0]]
    right = []
    for axis, name in enumerate(("x_mm", "y_mm", "z_mm")):
        if float(np.sum(vectors[axis, ~seen] ** 2)) > _OF_AXIS:
            right.append(f"{name} not determined")
        else:
            right.append(f"{name} {reported[axis] + shift[axis]:.4g} +- {sd[axis]:.2g}")
    return "position", f"{text}; {', '.join(right)} would be right"


def _exchange(fit: FaultFit, body: BodyChannels) -> tuple[str, str]:
    points = list(dict.fromkeys(body.points[c] for c in fit.fault.channels))
    if fit.fault.owner == "lasers":
        return "label_swap", "two lasers exchanged at all points"
    if len(points) == 1:
        return "label_swap", f"two beams of point {points[0]} exchanged"
    return "label_swap", f"points {points[0]} and {points[1]} exchanged"


SENTENCES: dict[str, Callable[[FaultFit, BodyChannels], tuple[str, str]]] = {
    "gain": _factor,
    "phase": _factor,
    "delay": _delay,
    "drift": _drift,
    "direction": _direction,
    "axes": _axes,
    "position": _position,
    "label_swap": _exchange,
}
