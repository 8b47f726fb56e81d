"""The verdict on every channel, the warnings, and the table ``dof.channels.csv``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kinematics.faults.search import Diagnosis
from kinematics.faults.sentences import STEPS, culprit, describe
from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import BodyChannels, LeftOut, Measurement
from stapeskit.arrays import Array
from stapeskit.faults import list_some
from stapeskit.spatial import dof_indices, point_rows
from stapeskit.warnings import Notice

WORDS = ("ok", *STEPS, "unused")
"""The verdicts of dof.channels.csv."""

_CURED = 0.1  # share of the squares that the motion of another body may leave


@dataclass(frozen=True)
class ChannelVerdict:
    """What was found on one channel in one run.

    Attributes
    ----------
    direction : ndarray, (3,)
        Beam as in the file.
    residual_rms_m : float
        Root mean square of |measured - fitted| over the lines, m; NaN when unused.
    weight : float
        Mean weight in the fit, relative to the strongest channel of the body; 0 when unused.
    verdict : str
        Of `WORDS`.
    estimate : str
        The size of the fault in words; empty when ok.
    p_value : float
        Probability of such values without a fault, by the tests of this channel; NaN when unused.
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


def channel_verdicts(
    run: str,
    body: BodyChannels,
    diagnosis: Diagnosis,
    residual_rms_m: Array,
    weight: Array,
    unused: Mapping[int, str],
) -> list[ChannelVerdict]:
    """Return the verdict of every channel of a body in one run; ``unused`` by channel."""
    found: dict[int, tuple[str, str]] = {}
    for finding in reversed(diagnosis.findings):  # the first of two on one channel counts
        found |= dict.fromkeys(finding.channels, (finding.verdict, describe(finding, body)))
    found |= {channel: (verdict, "") for channel, verdict in unused.items()}
    chances = np.exp(diagnosis.channel_log_p)
    return [
        ChannelVerdict(
            run,
            body.body,
            point,
            body.file_directions[channel],
            float(residual_rms_m[channel]),
            float(weight[channel]),
            *found.get(channel, ("ok", "")),
            float("nan") if channel in unused else float(chances[channel]),
        )
        for channel, point in enumerate(body.points)
    ]


def left_out_verdicts(runs: Sequence[str], left_out: Sequence[LeftOut]) -> list[ChannelVerdict]:
    """Return ``unused`` for every channel that the user left out, in every run."""
    nan = float("nan")
    return [
        ChannelVerdict(run, beam.body, beam.point, beam.direction, nan, 0.0, "unused", "left out", nan)
        for run in runs
        for beam in left_out
    ]


def fault_notices(body: BodyChannels, diagnosis: Diagnosis) -> list[Notice]:
    """Return one warning for each finding and each cause that many channels share."""
    notices = []
    for finding in diagnosis.findings:
        verdict = finding.verdict
        code = "flexible" if verdict == "flexible" else f"channel_{verdict}"
        text = f"{culprit(finding, body)}: {verdict}, {describe(finding, body)}. {STEPS[verdict]}."
        notices.append(Notice(code, text))
    for cause in diagnosis.causes:
        most = "" if cause.channel is None else f", most in channel {body.channel_name(cause.channel)}"
        notices.append(Notice(cause.code, f"body {body.body}: {cause.text}{most}. {cause.step}."))
    if diagnosis.noise_level != 1.0:
        text = (
            f"the noise of body {body.body} is {diagnosis.noise_level:.2g} times the stated one on all "
            "channels alike: standard deviations of the motion are off by the same factor. Check the sd or "
            "the number of averages."
        )
        notices.append(Notice("noise_level", text))
    return notices


def points_of_other_bodies(
    placed: Measurement, fits: Mapping[tuple[int, int], LineFit], diagnoses: Mapping[int, Diagnosis]
) -> Iterator[Notice]:
    """Return the points at fault that move with another body; fits by (run, body), diagnoses by body."""
    for number, found in diagnoses.items():
        body = placed.bodies[number]
        accused = {c for one in found.findings if one.owner in ("channel", "point") for c in one.channels}
        points = list(dict.fromkeys(body.points[channel] for channel in sorted(accused)))
        alone = _squares(placed, fits, number, number) if points else np.zeros(0)
        for other, mover in enumerate(placed.bodies if points else ()):
            left = _squares(placed, fits, number, other)
            own = {point: body.channels_of(point) for point in points}
            moved = [
                point for point in points if np.sum(left[own[point]]) < _CURED * np.sum(alone[own[point]])
            ]
            if moved:
                text = (
                    f"points {list_some(moved)} of body {body.body} move as body {mover.body} does at their"
                )
                yield Notice("channel_label_swap", f"{text} positions: their rows belong to it.")


def _squares(placed: Measurement, fits: Mapping[tuple[int, int], LineFit], number: int, mover: int) -> Array:
    """Return what the motion of one body leaves of the values of another, (c,), over their noise."""
    body = placed.bodies[number]
    total = np.zeros(len(body.points))
    for run in range(len(placed.runs)):
        own, other = fits[run, number], fits[run, mover]
        rows = point_rows(body.arms_m, body.directions)[:, dof_indices(other.beams.dof)]
        left = own.value - rows @ (other.q.T * placed.per_displacement)
        total += np.nansum(np.abs(left / (own.sd * own.factor)) ** 2, axis=1)
    return total


def write_channels(path: Path, verdicts: Sequence[ChannelVerdict]) -> None:
    """Write ``dof.channels.csv``."""
    from stapeskit.tables import write_columns

    def cells(name: str) -> list[object]:
        column = [getattr(verdict, name) for verdict in verdicts]
        return [f"{cell:.9g}" if isinstance(cell, float) and cell == cell else cell for cell in column]

    table = {name: cells(name) for name in ("run", "body", "point")}
    for k, axis in enumerate("xyz"):
        table[f"dir_{axis}"] = [f"{round(verdict.direction[k], 9) + 0.0:.9g}" for verdict in verdicts]
    names = ("residual_rms_m", "weight", "verdict", "estimate", "p_value")
    write_columns(path, table | {name: cells(name) for name in names})
