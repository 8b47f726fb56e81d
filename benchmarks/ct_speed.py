"""A scan of 1024^3 voxels is measured in seconds, beside VTK that is given the grey level.

Every method reads the same uncompressed TIFF in a process of its own and writes the mesh of the stapes as
PLY, its labels as NRRD and mass, centre of mass and inertia as JSON; ct2mass writes frames, M and
uncertainty besides. The peers are given the right level, and the volume of the stapes to choose the
component by. The scan is in the page cache; the runs are interleaved. "Own memory" is the peak of anonymous
memory (RssAnon, looked at every 5 ms): pages of a mapped file belong to the system. 0.2 had kernels in C.

    python -m benchmarks.ct_speed --shape 1024 --voxel-um 10 --repeat 7
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks._table import arguments, before, print_table
from simulate import Ear, Scan, write_scan

ROOT = Path(__file__).resolve().parents[1]
BEFORE = "ct_speed_quick_repeat_7"
OURS = "ct2mass"
PEERS = {"level given, VTK flying edges on the whole scan + trimesh": "vtk_trimesh"}
COLUMNS = ("wall, least (median)", "CPU, least", "own memory")


@dataclass(frozen=True)
class Run:
    """What one process cost."""

    wall_s: float
    processor_s: float
    own_mb: float


def run(command: list[str]) -> Run:
    """Run a process to its end.

    Raises
    ------
    SystemExit
        It failed.
    """
    started = time.perf_counter()
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    own, done = 0, 0
    while not done:
        own = max(own, own_kb(process.pid))
        done, status, usage = os.wait4(process.pid, os.WNOHANG)
        time.sleep(0.005)
    wall = time.perf_counter() - started
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        message = process.stderr.read().decode() if process.stderr else ""
        raise SystemExit(f"{' '.join(command)} ended with {process.returncode}:\n{message}")
    return Run(wall, usage.ru_utime + usage.ru_stime, own / 1024.0)


def own_kb(process: int) -> int:
    """Return the anonymous memory of a process, kB; 0 when it has ended."""
    try:
        lines = Path(f"/proc/{process}/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("RssAnon")), 0)


def commands(path: Path, folder: Path, scan: Scan) -> dict[str, list[str]]:
    """Return the command line of every method by its title."""
    level = str(0.5 * (scan.levels[0] + scan.levels[2]))
    ours = "import sys; from ct_inertia.cli import main; sys.exit(main())"
    words = shlex.split("--density 1900+-60 --anterior 1,0,0 --no-report --quiet --force --out")
    found = {OURS: [sys.executable, "-c", ours, str(path), *words, str(folder / "own")]}
    for title, name in PEERS.items():
        script = str(ROOT / "benchmarks" / "peers" / f"{name}.py")
        (folder / name).mkdir()
        found[title] = [sys.executable, script, str(path), str(folder / name), level]
    return found


def rows(runs: dict[str, list[Run]]) -> list[list[str]]:
    """Return one row a method, each figure followed by that of 0.2."""
    found = []
    for title, own in runs.items():
        walls = [one.wall_s for one in own]
        cells = [
            f"{min(walls):.2f} s ({np.median(walls):.2f} s)",
            f"{min(one.processor_s for one in own):.2f} s",
            f"{max(one.own_mb for one in own):.0f} MB",
        ]
        old = [before(BEFORE, column, title) for column in COLUMNS]
        found.append([title, *(cell for pair in zip(cells, old, strict=True) for cell in pair)])
    return found


if __name__ == "__main__":
    given = arguments(__doc__, shape=512, voxel_um=20.0, repeat=3)
    scan = Scan(voxel_um=given.voxel_um, shape=(given.shape,) * 3, seed=3, format="ome.tif")
    with tempfile.TemporaryDirectory() as place:
        path = write_scan(Path(place), scan.placed(Ear(gap_mm=0.1)), scan)
        methods = commands(path, Path(place), scan)
        runs: dict[str, list[Run]] = {title: [] for title in methods}
        for _ in range(given.repeat):
            for title, command in methods.items():
                runs[title].append(run(command))
        size = path.stat().st_size / 2**30
    print(f"{size:.2f} GiB, {given.shape}^3 voxels (0.2: 1024^3); {os.cpu_count()} cores; load ", end="")
    print(f"{os.getloadavg()[0]:.1f} at the end\n")
    print_table(("method", *(cell for column in COLUMNS for cell in (column, "0.2"))), rows(runs))
