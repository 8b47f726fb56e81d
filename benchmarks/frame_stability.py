"""The frames are repeatable to microns and hold in their 95 % intervals: one stapes, many poses and voxels.

Each scan shows the stapes in its window (gap 100 um) over a plastic plate, in a random pose, with noise of 2
to 6 % and blur of 1 to 1.4 voxels. For every voxel size: root mean square and largest deviation of the
footplate frame from its true pose, then those of the plate frame, then how often the intervals of the six
displacements of the footplate frame hold.

    python -m benchmarks.frame_stability --voxels-um 15,20,30,40 --poses 6
    python -m benchmarks.frame_stability --family analytic --voxels-um 20,40 --poses 6
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks._masses import Measured, measure
from benchmarks._table import NOTHING, arguments, print_table
from simulate import Ear, Scan, Stapes
from stapeskit.registration import displacement

COLUMNS = (
    "voxel, um", "scans", "origin, um", "normal, deg", "long axis, deg", "plate origin, um",
    "plate axes, mrad", "held", "CPU",
)  # fmt: skip


def scanned(family: str, voxel_um: float, pose: int, folder: Path) -> Measured:
    """Measure one scan."""
    rng = np.random.default_rng([pose, 5])
    scan = Scan(
        voxel_um=voxel_um, noise=float(rng.uniform(0.02, 0.06)), blur_voxels=float(rng.uniform(1.0, 1.4)),
        tilt_deg=25.0, upright="xyz"[pose % 3], seed=pose,
    )  # fmt: skip
    return measure(Ear(stapes=Stapes(family=family), gap_mm=0.1), scan, folder)


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
    seconds = np.median([one.seconds for one in found])
    return [
        f"{voxel_um:g}",
        len(found),
        spread(1e6 * np.linalg.norm(moved[:, :3], axis=1)),
        spread(np.degrees(np.hypot(moved[:, 3], moved[:, 5]))),
        spread(np.degrees(np.abs(moved[:, 4]))),
        spread(1e6 * plates[:, :3].max(axis=1)) if len(plates) else NOTHING,
        spread(1e3 * plates[:, 3:].max(axis=1)) if len(plates) else NOTHING,
        f"{100 * np.mean(held):.0f} %",
        f"{seconds:.1f} s",
    ]


def rows(family: str, voxels_um: list[float], poses: int, folder: Path) -> Iterator[list[object]]:
    """Yield one row a voxel size; scans that are refused do not count."""
    for voxel_um in voxels_um:
        found = [scanned(family, voxel_um, pose, folder) for pose in range(1, poses + 1)]
        good = [one for one in found if one.record is not None]
        if good:
            yield row(voxel_um, good)


if __name__ == "__main__":
    given = arguments(__doc__, family="openear", voxels_um="30,40", poses=2)
    sizes = [float(word) for word in given.voxels_um.split(",")]
    with tempfile.TemporaryDirectory() as place:
        print_table(COLUMNS, rows(given.family, sizes, given.poses, Path(place)))
    print("Root mean square/largest; held: 95 % intervals of the footplate frame; CPU of ct2mass.")
