"""The content of ``mass.json``, and the same for the steps that follow without a file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ct_inertia.frames.anatomy import Z_IS
from ct_inertia.mass.properties import point_masses
from ct_inertia.mass.sizes import comparisons, measured_sizes
from stapeskit.arrays import Array
from stapeskit.provenance import document_hash, record
from stapeskit.records.mass_file import mass_json, mass_record
from stapeskit.records.mass_matrix import MassMatrix
from stapeskit.spatial import parameter_basis

if TYPE_CHECKING:
    from ct_inertia.results import MassResult
    from stapeskit.records.mass_record import MassRecord

_OUTLINE_POINTS = 160  # of the footplate's outline in the file, up to twice as many: less than 0.05 mm apart

_NOT_INCLUDED = {
    "density": "density not included",
    "mass": "measured mass not included",
    "calibration": "calibration not included",
}


def mass_content(result: MassResult) -> dict[str, Any]:
    """Return the content of ``mass.json``: checked by its reader."""
    body = result.lead.body
    sizes = measured_sizes(body.volume_m3, body.density_kg_m3, result.footplate)
    further = {
        "frames": _frames(result),
        "uncertainty": {**budget(result.matrix), "not_included": _not_included(result)},
        "mass_known_by": result.lead.way,
        "mass_alternatives": [way.as_json(result.matrix) for way in result.ways[1:]],
        "found": _found(result),
        "published": comparisons(sizes),
        "segmentation": _segmentation(result),
    }
    provenance = record(result.inputs, result.options.given())
    return mass_json(result.record, provenance, further)


def mass_record_of(result: MassResult) -> MassRecord:
    """Return mass, frames and surfaces of a result for the rooms that use a mass.json."""
    content = result.content()
    text = json.dumps(content, indent=1) + "\n"
    import hashlib

    source = {
        "file": "mass.json in memory",
        "size_bytes": len(text.encode()),
        "modified": content["provenance"]["date"],
        "hash": f"sha256:{hashlib.sha256(text.encode()).hexdigest()}",
        "document_hash": document_hash(content),
    }
    surfaces = {"stapes": result.stapes, "plate": result.plate}
    meshes = {name: (one.vertices_mm, one.faces) for name, one in surfaces.items() if one is not None}
    return replace(mass_record(content), meshes=meshes, source=source)


def budget(matrix: MassMatrix) -> dict[str, dict[str, Any]]:
    """Return the standard deviations that each source adds, and the total.

    Returns
    -------
    dict
        By source and for ``total``: ``mass_kg``, ``center_of_mass_m`` (3, axes of the matrix),
        ``mass_matrix_diagonal_si`` (6; kg and kg m2).
    """
    parts = {**matrix.contributions, "total": matrix.covariance}
    return {name: _budget_row(matrix, np.asarray(part)) for name, part in parts.items()}


def _budget_row(matrix: MassMatrix, covariance: Array) -> dict[str, Any]:
    mass, first = matrix.parameters[0], matrix.parameters[1:4]
    linear = np.zeros((3, 10))
    linear[:, 0] = -first / mass**2
    linear[:, 1:4] = np.eye(3) / mass
    basis = parameter_basis()[:, range(6), range(6)]
    variance = np.einsum("ai,ab,bi->i", basis, covariance, basis)
    return {
        "mass_kg": _root(covariance[:1, 0])[0],
        "center_of_mass_m": _root(np.diag(linear @ covariance @ linear.T)),
        "mass_matrix_diagonal_si": _root(variance),
    }


def _root(values: Array) -> list[float]:
    return [float(value) for value in np.sqrt(np.maximum(values, 0.0))]


def _not_included(result: MassResult) -> list[str]:
    """List what the budget does not hold: values without an uncertainty, a cut-off part, assumptions."""
    codes = {notice.code for notice in result.notices}
    found = [] if result.lead.stated else [_NOT_INCLUDED[result.lead.way]]
    if "voxel_size" not in result.matrix.contributions:
        found.append(
            "voxel size not included (scanners are off by 0.1 to 0.5 %, doi:10.1371/journal.pone.0332263; "
            "inertia by 5 times that)"
        )
    if "bare_bone_assumed" in codes:
        found.append("bare bone assumed: soft coat not included")
    if "touches_border" in codes:
        found.append("cut part beyond a rounded end not included")
    return found


def _frames(result: MassResult) -> dict[str, Any]:
    side, plate = result.options.side, result.plate_frame
    anterior, other = result.anterior
    return {
        "anterior_from": result.footplate.anterior_from,
        "anterior_in_words": anterior,
        "other_choice": other,
        "array_directions_in_scan": result.grid_directions,
        "side": side,
        "z_is": Z_IS.get(side or "", "unknown"),
        "plate_from": None if plate is None else plate.source,
        "plate_cropped": None if plate is None else plate.cropped,
        "footplate_contributions_si": dict(result.footplate.contributions),
    }


def _found(result: MassResult) -> dict[str, Any]:
    """Return what an anatomist compares: dimensions, and the outline of the footplate."""
    footplate, gap, plate = result.footplate, result.gap, result.plate_frame
    outline = footplate.outline_mm[:: max(1, len(footplate.outline_mm) // _OUTLINE_POINTS)]
    return {
        "height_mm": footplate.height_mm,
        "footplate_length_mm": footplate.length_mm,
        "footplate_width_mm": footplate.width_mm,
        "footplate_area_mm2": footplate.face_area_mm2,
        "footplate_flatness_rms_mm": footplate.face_rms_mm,
        "gap_mm": None if gap is None else gap.median_mm,
        "gap_sd_mm": None if gap is None else gap.sd_mm,
        "gap_harmonic_mm": None if gap is None else gap.harmonic_mm,
        "gap_spread_mm": None if gap is None else gap.spread_mm,
        "gap_rim_share": None if gap is None else gap.rim_share,
        "surface_area_mm2": result.stapes.area_mm2,
        "holes": result.stapes.holes,
        "footplate_outline_in_footplate_mm": np.round(outline, 5),
        "plate_outline_in_scan_mm": None if plate is None else np.round(plate.outline_mm, 5),
        "added_masses": [
            {"position_mm": mass.position_mm, "mass_kg": mass.mass_kg, "sd_kg": mass.sd_kg}
            for mass in point_masses(result.options.add_mass)
        ],
    }


def _segmentation(result: MassResult) -> Mapping[str, Any] | None:
    body, scan = result.body, result.scan
    if body is None or scan is None:
        return None
    labelled, scene = body.labelled, body.scene
    levels = None
    if scene is not None:
        levels = {
            "air": scene.air,
            "bone": scene.bone,
            "plastic": labelled.plastic,
            "noise": scene.noise,
            "air_sd": scene.air_sd,
            "bone_sd": scene.bone_sd,
            "bone_from": scene.bone_from,
        }
    return {
        "levels": levels,
        "psf_sigma_mm": None if scene is None else scene.sigma_mm,
        "voxel_size_mm": scan.spacing_mm,
        "size_voxels": [int(count) for count in scan.size],
        "separation": labelled.separation,
        "media": {} if scene is None else dict(scene.media),
        "measured": dict(body.evidence),
    }
