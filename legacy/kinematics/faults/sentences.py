"""Sentences of the catalogue: verdict and estimate of each kind of fault, in the user's coordinates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from legacy.kinematics.faults.score_information import perpendicular_axes
from legacy.kinematics.measurement import BodyChannels
from legacy.stapeskit.arrays import Array

# A Finding with its fault, whose entry of the catalogue names the sentence.
Fitted = Any
Sentence = Callable[[Fitted, BodyChannels], tuple[str, str]]
# A factor this near to -1 is a wrong sign.
_SIGN = 0.35
# Standard deviations within which a factor is zero.
_NOTHING = 3.0
# A coordinate is determined when its sd is below this share of the rms distance of the points, and the
# undetermined directions hold less than this of its axis.
_DETERMINED, _OF_AXIS = 0.5, 0.1
# A turn of all beams about an axis is determined when its sd is below this, rad.
_TURN_SEEN = 0.5


def with_sd(value: float, sd: float, unit: str = "", digits: int = 3) -> str:
    """Write a size with its standard deviation; one that is not larger than that is not determined."""
    if not sd < abs(value):
        return "a size that these data do not determine"
    return f"{value:.{digits}g} +- {sd:.2g}{unit and ' ' + unit}"


def _sd(fit: Fitted) -> Array:
    return np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))


def _spread(value: Array, covariance: Array) -> float:
    """Return the standard deviation of the length of a value."""
    return float(np.sqrt(np.maximum(value @ covariance @ value, 0.0)) / max(np.linalg.norm(value), 1e-300))


def _seen(fit: Fitted, body: BodyChannels, unit: float, most: float) -> tuple[Array, Array, Array]:
    """Return parameters in axes of the file along directions whose sd is below ``most``.

    Returns
    -------
    value, covariance : ndarray, (3,) and (3, 3)
        Over ``unit``; zero along the other directions.
    open : ndarray, (3, n)
        These other directions.
    """
    values, vectors = np.linalg.eigh(fit.covariance / unit**2)
    vectors = body.file_from_here @ vectors
    seen = (values > 0.0) & (values < most**2)
    held = vectors[:, seen]
    value = held @ (held.T @ (body.file_from_here @ fit.parameters / unit))
    return value, (held * values[seen]) @ held.T, vectors[:, ~seen]


def exchange(verdict: str) -> Sentence:
    """Return what describes an exchange."""
    return lambda fit, _body: (verdict, fit.fault.text)


def factor(fit: Fitted, _body: BodyChannels) -> tuple[str, str]:
    """Describe a real factor, or a complex one."""
    p, sd = fit.parameters, _sd(fit)
    factor = 1.0 + p[0] + 1j * (p[1] if len(p) > 1 else 0.0)
    if abs(factor + 1.0) < _SIGN:
        return "sign", f"factor {factor.real:.3f} +- {sd[0]:.2g}"
    if not np.max(sd) < np.linalg.norm(p):
        return "gain", "a factor that these data do not determine"
    if abs(factor) < _NOTHING * sd[0]:
        return "gain", f"reads nothing of the motion: factor 0 within {_NOTHING * sd[0]:.2g}"
    if len(p) == 1:
        return "gain", f"factor {factor.real:.4g} +- {sd[0]:.2g}"
    turn = np.rad2deg(np.angle(factor))
    return "gain", f"factor {abs(factor):.4g} +- {sd[0]:.2g}, phase {turn:.2g} deg"


def angle(words: str, place: str = "") -> Sentence:
    """Return what describes a fault whose one parameter is an angle of the readings, rad."""

    def describe(fit: Fitted, _body: BodyChannels) -> tuple[str, str]:
        size = with_sd(float(np.rad2deg(fit.parameters[0])), float(np.rad2deg(_sd(fit)[0])), "deg")
        return "gain", f"{words} {size}{place and ' ' + place}"

    return describe


def phase_offset(fit: Fitted, body: BodyChannels) -> tuple[str, str]:
    """Describe a phase; half a turn is a wrong sign."""
    past = float(np.angle(-np.exp(1j * fit.parameters[0])))
    if abs(past) < _SIGN:
        size, sd = (float(np.rad2deg(one)) for one in (past, _sd(fit)[0]))
        return "sign", f"factor -1, phase besides {with_sd(size, sd, 'deg')}"
    return angle("phase off by")(fit, body)


def drift(fit: Fitted, _body: BodyChannels) -> tuple[str, str]:
    """Describe a factor that runs over the lines by its ends."""
    mean = 1.0 + fit.parameters[0] + 1j * fit.parameters[1]
    half = fit.parameters[2] + 1j * fit.parameters[3]
    first, last = _written(mean - half), _written(mean + half)
    return "drift", f"factor {first} at the first line, {last} at the last"


def _written(value: complex) -> str:
    turn = np.rad2deg(np.angle(value))
    return f"{abs(value):.3f}" + (f" at {turn:.1f} deg" if abs(turn) > 0.2 else "")


def direction(fit: Fitted, body: BodyChannels) -> tuple[str, str]:
    """Describe the turn of parallel beams, and the direction that would be right in the user's file."""
    p, slope = fit.parameters, float(np.linalg.norm(fit.parameters))
    # Along the way it points: the other way across may be open without the angle being so.
    spread = _spread(p, fit.covariance) if slope > 0.0 else np.inf
    angle = float(np.rad2deg(np.arctan(slope)))
    text = f"beam off by {with_sd(angle, float(np.rad2deg(spread / (1.0 + slope**2))), 'deg')}"
    channel = fit.channels[0]
    beam = body.directions[channel]
    same_axes = np.allclose(body.file_from_here @ beam, body.reported_directions[channel], atol=1e-6)
    if same_axes and float(np.max(_sd(fit))) < slope:
        right = beam + perpendicular_axes(beam).T @ p
        right = body.file_from_here @ (right / np.linalg.norm(right))
        text += f": dir_x, dir_y, dir_z {', '.join(f'{value:.4f}' for value in right)} would be right"
    return "direction", text


def axes(fit: Fitted, body: BodyChannels) -> tuple[str, str]:
    """Describe a turn of all beams against the positions, about the axes that the data determine."""
    turn, covariance, _ = _seen(fit, body, 1.0, _TURN_SEEN)
    size = float(np.linalg.norm(turn))
    turn = turn * (np.remainder(size + np.pi, 2.0 * np.pi) - np.pi) / max(size, 1e-300)
    angle, spread = float(np.linalg.norm(turn)), _spread(turn, covariance)
    if not spread < angle:
        return "direction", "all beams turned together by an angle that these data do not determine"
    written = with_sd(float(np.rad2deg(angle)), float(np.rad2deg(spread)), "deg")
    about = ", ".join(f"{value:.2g}" for value in turn / angle)
    return "direction", f"all beams turned together by {written} about ({about})"


def position(fit: Fitted, body: BodyChannels) -> tuple[str, str]:
    """Describe the shift of a point, and the coordinates that would be right in the user's file.

    Notes
    -----
    Directions whose sd is no small part of the body are not determined: of the shift only the others are
    believed. Parallel beams never show a shift along themselves.
    """
    points = np.unique(body.positions_mm, axis=0)
    reach = float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1))))
    shift, covariance, unseen = _seen(fit, body, 1e-3, _DETERMINED * reach)
    size = float(np.linalg.norm(shift))
    if not size > 0.0:
        return "position", "point off by a distance that these data do not determine"
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    text = f"point off by {with_sd(size, _spread(shift, covariance), 'mm')}"
    if "+-" not in text:
        return "position", text
    reported = body.reported_positions_mm[fit.channels[0]]
    right = []
    for axis, name in enumerate(("x_mm", "y_mm", "z_mm")):
        if float(np.sum(unseen[axis] ** 2)) > _OF_AXIS:
            right.append(f"{name} not determined")
        else:
            right.append(f"{name} {reported[axis] + shift[axis]:.4g} +- {sd[axis]:.2g}")
    return "position", f"{text}; {', '.join(right)} would be right"
