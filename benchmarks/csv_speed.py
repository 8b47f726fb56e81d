"""Time of reading a vibrometer table of 300 000 rows, beside plain readers: prints a markdown table.

``python benchmarks/csv_speed.py [ROWS]``. Smallest of seven passes over a file in the cache, after imports.
"""

from __future__ import annotations

import csv
import os
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import pandas as pd

from legacy.kinematics.tidy.ldv_csv import read_ldv

LINES = 1000
PLACE = "x_mm,y_mm,z_mm,"
KINDS = {
    "positions and beams in every row, 17 digits, sd": (True, "%.17g", True, False),
    "positions and beams in every row, 10 digits": (True, "%.9e", False, False),
    "positions in points.csv, dir = x, y, z, 10 digits": (False, "%.9e", False, False),
    "the same, rows in random order": (False, "%.9e", False, True),
}


def write(folder: Path, rows: int, whole: bool, digits: str, sd: bool, mixed: bool) -> tuple[Path, Path]:
    """Write a table of two bodies and the positions of its points."""
    rng = np.random.default_rng(1)
    freq = [f"{value:.10g}" for value in np.linspace(100.0, 10000.0, LINES)]
    head = "body,point," + (PLACE + "dir_x,dir_y,dir_z," if whole else "dir,") + "freq_hz,re_m_s,im_m_s"
    lines, places = [], []
    for channel in range(rows // LINES):
        body, point = ("stapes", "base")[channel >= rows // LINES // 2], channel // 3
        place = np.random.default_rng([2, point]).normal(size=3)
        beam = rng.normal(size=3)
        beam /= np.linalg.norm(beam)
        start = f"{body},{point}," + ",".join(f"{x:.6f}" for x in place) + ","
        places.append(start[:-1])
        start += ",".join(f"{x:.9f}" for x in beam) + ","
        start = start if whole else f"{body},{point},{'xyz'[channel % 3]},"
        for f, (re, im) in zip(freq, 1e-5 * rng.normal(size=(LINES, 2)), strict=True):
            lines.append(f"{start}{f},{digits % re},{digits % im}" + (",1.2345e-07" if sd else ""))
    if mixed:
        rng.shuffle(lines)
    path, points = folder / "ldv.csv", folder / "points.csv"
    path.write_text("\n".join([head + (",sd_m_s" if sd else ""), *lines]) + "\n")
    points.write_text("\n".join(["body,point,x_mm,y_mm,z_mm", *dict.fromkeys(places)]) + "\n")
    return path, points


def timed(work, passes=7):
    """Return the smallest wall and processor time, s."""
    walls, cpus = [], []
    for _ in range(passes):
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
    return min(walls), min(cpus)


def cells(path):
    """Read all cells with the csv module of the standard library."""
    with path.open(newline="") as file:
        return [[float(cell) for cell in row[-2:]] for row in list(csv.reader(file))[1:]]


def main() -> None:
    """Print the table."""
    rows = int(sys.argv[1]) if len(sys.argv) > 1 else 300_000
    print(
        f"| {rows} rows, wall / processor time, s | size | read_ldv, checked | pandas.read_csv | csv module |"
    )
    print("|-|-|-|-|-|")
    for name, options in KINDS.items():
        with tempfile.TemporaryDirectory() as folder:
            path, points = write(Path(folder), rows, *options)
            listed = None if options[0] else points
            own = timed(lambda p=path, q=listed: read_ldv(p, q))
            plain = timed(lambda p=path: pd.read_csv(p))
            slow = timed(lambda p=path: cells(p), 1)
            size = path.stat().st_size / 2**20
            columns = [f"{wall:.3f} / {cpu:.3f}" for wall, cpu in (own, plain, slow)]
            print(f"| {name} | {size:.0f} MiB | **{columns[0]}** | {columns[1]} | {columns[2]} |", flush=True)


if __name__ == "__main__":
    main()
