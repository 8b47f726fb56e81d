"""The first minutes of a newcomer: an empty folder, a scan and a measurement, and two commands.

A made-up ear is scanned and measured; `stapeskit new --yes` writes its study.toml and `scan2kd` runs it,
each in a process of its own, once for every format of the scan. Voxels without a header need their shape,
type and size, three keys that are added to study.toml. Density, side and anterior are not known.

    python -m benchmarks.first_minutes --voxel-um 30
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks._table import arguments, print_head, print_row
from simulate import Ear, Experiment, Scan, Truth, simulate_study

EAR = Ear(density_kg_m3=1750.0)  # of the assumed 1900 ± 200
FORMATS = ("tif", "nrrd", "nii.gz", "dicom", "raw")
EXPERIMENT = Experiment(lines=100, stapes_points=8, bone_points=6, seed=4)


def folder_of_a_newcomer(folder: Path, form: str, scan: Scan) -> tuple[Truth, str]:
    """Write scan, measurement, points and fiducials; return the truth, and keys that no file says."""
    made = "tif" if form == "raw" else form
    truth = simulate_study(EAR, replace(scan, format=made), EXPERIMENT, folder)
    for known in ("study.toml", "truth.json"):
        (folder / known).unlink()
    if form != "raw":
        return truth, ""
    import tifffile

    voxels = tifffile.imread(folder / "scan.tif")
    (folder / "scan.tif").unlink()
    voxels.astype("<u2").tofile(folder / "scan.raw")
    shape = ",".join(map(str, voxels.shape[::-1]))
    size = ",".join(f"{value:g}" for value in truth.placed.voxel_mm)
    return truth, f'shape = [{shape}]\ndtype = "uint16"\nspacing_mm = [{size}]'


def timed(module: str, *words: str, folder: Path) -> tuple[float, float]:
    """Run a command; return wall and processor time, s.

    Raises
    ------
    SystemExit
        It failed.
    """
    before, started = os.times(), time.perf_counter()
    code = f"import sys; from {module} import main; sys.argv[1:] = {list(words)!r}; main()"
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True)
    wall, after = time.perf_counter() - started, os.times()
    if done.returncode:
        raise SystemExit(f"{module} {' '.join(words)} ended with {done.returncode}:\n{done.stderr}")
    spent = after.children_user + after.children_system - before.children_user - before.children_system
    return wall, spent


def main() -> None:
    """Print the table."""
    given = arguments(__doc__, voxel_um=30.0)
    scan = Scan(voxel_um=given.voxel_um, samples=6, seed=4)
    print_head("scan", "new, s", "scan2kd, s", "processor, s", "verdict", "K(y) found", "true", "off by, sd")
    for form in FORMATS:
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            truth, keys = folder_of_a_newcomer(folder, form, scan)
            new, new_spent = timed("pipeline.stapeskit_command", "new", "--yes", folder=folder)
            study = folder / "study.toml"
            text = study.read_text(encoding="utf-8")
            study.write_text(text.replace("[scan]", f"[scan]\n{keys}", 1), encoding="utf-8")
            run, run_spent = timed("pipeline.cli", "--quiet", folder=folder)
            kd = json.loads((folder / "study_out" / "kd.json").read_text(encoding="utf-8"))
        found, sd = kd["stiffness_si"][0][0], kd["stiffness_sd_si"][0][0]
        true = float(np.asarray(truth.stiffness_si)[0, 0])
        print_row(
            form,
            f"{new:.1f}",
            f"{run:.1f}",
            f"{new_spent + run_spent:.1f}",
            kd["verdict"]["level"],
            f"{found:.0f} ± {sd:.0f} N/m",
            f"{true:.0f}",
            f"{(found - true) / sd:+.1f}",
        )
    print(f"\nLoad of the machine at the end {os.getloadavg()[0]:.1f}, {os.cpu_count()} cores.")


if __name__ == "__main__":
    main()
