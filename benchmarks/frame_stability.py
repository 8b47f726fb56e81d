"""Repeatability of the frames: one stapes scanned at several voxel sizes, in random poses, with noise.

    python benchmarks/frame_stability.py --phantom openear --voxels-um 10,15,20,25,30,40 --poses 6
    python benchmarks/frame_stability.py --phantom analytic --gap-um 40

Each scan shows the stapes in its window on a plastic plate. For every voxel size the table gives the root
mean square and the largest deviation of the footplate frame from its true pose: origin, normal, long axis;
then the same for the plate frame; then how often the 95 % intervals of the six displacements of the footplate
frame hold the truth.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

_HEAD = (
    "| voxel um | scans | origin um: rms / max | normal deg: rms / max | long axis deg: rms / max "
    "| plate origin um | plate axes mrad | footplate intervals that hold | CPU ms |"
)


def deviation(estimated: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the displacement (6,) of a frame in the axes of the true one, mm and rad; either way of x."""
    from legacy.stapeskit.frames import vector_from_rotation

    turn = truth[:3, :3].T @ estimated[:3, :3]
    sign = np.sign(turn[0, 0])
    turned = turn @ np.diag([sign, 1.0, sign])
    return np.concatenate([truth[:3, :3].T @ (estimated[:3, 3] - truth[:3, 3]), vector_from_rotation(turned)])


def scanned(seed: int, voxel_mm: float, gap_mm: float, stapes: Path | None) -> dict[str, np.ndarray]:
    """Return deviations, stated standard deviations and CPU time of one scan."""
    from legacy.ct_inertia.frames.anatomy import AnatomyHints
    from legacy.ct_inertia.frames.footplate import footplate_frame
    from legacy.ct_inertia.frames.plate_frame import plate_frame
    from legacy.ct_inertia.labelling.from_scan import find_bodies
    from legacy.ct_inertia.volume.volume import Volume
    from sample_volumes.phantom import Ear, render, scene, truth

    rng = np.random.default_rng([seed, 5])
    chosen = {} if stapes is None else {"stapes": stapes}
    placed = scene(
        Ear(
            voxel_mm=(voxel_mm,) * 3,
            gap_mm=gap_mm,
            noise=float(rng.uniform(0.02, 0.06)),
            psf_voxels=float(rng.uniform(1.0, 1.4)),
            tilt_deg=25.0,
            upright="xyz"[seed % 3],
            pose_seed=seed,
            noise_seed=seed,
            **chosen,
        )
    )
    known = truth(placed)
    bodies = find_bodies(Volume(render(placed), np.full(3, voxel_mm), np.zeros(3), np.eye(3)))
    start = time.process_time()
    frame = footplate_frame(
        bodies.frame_surface, AnatomyHints(), bodies.frame_blur_mm, bodies.frame_noise_mm4
    )
    spent = time.process_time() - start
    deviations = {
        "footplate": deviation(frame.scan_from_footplate.matrix, np.array(known["scan_from_footplate"])),
        "sd": np.sqrt(np.diag(frame.covariance)) * [1e3, 1e3, 1e3, 1.0, 1.0, 1.0],
        "cpu": np.array([spent]),
    }
    if bodies.plate is not None:
        border = getattr(bodies.plate, "on_border", None)
        middle = bodies.moments.centroid_mm
        plate = plate_frame(bodies.plate, middle, border, bodies.volume, bodies.psf_sigma_mm)
        deviations["plate"] = deviation(plate.scan_from_plate.matrix, np.array(known["scan_from_plate"]))
    return deviations


def row(voxel_um: float, scans: list[dict[str, np.ndarray]]) -> str:
    """Return one line of the table."""
    moved = np.array([scan["footplate"] for scan in scans])
    held = np.mean(np.abs(moved) < 1.96 * np.array([scan["sd"] for scan in scans]))
    parts = [
        1e3 * np.linalg.norm(moved[:, :3], axis=1),
        np.degrees(np.hypot(moved[:, 3], moved[:, 5])),
        np.degrees(np.abs(moved[:, 4])),
    ]
    cells = [f"{np.sqrt(np.mean(part**2)):.3g} / {part.max():.3g}" for part in parts]
    plates = np.array([scan["plate"] for scan in scans if "plate" in scan]).reshape(-1, 6)
    if len(plates):
        origin, axes = 1e3 * np.abs(plates[:, :3]).max(axis=1), 1e3 * np.abs(plates[:, 3:]).max(axis=1)
        cells += [f"{np.sqrt(np.mean(part**2)):.2g} / {part.max():.2g}" for part in (origin, axes)]
    else:
        cells += ["-", "-"]
    cpu = 1e3 * float(np.median([scan["cpu"][0] for scan in scans]))
    return f"| {voxel_um:g} | {len(scans)} | " + " | ".join(cells) + f" | {100.0 * held:.0f} % | {cpu:.0f} |"


def main() -> None:
    """Print the table."""
    from legacy.ct_inertia.errors import CtInertiaError
    from sample_volumes.analytic import write_analytic_stapes

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--phantom", choices=["openear", "analytic"], default="openear")
    parser.add_argument("--voxels-um", default="15,20,25,30,40")
    parser.add_argument("--poses", type=int, default=6)
    parser.add_argument("--gap-um", type=float, default=100.0)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    print(_HEAD)
    print("|" + "-|" * (_HEAD.count("|") - 1))
    with tempfile.TemporaryDirectory() as folder:
        stapes = None
        if options.phantom == "analytic":
            stapes = write_analytic_stapes(Path(folder) / "stapes.ply")
        for voxel in (float(part) for part in options.voxels_um.split(",")):
            scans = []
            for seed in range(options.seed, options.seed + options.poses):
                try:
                    scans.append(scanned(seed, 1e-3 * voxel, 1e-3 * options.gap_um, stapes))
                except CtInertiaError as fault:
                    print(f"{voxel:g} um, seed {seed}: {fault}", file=sys.stderr)
            if scans:
                print(row(voxel, scans), flush=True)


if __name__ == "__main__":
    main()
