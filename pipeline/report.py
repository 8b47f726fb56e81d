"""report.html of a study: verdict, K, D and modes first; the moving stapes, cut, budgets; the rest folded.

Everything is drawn from results; nothing of a page is stored. Sections come from the rooms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stapeskit.report import page
from stapeskit.report.quantities import MASS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pipeline.run import StudyResult
    from stapeskit.report.scene3d import Motion, Scene


def summary_rows(result: StudyResult) -> list[tuple[str, str]]:
    """Return verdict, mass, K, D and modes with their uncertainty."""
    verdict, *rows = result.fit.summary()
    return [verdict, ("mass", _mass_text(result.mass)), *rows]


def _mass_text(mass: Mapping[str, Any]) -> str:
    sd = mass["mass_matrix"]["standard_deviation_si"][0][0]
    known = not any(notice["code"] == "density_sd_not_given" for notice in mass.get("warnings", ()))
    return MASS.with_sd(float(mass["mass_kg"]), float(sd) if known else None)


def study_page(result: StudyResult) -> page.Page:
    """Return the report of a study."""
    from ct_inertia.report.sections import add_sections, reduced_matrix
    from fitting.report.page import add_sections as add_fit
    from fitting.report.page import first_screen, responses_section
    from kinematics.report.page import motion_sections

    fit, study = result.fit, result.study
    made = page.Page(result.name, study.about.notes)
    made.add(*first_screen(fit, reduced_matrix(result.mass)))
    made.section(*responses_section(fit))
    made.section("The moving stapes", page.viewer(moving_stapes(result)))
    add_sections(made, result.mass, result.pictured)
    motion_sections(made, result.moved)
    add_fit(fit, made)
    made.section("Warnings", page.notices(result.notices, study.about.confirmed))
    inputs = (page.inputs(each) for each in _provenances(result))
    made.appendix_section("Inputs", *inputs)
    return made


def _provenances(result: StudyResult) -> Sequence[Mapping[str, Any]]:
    found = (result.mass.get("provenance"), result.moved.motion.provenance, result.fit.provenance)
    return [each for each in found if each]


def moving_stapes(result: StudyResult) -> Scene:
    """Return the stapes with its modes, and the measured motion of it and of the bone and plate around it."""
    from ct_inertia.report.sections import scene
    from kinematics.report.motion import motion_scene
    from stapeskit.report.scene3d import Motion
    from stapeskit.spatial import dof_indices

    shown, measured = scene(result.mass, result.pictured), motion_scene(result.moved)
    modes: list[Motion] = []
    for number, mode in enumerate(result.fit.modes.pairs, 1):
        amplitudes = np.zeros(6, dtype=complex)
        amplitudes[dof_indices(result.fit.dof)] = mode.shape
        modes.append(Motion(f"mode {number}: {mode.frequency_hz:.0f} Hz", amplitudes, mode.frequency_hz))
    frame = result.measured.scan_from_footplate
    points = [replace(point, position_mm=frame.points(point.position_mm)) for point in measured.points]
    beams = [replace(beam, points_mm=frame.points(beam.points_mm)) for beam in measured.lines]
    around = "base" if "base" in result.moved.motion.bodies else None
    surfaces = [one if one.name == "stapes" else replace(one, body=around) for one in shown.surfaces]
    return replace(
        shown,
        surfaces=surfaces,
        points=points,
        motions=[*modes, *measured.motions],
        lines=[*shown.lines, *beams],
        title="The moving stapes",
        caption="The stapes with the modes of the fit, and the measured motion, enlarged; colours of points "
        "are their verdicts.",
    )


def write_figures(result: StudyResult, folder: Path, force: bool = False) -> list[Path]:
    """Write every figure of the report as PDF and SVG into a folder.

    Raises
    ------
    StapeskitError
        A file of another origin has the name of a figure, unless ``force``.
    """

    from ct_inertia.report.pictures import medial_view, slices_figure
    from fitting.report.figures import all_figures
    from kinematics.report.figures import residual_figure, spectra_figure
    from stapeskit.report.figures import save_figures

    figures: dict[str, Figure | None] = {
        **all_figures(result.fit),
        "medial": medial_view(result.mass, result.pictured),
        "cut": slices_figure(result.mass, result.pictured),
        "motion": spectra_figure(result.moved.motion),
        "channel_residuals": residual_figure(result.moved),
    }
    drawn = {name: drawing for name, drawing in figures.items() if drawing is not None}
    return save_figures("scan2kd figures", drawn, folder, force)
