"""How well is the stapes parted from the bone it stands in? Hard ears, each in two poses, and their truth.

    python benchmarks/in_situ.py [WORD ...]        only the cases whose names hold one of the words
    python benchmarks/in_situ.py --peer [WORD ...]       beside a marker watershed (scikit-image)

Simulated scans of a real stapes: PSF 1.2 voxels, noise 4 % of the contrast between bone and air. ``stated``
is the standard deviation that the program gives with its volume; M is the largest error over sqrt(Mii Mjj)
of the mass matrix about the true footplate centre, so that the cut alone shows. The watershed is told levels,
blur, place and true volume (benchmarks/peers/watershed.py).
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

CASES: dict[str, dict[str, Any]] = {
    "gap 100 um": {"gap_mm": 0.1},
    "gap 60 um": {"gap_mm": 0.06},
    "gap 40 um": {"gap_mm": 0.04},
    "gap 30 um": {"gap_mm": 0.03},
    "gap 60 um, 2 bridges of radius 50 um": {"gap_mm": 0.06, "bridges": 2, "bridge_radius_mm": 0.05},
    "gap 80 um, 2 bridges of radius 100 um": {"gap_mm": 0.08, "bridges": 2, "bridge_radius_mm": 0.1},
    "gap 80 um, 2 bridges of radius 150 um": {"gap_mm": 0.08, "bridges": 2, "bridge_radius_mm": 0.15},
    "gap 30 um, 2 bridges of radius 50 um": {"gap_mm": 0.03, "bridges": 2, "bridge_radius_mm": 0.05},
    "gap 30 um, 2 bridges of radius 150 um": {"gap_mm": 0.03, "bridges": 2, "bridge_radius_mm": 0.15},
    "gap 60 um, incus 40 um from the head": {"gap_mm": 0.06, "incus_gap_mm": 0.04},
    "incus grown 50 um into the head": {"incus_gap_mm": -0.05},
    "gap 60 um, incus grown 100 um into the head": {"gap_mm": 0.06, "incus_gap_mm": -0.1},
    "voxels 40 um, gap 60 um": {"voxel_mm": (0.04,) * 3, "gap_mm": 0.06},
    "voxels 50 um, gap 60 um": {"voxel_mm": (0.05,) * 3, "gap_mm": 0.06},
    "gap 60 um, bone beyond the border": {"gap_mm": 0.06, "bone_reach": 1.5},
    "gap 60 um, 6 fragments": {"gap_mm": 0.06, "dust": 6},
}


def scanned(settings: dict[str, Any], seed: int) -> tuple[Any, Any, dict[str, Any]]:
    """Return the placed bodies, the voxels, and the truth behind them."""
    from sample_volumes.phantom import Ear, render, scene, truth

    placed = scene(Ear(pose_seed=seed, noise_seed=seed, **{"voxel_mm": (0.02,) * 3, **settings}))
    return placed, render(placed), truth(placed)


def ours(placed: Any, grey: Any, behind: dict[str, Any]) -> str:
    """Return one line of the table behind the case's name: find_bodies."""
    from legacy.ct_inertia.errors import CtInertiaError
    from legacy.ct_inertia.labelling.from_scan import find_bodies
    from legacy.ct_inertia.mass.mass_properties import footplate_mass_matrix, from_density
    from legacy.ct_inertia.volume.volume import Volume
    from legacy.stapeskit.frames import RigidTransform

    volume = Volume(grey, np.array(placed.ear.voxel_mm), np.zeros(3), np.eye(3))
    started = time.process_time()
    try:
        bodies = find_bodies(volume)
    except CtInertiaError as refusal:
        return f"refused: {str(refusal)[:90]} | | | | | |"
    seconds = time.process_time() - started
    moments, exact = bodies.moments, behind["volume_m3"] * 1e9
    stated = np.sqrt(sum(part[0, 0] for part in moments.contributions.values()))
    centre = np.linalg.norm(moments.centroid_mm - behind["center_of_mass_in_scan_mm"]) * 1e3
    frame = RigidTransform(np.array(behind["scan_from_footplate"]), "scan", "footplate")
    body = from_density(moments, behind["density_kg_m3"], None)
    matrix = footplate_mass_matrix(body, frame, np.zeros((6, 6))).matrix
    true = np.array(behind["mass_matrix_si"])
    root = np.sqrt(np.diag(true))
    worst = np.abs((matrix - true) / np.outer(root, root)).max()
    codes = ", ".join(notice.code for notice in bodies.notices) or "none"
    return (
        f"{100 * (moments.volume_mm3 / exact - 1):+.3f} % | {100 * stated / exact:.3f} % | {centre:.2f} um | "
        f"{100 * worst:.3f} % | {codes} | {seconds:.1f} s |"
    )


def peer(placed: Any, grey: Any, behind: dict[str, Any]) -> str:
    """Return one line of the table behind the case's name: a marker watershed on the box of the stapes."""
    from benchmarks.ct_accuracy import against
    from benchmarks.peers.watershed import watershed_integral

    ear, spacing = placed.ear, placed.ear.voxel_mm[0]
    stapes, reach = placed.solids[0][0].vertices / spacing, int(np.ceil(0.5 / spacing))
    low = np.maximum(np.floor(stapes.min(axis=0)).astype(int) - reach, 0)
    high = np.ceil(stapes.max(axis=0)).astype(int) + reach
    box = tuple(slice(a, b) for a, b in zip(low[::-1], high[::-1], strict=True))
    started = time.process_time()
    levels, sigma = (ear.levels[0], ear.levels[2]), ear.psf_voxels * spacing
    size, centre, second, depth = watershed_integral(
        grey[box], spacing, levels, sigma, behind["volume_m3"] * 1e9
    )
    seconds = time.process_time() - started
    off = against(behind, size, centre + low * spacing, second)
    return (
        f"{off['volume']:+.3f} % | none | {off['centre']:.2f} um | {off['matrix']:.3f} % | "
        f"eroded by {depth:g} voxels | {seconds:.1f} s |"
    )


def main() -> None:
    """Print the table."""
    words = [word for word in sys.argv[1:] if word != "--peer"]
    print("| case | pose | volume | stated | centre of mass | M | warnings | CPU |")
    print("|-|-|-|-|-|-|-|-|")
    for name, settings in CASES.items():
        if words and not any(word in name for word in words):
            continue
        for seed in (1, 2):
            placed, grey, behind = scanned(settings, seed)
            print(f"| {name} | {seed} | {ours(placed, grey, behind)}", flush=True)
            if "--peer" in sys.argv:
                print(f"| {name}: watershed | {seed} | {peer(placed, grey, behind)}", flush=True)


if __name__ == "__main__":
    main()
