"""The uncertainty of the mass matrix in a form that a person can read: one row per source."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from legacy.ct_inertia.mass.voxel_scale import SCANNER_WORDS
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.records.mass_record import MassMatrix
from legacy.stapeskit.spatial import parameter_basis


def budget(matrix: MassMatrix) -> dict[str, dict[str, Any]]:
    """Return the standard deviations that each source adds, and the total.

    Returns
    -------
    dict
        By source and for ``total``: ``mass_kg``, ``center_of_mass_m`` (3, axes of the matrix),
        ``mass_matrix_diagonal_si`` (6; kg and kg m2).
    """
    parts: dict[str, Array] = {name: np.asarray(part) for name, part in matrix.contributions.items()}
    rows = {name: _row(matrix, part) for name, part in parts.items()}
    rows["total"] = _row(matrix, matrix.covariance)
    return rows


def _row(matrix: MassMatrix, covariance: Array) -> dict[str, Any]:
    mass, first = matrix.parameters[0], matrix.parameters[1:4]
    linear = np.zeros((3, 10))
    linear[:, 0] = -first / mass**2
    linear[:, 1:4] = np.eye(3) / mass
    basis = parameter_basis()[:, range(6), range(6)]
    variance = np.einsum("ai,ab,bi->i", basis, covariance, basis)
    return {
        "mass_kg": float(np.sqrt(max(covariance[0, 0], 0.0))),
        "center_of_mass_m": _root(np.diag(linear @ covariance @ linear.T)),
        "mass_matrix_diagonal_si": _root(variance),
    }


def _root(values: Array) -> list[float]:
    return [float(value) for value in np.sqrt(np.maximum(values, 0.0))]


_MASS_SOURCES = {
    "density": "density not included",
    "mass": "measured mass not included",
    "calibration": "calibration not included",
}


def mass_sd_missing(content: Mapping[str, Any]) -> str:
    """Return what the leading way to the mass lacks, by the content of mass.json; empty when it has an sd.

    A mass without it is not shown with the standard deviation of the rest of the budget.
    """
    missing = set(content["uncertainty"].get("not_included", ()))
    without_sd = [way for way, words in _MASS_SOURCES.items() if words in missing]
    return f"the {without_sd[0]} has no standard deviation" if without_sd else ""


def not_included(
    contributions: Mapping[str, Any],
    mass_known_by: str,
    cut: bool = False,
    bare: bool = False,
    linear: bool = False,
) -> list[str]:
    """List what the budget does not hold: values without an uncertainty, a cut-off part, assumptions."""
    missing = []
    if mass_known_by not in contributions:
        missing.append(_MASS_SOURCES[mass_known_by])
    if "voxel_size" not in contributions:
        missing.append(f"voxel size not included ({SCANNER_WORDS})")
    if bare:
        missing.append("bare bone assumed: soft coat not included")
    if linear and "grey_scale" not in contributions:
        missing.append("linear grey scale assumed: tone curve or gamma of the export not included")
    if cut:
        missing.append("cut part not included")
    return missing
