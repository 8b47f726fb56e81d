"""The volume of a stapes that touches other bone is true within its stated standard deviation: 16 hard ears.

Simulated scans of a real stapes: blur 1.2 voxels, noise 4 % of the contrast between bone and air, voxels of
20 um unless another size is named. "Stated" is the standard deviation given with the volume; M is the largest
error over sqrt(Mii Mjj) about the true footplate frame, so that the cut alone shows. 0.2 drew other noise on
the same bodies, and its time is that without reading, frames and files.

    python -m benchmarks.in_situ --word gap
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

from benchmarks._masses import measure
from benchmarks._table import NOTHING, Before, arguments, print_table
from simulate import Ear, Scan

CASES = {
    "gap 100 um": (Ear(gap_mm=0.1), 20.0),
    "gap 60 um": (Ear(gap_mm=0.06), 20.0),
    "gap 40 um": (Ear(gap_mm=0.04), 20.0),
    "gap 30 um": (Ear(gap_mm=0.03), 20.0),
    "gap 60 um, 2 bridges of radius 50 um": (Ear(gap_mm=0.06, bridges=2, bridge_radius_mm=0.05), 20.0),
    "gap 80 um, 2 bridges of radius 100 um": (Ear(gap_mm=0.08, bridges=2, bridge_radius_mm=0.1), 20.0),
    "gap 80 um, 2 bridges of radius 150 um": (Ear(gap_mm=0.08, bridges=2, bridge_radius_mm=0.15), 20.0),
    "gap 30 um, 2 bridges of radius 50 um": (Ear(gap_mm=0.03, bridges=2, bridge_radius_mm=0.05), 20.0),
    "gap 30 um, 2 bridges of radius 150 um": (Ear(gap_mm=0.03, bridges=2, bridge_radius_mm=0.15), 20.0),
    "gap 60 um, incus 40 um from the head": (Ear(gap_mm=0.06, incus_gap_mm=0.04), 20.0),
    "incus grown 50 um into the head": (Ear(incus_gap_mm=-0.05), 20.0),
    "gap 60 um, incus grown 100 um into the head": (Ear(gap_mm=0.06, incus_gap_mm=-0.1), 20.0),
    "voxels 40 um, gap 60 um": (Ear(gap_mm=0.06), 40.0),
    "voxels 50 um, gap 60 um": (Ear(gap_mm=0.06), 50.0),
    "gap 60 um, bone beyond the border": (Ear(gap_mm=0.06, bone_reach=1.5), 20.0),
    "gap 60 um, 6 fragments": (Ear(gap_mm=0.06, dust=6), 20.0),
}
BEFORE = Before("in_situ")
COLUMNS = ("volume", "stated", "centre of mass", "M", "CPU")


def rows(word: str, poses: int, folder: Path) -> Iterator[list[object]]:
    """Yield one row a case and pose, each figure followed by that of 0.2."""
    for name, (ear, voxel_um) in CASES.items():
        for pose in range(1, poses + 1) if word in name else ():
            found = measure(ear, Scan(voxel_um=voxel_um, seed=pose), folder)
            old = [BEFORE.cell(column, name, str(pose)) for column in COLUMNS]
            if found.record is None:
                yield [name, pose, f"refused: {found.refusal}", *[NOTHING] * 9, ""]
                continue
            new = [
                f"{100 * found.volume_error:+.3f} %",
                f"{100 * found.volume_sd:.3f} %",
                f"{found.centre_error_um:.2f} um",
                f"{100 * found.matrix_share(true_frame=True):.3f} %",
                f"{found.seconds:.1f} s",
            ]
            pairs = (cell for pair in zip(new, old, strict=True) for cell in pair)
            yield [name, pose, *pairs, ", ".join(found.codes)]


if __name__ == "__main__":
    given = arguments(__doc__, word="", poses=1)
    with tempfile.TemporaryDirectory() as place:
        head = ("case", "pose", *(cell for column in COLUMNS for cell in (column, "0.2")), "warnings")
        print_table(head, rows(given.word, given.poses, Path(place)))
