"""How true are mass and mass matrix? ct2mass and what labs use now, on the same simulated scans.

    python benchmarks/ct_accuracy.py             10 to 40 um, both stapes; tables and docs/ct_accuracy.png
    python benchmarks/ct_accuracy.py --voxel-um 40,28,20 --poses 1
    python benchmarks/ct_accuracy.py --plot-only errors.json

Two stapes, a real one (OpenEar) and a made one, stand in their oval windows (gap 100 um) over a plastic
plate; PSF 1.2 voxels, noise 4 % of the contrast between bone and air. ct2mass gets the file and nothing else.
The peers get what nobody tells them in a laboratory: the level halfway between air and bone (but for Otsu and
multi-Otsu, which find theirs on the whole scan), and the stapes alone, all that is nearer to another body
being replaced by air. They have no footplate frame; their M is about the true one. Errors are root mean
squares over the poses.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

GAP_MM = 0.1


def against(
    truth: dict[str, Any], volume: float, centre: Any, second: Any, frame: Any = None
) -> dict[str, float]:
    """Return the errors of a body of known density: percent, um, percent of sqrt(Mii Mjj)."""
    pose = np.array(truth["scan_from_footplate"])
    density = truth["density_kg_m3"]
    exact = np.array(truth["mass_matrix_si"])
    exact_centre = np.array(truth["center_of_mass_in_scan_mm"])
    about = pose if frame is None else frame
    matrix = _matrix(density, volume, centre, second, about)
    mass = exact[0, 0]
    arm = (pose[:3, :3].T @ (exact_centre - pose[:3, 3])) * 1e-3
    exact_trace = np.trace(exact[3:, 3:]) - 2.0 * mass * (arm @ arm)
    trace = 2.0 * np.trace(second) * density * 1e-15
    root = np.sqrt(np.diag(exact))
    return {
        "volume": 100.0 * (density * volume * 1e-9 / mass - 1.0),
        "inertia": 100.0 * (trace / exact_trace - 1.0),
        "centre": 1e3 * float(np.linalg.norm(np.asarray(centre) - exact_centre)),
        "matrix": 100.0 * float(np.abs((matrix - exact) / np.outer(root, root)).max()),
    }


def _matrix(density: float, volume: float, centre: Any, second: Any, pose: Any) -> Any:
    """Return the 6x6 mass matrix about the origin of a frame, in its axes, SI."""
    turn = np.asarray(pose)[:3, :3]
    x, y, z = turn.T @ (np.asarray(centre) - np.asarray(pose)[:3, 3]) * 1e-3
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    mass = density * volume * 1e-9
    about = turn.T @ np.asarray(second) @ turn * density * 1e-15
    inertia = np.trace(about) * np.eye(3) - about
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = mass * np.eye(3)
    matrix[:3, 3:], matrix[3:, :3] = -mass * cross, mass * cross
    matrix[3:, 3:] = inertia - mass * cross @ cross
    return matrix


def ours(path: Path, truth: dict[str, Any]) -> dict[str, float]:
    """Run ct2mass in a process of its own and return the errors of its mass.json."""
    anterior = ",".join(f"{part:.3f}" for part in np.array(truth["scan_from_footplate"])[:3, 0])
    out = path.parent / "out"
    command = [
        sys.executable,
        "-c",
        "import sys; from ct_inertia.cli import main; sys.exit(main())",
        str(path),
    ]
    command += ["--density", f"{truth['density_kg_m3']}+-0", f"--anterior={anterior}", "--no-report"]
    subprocess.run([*command, "--quiet", "--out", str(out)], check=True, cwd=ROOT)
    content = json.loads((out / "mass.json").read_text(encoding="utf-8"))
    inertia = np.array(content["inertia_about_center_of_mass_in_scan_axes_kg_m2"])
    second = (0.5 * np.trace(inertia) * np.eye(3) - inertia) * 1e15 / truth["density_kg_m3"]
    frame = np.array(content["frames"]["scan_from_footplate"])
    errors = against(truth, content["volume_m3"] * 1e9, content["center_of_mass_in_scan_mm"], second, frame)
    exact, matrix = np.array(truth["mass_matrix_si"]), np.array(content["mass_matrix"]["matrix_si"])
    root = np.sqrt(np.diag(exact))
    errors["matrix"] = 100.0 * float(np.abs((matrix - exact) / np.outer(root, root)).max())
    return errors


def handed(volume: Any, placed: Any, air: float) -> tuple[Any, Any]:
    """Return the box of the stapes with every other body replaced by air, and the box's origin in mm."""
    from dataclasses import replace

    from sample_volumes.phantom import Renderer

    spacing = np.asarray(placed.ear.voxel_mm)
    reach = np.ceil(0.3 / spacing).astype(int)
    stapes = placed.solids[0][0].vertices / spacing
    low = np.maximum(np.floor(stapes.min(axis=0)).astype(int) - reach, 0)
    high = np.minimum(np.ceil(stapes.max(axis=0)).astype(int) + reach, placed.shape)
    box = tuple(slice(a, b) for a, b in zip(low[::-1], high[::-1], strict=True))
    fields = []
    for solids in (placed.solids[:1], placed.solids[1:]):
        part = Renderer(replace(placed, solids=solids))
        fields.append(part.contrast(int(low[2]), int(high[2] - low[2]))[:, box[1], box[2]].copy())
    grey = volume[box].astype(np.float32)
    grey[fields[1] > fields[0]] = air
    return grey, low * spacing


def errors_of(stapes: Path, voxel_um: float, seed: int, folder: Path) -> dict[str, dict[str, float]]:
    """Return the errors of every method on one scan."""
    import tifffile
    from scipy.ndimage import gaussian_filter
    from skimage.filters import threshold_multiotsu

    from benchmarks.peers import measures
    from sample_volumes.phantom import Ear, scene, truth, write_scan

    spacing = voxel_um * 1e-3
    ear = Ear(voxel_mm=(spacing,) * 3, gap_mm=GAP_MM, pose_seed=seed, noise_seed=seed, stapes=stapes)
    placed = scene(ear)
    exact = truth(placed)
    path = folder / "scan.tif"
    write_scan(path, placed)
    errors = {"stapeskit": ours(path, exact)}
    volume = tifffile.imread(path).astype(np.uint16)
    grey, origin = handed(volume, placed, ear.levels[0])
    half = 0.5 * (ear.levels[0] + ear.levels[2])
    otsu = measures.otsu_level(volume)
    smooth = gaussian_filter(volume, 1.0, output=np.float32)
    classes = float(threshold_multiotsu(smooth[::2, ::2, ::2], 3)[1])
    del smooth, volume
    ways = {
        "count": (measures.voxel_count, grey, half),
        "skimage": (measures.marching_cubes, grey, half),
        "vtk": (measures.vtk_flying_edges, grey, half),
        "simpleitk": (measures.simpleitk_otsu, grey, otsu),
        "surfacenets": (measures.surface_nets, grey, half),
        "multiotsu": (measures.voxel_count, gaussian_filter(grey, 1.0), classes),
    }
    for name, (way, values, level) in ways.items():
        size, centre, second = way(values, spacing, level)
        errors[name] = against(exact, size, centre + origin, second)
    return errors


def main() -> None:
    """Measure, print the tables, draw the figure."""
    from benchmarks.peers.accuracy_plot import plot, print_tables

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--voxel-um", default="40,28,20,14,10", help="x, y and z alike")
    parser.add_argument("--poses", type=int, default=2)
    parser.add_argument("--stapes", default="openear,analytic")
    parser.add_argument("--plot-only", type=Path, help="errors written by a former run")
    parser.add_argument("--save", type=Path, help="write the errors as JSON")
    parser.add_argument("--figure", type=Path, default=ROOT / "docs" / "ct_accuracy.png")
    options = parser.parse_args()
    if options.plot_only:
        rows = json.loads(options.plot_only.read_text(encoding="utf-8"))
    else:
        rows = measured(options)
    print_tables(rows)
    plot(rows, options.figure)


def measured(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return one row for each scan and method."""
    from benchmarks.peers.accuracy_plot import METHODS
    from sample_volumes.analytic import write_analytic_stapes
    from sample_volumes.bodies import OPENEAR_STAPES

    rows = []
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for stapes in options.stapes.split(","):
            mesh = OPENEAR_STAPES if stapes == "openear" else write_analytic_stapes(folder / "made.ply")
            for voxel_um in (float(word) for word in options.voxel_um.split(",")):
                for seed in range(17, 17 + options.poses):
                    errors = errors_of(mesh, voxel_um, seed, folder)
                    head = {"stapes": stapes, "voxel_um": voxel_um, "seed": seed}
                    rows += [{**head, "method": name, **errors[name]} for name in METHODS]
                    if options.save:
                        options.save.write_text(json.dumps(rows, indent=1), encoding="utf-8")
                    print(f"{stapes} {voxel_um:g} um, pose {seed}: {errors['stapeskit']}", file=sys.stderr)
    return rows


if __name__ == "__main__":
    main()
