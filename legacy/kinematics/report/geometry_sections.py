"""Report: positions of points and beams, motions that they cannot observe, registration of the frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from legacy.kinematics.report.draw_geometry import faulty_channels, placement_figure
from legacy.kinematics.report.stapes_surface import Scenery
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.page import page
from legacy.stapeskit.page.page import Section

if TYPE_CHECKING:
    from legacy.kinematics.points2dof import Points2Dof
    from legacy.stapeskit.alignment.registration import Registration

# Channels up to which the figure is SVG.
_LIGHT = 150


def points_section(result: Points2Dof, scenery: Scenery) -> Section:
    """Return the figure of points and beams, and what the beams of each body can observe."""
    section = Section("Points and beams", key="points_and_beams")
    bodies = result.measurement.bodies
    channels = sum(len(body.points) for body in bodies)
    wrong = len(faulty_channels(result))
    where = "on the surface of the stapes" if scenery.has_surface else "in the footplate frame"
    surface = (
        " Hollow: behind the bone from there. Dashed: outline of the medial face of the footplate."
        if scenery.has_surface
        else " No surface of the stapes was given."
    )
    section.add(
        page.figure(
            placement_figure(result, scenery),
            f"Measurement points and beams (arrows towards the laser head) {where}; circle and black arrows: "
            f"footplate centre and axes.{surface}" + (" Red: channels with a verdict." if wrong else ""),
            f"{channels} beams of {', '.join(body.body for body in bodies)} seen from three sides, "
            f"{wrong} of them with a verdict",
            vector=channels <= _LIGHT,
            palette=True,
        )
    )
    rows = []
    for number, body in enumerate(bodies):
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
    )
    return section


def registration_section(result: Points2Dof) -> Section:
    """Return how the fiducials fit, and what that leaves unknown at the footplate and at the points."""
    section = Section("Registration", key="registration")
    fit = result.placement.registration
    if fit is None:
        return section
    sd = np.sqrt(np.diag(fit.covariance_si))
    to_reference = fit.transform @ result.placement.transform.inverse()
    source = fit.transform.inverse()

    def error(points_mm: Array) -> Array:
        """Return the target registration error, um, at points given in the footplate frame."""
        return fit.target_registration_error(source.points(to_reference.points(points_mm))) * 1e3

    chi2 = (
        "not tested (sd estimated from the residuals)"
        if np.isnan(fit.chi2)
        else f"{fit.chi2:.3g} of {fit.n_dof}"
    )
    turn = np.rad2deg(sd[3:])
    rows = [
        (fit.kind, str(len(fit.residuals_mm))),
        ("residual, rms", f"{fit.rms_mm * 1e3:.3g} µm"),
        ("chi2", chi2),
        ("largest distance from one plane", f"{fit.flat_mm:.3g} mm"),
        ("target error at the footplate centre, rms", f"{error(np.zeros((1, 3)))[0]:.3g} µm"),
    ]
    for body in result.measurement.bodies:
        worst = float(np.max(error(body.positions_mm)))
        rows.append((f"largest target error at a point of {body.body}, rms", f"{worst:.3g} µm"))
    rows.append(("sd of the rotation about x, y, z", ", ".join(f"{value:.2g}" for value in turn) + "°"))
    if np.isnan(fit.flat_mm):
        rows = [row for row in rows if row[0] != "largest distance from one plane"]
    section.add(page.table((f"registration by {fit.kind}", f"to {fit.transform.to}"), rows))
    section.add(page.subheading(f"Residuals of the {fit.kind}"))
    section.add(
        page.table(
            ("fiducial", "x (µm)", "y (µm)", "z (µm)", "length (µm)", "sd (µm)"),
            _fiducial_rows(fit),
        )
    )
    matrix = result.placement.transform.matrix
    section.add(
        page.table(
            (f"{result.placement.transform.to}_from_{result.placement.transform.source}", "", "", "mm"),
            [[f"{value:.6f}" for value in row] for row in matrix],
        )
    )
    return section


def _fiducial_rows(fit: Registration) -> list[tuple[str, ...]]:
    """Return name, residual and sd of every fiducial, um."""
    rows = []
    for number, (residual, sd) in enumerate(zip(fit.residuals_mm, fit.sd_mm, strict=True)):
        size, spread = float(np.linalg.norm(residual)), float(np.max(sd))
        name = fit.names[number] if fit.names else str(number + 1)
        rows.append((name, *(f"{1e3 * value:.3g}" for value in (*residual, size, spread))))
    return rows
