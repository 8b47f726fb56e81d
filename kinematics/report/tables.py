"""Rows of the tables of a motion, for terminal, notebook, JSON and page."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from kinematics.fit.beams import unseen_motions
from stapeskit.arrays import Array
from stapeskit.report.figures import dof_unit

if TYPE_CHECKING:
    from kinematics.results import MotionResult

MOST_BODIES = 6  # of a summary, which fits one screen
_MOST_STATEMENTS = 4


def summary_rows(result: MotionResult) -> list[tuple[str, str]]:
    """Return files taken, degrees of freedom, lines, fit of every body, verdicts and registration."""
    motion = result.motion
    per = f" per {motion.reference}" if motion.reference else ""
    runs = len(motion.runs)
    rows = [(f"{role} (found beside LDV)", str(path)) for role, path in result.taken.items()]
    rows += [
        ("degrees of freedom", ", ".join(motion.dof) + per),
        ("lines", f"{line_words(motion.freq_hz)}, {runs} run{'s' if runs > 1 else ''}"),
    ]
    rows += [("input", text) for text in result.measurement.statements[:_MOST_STATEMENTS]]
    for name, body in bodies_json(result).items():
        n_dof = body["n_dof"]
        text = f"{body['channels']} channels, "
        text += f"chi2/dof {body['chi2'] / n_dof:.3g}" if n_dof else "no redundancy"
        if body["best_peak_over_noise"]:
            text += f", best peak/noise {body['best_peak_over_noise']:.3g}"
        rows.append((name, text))
        if body["unobservable"]:
            rows.append((f"{name} not seen", "; ".join(body["unobservable"])))
    counts = Counter(one.verdict for one in result.channels)
    rows.append(("channels", ", ".join(f"{number} {name}" for name, number in counts.most_common())))
    rows += registration_rows(result)
    for one in result.repeats:
        scatter = f", scatter {one.scatter:.3g} times their noise" if np.isfinite(one.scatter) else ""
        rows.append((f"repeats of run {one.run}", f"{len(one.repeats)} pooled{scatter}"))
    return rows


def line_words(freq_hz: Array) -> str:
    """Return number and range of lines in words."""
    return f"{len(freq_hz)} from {freq_hz[0]:.5g} to {freq_hz[-1]:.5g} Hz"


def bodies_json(result: MotionResult) -> dict[str, dict[str, Any]]:
    """Return channels, chi2, peak over noise and unobservable motions of the first bodies, by name."""
    motion = result.motion
    sd = motion.standard_deviation
    found = {}
    for number, name in enumerate(motion.bodies[:MOST_BODIES]):
        size = np.nanmax(np.abs(motion.q[:, number]), axis=(0, 1))
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = size / np.sqrt(np.nanmean(sd[:, number] ** 2, axis=(0, 1)))
        body = result.measurement.bodies[number]
        best = float(np.nanmax(np.where(np.isfinite(ratio), ratio, 0.0)))
        found[name] = {
            "channels": len(body.points),
            "chi2": float(np.nansum(motion.chi2[:, number])),
            "n_dof": int(np.sum(motion.n_dof[:, number])),
            "best_peak_over_noise": best,
            "unobservable": unseen_motions(body.arms_m, body.directions),
        }
    return found


def registration_rows(result: MotionResult) -> list[tuple[str, str]]:
    """Return how the coordinates are tied to the footplate, and how well."""
    placement, fit = result.placement, result.placement.registration
    if fit is None:
        rows = [("coordinates", f"given in frame {placement.reference}")]
    else:
        turn, shift = pose_sd(result)
        text = (
            f"{len(fit.residuals_mm)} fiducials in frame {placement.reference}, rms {1e3 * fit.rms_mm:.0f} "
            f"µm; at the footplate sd {1e3 * shift:.0f} µm, {turn:.2g}°"
        )
        rows = [("registration", text)]
    for check in result.checks:
        rows.append(
            (f"{check.body} on its surface", f"{1e3 * check.rms_mm:.0f} µm rms, p {check.p_value:.2g}")
        )
    if result.errors is not None and result.errors.shown.errors and not result.errors.calibrated:
        rows.append(("lasers agree", f"p {result.errors.shown.p_value:.2g}"))
    return rows


def pose_sd(result: MotionResult) -> tuple[float, float]:
    """Return the rms sd of the turn, degrees, and of the footplate centre, mm, by all errors of frames."""
    placement = result.placement
    spread = placement.derivative @ placement.covariance @ placement.derivative.T
    turn = float(np.rad2deg(np.sqrt(np.trace(spread[3:, 3:]) / 3.0)))
    # the footplate centre lies at R^T (0 - t) in the measurement's own frame
    moved, _ = placement.changes(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]]))
    shift = np.einsum("pi,pq,qi->", moved[:, 0], placement.covariance, moved[:, 0])
    return turn, 1e3 * float(np.sqrt(shift / 3.0))


def registration_json(result: MotionResult) -> dict[str, Any]:
    """Return pose, residuals, distances from surfaces, lasers and calibration for JSON."""
    fit, transform = result.placement.registration, result.placement.transform
    found: dict[str, Any] = {
        "footplate_from_source": transform.matrix,
        "source_frame": transform.source,
        "surface_checks": [
            {key: getattr(one, key) for key in ("body", "rms_mm", "p_value", "points")}
            for one in result.checks
        ],
    }
    if fit is not None:
        turn, shift = pose_sd(result)
        known = {key: getattr(fit, key) for key in ("names", "residuals_mm", "rms_mm", "chi2", "n_dof")}
        found["registration"] = {**known, "footplate_centre_sd_mm": shift, "turn_sd_deg": turn}
    if result.errors is not None:
        keys = ("name", "value", "sd", "stated_sd", "unit")
        name = "calibration" if result.errors.calibrated else "lasers"
        found[name] = [dict(zip(keys, row, strict=True)) for row in result.errors.shown.rows()]
    return found


def motion_rows(result: MotionResult) -> list[tuple[object, ...]]:
    """Return amplitude, noise and shared errors of every degree of freedom of every body, rms over lines."""
    motion = result.motion
    shared = shared_sd(result)
    rows: list[tuple[object, ...]] = []
    for number, name in enumerate(motion.bodies[:MOST_BODIES]):
        for place, dof in enumerate(motion.dof):
            factor, unit = dof_unit(dof, motion.reference)
            size, noise = (
                float(np.sqrt(np.nanmean(np.abs(values[:, number, :, place]) ** 2)))
                for values in (motion.q, motion.standard_deviation)
            )
            whole = float(np.sqrt(np.sum([part[number, place] ** 2 for part in shared.values()])))
            worst = max(shared, key=lambda source: shared[source][number, place], default="")
            cells = (factor * size, factor * noise, factor * whole)
            rows.append((name, dof, *(f"{cell:.3g}" for cell in cells), unit, worst if whole else ""))
    return rows


def shared_sd(result: MotionResult) -> dict[str, Array]:
    """Return what each source of shared errors adds, rms over lines (body, dof), SI."""
    shared = result.motion.shared
    if shared is None:
        return {}
    sources = [name.partition(".")[0] for name in shared.names]
    found = {}
    for source in dict.fromkeys(sources):
        own = np.flatnonzero([one == source for one in sources])
        slopes = np.nan_to_num(shared.derivatives[own])
        variance = np.einsum(
            "prbld,pq,qrbld->bd", slopes.conj(), shared.covariance[np.ix_(own, own)], slopes, optimize=True
        ).real
        count = slopes.shape[1] * slopes.shape[3]
        found[source] = np.sqrt(np.maximum(variance, 0.0) / count)
    return found
