"""The report on points and degrees of freedom, as sections that the pipeline's report takes over."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from kinematics import drawings, page
from kinematics.page import Page, Section
from kinematics.points2dof import Points2Dof
from kinematics.verdicts import ChannelVerdict

if TYPE_CHECKING:
    from markupsafe import Markup

Array = NDArray[np.float64]


def sections(result: Points2Dof, surface_mm: Array | None = None) -> list[Section]:
    """Return the sections on points, motion, residuals, verdicts and registration.

    Parameters
    ----------
    result : Points2Dof
    surface_mm : ndarray, (n, 3), optional
        Vertices of the stapes in the footplate frame, mm, drawn behind the points.
    """
    made = [_points(result, surface_mm), _motion(result), _verdicts(result), _residuals(result)]
    if result.placement.registration is not None:
        made.append(_registration(result))
    return made


def write_report(path: Path, result: Points2Dof, surface_mm: Array | None = None) -> None:
    """Write ``dof.html``."""
    motion = result.motion
    bodies = ", ".join(f"{b.body} ({len(b.points)} channels)" for b in result.measurement.bodies)
    lead = (
        f"{bodies}; {len(motion.runs)} run{'s' if len(motion.runs) > 1 else ''}, {len(motion.freq_hz)} "
        f"lines from {motion.freq_hz[0]:.6g} to {motion.freq_hz[-1]:.6g} Hz; {', '.join(motion.dof)} "
        "about the footplate centre in footplate axes, displacement amplitudes (peak) of e^{+iwt}."
    )
    made = Page("Points to degrees of freedom", lead)
    made.section("Warnings", page.notices(result.notices))
    made.sections += sections(result, surface_mm)
    made.section("Inputs", page.inputs_table(dict(motion.provenance)), _versions(result))
    made.write(path)


def _points(result: Points2Dof, surface_mm: Array | None) -> Section:
    section = Section("Points and beams")
    shadow = " Grey: vertices of the stapes surface." if surface_mm is not None else ""
    section.add(
        page.figure(
            drawings.placement_figure(result, surface_mm),
            "Measurement points and beams (towards the laser head) in the footplate frame, mm, from "
            "three sides. Arrows: axes of the frame at the footplate centre. "
            f"Red: channels with a verdict.{shadow}",
            "points and beams in three projections",
        )
    )
    rows = []
    for number, body in enumerate(result.measurement.bodies):
        fit = result.fits[0, number]
        unseen = "; ".join(result.unseen.get(body.body, ())) or "none"
        rows.append(
            (body.body, len(set(body.points)), len(body.points), f"{fit.beams.lever_m * 1e3:.3g}",
             f"{fit.beams.condition:.3g}", unseen)
        )  # fmt: skip
    section.add(
        page.table(
            ("body", "points", "channels", "lever (mm)", "condition", "motions that no beam sees"),
            rows,
            words=True,
        ),
        page.text(
            "A rotation of all points and beams together, and a common shift of all points, leave no "
            "residual: only the registration guards against them."
        ),
    )
    return section


def _motion(result: Points2Dof) -> Section:
    motion = result.motion
    section = Section("Motion of the rigid bodies")
    per = f" per unit of {motion.reference}" if motion.reference else ""
    section.add(
        page.figure(
            drawings.spectra_figure(motion),
            f"Amplitude and phase of the generalized coordinates{per} about the footplate centre in "
            "footplate axes; bands: two standard deviations of channel noise.",
            "spectra of the degrees of freedom",
        )
    )
    if motion.shared is not None:
        section.add(page.subheading("Errors that all lines share"), _shared_table(result))
    return section


def _shared_table(result: Points2Dof) -> Markup:
    """Return, per source, the relative change of each degree of freedom for one standard deviation."""
    motion = result.motion
    shared = motion.shared
    if shared is None:
        return page.text("None.")
    sources = list(dict.fromkeys(name.split(".")[0] for name in shared.names))
    rows = []
    for number, body in enumerate(motion.bodies):
        size = np.sqrt(np.nanmean(np.abs(motion.q[:, number]) ** 2, axis=(0, 1)))
        for source in sources:
            pick = [k for k, name in enumerate(shared.names) if name.startswith(source + ".")]
            d = shared.derivatives[pick][:, :, number]
            c = shared.covariance[np.ix_(pick, pick)]
            variance = np.real(np.einsum("arfd,ab,brfd->rfd", d.conj(), c, d, optimize=True))
            share = np.sqrt(np.nanmean(variance, axis=(0, 1))) / np.maximum(size, 1e-300)
            rows.append((body, source.replace("_", " "), *(f"{100.0 * value:.2g} %" for value in share)))
    return page.table(("body", "source", *motion.dof), rows)


def _verdicts(result: Points2Dof) -> Section:
    section = Section("Verdict on every channel")
    counts = Counter(v.verdict for v in result.channels)
    said = ", ".join(f"{number} {name}" for name, number in counts.most_common())
    section.add(page.text(f"{len(result.channels)} channels: {said}."))
    faulty = [v for v in result.channels if v.verdict != "ok"]
    header = ("run", "body", "point", "beam", "residual rms (nm)", "weight", "verdict", "estimate", "p")
    if faulty:
        section.add(page.table(header, _verdict_rows(faulty)))
    if len(result.channels) <= 240:
        section.add(page.folded("All channels", page.table(header, _verdict_rows(result.channels))))
    section.add(
        page.text(
            "p of a fault is corrected for the number of tests; p of an ok channel is the chance of "
            "so large a residual. Channels with a verdict stay in the fit unless they read zero "
            "or hold nothing."
        )
    )
    return section


def _verdict_rows(channels: Sequence[ChannelVerdict]) -> list[tuple[str, ...]]:
    return [
        (
            v.run, v.body, v.point, ", ".join(f"{value:.3f}" for value in v.direction),
            f"{v.residual_rms_m * 1e9:.3g}", f"{v.weight:.3g}", v.verdict, v.estimate, _chance(v.p_value),
        )
        for v in channels
    ]  # fmt: skip


def _chance(p: float) -> str:
    return "< 1e-300" if p < 1e-300 else f"{p:.2g}"


def _residuals(result: Points2Dof) -> Section:
    section = Section("Residuals of the rigid fit")
    section.add(
        page.figure(
            drawings.residual_figure(result),
            f"|residual| in units of its sd, run {result.motion.runs[0]}. Noise alone gives about 1.2.",
            "residual map of channels over frequency",
            vector=False,
        )
    )
    if np.any(result.motion.n_dof > 0):
        section.add(
            page.figure(
                drawings.chi2_figure(result.motion),
                "chi2 per degree of freedom; dashed: 95 % range of a rigid body with the stated noise.",
                "chi2 over frequency",
            )
        )
    section.add(_chi2_table(result))
    return section


def _chi2_table(result: Points2Dof) -> Markup:
    from scipy.special import chdtrc

    rows = []
    motion = result.motion
    for run, run_name in enumerate(motion.runs):
        for number, body in enumerate(motion.bodies):
            good = np.isfinite(motion.chi2[run, number]) & (motion.n_dof[run, number] > 0)
            chi2 = float(np.sum(motion.chi2[run, number][good]))
            n_dof = int(np.sum(motion.n_dof[run, number][good]))
            p = float(chdtrc(n_dof, chi2)) if n_dof else float("nan")
            rows.append((run_name, body, f"{chi2:.6g}", n_dof, f"{chi2 / max(n_dof, 1):.3g}", f"{p:.2g}"))
    return page.table(("run", "body", "chi2", "degrees of freedom", "ratio", "p"), rows)


def _registration(result: Points2Dof) -> Section:
    section = Section("Registration")
    fit = result.placement.registration
    if fit is None:
        return section
    sd = np.sqrt(np.diag(fit.covariance_si))
    centre = fit.transform.inverse().points(_centre_in(result))
    error = float(fit.target_registration_error(centre)[0])
    chi2 = (
        "not tested (sd estimated from the residuals)"
        if np.isnan(fit.chi2)
        else f"{fit.chi2:.3g} of {fit.n_dof}"
    )
    turn = np.rad2deg(sd[3:])
    rows = [
        ("fiducials", str(len(fit.residuals_mm))),
        ("residual, rms", f"{fit.rms_mm * 1e3:.3g} um"),
        ("chi2", chi2),
        ("largest distance from one plane", f"{fit.flat_mm:.3g} mm"),
        ("target error at the footplate centre, rms", f"{error * 1e3:.3g} um"),
        ("sd of the rotation", ", ".join(f"{value:.2g}" for value in turn) + " deg"),
    ]
    section.add(page.table(("fiducial registration", fit.transform.to), rows))
    matrix = result.placement.transform.matrix
    section.add(
        page.table(
            (f"{result.placement.transform.to}_from_{result.placement.transform.source}", "", "", "mm"),
            [[f"{value:.6f}" for value in row] for row in matrix],
        )
    )
    return section


def _centre_in(result: Points2Dof) -> Array:
    """Return the footplate centre (1, 3) in the frame that the fiducials were fitted to, mm."""
    fit = result.placement.registration
    if fit is None:
        return np.zeros((1, 3))
    to_reference = fit.transform @ result.placement.transform.inverse()
    return to_reference.points(np.zeros((1, 3)))


def _versions(result: Points2Dof) -> Markup:
    record = dict(result.motion.provenance)
    versions = record.get("versions", {})
    rows = [("command", record.get("command", "")), ("date", record.get("date", ""))]
    rows += [(name, version) for name, version in versions.items()]
    rows += [("degrees of freedom", ", ".join(result.options.dof)), ("robust", result.options.robust)]
    return page.table(("", ""), rows, words=True)
