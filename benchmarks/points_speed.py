"""How fast is the fit of rigid motion, and in how much memory? Beside pyFBS and sdynpy, as a markdown table.

    python benchmarks/points_speed.py                          200 points x 3 beams x 20 000 lines (183 MiB)
    python benchmarks/points_speed.py --peers PYTHON           beside the pyFBS and sdynpy of that interpreter
    python benchmarks/points_speed.py --points 40 --lines 2000

Times are processor seconds of one thread (OPENBLAS_NUM_THREADS=1), the least of some repetitions of ours and
one run of the peers, each in a process of its own on the same file; reading the file is not counted. pyFBS
runs again with as many threads as its libraries take by themselves, for which its small products wait.
"Passes" are multiples of one sum over the data in memory (values, and sd where each value has its own), in
the same process. "Memory" is the peak of all that is allocated, data included, over the size of the data;
for peers the resident size of the process. The peers are installed by hand, in an environment of their own:
pip install pyFBS==1.0.7 sdynpy.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
PEERS = Path(__file__).parent / "peers"
SEED = 20
PARTS = ("setup", "fit", "consistency", "residuals")
DOF = ("x", "y", "z", "alpha", "beta", "gamma")


def simulated(points: int, lines: int) -> dict[str, Any]:
    """Return readings of points of 3 mm spread along x, y and z, with 1 % noise."""
    rng = np.random.default_rng(SEED)
    places = np.repeat(rng.normal(size=(points, 3)), 3, axis=0)
    beams = np.tile(np.eye(3), (points, 1))
    q = rng.normal(size=(lines, 12)).view(complex) * np.array([1e-7] * 3 + [1e-4] * 3)
    arms = places * 1e-3
    value = np.hstack([beams, np.cross(arms, beams)]) @ q.T
    for channel in value:
        channel += 1e-9 * rng.normal(size=2 * lines).view(complex)
    names = tuple(str(c // 3) for c in range(3 * points))
    return {"points": names, "positions_mm": places, "directions": beams, "value": value}


def least(work: Callable[[], Any], repeat: int) -> tuple[float, Any]:
    """Return the least processor time of some runs, and the last result."""
    best, result = np.inf, None
    for _ in range(repeat):
        result = None
        start = time.process_time()
        result = work()
        best = min(best, time.process_time() - start)
    return best, result


def peak(work: Callable[[], Any]) -> int:
    """Return the most memory in bytes that a call allocates."""
    tracemalloc.start()
    kept = work()
    bytes_held = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    del kept
    return bytes_held


def ours(data: dict[str, Any], repeat: int) -> tuple[list[dict[str, Any]], np.ndarray]:
    """Measure the fit alone and the whole of points2dof; return rows and the motion (freq, 6)."""
    from legacy.kinematics.fit.beams import beam_set
    from legacy.kinematics.fit.rigid_fit import fit_lines
    from legacy.kinematics.measurement import from_arrays
    from legacy.kinematics.points2dof import points2dof

    value = data["value"]
    flat = value.reshape(-1).view(float)
    beams = beam_set("body", data["positions_mm"], data["directions"], DOF)
    alike = np.full((1, value.shape[1]), 1e-9)
    rng = np.random.default_rng(SEED + 1)
    single = np.empty(value.shape)
    for row in single:
        row[:] = 1e-9 * rng.uniform(0.5, 2.0, len(row))
    freq = np.linspace(100.0, 10000.0, value.shape[1])
    once = least(lambda: flat.sum(), 3 * repeat)[0]
    both = once + least(lambda: single.sum(), 3 * repeat)[0]

    def whole(extra: dict[str, Any]) -> Any:
        return points2dof(from_arrays({"body": {**data, **extra}}, freq, order=0))

    def spoiled(extra: dict[str, Any], gaps: bool = False) -> Any:
        """Run it with one channel 5 % too large, or with one value missing at every tenth line."""
        at = np.arange(0, value.shape[1], 10)
        places = (rng.integers(len(value), size=len(at)), at) if gaps else (len(value) // 2, slice(None))
        kept = value[places].copy()
        value[places] = np.nan if gaps else 1.05 * kept
        result = whole(extra)
        value[places] = kept
        return result

    placed = {"sd": 1e-9, "position_sd_mm": 0.02}
    cases: list[tuple[str, Callable[[], Any], int]] = [
        (
            "DOFs, residuals, chi2 and energies per channel",
            lambda: fit_lines(beams, value, alike),
            value.nbytes,
        ),
        (
            "the same with variances and 6x6 covariances per line",
            lambda: fit_lines(beams, value, single),
            value.nbytes + single.nbytes,
        ),
        ("points2dof: fit, search for faults, notices", lambda: whole({"sd": 1e-9}), value.nbytes),
        ("the same, noise from the residuals", lambda: whole({}), value.nbytes),
        ("the same, positions known to 20 um", lambda: whole(placed), value.nbytes),
        ("the same, one channel 5 % too large", lambda: spoiled({"sd": 1e-9}), value.nbytes),
        ("the same, that and positions known to 20 um", lambda: spoiled(placed), value.nbytes),
        ("the same, a value missing at every tenth line", lambda: spoiled({"sd": 1e-9}, True), value.nbytes),
    ]
    rows, q = [], np.empty(0)
    for number, (name, work, size) in enumerate(cases):
        seconds, result = least(work, repeat if number < 4 else min(repeat, 2))
        if number == 0:
            q = result.q
        del result
        passes, memory = seconds / (once if size == value.nbytes else both), 1.0 + peak(work) / size
        rows.append({"name": name, "seconds": seconds, "passes": passes, "memory": memory})
    rows.insert(0, {"name": "one sum over the data", "seconds": once, "passes": 1.0, "memory": 1.0})
    return rows, q


def peer(python: str, script: str, folder: Path, threads: bool = False) -> dict[str, float] | None:
    """Run a peer with one thread or its own choice; return what it printed, None when it cannot run."""
    environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
    environment.pop("PYTHONPATH", None)
    if threads:
        environment.pop("OPENBLAS_NUM_THREADS", None)
    done = subprocess.run(
        [python, str(PEERS / script), str(folder)],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    if done.returncode or not lines:
        print(f"{script} did not run: {(done.stderr.strip().splitlines() or ['no output'])[-1]}\n")
        return None
    return {key: value for line in lines for key, value in line.items()}


def total(seconds: dict[str, float]) -> float:
    """Return the seconds of all parts of a peer."""
    return sum(value for key, value in seconds.items() if key in PARTS)


def table(
    rows: list[dict[str, Any]], peers: dict[str, dict[str, float] | None], size: int, difference: float | None
) -> str:
    """Write the markdown table."""
    names = ("pyFBS", "pyFBS, threads as installed")
    slow = {name: total(peer) for name in names if (peer := peers.get(name)) is not None}
    columns = "".join(f" {name} over this |" for name in slow)
    lines = [f"| | processor time | passes over the data | memory / data |{columns}"]
    lines.append("|-|-|-|-|" + "-|" * len(slow))
    once = rows[0]["seconds"]
    for row in rows:
        cells = [
            row["name"],
            f"{1e3 * row['seconds']:.0f} ms",
            f"{row['passes']:.1f}",
            f"{row['memory']:.2f}",
        ]
        ratios = [
            f"{seconds / row['seconds']:.0f}" if row is not rows[0] else "" for seconds in slow.values()
        ]
        lines.append("| " + " | ".join([*cells, *ratios]) + " |")
    for name, peer in peers.items():
        if peer is None:
            continue
        seconds, times = total(peer), {key: value for key, value in peer.items() if key in PARTS}
        parts = ", ".join(f"{key} {value:.2f} s" for key, value in times.items())
        cells = [
            f"{name}: {parts}",
            f"{seconds:.1f} s",
            f"{seconds / once:.0f}",
            f"{peer['peak_bytes'] / size:.1f}",
        ]
        lines.append(
            "| " + " | ".join([*cells, *[f"{other / seconds:.1f}" for other in slow.values()]]) + " |"
        )
    if difference is not None:
        lines.append(
            f"\nLargest difference of the motion from pyFBS, relative to its largest: {difference:.1e}."
        )
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--points", type=int, default=200)
    parser.add_argument("--lines", type=int, default=20000)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--peers", default=os.environ.get("POINTS_PEERS", ""), metavar="PYTHON")
    options = parser.parse_args()
    data = simulated(options.points, options.lines)
    size = data["value"].nbytes
    print(f"{options.points} points x 3 beams x {options.lines} lines, {size / 2**20:.0f} MiB, one thread\n")
    rows, q = ours(data, options.repeat)
    times: dict[str, dict[str, float] | None] = {}
    difference = None
    if options.peers:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            np.save(folder / "value.npy", data["value"])
            np.save(folder / "positions.npy", data["positions_mm"] * 1e-3)
            np.save(folder / "directions.npy", data["directions"])
            times["pyFBS"] = peer(options.peers, "points_pyfbs.py", folder)
            if times["pyFBS"] is not None:
                theirs = np.load(folder / "pyfbs.npy").T
                difference = float(
                    np.max(np.max(np.abs(q - theirs), axis=0) / np.max(np.abs(theirs), axis=0))
                )
            times["pyFBS, threads as installed"] = peer(
                options.peers, "points_pyfbs.py", folder, threads=True
            )
            times["sdynpy, residuals alone"] = peer(options.peers, "points_sdynpy.py", folder)
    else:
        print("pyFBS and sdynpy: not run (name an interpreter that has them with --peers).\n")
    print(table(rows, times, size, difference))


if __name__ == "__main__":
    main()
