"""The result of a measurement of mass in a few rows, for terminal and notebook."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from legacy.ct_inertia.ct2mass import MassMeasurement
from legacy.stapeskit.page.quantities import FIRST_MOMENT, INERTIA, LENGTH, MASS, VOLUME, ShownUnit


def measured_rows(result: MassMeasurement) -> list[tuple[str, str]]:
    """Return mass, centre, entries of the mass matrix, footplate and frames with their uncertainty."""
    body, footplate, matrix = result.body, result.footplate, result.matrix
    deviation = matrix.standard_deviation
    pose = np.sqrt(np.diag(footplate.covariance))

    centre_m = matrix.parameters[1:4] / matrix.parameters[0]
    stated = result.options.mass_known_by in matrix.contributions

    def entry(row: int, column: int, unit: ShownUnit) -> str:
        value, sd = float(matrix.matrix[row, column]), float(deviation[row, column])
        return unit.with_sd(value, sd) if stated else unit.text(value, ".5g")

    rows: list[tuple[str, str]] = [
        ("volume", f"{VOLUME.text(body.volume_m3, '.4f')} at {body.density_kg_m3:.0f} kg/m³"),
        ("mass", entry(0, 0, MASS)),
        ("centre of mass (footplate)", _vector(LENGTH.of(centre_m), LENGTH.symbol)),
        ("M(alpha)", entry(3, 3, INERTIA)),
        ("M(gamma)", entry(5, 5, INERTIA)),
        ("M(y, alpha)", entry(1, 3, FIRST_MOMENT)),
        ("M(y, gamma)", entry(1, 5, FIRST_MOMENT)),
        *([] if stated else [("sd of mass and M", _without(result))]),
        (
            "footplate",
            f"{footplate.length_mm:.2f} × {footplate.width_mm:.2f} mm; height {footplate.height_mm:.2f} mm",
        ),
        ("footplate centre (scan)", _vector(footplate.scan_from_footplate.translation_mm, "mm")),
        (
            "frame sd",
            f"{1e6 * np.max(pose[:3]):.1f} µm, {np.degrees(np.max(pose[3:])):.2f}°; "
            f"x by {footplate.anterior_from}",
        ),
    ]
    if result.plate_frame is not None:
        rows.append(("plate frame (scan)", _vector(result.plate_frame.scan_from_plate.translation_mm, "mm")))
    return rows


def _without(result: MassMeasurement) -> str:
    """Return why mass and M have no standard deviation, and what the rest of the budget is."""
    way, matrix = result.options.mass_known_by, result.matrix
    share = matrix.standard_deviation[0, 0] / matrix.matrix[0, 0]
    return f"not known: none was given of the {way} (volume alone: {100.0 * share:.2g} %)"


def summary_rows(result: MassMeasurement, content: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the measured values, the other ways to the mass, and what a surface for show would change.

    Parameters
    ----------
    result : MassMeasurement
    content : mapping
        Of mass.json.
    """
    rows = measured_rows(result)
    for way in content["mass_alternatives"]:
        worst = max(abs(value) for row in way["matrix_change_percent"] for value in row)
        shift = float(np.linalg.norm(way["center_of_mass_change_m"])) * 1e6
        rows.append(
            (
                f"by {way['by']} instead",
                f"{MASS.text(way['mass_kg'], '.5g')} ({way['mass_change_percent']:+.2f} %) at "
                f"{way['density_kg_m3']:.0f} kg/m³; centre {shift:.1f} µm off; M within {worst:.2f} %",
            )
        )
    for step in content.get("display_mesh", {}).get("steps", []):
        shift = float(np.linalg.norm(step["center_of_mass_change_mm"])) * 1e3
        rows.append(
            (
                f"display: {step['step']} {step['asked']}",
                f"{step['faces']} faces; would change the mass by {step['mass_change_percent']:+.3f} %, "
                f"its centre by {shift:.2f} µm, M by {step['mass_matrix_change_percent']:.3f} %",
            )
        )
    return rows


def _vector(values: Any, unit: str) -> str:
    return ", ".join(f"{value:.4f}" for value in values) + f" {unit}"
