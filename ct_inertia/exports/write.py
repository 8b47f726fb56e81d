"""Every file that a measurement of mass writes, and which of them a run may write."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stapeskit.faults import StapeskitError
from stapeskit.outputs import Outputs
from stapeskit.spatial import DOF_NAMES, PARAMETER_NAMES, central_tensor

if TYPE_CHECKING:
    from ct_inertia.options import MassOptions
    from ct_inertia.results import MassResult

LABELS, MEASURED_LABELS = "labels.seg.nrrd", "labels.measured.seg.nrrd"
CROP, REPORT = "scan_crop.nrrd", "report.html"
_CROP_MARGIN_MM = 0.5  # around the stapes: annulus, face of the plate and tip of the incus are in the picture
_CROP_PLANES = 8  # read and written at a time


def outputs_of(
    options: MassOptions,
    folder: Path,
    *,
    report: bool = True,
    exports: Sequence[str] = (),
    force: bool = False,
) -> tuple[Outputs, str]:
    """Return the files that a run may write, and the name of its labels: those given are never written over.

    ``exports`` are formats of `EXPORTS`; ``force`` replaces files that the command is not known to have made.
    """
    folder = Path(folder)
    kept = folder / LABELS
    corrected = options.labels is not None and kept.exists() and os.path.samefile(kept, options.labels)
    labels = MEASURED_LABELS if corrected else LABELS
    names = ["mass.json", "stapes.ply", "plate.ply", labels, CROP]
    names += [REPORT] if report else []
    names += [EXPORTS[name][0] for name in exports]
    return Outputs("ct2mass", folder, names, [*options.inputs.values()], force), labels


def write_files(
    result: MassResult,
    stage: Path,
    *,
    report: bool = True,
    labels_name: str = LABELS,
    exports: Sequence[str] = (),
) -> tuple[str, ...]:
    """Write every file of a result into an empty folder and return their names, as in `outputs_of`."""
    content = result.content()
    names, files = ["mass.json", "stapes.ply"], [EXPORTS[name] for name in dict.fromkeys(exports)]
    if needs_crop(result) and "crop" not in exports:
        files.append(EXPORTS["crop"])
    with ThreadPoolExecutor(2) as pool:  # labels of a large scan are packed while the rest is written
        packed = []
        if result.body is not None and result.scan is not None:
            from ct_inertia.exports.labels import write_labels

            packed.append(pool.submit(write_labels, stage / labels_name, result.body.labelled, result.scan))
            content = {**content, "labels_file": labels_name}
        packed += [pool.submit(write, result, stage / file) for file, write in files]
        (stage / "mass.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        result.stapes.write(stage / "stapes.ply")
        if result.plate is not None:
            names.append("plate.ply")
            result.plate.write(stage / "plate.ply")
        names += [file for file, _ in files]
        if report:
            from ct_inertia.report.sections import mass_page

            mass_page(content, result.pictured).write(stage / REPORT)
            names.append(REPORT)
        for one in packed:
            one.result()
    if "labels_file" in content:
        names.append(labels_name)
    return tuple(names)


def needs_crop(result: MassResult) -> bool:
    """Return whether other programs would not place the scan where its scan coordinates are."""
    options, scan = result.options, result.scan
    if scan is None or options.file is None:
        return False
    return options.spacing_mm is not None or options.mirror is not None or not scan.carries_place


def _write_crop(result: MassResult, path: Path) -> None:
    """Write the voxels around the stapes as NRRD."""
    from ct_inertia.exports.labels import write_crop

    scan = result.scan
    if scan is None:
        raise StapeskitError.of("--export crop", "asked of a scan", "a mesh")
    index = scan.index_points(result.stapes.vertices_mm)
    margin = np.ceil(_CROP_MARGIN_MM / scan.spacing_mm)
    low = np.clip(np.floor(index.min(axis=0) - margin), 0, scan.size - 1).astype(int)
    high = np.clip(np.ceil(index.max(axis=0) + margin) + 1, 1, scan.size).astype(int)
    x, y, z = (slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    transform = scan.scan_from_index.copy()
    transform[:3, 3] = scan.scan_points(low)
    slabs = (slab for _, slab in scan.slabs(_CROP_PLANES, (z, y, x)))
    write_crop(path, slabs, [int(n) for n in (high - low)[::-1]], scan.dtype, transform)


def _write_mesh(result: MassResult, path: Path) -> None:
    result.stapes.write(path)


def _write_mat(result: MassResult, path: Path) -> None:
    """Write mass.mat (version 5) for MATLAB and Octave: SI units, matrices with standard deviations."""
    from scipy.io import savemat

    matrix, plate = result.matrix, result.record.plate_mass_matrix
    sd = matrix.standard_deviation if result.lead.stated else np.full((6, 6), np.nan)
    frames: dict[str, Any] = {"scan_from_footplate": result.footplate.scan_from_footplate.matrix}
    content: dict[str, Any] = {
        "M": matrix.matrix,
        "M_sd": sd,
        "J": central_tensor(matrix.parameters)[1],
        "c": (matrix.parameters[1:4] / matrix.parameters[0])[:, None],
        "mass_kg": float(matrix.parameters[0]),
        "parameters": matrix.parameters[:, None],
        "parameters_covariance": matrix.covariance,
        "dof": np.array(DOF_NAMES, dtype=object)[:, None],
        "parameter_names": np.array(PARAMETER_NAMES, dtype=object)[:, None],
        "density_kg_m3": result.lead.body.density_kg_m3,
        "volume_m3": result.lead.body.volume_m3,
        "units": {
            "M": "6x6 about the footplate centre in footplate axes: kg, kg m, kg m2",
            "J": "3x3 about the centre of mass in footplate axes: kg m2; J(1,2) = -integral of x y dm",
            "c": "centre of mass from the footplate centre, footplate axes: m",
            "frames": "a_from_b maps b-coordinates to a-coordinates; translation in mm",
        },
    }
    if plate is not None and result.record.scan_from_plate is not None:
        frames["scan_from_plate"] = result.record.scan_from_plate.matrix
        content |= {"M_plate_axes": plate.matrix, "M_plate_axes_sd": plate.standard_deviation}
    savemat(path, {**content, "frames": frames}, long_field_names=True)


EXPORTS: dict[str, tuple[str, Callable[[Any, Path], None]]] = {
    "stl": ("stapes.stl", _write_mesh),
    "obj": ("stapes.obj", _write_mesh),
    "glb": ("stapes.glb", _write_mesh),
    "mat": ("mass.mat", _write_mat),
    "crop": (CROP, _write_crop),
}
"""File name and writer of every format of ``--export``."""
