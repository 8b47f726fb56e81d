"""MATLAB: mass.mat (version 5), SI units, every matrix with its standard deviation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from legacy.ct_inertia.exports.body import ExportBody
from legacy.stapeskit.spatial import DOF_NAMES, PARAMETER_NAMES

UNITS = {"length": "m (frames: mm)", "mass": "kg", "inertia": "kg m2", "coordinates": "footplate"}
_DESCRIPTIONS = {
    "M": "6x6 about the footplate centre in footplate axes: kg, kg m, kg m2",
    "J": "3x3 about the centre of mass in footplate axes: kg m2; J(1,2) = -integral of x y dm",
    "c": "centre of mass from the footplate centre, footplate axes: m",
    "parameters": "m, m c, J about the footplate centre: kg, kg m, kg m2",
    "frames": "a_from_b maps b-coordinates to a-coordinates; translation in mm",
}


def write(body: ExportBody, folder: Path) -> list[str]:
    """Write mass.mat; return its name."""
    from scipy.io import savemat

    matrix = body.matrix
    frames: dict[str, Any] = {"scan_from_footplate": body.scan_from_footplate.matrix}
    content: dict[str, Any] = {
        "M": matrix.matrix,
        "M_sd": matrix.standard_deviation,
        "J": body.inertia_kg_m2,
        "c": body.com_m[:, None],
        "mass_kg": body.mass_kg,
        "parameters": matrix.parameters[:, None],
        "parameters_covariance": matrix.covariance,
        "dof": _names(DOF_NAMES),
        "parameter_names": _names(PARAMETER_NAMES),
        "density_kg_m3": body.density_kg_m3,
        "volume_m3": body.volume_m3,
        "source": body.source,
        "units": _DESCRIPTIONS,
    }
    if body.scan_from_plate is not None:
        frames["scan_from_plate"] = body.scan_from_plate.matrix
        frames["plate_from_footplate"] = (body.scan_from_plate.inverse() @ body.scan_from_footplate).matrix
    if body.plate_matrix is not None:
        content["M_plate_axes"] = body.plate_matrix.matrix
        content["M_plate_axes_sd"] = body.plate_matrix.standard_deviation
    content["frames"] = frames
    savemat(folder / "mass.mat", content, long_field_names=True)
    return ["mass.mat"]


def _names(names: tuple[str, ...]) -> np.ndarray[Any, Any]:
    """Return names as a cell array (n, 1)."""
    return np.array(names, dtype=object)[:, None]
