"""The content of ``mass.json``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.exports.output_files import LABELS
from legacy.ct_inertia.grey.scan_border import CODE as CUT_BY_BORDER
from legacy.ct_inertia.grey.soft_coat import BARE
from legacy.ct_inertia.mass.budget import budget, not_included
from legacy.ct_inertia.mass.mass_properties import point_masses
from legacy.ct_inertia.mass.published_sizes import comparisons, measured_values
from legacy.ct_inertia.native import which
from legacy.ct_inertia.surface.surface import Surface
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import RigidTransform
from legacy.stapeskit.options import declared, plain
from legacy.stapeskit.provenance import Hashes, record
from legacy.stapeskit.records.mass_record import SCHEMA, MassMatrix
from legacy.stapeskit.spatial import DOF_NAMES, PARAMETER_NAMES, dof_indices

if TYPE_CHECKING:
    from legacy.ct_inertia.ct2mass import MassMeasurement
    from legacy.ct_inertia.frames.window_gap import WindowGap
    from legacy.ct_inertia.options import MassOptions


REDUCED = ("y", "alpha", "gamma")
_CONVENTION = {
    "footplate": "displacement of the footplate frame in its own axes, m and rad",
    "plate": "displacement of the plate frame in its own axes, m and rad",
}
# Points to which the footplate's outline is thinned, up to twice as many: less than 0.05 mm apart.
_OUTLINE_POINTS = 160


def mass_json(
    result: MassMeasurement,
    sha256: bool = False,
    hashes: Hashes | None = None,
    second: bool = True,
    labels_file: str = LABELS,
) -> dict[str, Any]:
    """Return the content of ``mass.json``.

    Parameters
    ----------
    result : MassMeasurement
    sha256 : bool
        Hash the inputs with SHA-256 instead of the faster default.
    hashes : Hashes, optional
        Of the inputs, when they were begun before.
    second : bool
        Ask another program (pymeshlab) for the moments of the surface.
    labels_file : str
        Under which name the labels are written beside it; see `output_files.labels_name`.
    """
    body, matrix = result.body, result.matrix
    deviation = matrix.standard_deviation
    places = dof_indices(REDUCED)
    reduced = np.ix_(places, places)
    inputs, parameters = result.options.inputs, _parameters(result.options)
    provenance = record(inputs, parameters, calibrated.version(), sha256=sha256, hashes=hashes)
    provenance["kernels"] = which()
    content = {
        "schema": SCHEMA,
        "density_kg_m3": body.density_kg_m3,
        "volume_m3": body.volume_m3,
        "mass_kg": body.mass_kg,
        "center_of_mass_in_scan_mm": body.com_mm.tolist(),
        "inertia_about_center_of_mass_in_scan_axes_kg_m2": body.inertia_about_com.tolist(),
        "frames": _frames(result),
        "inertial_parameters": {
            "names": list(PARAMETER_NAMES),
            "about": matrix.about,
            "axes": matrix.axes,
            "values_si": matrix.parameters.tolist(),
            "covariance_si": matrix.covariance.tolist(),
            "contributions_si": {name: part.tolist() for name, part in matrix.contributions.items()},
        },
        "mass_matrix": _matrix_block(matrix),
        "mass_matrix_plate_axes": None if result.plate_matrix is None else _matrix_block(result.plate_matrix),
        "mass_matrix_reduced": {
            "about": matrix.about,
            "axes": matrix.axes,
            "dof": list(REDUCED),
            "matrix_si": matrix.matrix[reduced].tolist(),
            "standard_deviation_si": deviation[reduced].tolist(),
        },
        "uncertainty": {
            **budget(matrix),
            "not_included": not_included(
                matrix.contributions,
                result.options.mass_known_by,
                cut=any(notice.code == CUT_BY_BORDER for notice in result.notices),
                bare=any(notice.code == BARE for notice in result.notices),
                linear=result.bodies is not None and result.bodies.levels is not None,
            ),
        },
        "mass_known_by": result.options.mass_known_by,
        "mass_alternatives": [way.as_json(matrix) for way in result.ways[1:]],
        "found": _anatomy(result),
        "published": comparisons(measured_values(body.volume_m3, body.density_kg_m3, result.footplate)),
        "cross_check": _cross_check(result, second),
        "segmentation": _segmentation(result),
        "labels_file": None if result.bodies is None else labels_file,
        "warnings": [notice.as_json() for notice in result.notices],
        "provenance": provenance,
    }
    plain: dict[str, Any] = _finite(content)
    return plain


def _matrix_block(matrix: MassMatrix) -> dict[str, Any]:
    return {
        "about": matrix.about,
        "axes": matrix.axes,
        "dof": list(DOF_NAMES),
        "matrix_si": (matrix.matrix + 0.0).tolist(),
        "standard_deviation_si": matrix.standard_deviation.tolist(),
    }


def _frames(result: MassMeasurement) -> dict[str, Any]:
    footplate = result.footplate.scan_from_footplate
    plate: RigidTransform | None = None
    covariance: dict[str, Any] = {
        "scan_from_footplate": _pose(result.footplate.covariance, "footplate"),
        "scan_from_plate": None,
    }
    if result.plate_frame is not None:
        plate = result.plate_frame.scan_from_plate
        covariance["scan_from_plate"] = _pose(result.plate_frame.covariance, "plate")
    return {
        "scan_from_footplate": footplate.matrix.tolist(),
        "scan_from_plate": None if plate is None else plate.matrix.tolist(),
        "plate_from_footplate": None if plate is None else (plate.inverse() @ footplate).matrix.tolist(),
        "pose_covariance": covariance,
        "anterior_from": result.footplate.anterior_from,
        "side": result.options.side,
        "z_is": {"left": "superior", "right": "inferior"}.get(result.options.side or "", "unknown"),
        "plate_from": None if result.plate_frame is None else result.plate_frame.source,
        "plate_cropped": None if result.plate_frame is None else result.plate_frame.cropped,
    }


def _pose(covariance: Array, frame: str) -> dict[str, Any]:
    return {
        "names": list(DOF_NAMES),
        "convention": _CONVENTION[frame],
        "matrix_si": np.asarray(covariance).tolist(),
    }


def _anatomy(result: MassMeasurement) -> dict[str, Any]:
    """Return what an anatomist compares: dimensions, and the outline of the footplate."""
    footplate = result.footplate
    outline = footplate.outline_mm
    step = max(1, len(outline) // _OUTLINE_POINTS)
    plate = result.plate_frame
    return {
        "height_mm": footplate.height_mm,
        "footplate_length_mm": footplate.length_mm,
        "footplate_width_mm": footplate.width_mm,
        "footplate_area_mm2": footplate.face_area_mm2,
        "footplate_flatness_rms_mm": footplate.face_rms_mm,
        **_gap(result.gap),
        "surface_area_mm2": result.stapes.area_mm2,
        "holes": _holes(result.stapes),
        "footplate_outline_in_footplate_mm": np.round(outline[::step], 5).tolist(),
        "plate_outline_in_scan_mm": None if plate is None else np.round(plate.outline_mm, 5).tolist(),
        "added_masses": [
            {"position_mm": mass.position_mm.tolist(), "mass_kg": mass.mass_kg, "sd_kg": mass.sd_kg}
            for mass in point_masses(result.options.add_mass)
        ],
    }


def _gap(gap: WindowGap | None) -> dict[str, float | None]:
    """Return the gap around the footplate; null where the scan does not show it."""
    return {
        "gap_mm": None if gap is None else gap.median_mm,
        "gap_sd_mm": None if gap is None else gap.sd_mm,
        "gap_harmonic_mm": None if gap is None else gap.harmonic_mm,
        "gap_spread_mm": None if gap is None else gap.spread_mm,
        "gap_rim_share": None if gap is None else gap.rim_share,
    }


def _holes(surface: Surface) -> int:
    """Return the genus of a surface of one piece: 1 for a stapes."""
    return (2 - surface.euler_characteristic) // 2


def _cross_check(result: MassMeasurement, second: bool) -> dict[str, Any]:
    """Compare the moments used with those of the surface written, and of one at the half grey level."""
    used, mesh = result.moments, result.mesh_moments
    opinion = None
    if second:
        from legacy.ct_inertia.surface.meshlab_check import second_opinion

        opinion = second_opinion(result.stapes)
    root = np.sqrt(np.diag(result.matrix.matrix))
    difference = (result.mesh_matrix.matrix - result.matrix.matrix) / np.outer(root, root)
    return {
        "used": "surface" if result.bodies is None or used is mesh else "partial volume",
        "other": "surface",
        "volume_m3": mesh.volume_mm3 * 1e-9,
        "volume_difference_percent": 100.0 * (mesh.volume_mm3 / used.volume_mm3 - 1.0),
        "centroid_difference_mm": (mesh.centroid_mm - used.centroid_mm).tolist(),
        "mass_matrix_difference_percent": (100.0 * difference).tolist(),
        "mass_matrix_difference_of": "sqrt(Mii Mjj)",
        "half_level": _half_level(result),
        "surface_by_pymeshlab": None if opinion is None else asdict(opinion),
    }


def _half_level(result: MassMeasurement) -> dict[str, Any] | None:
    """Compare with the surface half way between air and bone, which no moment has shaped."""
    if result.bodies is None or result.bodies.levels is None:
        return None
    used, half = result.moments, result.bodies.frame_surface.moments()
    return {
        "volume_difference_percent": 100.0 * (half.volume_mm3 / used.volume_mm3 - 1.0),
        "centroid_difference_mm": (half.centroid_mm - used.centroid_mm).tolist(),
    }


def _segmentation(result: MassMeasurement) -> dict[str, Any] | None:
    bodies = result.bodies
    if bodies is None:
        return None
    return {
        "levels": None if bodies.levels is None else asdict(bodies.levels),
        "psf_sigma_mm": bodies.psf_sigma_mm,
        "voxel_size_mm": bodies.volume.spacing_mm.tolist(),
        "size_voxels": [int(count) for count in bodies.volume.size],
        "evidence": dict(bodies.evidence),
    }


def _parameters(options: MassOptions) -> dict[str, Any]:
    """Return every option that was given, as JSON."""
    given = {option.key: getattr(options, option.field) for option in declared(type(options))}
    return {
        key: value.name if isinstance(value, Path) else plain(value)
        for key, value in given.items()
        if value not in (None, False, ())
    }


def _finite(value: Any) -> Any:
    """Return JSON-able content: arrays as lists, numbers that are not finite as null."""
    if isinstance(value, Mapping):
        return {str(key): _finite(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray):
        return _finite(value.tolist())
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    if isinstance(value, np.generic):
        return _finite(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
