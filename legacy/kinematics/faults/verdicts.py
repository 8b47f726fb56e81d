"""The verdict on every channel, and its table ``dof.channels.csv``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from legacy.kinematics.faults.catalogue import ADVICE
from legacy.kinematics.faults.diagnosis import Diagnosis
from legacy.kinematics.faults.findings import Finding, channel_list, describe
from legacy.kinematics.measurement import BodyChannels, LeftOut, direction_name
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.option_names import written
from legacy.stapeskit.tables.text_cells import as_text_cell
from legacy.stapeskit.warnings import Notice


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
    step : str
        What to do about a cause that many channels share; empty otherwise.
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
    step: str = ""


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

    found: dict[int, tuple[str, str, float, str]] = {
        channel: (*describe(finding, body), finding.p_value, finding.step)
        for finding in reversed(diagnosis.findings)  # the first of two on one channel counts
        for channel in finding.channels
    }
    found |= {channel: (verdict, "", np.nan, "") for channel, verdict in unused.items()}
    number = 2.0 * diagnosis.lines
    chances = np.where(number > 0.0, chdtrc(np.maximum(number, 1.0), number * diagnosis.energy), np.nan)
    return [
        ChannelVerdict(
            run,
            body.body,
            point,
            body.reported_directions[channel],
            float(residual_rms_m[channel]),
            float(weight[channel]),
            *found.get(channel, ("ok", "", float(chances[channel]), "")),
        )
        for channel, point in enumerate(body.points)
    ]


def left_out_verdicts(runs: Sequence[str], left_out: Sequence[LeftOut]) -> list[ChannelVerdict]:
    """Return ``unused`` for every channel that the user left out, in every run."""
    return [
        ChannelVerdict(run, beam.body, beam.point, beam.direction, np.nan, 0.0, "unused", "left out", np.nan)
        for run in runs
        for beam in left_out
    ]


def fault_notices(run: str, body: BodyChannels, diagnosis: Diagnosis, several: bool) -> list[Notice]:
    """Return one notice per finding."""
    where = f" in run {run}" if several else ""
    notices = []
    for finding in diagnosis.findings:
        verdict, estimate = describe(finding, body)
        step = f" {finding.step}." if finding.step else ""
        if finding.code:
            text = f"body {body.body}{where}: {estimate}.{step}"
        elif verdict == "flexible":
            text = f"body {body.body}{where} does not move as a rigid body: {estimate}"
            text += f"{_describe_bend(body, diagnosis)}.{step}"
        elif finding.kind == "position" and finding.fault is None:
            text = (
                f"body {body.body}{where}: {estimate} would explain the residuals; state them as sd_mm in "
                "the points file, or measure the points anew."
            )
        else:
            text = f"{_culprit(finding, body)}{where}: {verdict}, {estimate}. {written(ADVICE[verdict][1])}"
        notices.append(Notice(finding.code or ADVICE[verdict][0], text))
    return notices


def _describe_bend(body: BodyChannels, diagnosis: Diagnosis) -> str:
    """Describe from which frequency on a body is not rigid, and where it bends most."""
    structure = diagnosis.structure
    text = "" if np.isnan(structure.begins_hz) else f", from about {structure.begins_hz:.3g} Hz on"
    if not np.any(structure.pattern > 0.0):
        return text
    return f"{text}, most at channel {body.channel_name(int(np.argmax(structure.pattern)))}"


def _culprit(finding: Finding, body: BodyChannels) -> str:
    """Name what is at fault: the body, the beams of one laser, or channels."""
    if finding.owner == "body":
        return f"body {body.body}"
    return _laser(finding, body) if finding.owner == "laser" else channel_list(finding.channels, body)


def _laser(finding: Finding, body: BodyChannels) -> str:
    """Name the beams of one laser."""
    beam = direction_name(body.reported_directions[finding.channels[0]])
    return f"all {len(finding.channels)} beams along ({beam}) of body {body.body}"


def write_channels(path: Path, verdicts: Sequence[ChannelVerdict]) -> None:
    """Write ``dof.channels.csv``."""
    import pandas as pd

    texts = {name: [as_text_cell(getattr(v, name)) for v in verdicts] for name in ("run", "body", "point")}
    beams = {
        f"dir_{axis}": [round(float(v.direction[k]), 9) + 0.0 for v in verdicts]
        for k, axis in enumerate("xyz")
    }
    names = ("residual_rms_m", "weight", "verdict", "estimate", "p_value")
    frame = pd.DataFrame({**texts, **beams, **{name: [getattr(v, name) for v in verdicts] for name in names}})
    frame.to_csv(path, index=False, lineterminator="\n", float_format="%.9g")
