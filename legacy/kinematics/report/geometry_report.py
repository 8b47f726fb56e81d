"""The report on registration, surfaces and calibration: on the terminal, in JSON, on the page."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from legacy.kinematics.points2dof import Points2Dof
    from legacy.kinematics.registration.calibrate import Calibration
    from legacy.kinematics.registration.laser_errors import LaserErrors
    from legacy.kinematics.registration.surface_check import SurfaceCheck
    from legacy.stapeskit.page.page import Section

_CENTRE = np.zeros((1, 3))


def centre_error(result: Points2Dof) -> float | None:
    """Return the root mean square error of the footplate centre by the registration, mm."""
    fit = result.placement.registration
    if fit is None:
        return None
    return float(fit.target_registration_error(result.placement.transform.inverse().points(_CENTRE))[0])


def rows(result: Points2Dof) -> list[tuple[str, str]]:
    """Return the rows of the command's table."""
    entries = []
    fit = result.placement.registration
    error = centre_error(result)
    if fit is not None and error is not None:
        text = f"{len(fit.residuals_mm)} {fit.kind}, residual {fit.rms_mm * 1e3:.3g} µm rms"
        entries.append(("registration", f"{text}, footplate centre ± {error * 1e3:.3g} µm"))
    for check in result.placement.checks:
        entries.append((f"{check.body} on the {check.surface}", _check_words(check)))
    if result.calibration is not None:
        entries.append(("calibration", _calibration_words(result.calibration)))
    return entries


def _check_words(check: SurfaceCheck) -> str:
    sentences = [f"{len(check.points)} points {check.rms_mm * 1e3:.3g} µm rms off it"]
    if np.isfinite(check.chi2):
        sentences.append(f"p {check.p_value:.2g}")
    return ", ".join(sentences)


def _calibration_words(calibration: Calibration) -> str:
    text = f"{int(np.sum(calibration.seen))} of {len(calibration.seen)} parameters determined by the data"
    axes = [k for k, name in enumerate(calibration.model.names) if name.startswith("axes.")]
    if axes:
        turn = float(np.rad2deg(np.linalg.norm(calibration.values[axes])))
        sd = float(np.rad2deg(np.max(calibration.sd[axes])))
        text += f", axes turned {turn:.2g} ± {sd:.2g}°"
    return f"{text}, p {calibration.p_value:.2g} against the priors"


def as_json(result: Points2Dof) -> dict[str, Any]:
    """Return the keys ``registration``, ``surface_checks``, ``calibration`` and ``lasers`` of the JSON."""
    fit = result.placement.registration
    content: dict[str, Any] = {
        "registration": None,
        "surface_checks": [],
        "calibration": None,
        "lasers": None,
    }
    if fit is not None:
        content["registration"] = {
            "kind": fit.kind,
            "points": len(fit.residuals_mm),
            "residual_rms_mm": fit.rms_mm,
            "chi2": None if np.isnan(fit.chi2) else fit.chi2,
            "n_dof": fit.n_dof,
            "error_at_footplate_centre_mm": centre_error(result),
            f"{fit.transform.to}_from_{fit.transform.source}": fit.transform.matrix.tolist(),
            "pose_covariance_si": fit.covariance_si.tolist(),
        }
    content["surface_checks"] = [
        {
            "body": check.body,
            "surface": check.surface,
            "points": list(check.points),
            "distance_mm": check.distance_mm.tolist(),
            "expected_sd_mm": check.expected_sd_mm.tolist(),
            "chi2": None if np.isnan(check.chi2) else check.chi2,
            "n_dof": check.n_dof,
            "p_value": check.p_value,
            "shift_mm": check.shift_mm.tolist(),
            "shift_sd_mm": check.shift_sd_mm.tolist(),
            "turn_deg": check.turn_deg.tolist(),
            "turn_sd_deg": check.turn_sd_deg.tolist(),
            "open_motions": list(check.open_motions),
        }
        for check in result.placement.checks
    ]
    if result.calibration is not None:
        calibration = result.calibration
        content["calibration"] = {
            "names": list(calibration.model.names),
            "values_si": calibration.values.tolist(),
            "sd_si": calibration.sd.tolist(),
            "prior_sd_si": calibration.model.prior_sd.tolist(),
            "told_by_the_data": calibration.seen.tolist(),
            "chi2": calibration.chi2,
            "n_dof": calibration.n_dof,
            "p_value": calibration.p_value,
        }
    if result.lasers is not None:
        content["lasers"] = {
            "names": list(result.lasers.names),
            "values_si": result.lasers.estimate.values.tolist(),
            "sd_si": result.lasers.sd.tolist(),
            "prior_sd_si": result.lasers.prior_sd.tolist(),
            "directions": result.lasers.directions.tolist(),
        }
    return content


def sections(result: Points2Dof) -> list[Section]:
    """Return the sections on measured points against the scan's surfaces and on the calibration."""
    parts = []
    if result.placement.checks:
        parts.append(_surfaces(result.placement.checks))
    if result.calibration is not None:
        parts.append(_calibration(result.calibration))
    if result.lasers is not None:
        parts.append(_lasers(result.lasers))
    return parts


def _surfaces(checks: tuple[SurfaceCheck, ...]) -> Section:
    from legacy.kinematics.registration.surface_check import shift_words
    from legacy.stapeskit.page import page
    from legacy.stapeskit.page.page import Section

    section = Section("Points on the surfaces of the scan", key="points_on_surfaces")
    section.add(
        page.text(
            "Distances of the measured points, as the registration places them, from the surface that they "
            "must lie on. A shift of all points alike says that the sample moved between scan and "
            "measurement, or that the registration is wrong; along the motions named last it would not show."
        )
    )
    entries = []
    for check in checks:
        expected = float(np.sqrt(np.mean(check.expected_sd_mm**2)))
        entries.append(
            (f"{check.body} on the {check.surface}", len(check.points), f"{check.rms_mm * 1e3:.3g}",
             f"{expected * 1e3:.3g}", f"{check.p_value:.2g}", shift_words(check),
             "; ".join(check.open_motions) or "none")
        )  # fmt: skip
    head = (
        "points",
        "number",
        "distance, rms (µm)",
        "expected",
        "p",
        "best rigid shift, footplate axes",
        "motions not seen",
    )
    section.add(page.table(head, entries, words=True))
    return section


def _calibration(calibration: Calibration) -> Section:
    from legacy.kinematics.registration.prior_errors import shown
    from legacy.stapeskit.page import page
    from legacy.stapeskit.page.page import Section

    section = Section("Geometry estimated with the motion", key="calibration")
    section.add(
        page.text(
            "Most probable errors of the stated geometry, all lines together, the motion at every line left "
            "free. Against the stated errors: "
            f"chi2 {calibration.chi2:.3g} for {calibration.n_dof} seen directions, "
            f"p {calibration.p_value:.2g}. "
            "Rows without a mark are known from the statement alone. "
            "A shift of all points of a body together, a turn of positions and beams together, and one gain "
            "common to all lasers leave no residual: they rest on fiducials and references."
        )
    )
    entries = []
    for place, name in enumerate(calibration.model.names):
        _, factor, unit = shown(name)
        value, sd, prior = calibration.values[place], calibration.sd[place], calibration.model.prior_sd[place]
        mark = "seen" if calibration.seen[place] else ""
        numbers = (f"{value * factor:+.3g}", f"{sd * factor:.2g}", f"{prior * factor:.2g}")
        entries.append((name, *numbers, unit, mark))
    head = ("parameter", "estimate", "sd", "stated sd", "unit", "determined by the data")
    most = 60
    section.add(page.table(head, entries[:most]))
    if len(entries) > most:
        section.add(page.text(f"... and {len(entries) - most} more in the JSON result."))
    return section


def _lasers(lasers: LaserErrors) -> Section:
    from legacy.kinematics.registration.laser_notices import laser_table
    from legacy.stapeskit.page import page
    from legacy.stapeskit.page.page import Section

    section = Section("How the lasers agree", key="lasers")
    section.add(
        page.text(
            "Gain, phase and delay of each laser against the mean of all, as the beams tell them together "
            "with the motion. The motion is corrected by the estimates; their sd enters K and D as an error "
            "that all lines share. What all lasers have in common changes no K and no D."
        )
    )
    rows = [
        (name, f"{value:+.3g}", f"{sd:.2g}", f"{stated:.2g}", unit)
        for name, value, sd, stated, unit in laser_table(lasers)
    ]
    section.add(page.table(("parameter", "estimate", "sd", "stated sd", "unit"), rows))
    return section
