"""Simulated ears, scanned at random, and how far what is measured lies from the truth in stated sd.

``python -m tests.mass.population FIRST COUNT [labels]`` prints the table that the numbers of
calibrated.toml are fitted on.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ct_inertia.ct2mass import measure_mass
from ct_inertia.options import MassOptions
from ct_inertia.results import MassResult
from ct_inertia.scan.label_file import write_segmentation
from simulate import Ear, Scan, Stapes, Truth, coverage_of, simulate_study
from stapeskit.arrays import Array
from stapeskit.registration import displacement

FAMILIES = ("openear", "openear", "analytic", "gutter")


@dataclass(frozen=True)
class Case:
    """One simulated ear as measured, and errors in stated standard deviations (z) of pose, plate and M."""

    truth: Truth
    result: MassResult

    @property
    def pose_z(self) -> Array:
        """Of the footplate frame, (6,)."""
        step = displacement(self.result.footplate.scan_from_footplate, self.truth.scan_from_footplate)
        return step / np.sqrt(np.diag(self.result.footplate.covariance))

    @property
    def plate_z(self) -> Array:
        """Of the plate frame, (6,); NaN without one."""
        plate = self.result.plate_frame
        if plate is None:
            return np.full(6, np.nan)
        step = displacement(plate.scan_from_plate, self.truth.scan_from_plate)
        return step / np.sqrt(np.diag(plate.covariance))

    @property
    def mass_z(self) -> Array:
        """Of the ten inertial parameters, (10,): all sources, the density's error with them."""
        matrix = self.result.matrix
        return (matrix.parameters - self.truth.parameters_si) / np.sqrt(np.diag(matrix.covariance))


def draw(seed: int) -> tuple[Ear, Scan]:
    """Draw an ear and how it is scanned: 20 to 40 um, noise of 2 to 8 %, part of it common to neighbours."""
    rng = np.random.default_rng(seed)
    family = FAMILIES[int(rng.integers(len(FAMILIES)))]
    stretch = tuple(float(v) for v in rng.uniform(0.92, 1.08, 3))
    warp = float(rng.uniform(0.0, 0.05)) if family == "openear" else 0.0
    stapes = Stapes(
        family=family,
        scale=float(rng.uniform(0.88, 1.05)),
        stretch=stretch,  # type: ignore[arg-type]
        warp=warp,
        mirrored=bool(rng.random() < 0.5),
        seed=seed,
    )
    ear = Ear(stapes=stapes, gap_mm=float(rng.uniform(0.08, 0.25)), density_sd=0.002)
    scan = Scan(
        voxel_um=float(rng.uniform(20.0, 40.0)),
        blur_voxels=float(rng.uniform(0.9, 1.5)),
        noise=float(rng.uniform(0.02, 0.08)),
        noise_correlation_voxels=float(rng.choice([0.0, 0.0, 0.8])),
        samples=4,
        seed=seed,
    )
    return ear, scan


def write_labels(path: Path, truth: Truth) -> None:
    """Write the true bodies as labels on the voxels of the scan."""
    placed = truth.placed
    labels = np.zeros(placed.shape[::-1], dtype=np.uint8)
    for solid, material in reversed(placed.solids):
        number = 1 if solid is placed.solids[0][0] else {"bone": 3, "plastic": 2}[material]
        labels[coverage_of(solid, placed.shape, placed.voxel_mm, samples=2) > 0.5] = number
    transform = np.eye(4)
    transform[:3, :3] *= placed.voxel_mm
    write_segmentation(path, [labels], labels.shape, transform)


def measure(seed: int, with_labels: bool = False, **options: object) -> Case:
    """Simulate an ear and measure it: found in the scan, or by true labels on it."""
    ear, scan = draw(seed)
    with tempfile.TemporaryDirectory() as name:
        truth = simulate_study(ear, scan, None, Path(name))
        anterior = tuple(float(v) for v in truth.scan_from_footplate.rotation[:, 0])
        density = truth.stated_density_kg_m3
        given = {"anterior": anterior, "density": density, "coat": 0, **options}
        if with_labels:
            write_labels(Path(name) / "labels.seg.nrrd", truth)
            given["labels"] = str(Path(name) / "labels.seg.nrrd")
        result = measure_mass(MassOptions.of(scan=str(Path(name) / "scan.tif"), **given))
    return Case(truth, result)


def main() -> None:
    """Print errors over stated standard deviations of many ears."""
    first, count = int(sys.argv[1]), int(sys.argv[2])
    rows = []
    np.set_printoptions(precision=2, suppress=True, linewidth=200)
    for seed in range(first, first + count):
        case = measure(seed, with_labels="labels" in sys.argv)
        rows.append(np.concatenate([case.pose_z, case.plate_z, case.mass_z]))
        print(seed, case.truth.ear.stapes.family, rows[-1][:6], rows[-1][6:12], rows[-1][12:], flush=True)
    table = np.array(rows)
    print("rms", np.sqrt(np.nanmean(table**2, axis=0)))
    print("within 95 %", np.nanmean(np.abs(table) < 1.96, axis=0))


if __name__ == "__main__":
    main()
