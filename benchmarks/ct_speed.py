"""How fast, and in how much memory? Whole processes from the file to mass, labels and mesh, side by side.

    python benchmarks/ct_speed.py                        1024^3 voxels of 10 um (2 GiB)
    python benchmarks/ct_speed.py --voxel-um 20 --shape 512 --repeat 5
    python benchmarks/ct_speed.py --scan scan.tif --level 19000 --only stapeskit,vtk
    python benchmarks/ct_speed.py --quick                without the peers that take more than ten seconds

Every method reads the same uncompressed TIFF in a process of its own and writes the mesh of the stapes as
PLY, its labels as NRRD and mass, centre of mass and inertia as JSON; ct2mass writes its mesh of the plate,
frames, M and uncertainty besides. The peers but multi-Otsu are given the right level, and all of them the
volume of the stapes to choose the component by. The scan is in the page cache; the runs are interleaved. "Own
memory" is the peak of anonymous memory (RssAnon, looked at every 5 ms): pages of a mapped file belong to the
system.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
PEERS = Path(__file__).parent / "peers"
LEVEL = 19000.0
# Of many seconds: left out by --quick, and run as often as said at most.
SLOW = {"skimage": 2, "simpleitk": 2, "multiotsu": 1}


@dataclass(frozen=True)
class Run:
    """What one process cost."""

    wall_s: float
    cpu_s: float
    peak_mb: float
    own_mb: float


def methods(scan: Path, folder: Path, level: float) -> dict[str, list[str]]:
    """Return the command line of every method, by short name."""
    python = sys.executable
    peer = {
        "skimage": ("skimage_trimesh.py", str(level)),
        "vtk": ("vtk_trimesh.py", str(level)),
        "connectivity": ("vtk_connectivity.py", str(level)),
        "multiotsu": ("gauss_multiotsu.py",),
        "simpleitk": ("simpleitk.py", str(level)),
    }
    ours = "import sys; from ct_inertia.cli import main; sys.exit(main())"
    return {
        "stapeskit": [
            *(python, "-c", ours, str(scan), "--density", "1900+-60", "--anterior", "1,0,0"),
            *("--no-report", "--quiet", "--out", str(folder / "stapeskit")),
        ],
        **{
            name: [python, str(PEERS / script), str(scan), str(folder / name), *more]
            for name, (script, *more) in peer.items()
        },
        "read": [python, str(PEERS / "read_once.py"), str(scan)],
    }


TITLES = {
    "stapeskit": "ct2mass",
    "skimage": "level given, scikit-image + trimesh",
    "vtk": "level given, VTK flying edges on the whole scan + trimesh",
    "connectivity": "level given, VTK connectivity, flying edges on the box + trimesh",
    "multiotsu": "Gauss + multi-Otsu, scikit-image + trimesh",
    "simpleitk": "level given, SimpleITK statistics, scikit-image mesh",
    "read": "reading the file once (no result)",
}


def measured(command: list[str], folder: Path, environment: dict[str, str]) -> Run:
    """Run a process and return its cost."""
    folder.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    process = subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, cwd=ROOT
    )
    own = 0
    while True:
        own = max(own, _own_kb(process.pid))
        done, status, usage = os.wait4(process.pid, os.WNOHANG)
        if done:
            break
        time.sleep(0.005)
    wall = time.perf_counter() - started
    messages = process.stderr.read().decode() if process.stderr else ""
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} ended with {process.returncode}:\n{messages}")
    return Run(wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024.0, own / 1024.0)


def _own_kb(pid: int) -> int:
    """Return the anonymous memory of a process, kB."""
    try:
        for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines():
            if line.startswith("RssAnon"):
                return int(line.split()[1])
    except (OSError, ValueError):
        pass
    return 0


def make_scan(path: Path, voxel_um: float, shape: int) -> None:
    """Write the scan of a stapes in its oval window, gap 100 um, with its plate, as OME-TIFF."""
    from sample_volumes.phantom import Ear, scene, write_scan

    ear = Ear(voxel_mm=(voxel_um * 1e-3,) * 3, shape=(shape,) * 3, gap_mm=0.1, pose_seed=3, noise_seed=3)
    write_scan(path, scene(ear))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--voxel-um", type=float, default=10.0)
    parser.add_argument("--shape", type=int, default=1024, help="voxels along each side")
    parser.add_argument("--scan", type=Path, help="a scan that exists already")
    parser.add_argument("--level", type=float, default=LEVEL, help="grey value between air and bone")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--only", default=",".join(TITLES), help=f"some of {','.join(TITLES)}")
    parser.add_argument("--quick", action="store_true", help=f"leave out {', '.join(SLOW)}")
    options = parser.parse_args()
    from legacy.ct_inertia.native import which

    names = [name for name in options.only.split(",") if not (options.quick and name in SLOW)]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        scan = options.scan
        if scan is None:
            scan = folder / "scan.ome.tif"
            with ProcessPoolExecutor(1, get_context("spawn")) as apart:
                apart.submit(make_scan, scan, options.voxel_um, options.shape).result()
        commands = methods(scan, folder, options.level)
        environment = dict(os.environ)
        subprocess.run(commands["read"], check=True, stdout=subprocess.DEVNULL)
        runs: dict[str, list[Run]] = {name: [] for name in names}
        for turn in range(options.repeat):
            for name in names:
                if turn >= SLOW.get(name, options.repeat):
                    continue
                runs[name].append(measured(commands[name], folder / name, environment))
                last = runs[name][-1]
                print(f"{name} {last.wall_s:.2f} s, load {os.getloadavg()[0]:.1f}", file=sys.stderr)
        size = scan.stat().st_size / 2**30
        print(f"{size:.2f} GiB; {os.cpu_count()} cores; load {os.getloadavg()[0]:.1f} at the end;", end=" ")
        print(f"kernels of ct2mass: {which()}\n")
        print_table(runs)
        if "stapeskit" in names:
            first_run(commands["stapeskit"], folder, environment, runs["stapeskit"])


def print_table(runs: dict[str, list[Run]]) -> None:
    """Print what every method cost, and how much more than ct2mass."""
    ours = runs.get("stapeskit")
    print("| method | wall, least (median) | x ct2mass | CPU, least | x ct2mass | peak RSS | own memory |")
    print("|-|-|-|-|-|-|-|")
    for name, own in runs.items():
        wall, cpu = [run.wall_s for run in own], min(run.cpu_s for run in own)
        times = ["", ""]
        if ours:
            least = min(run.wall_s for run in ours), min(run.cpu_s for run in ours)
            times = [f"{value / unit:.2f}" for value, unit in zip((min(wall), cpu), least, strict=True)]
        peak, memory = (max(getattr(run, key) for run in own) for key in ("peak_mb", "own_mb"))
        print(
            f"| {TITLES[name]} | {min(wall):.2f} s ({np.median(wall):.2f} s) | {times[0]} | {cpu:.2f} s | "
            f"{times[1]} | {peak:.0f} MB | {memory:.0f} MB |"
        )


def first_run(command: list[str], folder: Path, environment: dict[str, str], usual: list[Run]) -> None:
    """Print how much longer a first run takes: no compiled Python file of any package exists yet."""
    with tempfile.TemporaryDirectory() as empty:
        first = measured(command, folder / "stapeskit", environment | {"PYTHONPYCACHEPREFIX": empty})
        again = measured(command, folder / "stapeskit", environment | {"PYTHONPYCACHEPREFIX": empty})
    print(
        f"\nFirst run, no Python file compiled yet: {first.wall_s:.2f} s; the next: {again.wall_s:.2f} s "
        f"(usual {min(run.wall_s for run in usual):.2f} s)."
    )


if __name__ == "__main__":
    main()
