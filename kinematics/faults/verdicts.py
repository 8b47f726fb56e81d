"""The verdict on every channel, and its table ``dof.channels.csv``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.diagnose import Diagnosis, Finding
from kinematics.measurement import BodyChannels, direction_name
from stapeskit.warnings import Notice

Array = NDArray[np.float64]
_SIGN = 0.35
_CODES = {
    "gain": "channel_gain",
    "sign": "channel_sign",
    "direction": "channel_direction",
    "position": "channel_position",
    "noise": "channel_noise",
    "label_swap": "channel_label_swap",
    "drift": "channel_drift",
    "flexible": "flexible",
}
_ALONG = 0.999


@dataclass(frozen=True)
class ChannelVerdict:
    """What was found on one channel in one run.

    Attributes
    ----------
    run, body, point : str
    direction : ndarray, (3,)
        Beam as it stood in the file, in the coordinates of the measurement.
    residual_rms_m : float
        Root mean square of |measured - fitted| over the lines, m; NaN when unused.
    weight : float
        Mean weight in the fit, relative to the strongest channel of the body; 0 when unused.
    verdict : str
        ``ok``, ``gain``, ``sign``, ``direction``, ``position``, ``noise``, ``label_swap``, ``drift``,
        ``flexible``, ``zeros`` or ``unused``.
    estimate : str
        The size of the fault in words; empty when ok.
    p_value : float
        For a fault: probability of such evidence by chance, corrected for the number of tests. For ``ok``:
        probability of so large a residual, without correction. NaN when unused.
    """

    run: str
    body: str
    point: str
    direction: Array
    residual_rms_m: float
    weight: float
    verdict: str
    estimate: str
    p_value: float


def describe(finding: Finding, body: BodyChannels) -> tuple[str, str]:
    """Return the verdict of a finding and its estimate in words, with what the data hardly tell from it."""
    verdict, estimate = _described(finding, body)
    others = []
    for rival in finding.rivals if verdict != "flexible" else ():
        name, size = _described(rival, body)
        where = (
            ""
            if sorted(rival.channels) == sorted(finding.channels)
            else f" of {_channel_list(rival.channels, body)}"
        )
        others.append(f"{name}{where} ({size})")
    if verdict in ("position", "drift") and len(finding.channels) == 1 and _parallel(body):
        others.append("a beam off its direction, which reads motion that parallel beams do not see")
    return verdict, "; not told apart from ".join([estimate, " or ".join(others)]) if others else estimate


def _parallel(body: BodyChannels) -> bool:
    """Tell whether all beams of a body are parallel."""
    return bool(np.all(np.abs(body.directions @ body.directions[0]) > _ALONG))


def _described(finding: Finding, body: BodyChannels) -> tuple[str, str]:
    fit = finding.fit
    if finding.text:
        return finding.kind, finding.text
    if finding.kind == "noise":
        return "noise", f"noise {finding.size:.3g} times that of its sd"
    if finding.kind == "flexible" or fit is None:
        return "flexible", f"non-rigid motion {100.0 * finding.size:.2g} % of the motion"
    p, sd = fit.parameters, np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    if finding.kind in ("gain", "phase"):
        return _factored(p, sd)
    if finding.kind == "delay":
        return "gain", f"delayed, phase lag {np.rad2deg(p[0]):.3g} +- {np.rad2deg(sd[0]):.2g} deg at mid-band"
    if finding.kind == "drift":
        start, end = 1.0 + p[0] + 1j * p[1] - p[2] - 1j * p[3], 1.0 + p[0] + 1j * p[1] + p[2] + 1j * p[3]
        return "drift", f"factor {_factor(start)} at the first line, {_factor(end)} at the last"
    if finding.kind == "direction":
        slope = float(np.linalg.norm(p))
        # Along the way it points: the other way across may be open without the angle being so.
        along = (
            float(np.sqrt(np.maximum(p @ fit.covariance @ p, 0.0))) / slope
            if slope > 0.0
            else float(np.max(sd))
        )
        angle, spread = np.arctan(slope), along / (1.0 + slope**2)
        return "direction", f"beam off by {np.rad2deg(angle):.3g} +- {np.rad2deg(spread):.2g} deg"
    if finding.kind == "axes":
        turned = ", ".join(f"{value:.2g}" for value in np.rad2deg(p))
        return "direction", f"all beams turned together by ({turned}) deg"
    if finding.kind == "position":
        shift = ", ".join(f"{value * 1e3:.3g}" for value in p)
        return "position", f"point off by ({shift}) +- {float(np.sqrt(np.mean(sd**2))) * 1e3:.2g} mm"
    return "label_swap", _partner(finding, body)


def _factored(p: Array, sd: Array) -> tuple[str, str]:
    """Describe a real factor, or a complex one."""
    factor = 1.0 + p[0] + 1j * (p[1] if len(p) > 1 else 0.0)
    if abs(factor + 1.0) < _SIGN:
        return "sign", f"factor {factor.real:.3f} +- {sd[0]:.2g}"
    if len(p) == 1:
        return "gain", f"factor {factor.real:.4g} +- {sd[0]:.2g}"
    turn = np.rad2deg(np.angle(factor))
    return "gain", f"factor {abs(factor):.4g} +- {sd[0]:.2g}, phase {turn:.2g} deg"


def _factor(value: complex) -> str:
    turn = np.rad2deg(np.angle(value))
    return f"{abs(value):.3f}" + (f" at {turn:.1f} deg" if abs(turn) > 0.2 else "")


def _partner(finding: Finding, body: BodyChannels) -> str:
    points = list(dict.fromkeys(body.points[c] for c in finding.channels))
    if finding.owner == "lasers":
        return "two lasers exchanged at all points"
    if len(points) == 1:
        return f"two beams of point {points[0]} exchanged"
    return f"points {points[0]} and {points[1]} exchanged"


def channel_verdicts(
    run: str,
    body: BodyChannels,
    diagnosis: Diagnosis,
    residual_rms_m: Array,
    weight: Array,
    unused: dict[int, str],
) -> list[ChannelVerdict]:
    """Return the verdict of every channel of a body in one run."""
    from scipy.special import chdtrc

    found: dict[int, tuple[str, str, float]] = {}
    for finding in diagnosis.findings:
        verdict, estimate = describe(finding, body)
        for channel in finding.channels:
            found.setdefault(channel, (verdict, estimate, finding.p_value))
    made = []
    number = 2.0 * diagnosis.lines
    chances = np.where(number > 0.0, chdtrc(np.maximum(number, 1.0), number * diagnosis.energy), np.nan)
    for channel, point in enumerate(body.points):
        verdict, estimate, p = found.get(channel, ("ok", "", float(chances[channel])))
        if channel in unused:
            verdict, estimate, p = unused[channel], "", np.nan
        made.append(
            ChannelVerdict(
                run,
                body.body,
                point,
                body.reported_directions[channel],
                float(residual_rms_m[channel]),
                float(weight[channel]),
                verdict,
                estimate,
                p,
            )
        )
    return made


def fault_notices(run: str, body: BodyChannels, diagnosis: Diagnosis, several: bool) -> list[Notice]:
    """Return one notice per finding."""
    where = f" in run {run}" if several else ""
    notices = []
    for finding in diagnosis.findings:
        verdict, estimate = describe(finding, body)
        if verdict == "flexible":
            text = (
                f"body {body.body}{where} does not move as a rigid body: {estimate}{_bent(body, diagnosis)}."
            )
        elif finding.owner == "laser":
            text = f"{_laser(finding, body)}{where}: {verdict}, {estimate}; correct it or leave them out."
        elif finding.kind == "position" and finding.fit is None:
            text = (
                f"body {body.body}{where}: {estimate} would explain the residuals; state them as sd_mm in "
                "the points file, or measure the points anew."
            )
        elif finding.kind == "axes":
            text = f"body {body.body}{where}: beam axes do not agree with the positions: {estimate}."
        else:
            names = _channel_list(finding.channels, body)
            swapped = verdict == "label_swap" and "exchanged" in estimate
            step = "exchange the two names" if swapped else "correct it or leave the channel out"
            text = f"{names}{where}: {verdict}, {estimate}; {step}."
        notices.append(Notice(_CODES[verdict], text))
    return notices


def _bent(body: BodyChannels, diagnosis: Diagnosis) -> str:
    """Say from where on a body is not rigid, and where it bends most."""
    structure = diagnosis.structure
    text = "" if np.isnan(structure.begins_hz) else f", from about {structure.begins_hz:.3g} Hz on"
    if not np.any(structure.pattern > 0.0):
        return text
    return f"{text}, most at channel {body.channel_name(int(np.argmax(structure.pattern)))}"


def _laser(finding: Finding, body: BodyChannels) -> str:
    """Name the beams of one laser."""
    beam = direction_name(body.reported_directions[finding.channels[0]])
    return f"all {len(finding.channels)} beams along ({beam}) of body {body.body}"


def _channel_list(channels: Sequence[int], body: BodyChannels) -> str:
    if len(channels) == 1:
        return f"channel {body.channel_name(channels[0])}"
    points = list(dict.fromkeys(body.points[c] for c in channels))
    return f"point{'s' if len(points) > 1 else ''} {' and '.join(points)} of body {body.body}"


def write_channels(path: Path, verdicts: Sequence[ChannelVerdict]) -> None:
    """Write ``dof.channels.csv``."""
    import pandas as pd

    frame = pd.DataFrame(
        {
            "run": [v.run for v in verdicts],
            "body": [v.body for v in verdicts],
            "point": [v.point for v in verdicts],
            "dir_x": [round(float(v.direction[0]), 9) + 0.0 for v in verdicts],
            "dir_y": [round(float(v.direction[1]), 9) + 0.0 for v in verdicts],
            "dir_z": [round(float(v.direction[2]), 9) + 0.0 for v in verdicts],
            "residual_rms_m": [v.residual_rms_m for v in verdicts],
            "weight": [v.weight for v in verdicts],
            "verdict": [v.verdict for v in verdicts],
            "estimate": [v.estimate for v in verdicts],
            "p_value": [v.p_value for v in verdicts],
        }
    )
    frame.to_csv(path, index=False, lineterminator="\n", float_format="%.9g")
