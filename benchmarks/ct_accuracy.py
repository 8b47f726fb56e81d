"""How true is the mass matrix? stapeskit and what labs use now, on the same simulated scans of a real stapes.

    python benchmarks/ct_accuracy.py [VOXEL_UM ...]

Every method sees the same volume: stapes in its oval window (gap 0.2 mm), bone, plate; PSF 1.2 voxels, noise
4 % of the contrast between bone and air. The peers are given the right grey levels and the right component,
which nobody tells them in a laboratory; multi-Otsu finds its own level.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))


def half_level_mesh(volume: np.ndarray, spacing: float, level: float) -> dict[str, object]:
    """Threshold, connected component, marching cubes (scikit-image), mass properties (trimesh)."""
    import trimesh
    from scipy.ndimage import find_objects, label
    from skimage.measure import marching_cubes

    labels, _ = label(volume > level)
    sizes = np.bincount(labels.ravel())[1:]
    stapes = 1 + int(np.argmin(np.abs(sizes * spacing**3 - 2.3)))
    box = tuple(slice(s.start - 2, s.stop + 2) for s in find_objects(labels)[stapes - 1])
    grey = volume[box].astype(np.float32)
    others = (labels[box] != stapes) & (labels[box] != 0)
    grey[others] = 0.0
    vertices, faces, _, _ = marching_cubes(grey, level + 0.25, allow_degenerate=False)
    start = np.array([s.start for s in box])
    points = (vertices + start)[:, ::-1] * spacing
    mesh = max(trimesh.Trimesh(points, faces).split(), key=lambda part: abs(part.volume))
    if mesh.volume < 0.0:
        mesh.invert()
    return {"V": mesh.volume, "c": np.array(mesh.center_mass), "J": np.array(mesh.moment_inertia)}


def voxel_count(volume: np.ndarray, spacing: float, level: float) -> dict[str, object]:
    """Threshold, connected component, count of voxels."""
    from scipy.ndimage import label

    labels, _ = label(volume > level)
    sizes = np.bincount(labels.ravel())[1:]
    points = np.argwhere(labels == 1 + int(np.argmin(np.abs(sizes * spacing**3 - 2.3))))[:, ::-1] * spacing
    centre = points.mean(axis=0)
    second = (points - centre).T @ (points - centre) * spacing**3
    return {"V": len(points) * spacing**3, "c": centre, "J": np.trace(second) * np.eye(3) - second}


def gauss_multi_otsu(volume: np.ndarray, spacing: float) -> dict[str, object]:
    """Gauss filter, multi-Otsu with three classes, count of voxels: the usual script."""
    from scipy.ndimage import gaussian_filter
    from skimage.filters import threshold_multiotsu

    smooth = gaussian_filter(volume.astype(np.float32), 1.0)
    return voxel_count(smooth, spacing, threshold_multiotsu(smooth[::2, ::2, ::2], 3)[1])


def ours(path: Path, truth: dict) -> dict[str, object]:
    """Return ct2mass's moments per unit density."""
    from ct_inertia.ct2mass import MassOptions, ct2mass

    anterior = tuple(np.array(truth["scan_from_footplate"])[:3, 0])
    result = ct2mass(MassOptions(path, density=(truth["density_kg_m3"], 0.0), anterior=anterior))
    moments = result.moments
    exact = np.array(truth["mass_matrix_si"])
    root = np.sqrt(np.diag(exact))
    frame = (
        np.linalg.inv(np.array(truth["scan_from_footplate"])) @ result.footplate.scan_from_footplate.matrix
    )
    extra = {
        "M": np.abs((result.matrix.matrix - exact) / np.outer(root, root)).max() * 100.0,
        "origin": np.linalg.norm(frame[:3, 3]) * 1e3,
        "normal": np.degrees(np.arccos(min(1.0, frame[1, 1]))),
    }
    return {"V": moments.volume_mm3, "c": moments.centroid_mm, "J": moments.inertia_mm5, **extra}


def main() -> None:
    """Print one table."""
    import tifffile

    from sample_volumes.bodies import stapes_in_footplate
    from sample_volumes.phantom import Ear, scene, truth, write_scan

    exact = stapes_in_footplate().moments()
    print("| voxel | method | volume | inertia (trace) | centre of mass | M, of sqrt(Mii Mjj) | time |")
    print("|-|-|-|-|-|-|-|")
    for voxel_um in [float(word) for word in sys.argv[1:]] or [40.0, 25.0, 20.0]:
        spacing = voxel_um * 1e-3
        ear = Ear(voxel_mm=(spacing,) * 3, pose_seed=17, noise_seed=17)
        placed = scene(ear)
        behind = truth(placed)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "scan.tif"
            write_scan(path, placed)
            volume = tifffile.imread(path).astype(np.uint16)
            middle = 0.5 * (ear.levels[0] + ear.levels[2])
            methods = {
                "stapeskit": lambda p=path, t=behind: ours(p, t),
                "half level given, scikit-image + trimesh": lambda v=volume, h=spacing, m=middle: (
                    half_level_mesh(v, h, m)
                ),
                "half level given, voxel count": lambda v=volume, h=spacing, m=middle: voxel_count(v, h, m),
                "Gauss + multi-Otsu, voxel count": lambda v=volume, h=spacing: gauss_multi_otsu(v, h),
            }
            for name, method in methods.items():
                started = time.perf_counter()
                found = method()
                seconds = time.perf_counter() - started
                centre = np.linalg.norm(found["c"] - np.array(behind["center_of_mass_in_scan_mm"])) * 1e3
                inertia = np.trace(found["J"]) / np.trace(exact.inertia_mm5) - 1.0
                matrix = f"{found['M']:.2f} %" if "M" in found else "no frame"
                print(
                    f"| {voxel_um:g} um | {name} | {100 * (found['V'] / exact.volume_mm3 - 1):+.3f} % | "
                    f"{100 * inertia:+.3f} % | {centre:.2f} um | {matrix} | {seconds:.1f} s |"
                )


if __name__ == "__main__":
    main()
