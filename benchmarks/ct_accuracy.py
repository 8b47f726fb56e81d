"""Mass and mass matrix of ct2mass are truer than those of what laboratories use now, on the same scans.

Two stapedes, a real one (OpenEar) and a made one, in their windows (gap 100 um) over a plastic plate; blur
1.2 voxels, noise 4 % of the contrast between bone and air. ct2mass gets the file and nothing else. The
peers get what nobody tells them in a laboratory: the level halfway between air and bone (but for Otsu's,
which finds its own), and a scan of the stapes alone in the same pose. They have no footplate frame; their M
is about the true one. Errors are root mean squares over the poses.

    python -m benchmarks.ct_accuracy --voxel-um 40,28,20 --poses 1
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks._masses import matrix_in_frame, measure, shares
from benchmarks._table import arguments, print_table, root_mean_square
from benchmarks.peers import measures
from simulate import Ear, MassProperties, Moments, Scan, Stapes, Truth, render, simulate_truth, uniform_mass
from stapeskit.arrays import Array

STAPES = {"real stapes": "openear", "made stapes": "analytic"}
QUANTITIES = ("volume, %", "centre of mass, um", "M, worst entry, % of sqrt(Mii Mjj)")
OURS = "ct2mass"
PEERS = {
    "half level, flying edges (VTK + trimesh)": measures.vtk_flying_edges,
    "half level, voxel count": measures.voxel_count,
    "Otsu, label statistics (SimpleITK)": measures.simpleitk_otsu,
    "half level, SurfaceNets (PyVista)": measures.surface_nets,
}


def errors(body: MassProperties, matrix: Array, truth: Truth) -> Array:
    """Return the errors (3,) of a body in scan axes, in the order of QUANTITIES."""
    true = truth.mass
    off = np.linalg.norm(body.centre_of_mass_mm - truth.centre_of_mass_in_scan_mm)
    return np.array(
        [
            100.0 * (body.mass_kg / true.mass_kg - 1.0),
            1e3 * off,
            100.0 * np.max(np.abs(shares(matrix, truth.mass_matrix_si))),
        ]
    )


def of_peers(ear: Ear, scan: Scan) -> dict[str, Array]:
    """Return the errors of every peer on the scan of the stapes alone."""
    alone = replace(ear, bone=False, plate=False)
    truth = simulate_truth(alone, scan)
    grey = render(truth.placed, scan)
    spacing, (air, _, bone) = float(scan.voxel_mm[0]), scan.levels
    half, otsu = 0.5 * (air + bone), measures.otsu_level(grey)
    found = {}
    for name, way in PEERS.items():
        level = otsu if name.startswith("Otsu") else half
        volume, centre, second = way(grey, spacing, level)
        moments = Moments(volume_mm3=volume, centroid_mm=np.asarray(centre), second_mm5=np.asarray(second))
        body = uniform_mass(moments, ear.density_kg_m3)
        found[name] = errors(body, matrix_in_frame(body, truth.scan_from_footplate), truth)
    return found


def of_scan(family: str, voxel_um: float, pose: int, folder: Path) -> dict[str, Array]:
    """Return the errors of every method on one ear."""
    ear, scan = Ear(stapes=Stapes(family=family), gap_mm=0.1), Scan(voxel_um=voxel_um, seed=pose)
    ours = measure(ear, scan, folder)
    if ours.record is None:
        raise SystemExit(f"{family}, {voxel_um} um, pose {pose}: {ours.refusal}")
    return {OURS: errors(ours.body_in_scan, ours.matrix.matrix, ours.truth), **of_peers(ear, scan)}


if __name__ == "__main__":
    given = arguments(__doc__, voxel_um="40", poses=1)
    sizes = sorted(float(word) for word in given.voxel_um.split(","))
    found: dict[tuple[str, float], list[dict[str, Array]]] = {}
    with tempfile.TemporaryDirectory() as place:
        for kind, family in STAPES.items():
            for size in sizes:
                poses = range(17, 17 + given.poses)
                found[kind, size] = [of_scan(family, size, pose, Path(place)) for pose in poses]
    print("Errors, root mean squares over the poses: real stapes/made stapes.\n")
    ends = tuple(dict.fromkeys((sizes[0], sizes[-1])))
    rows = []
    for method in (OURS, *PEERS):
        cells = [method]
        for place_of in range(len(QUANTITIES)):
            for size in ends:
                errors_of = [[one[method][place_of] for one in found[kind, size]] for kind in STAPES]
                cells.append("/".join(f"{root_mean_square(values):.2g}" for values in errors_of))
        rows.append(cells)
    print_table(("method", *(f"{what}, {size:g} um" for what in QUANTITIES for size in ends)), rows)
