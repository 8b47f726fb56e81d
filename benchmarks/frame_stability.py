"""The frames and the gap of the ligament are found to microns and hold in their 95 % intervals.

Each scan shows a real, analytic or foreign stapes in its window (gap of 30 to 150 um) over a plastic plate,
in a random pose, with noise of 1 to 6 %, shared by neighbours in half, and blur of 0.9 to 1.5 voxels. For
every voxel size: root mean square and largest deviation of the footplate frame from its true pose, then those
of the plate frame, of the gap, and how often the intervals of the six displacements of the footplate frame,
and of the gap, hold.

    python -m benchmarks.frame_stability --voxels-um 15,20,30,40 --poses 6
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks._masses import Measured, measure
from benchmarks._table import NOTHING, arguments, print_table
from ct_inertia.frames.footplate import footplate_frame
from ct_inertia.frames.gap import window_gap
from ct_inertia.surface.surface import Surface
from simulate import Ear, Scan, Stapes
from simulate.solids import joined
from stapeskit.registration import displacement

COLUMNS = (
    "voxel, um", "scans", "origin, um", "normal, deg", "long axis, deg", "plate origin, um",
    "plate axes, mrad", "gap, um", "held", "gap held", "CPU",
)  # fmt: skip


# of the poses in turn; the real stapes twice, since it is what labs have
FAMILIES = (
    "openear", "openear", "analytic", "foreign gutter", "foreign base", "foreign asymmetric", "foreign thick",
    "foreign curved", "foreign focus",
)  # fmt: skip


def scanned(voxel_um: float, pose: int, folder: Path) -> Measured:
    """Measure one scan."""
    rng = np.random.default_rng([pose, 5])
    family = FAMILIES[pose % len(FAMILIES)]
    stapes = Stapes(
        family=family, scale=rng.uniform(0.9, 1.1), mirrored=bool(rng.integers(2)), seed=5000 + pose,
        warp=rng.uniform(0.0, 0.05) if family == "openear" else 0.0,
    )  # fmt: skip
    scan = Scan(
        voxel_um=voxel_um, noise=rng.uniform(0.01, 0.06), blur_voxels=rng.uniform(0.9, 1.5), tilt_deg=50.0,
        upright="xyz"[pose % 3], seed=pose, noise_correlation_voxels=max(rng.uniform(-1.0, 1.0), 0.0),
    )  # fmt: skip
    return measure(Ear(stapes=stapes, gap_mm=rng.uniform(0.03, 0.15)), scan, folder)


def true_gap_mm(one: Measured) -> float:
    """Return the gap between the exact surfaces."""
    stapes, *others = (solid for solid, material in one.truth.placed.solids if material == "bone")
    exact, wall = (Surface(solid.vertices_mm, solid.faces) for solid in (stapes, joined(*others)))
    gap = window_gap(footplate_frame(exact), exact, wall)
    return np.nan if gap is None else gap.median_mm


def spread(values: np.ndarray) -> str:
    """Return root mean square and maximum."""
    return f"{np.sqrt(np.mean(values**2)):.3g}/{np.max(values):.3g}"


def row(voxel_um: float, found: list[Measured]) -> list[object]:
    """Return one row of the table."""
    moved = np.array([one.frame_deviation for one in found])
    held = np.abs(moved) < 1.96 * np.array([one.frame_sd for one in found])
    plates = np.array(
        [
            np.abs(displacement(one.truth.scan_from_plate, one.record.scan_from_plate))
            for one in found
            if one.record is not None and one.record.scan_from_plate is not None
        ]
    ).reshape(-1, 6)
    gaps = [(one.gap.median_mm - true_gap_mm(one), one.gap.sd_mm) for one in found if one.gap is not None]
    off, stated = np.array(gaps).reshape(-1, 2).T
    seconds = np.median([one.seconds for one in found])
    return [
        f"{voxel_um:g}",
        len(found),
        spread(1e6 * np.linalg.norm(moved[:, :3], axis=1)),
        spread(np.degrees(np.hypot(moved[:, 3], moved[:, 5]))),
        spread(np.degrees(np.abs(moved[:, 4]))),
        spread(1e6 * plates[:, :3].max(axis=1)) if len(plates) else NOTHING,
        spread(1e3 * plates[:, 3:].max(axis=1)) if len(plates) else NOTHING,
        spread(1e3 * np.abs(off)) if gaps else NOTHING,
        f"{100 * np.mean(held):.0f} %",
        f"{100 * np.mean(np.abs(off) < 1.96 * stated):.0f} %" if gaps else NOTHING,
        f"{seconds:.1f} s",
    ]


def rows(voxels_um: list[float], poses: int, folder: Path) -> Iterator[list[object]]:
    """Yield one row a voxel size; scans that are refused do not count."""
    for voxel_um in voxels_um:
        found = [scanned(voxel_um, pose, folder) for pose in range(1, poses + 1)]
        good = [one for one in found if one.record is not None]
        if good:
            yield row(voxel_um, good)


if __name__ == "__main__":
    given = arguments(__doc__, voxels_um="30,40", poses=2)
    sizes = [float(word) for word in given.voxels_um.split(",")]
    with tempfile.TemporaryDirectory() as place:
        print_table(COLUMNS, rows(sizes, given.poses, Path(place)))
    print("Root mean square/largest; held: 95 % intervals of the footplate frame; CPU of ct2mass.")
