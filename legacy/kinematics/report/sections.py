"""The report on points and degrees of freedom, as sections that the pipeline's report takes over."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from legacy.kinematics.points2dof import Points2Dof
from legacy.kinematics.report import geometry_report
from legacy.kinematics.report.fault_sections import (
    channel_count,
    clean_words,
    groups_of,
    residual_section,
    verdict_section,
)
from legacy.kinematics.report.geometry_sections import points_section, registration_section
from legacy.kinematics.report.motion_sections import motion_section, moving_section
from legacy.kinematics.report.repeat_sections import repeats_section
from legacy.kinematics.report.stapes_surface import Scenery
from legacy.stapeskit.page import page
from legacy.stapeskit.page.drawings import line_words
from legacy.stapeskit.page.page import Page, Section
from legacy.stapeskit.warnings import Notice

if TYPE_CHECKING:
    from markupsafe import Markup

# Warnings of one code that are shown at once; the others unfold.
_SHOWN_OF_A_CODE = 4
_QUANTITIES = ("displacement", "velocity", "acceleration")


def sections(result: Points2Dof, scenery: Scenery | None = None, interactive: bool = False) -> list[Section]:
    """Return the sections on points, motion, residuals, verdicts and registration.

    Parameters
    ----------
    scenery : Scenery, optional
        The stapes in the footplate frame, drawn behind the points.
    interactive : bool
        Add the moving picture with its script.
    """
    scenery = scenery or Scenery()
    parts = [
        points_section(result, scenery),
        moving_section(result, scenery, interactive),
        motion_section(result),
        verdict_section(result),
        residual_section(result),
    ]
    if result.repeats:
        parts.append(repeats_section(result))
    if result.placement.registration is not None:
        parts.append(registration_section(result))
    parts += geometry_report.sections(result)
    return parts


def write_report(path: Path, result: Points2Dof, scenery: Scenery | None = None) -> None:
    """Write ``dof.html``.

    Parameters
    ----------
    scenery : Scenery, optional
    """
    motion = result.motion
    bodies = ", ".join(f"{b.body} ({len(b.points)} channels)" for b in result.measurement.bodies)
    per = f" per unit of {motion.reference}" if motion.reference else ""
    low, high = f"{motion.freq_hz[0]:.6g}", f"{motion.freq_hz[-1]:.6g}"
    lines = (
        f"{len(motion.freq_hz)} lines from {low} to {high} Hz"
        if len(motion.freq_hz) > 1
        else f"1 line at {low} Hz"
    )
    lead = (
        f"{bodies}; {len(motion.runs)} run{'s' if len(motion.runs) > 1 else ''}, {lines}; "
        f"{', '.join(motion.dof)}{per} "
        "about the footplate centre in footplate axes, displacement amplitudes (peak) of e^{+iωt}."
    )
    report = Page("Points to degrees of freedom", lead)
    report.section("Warnings", page.text(_in_short(result)), *grouped_notices(result.notices))
    report.sections += sections(result, scenery, interactive=True)
    report.section("Inputs", *_inputs(result))
    report.write(path)


def _in_short(result: Points2Dof) -> str:
    """Return the outcome of the diagnosis in one sentence."""
    wrong = [v for v in result.channels if v.verdict != "ok"]
    if not wrong:
        return f"{channel_count(result)}. {clean_words(result)}"
    several = len(result.motion.runs) > 1
    named = []
    for group in groups_of(result)[:5]:
        where = f" in run {group.verdict.run}" if several else ""
        points = "; ".join(group.names[:3]) + (" ..." if len(group.names) > 3 else "")
        named.append(f"{group.verdict.body} {points}: {group.verdict.verdict}{where}")
    counts = Counter(v.body for v in wrong)
    total = " and ".join(f"{number} of {body}" for body, number in counts.items())
    return f"{len(wrong)} of {channel_count(result)} have a verdict, {total}. {'. '.join(named)}."


def grouped_notices(notices: Sequence[Notice]) -> list[Markup]:
    """Return the warnings by code; of many with one code all but the first are folded away."""
    by_code: dict[str, list[Notice]] = {}
    for notice in notices:
        by_code.setdefault(notice.code, []).append(notice)
    if not by_code:
        return [page.notices(())]
    blocks = []
    for code, own in by_code.items():
        blocks.append(page.notices(own[:_SHOWN_OF_A_CODE]))
        rest = own[_SHOWN_OF_A_CODE:]
        if rest:
            blocks.append(page.folded(f"{len(rest)} more with the code {code}", page.notices(rest)))
    return blocks


def _inputs(result: Points2Dof) -> list[Markup]:
    """Return what was read, the choices made, and the versions."""
    record = dict(result.motion.provenance)
    blocks = [page.inputs_table(record)] if record.get("inputs") else []
    measurement, freq = result.measurement, result.motion.freq_hz
    read = [
        ("quantity", f"{_QUANTITIES[measurement.order]}, turned into displacement (m, peak, e^{{+iωt}})"),
        (
            "noise of the channels",
            "; ".join(f"{body.body}: {_noise_words(body)}" for body in measurement.bodies),
        ),
        ("runs", ", ".join(measurement.runs)),
        ("lines", line_words(freq)),
        ("coordinates", f"given in the frame {result.placement.transform.source}"),
        ("degrees of freedom", ", ".join(result.options.dof)),
        ("robust", result.options.robust),
    ]
    if result.options.reference:
        read.append(("reference", result.options.reference))
    read += [(name, str(record[name])) for name in ("command", "date") if record.get(name)]
    read += [(name, version) for name, version in record.get("versions", {}).items()]
    blocks.append(page.table(("", ""), read, words=True))
    return blocks


def _noise_words(body: object) -> str:
    """Return where the standard deviations of a body came from."""
    sd, relative = getattr(body, "sd", None), getattr(body, "relative", False)
    if sd is None:
        return "not stated, estimated from the residuals"
    missing = bool(np.any(~np.isfinite(sd)))
    words = "known up to one factor, which the residuals give" if relative else "as stated"
    return words + (", missing for some values" if missing else "")
