"""Is the gap around the footplate right, and does its standard deviation hold?

    python benchmarks/window_gap.py [--start K] [--scans N] [--phantom]

Stapedes of nine families in their oval window, gap, voxel, blur and noise drawn (seeds K, K+1, ...). The
truth is the gap by its definition between the two bodies themselves, on a fine grid. ``--phantom`` measures
the real stapes in a window that keeps one gap all round, at several voxels and blurs.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import foreign_scans as scans
from benchmarks import foreign_shapes as shapes

FAMILIES = ("base", "asymmetric", "thick", "curved", "mirrored", "gutter", "focus", "thin", "flat thin")
# Voxel of the exact shapes, mm: as foreign_scans draws them.
_FINE_MM = 0.022


def true_gap(anatomy: shapes.Anatomy, gap_mm: float) -> NDArray[np.float64]:
    """Return the median gap, the harmonic mean, the sd along the rim, mm, and the share of the rim."""
    from legacy.ct_inertia.bodies import WindowWall
    from legacy.ct_inertia.frames.anatomy import AnatomyHints
    from legacy.ct_inertia.frames.footplate import footplate_frame
    from legacy.ct_inertia.frames.window_gap import window_gap
    from legacy.ct_inertia.surface.contours import contoured
    from legacy.ct_inertia.surface.isosurface import iso_surface

    grid, place = scans.fine_grid(_FINE_MM)
    stapes = iso_surface(-grid.signed(lambda p: shapes.body(anatomy, p)), 0.0, place)
    points, faces = contoured(-grid.signed(lambda p: shapes.window(anatomy, p, gap_mm)), 0.0)
    wall = WindowWall(points @ place[:3, :3].T + place[:3, 3], faces, 0.0, 0.0, 0.0)
    frame = footplate_frame(stapes, AnatomyHints(np.array([1.0, 0.0, 0.0]), {}, None))
    gap = window_gap(frame, stapes, 0.0, wall)
    if gap is None:
        return np.full(4, np.nan)
    return np.array([gap.median_mm, gap.harmonic_mm, gap.spread_mm, gap.rim_share])


def scan_gap(number: int, folder: Path) -> None:
    """Measure the gap of one scan and print it beside the truth."""
    from legacy.ct_inertia.ct2mass import MassOptions, ct2mass
    from legacy.ct_inertia.errors import CtInertiaError

    rng = np.random.default_rng([number, 77])
    anatomy = shapes.draw(FAMILIES[number % len(FAMILIES)], rng)
    gap_mm = float(rng.uniform(0.03, 0.15))
    scene = scans.draw_scene(rng, gap_mm=gap_mm)
    file = folder / "scan.tif"
    anterior = scans.make(anatomy, scene, rng, file).scan_from_body[:3, 0]
    head = f"| {number} {anatomy.family} | {scene.voxel_um:.0f} | {scene.noise:.3f} |"
    options = MassOptions(
        file, density=(1900.0, None), spacing_mm=(scene.voxel_um * 1e-3,), anterior=tuple(anterior.tolist())
    )
    try:
        result = ct2mass(options)
    except CtInertiaError as refusal:
        print(f"{head} refused: {str(refusal)[:80]} |", flush=True)
        return
    gap, sigma = result.gap, 0.0 if result.bodies is None else result.bodies.psf_sigma_mm
    true = true_gap(anatomy, gap_mm)
    if gap is None:
        print(f"{head} {1e3 * true[0]:.1f} | none stated |", flush=True)
        return
    error = gap.median_mm - true[0]
    print(
        f"{head} {1e3 * true[0]:.1f} | {true[0] / sigma:.1f} | {1e3 * error:+.1f} ± {1e3 * gap.sd_mm:.1f} | "
        f"{error / gap.sd_mm:+.1f} | {1e3 * (gap.harmonic_mm - true[1]):+.1f} | "
        f"{1e3 * gap.spread_mm:.0f}; {1e3 * true[2]:.0f} | {gap.rim_share:.2f}; {true[3]:.2f} |",
        flush=True,
    )


def phantom_gap(gap_mm: float, voxel_mm: float, psf_voxels: float) -> str:
    """Return a row: the gap that is found around the real stapes in a window with one gap all round."""
    from legacy.ct_inertia.frames.footplate import footplate_frame
    from legacy.ct_inertia.frames.window_gap import window_gap
    from legacy.ct_inertia.labelling.from_scan import find_bodies
    from legacy.ct_inertia.volume.volume import Volume
    from sample_volumes.phantom import Ear, render, scene

    ear = Ear(voxel_mm=(voxel_mm,) * 3, plate=False, gap_mm=gap_mm, psf_voxels=psf_voxels)
    bodies = find_bodies(Volume(render(scene(ear)), np.full(3, voxel_mm), np.zeros(3), np.eye(3)))
    surface, blur = bodies.frame_surface, bodies.frame_blur_mm
    gap = window_gap(footplate_frame(surface, blur_mm=blur), surface, blur, bodies.wall)
    head = f"| {1e3 * gap_mm:.0f} | {1e3 * voxel_mm:.0f} | {1e3 * bodies.psf_sigma_mm:.0f} |"
    if gap is None:
        return f"{head} none stated | | |"
    return (
        f"{head} {1e3 * gap.median_mm:.1f} ± {1e3 * gap.sd_mm:.1f} | {1e3 * gap.harmonic_mm:.1f} | "
        f"{1e3 * gap.spread_mm:.1f} |"
    )


def phantoms() -> None:
    """Print the table of the phantom."""
    print("| gap, um | voxel, um | blur, um | median found ± sd, um | harmonic mean | sd along the rim |")
    print("|-|-|-|-|-|-|")
    for gap_mm in (0.04, 0.06, 0.1, 0.15):
        for voxel_mm, blur in ((0.02, 1.2), (0.03, 0.8), (0.03, 1.2), (0.04, 1.2)):
            print(phantom_gap(gap_mm, voxel_mm, blur), flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--scans", type=int, default=12)
    parser.add_argument("--phantom", action="store_true")
    given = parser.parse_args()
    if given.phantom:
        phantoms()
        return
    heads = (
        "scan", "voxel, um", "noise", "gap, um", "gap over blur", "error ± sd, um", "error over sd",
        "error of the harmonic mean, um", "sd along the rim, um: found; true",
        "share of the rim: found; true",
    )  # fmt: skip
    print(f"| {' | '.join(heads)} |\n|{'-|' * len(heads)}")
    with tempfile.TemporaryDirectory() as place:
        for number in range(given.start, given.start + given.scans):
            scan_gap(number, Path(place))


if __name__ == "__main__":
    main()
