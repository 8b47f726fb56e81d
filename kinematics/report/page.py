"""dof.html: verdict, motion, channels, registration, shared errors; other reports take its sections over."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from kinematics.faults.rounds import POWER, detectable
from kinematics.report.figures import MOST_RUNS, residual_figure, spectra_figure
from kinematics.report.motion import motion_scene
from kinematics.report.tables import motion_rows, summary_rows
from stapeskit.report import page
from stapeskit.report.quantities import Quantity, ShownUnit
from stapeskit.warnings import VERDICTS, Notice, table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from markupsafe import Markup

    from kinematics.results import MotionResult
    from stapeskit.report.page import Page

_SENTENCES = {
    "believe": "no warning calls for a check",
    "check": "look at these warnings before the motion is used",
    "do not use": "a warning says that the motion is wrong as it stands",
}
_MOST_ROWS = 60  # of the table of verdicts
_UNITS = {
    **dict.fromkeys(("gain", "phase", "drift"), ("%", 100.0)),
    **dict.fromkeys(("direction", "axes"), ("°", 180.0 / np.pi)),
    "delay": ("µs", 1e6),
    "position": ("µm", 1e6),
}


def motion_page(result: MotionResult) -> Page:
    """Return the page of a motion."""
    motion = result.motion
    per = f" per unit of {motion.reference}" if motion.reference else ""
    lead = (
        f"{', '.join(motion.dof)} about the footplate centre in footplate axes{per}; displacement, peak, "
        f"exp(+i omega t); {len(motion.freq_hz)} lines."
    )
    made = page.Page(result.title, lead)
    level, reasons = motion_verdict(result.notices)
    made.add(page.verdict(level, _SENTENCES[level], reasons))
    made.add(page.table(("", ""), summary_rows(result), words=True))
    some = f"the first {MOST_RUNS} of {len(motion.runs)} runs; " if len(motion.runs) > MOST_RUNS else ""
    caption = f"Amplitude and phase; {some}bands are 95 % of the channel noise."
    curves = page.figure(spectra_figure(motion), caption, "amplitude and phase over frequency", file="motion")
    made.section("Amplitude and phase", curves)
    made.section("The moving bodies", page.viewer(motion_scene(result)))
    motion_sections(made, result)
    made.section("Warnings", page.notices(result.notices))
    made.appendix_section("Inputs", page.inputs(motion.provenance))
    return made


def motion_verdict(notices: Sequence[Notice]) -> tuple[str, list[Notice]]:
    """Return ``believe``, ``check`` or ``do not use`` by the worst warning, and those that lower it."""
    known = table()
    found = [known[notice.code].verdict if notice.code in known else "check" for notice in notices]
    reasons = [one for one, level in zip(notices, found, strict=True) if level != VERDICTS[0]]
    return max(found, key=VERDICTS.index) if reasons else "believe", reasons


def motion_sections(made: Page, result: MotionResult) -> None:
    """Add the verdicts on channels, and the appendix on residuals and registration, to a page."""
    made.section("Channels and verdicts", *_channels(result))
    made.appendix_section("Motion and residuals", _motion(result), *_residuals(result))
    made.appendix_section("From the vibrometer to the footplate", *_registration(result))


def _motion(result: MotionResult) -> Markup:
    head = ("body", "motion", "rms", "noise (sd)", "shared errors (sd)", "unit", "largest source")
    rows = motion_rows(result)
    return page.table(head, rows, "Root mean square over all lines.", title="Motion of the bodies", names=2)


def _channels(result: MotionResult) -> list[Markup]:
    odd = [one for one in result.channels if one.verdict != "ok"]
    blocks = []
    if odd:
        head = ("body", "point", "beam", "verdict", "what was found", "p")
        rows = [
            (
                one.body if len(result.motion.runs) == 1 else f"{one.body}, run {one.run}",
                one.point,
                ", ".join(f"{value:.3f}" for value in one.direction),
                one.verdict,
                one.estimate,
                f"{one.p_value:.2g}" if one.p_value > 0.0 else "< 1e-300",
            )
            for one in odd[:_MOST_ROWS]
        ]
        more = f" {len(odd) - _MOST_ROWS} more are in the table of channels." if len(odd) > _MOST_ROWS else ""
        blocks.append(page.table(head, rows, f"Channels with a verdict.{more}", words=True))
    else:
        blocks.append(
            page.text(f"All {len(result.channels)} channels agree with rigid motion of their body.")
        )
    return blocks


def _residuals(result: MotionResult) -> list[Markup]:
    shown = f" of run {result.motion.runs[0]}" if len(result.motion.runs) > 1 else ""
    caption = f"Residuals{shown} over their noise: 1 is noise alone. Names have the colour of the verdict."
    drawn = page.figure(residual_figure(result), caption, "residuals of every channel", file="residuals")
    return [drawn, page.folded("What would have been found", *_detectable(result))]


def _registration(result: MotionResult) -> list[Markup]:
    fit = result.placement.registration
    if fit is None:
        frame = result.placement.reference
        blocks = [
            page.text(f"Positions and directions are given in the frame {frame}: nothing was registered.")
        ]
    else:
        rows = [
            (name, *(f"{1e3 * value:+.0f}" for value in left), f"{1e3 * sd:.0f}")
            for name, left, sd in zip(fit.names, fit.residuals_mm, fit.sd_mm, strict=True)
        ]
        chi2 = f", chi2 {fit.chi2:.3g} for {fit.n_dof}" if np.isfinite(fit.chi2) else ""
        caption = (
            f"Residuals in µm, axes of the frame {fit.transform.to}; rms {1e3 * fit.rms_mm:.0f} µm{chi2}."
        )
        blocks = [page.table(("fiducials", "x", "y", "z", "sd"), rows, caption)]
    if result.checks:
        rows = [
            (check.body, str(len(check.points)), f"{1e3 * check.rms_mm:.0f}",
             f"{1e3 * float(np.sqrt(np.mean(check.expected_sd_mm**2))):.0f}", f"{check.p_value:.2g}")
            for check in result.checks
        ]  # fmt: skip
        head = ("body", "points", "rms off it (µm)", "expected (µm)", "p")
        caption = "Did the sample move? Measured points against the surfaces of the scan."
        blocks.append(page.table(head, rows, caption))
    return [*blocks, page.subheading("Errors that all lines share"), *_shared(result)]


def _shared(result: MotionResult) -> list[Markup]:
    blocks = []
    if result.errors is not None and (shown := result.errors.shown.rows()):
        caption = "How far the lasers agree, as the redundancy of the beams shows it."
        if result.errors.calibrated:
            caption = "The geometry as estimated together with the motion."
        rows = [
            (name, Quantity(value, sd, ShownUnit(unit, 1.0)), f"{stated:.3g} {unit}")
            for name, value, sd, stated, unit in shown[:_MOST_ROWS]
        ]
        blocks.append(page.table(("", "estimate", "stated sd"), rows, caption))
    shared = result.motion.shared
    if shared is None:
        return [*blocks, page.text("No errors are stated that all lines share.")]
    sources: dict[str, int] = {}
    for name in shared.names:
        source = name.partition(".")[0]
        sources[source] = sources.get(source, 0) + 1
    listed = ", ".join(f"{source} ({number})" for source, number in sources.items())
    text = (
        f"Parameters: {listed}. They stand apart from the noise, with their covariance and the derivatives "
        "of the motion, and go coherently into stiffness and damping."
    )
    return [page.text(text), *blocks]


def _detectable(result: MotionResult) -> list[Markup]:
    rows = []
    for number, body in enumerate(result.measurement.bodies):
        found = detectable(result.diagnoses[number].last)
        for owner, kind in dict.fromkeys((one.place.owner, one.kind) for one in found):
            sizes = np.array([one.size for one in found if (one.place.owner, one.kind) == (owner, kind)])
            unit, factor = _UNITS[kind]
            known = factor * sizes[np.isfinite(sizes)]
            never = len(sizes) - len(known)
            cells = (f"{np.median(known):.3g}", f"{np.max(known):.3g}") if len(known) else ("", "")
            rows.append((body.body, f"{kind} of a {owner}", *cells, unit, str(never) if never else ""))
    head = ("body", "fault", "median", "largest", "unit", "never shows at")
    caption = f"Smallest faults that are found with a probability of {100 * POWER:.0f} %."
    text = (
        "A mirror of positions and beams together, one gain of all lasers, and a turn of everything never "
        "show."
    )
    return [page.table(head, rows, caption, names=2), page.text(text)]
