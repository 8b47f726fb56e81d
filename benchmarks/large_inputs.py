"""How long do the largest inputs take, and in how much memory? A markdown table.

    python benchmarks/large_inputs.py                     a million rows as CSV and as UFF, 100 000 points
    python benchmarks/large_inputs.py --only volume       a TIFF of 2048^3 8-bit voxels (8 GiB on the disk)

Every command runs in a process of its own. "Own memory" is the peak of anonymous memory: pages of a mapped
file belong to the system.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.ct_speed import measured  # noqa: E402

SEED, NOISE = 7, 1e-6
AXES = "xyz"


def _readings(points: int, lines: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return frequencies, positions in mm (point, 3) and velocities along x, y, z (point, 3, line), m/s."""
    rng = np.random.default_rng(SEED)
    freq = np.linspace(100.0, 10_000.0, lines)
    places = rng.uniform(-1.5, 1.5, size=(points, 3))
    motion = rng.normal(size=(6, 1)) * np.array([[1e-3]] * 3 + [[1.0]] * 3) / (1.0 + 1j * freq / 3000.0)
    turned = np.cross(motion[None, 3:].transpose(0, 2, 1), places[:, None] * 1e-3).transpose(0, 2, 1)
    value = motion[None, :3] + turned
    return freq, places, value + NOISE * (rng.normal(size=(*value.shape, 2)) @ [1.0, 1j])


def _csv(folder: Path, points: int, lines: int) -> list[str]:
    freq, places, value = _readings(points, lines)
    with (folder / "ldv.csv").open("w", encoding="utf-8") as stream:
        stream.write("body,point,x_mm,y_mm,z_mm,dir,freq_hz,re_m_s,im_m_s,sd_m_s\n")
        for point, place in enumerate(places):
            start = f"stapes,{point},{place[0]:.6f},{place[1]:.6f},{place[2]:.6f},"
            for axis, row in zip(AXES, value[point], strict=True):
                stream.writelines(
                    f"{start}{axis},{f:.6g},{v.real:.9g},{v.imag:.9g},{NOISE}\n"
                    for f, v in zip(freq.tolist(), row.tolist(), strict=True)
                )
    return ["ldv.csv"]


def _million_rows(folder: Path) -> list[str]:
    return _csv(folder, 50, 6667)


def _many_points(folder: Path) -> list[str]:
    return _csv(folder, 100_000, 2)


def _universal(folder: Path) -> list[str]:
    from tests.kinematics import written_uff as uff

    freq, places, value = _readings(50, 6667)
    with (folder / "ldv.uff").open("wb") as stream:
        stream.write(uff.units())
        stream.write(uff.nodes_2411({k + 1: place * 1e-3 for k, place in enumerate(places)}))
        for point, rows in enumerate(value, 1):
            for axis, row in enumerate(rows, 1):
                stream.write(uff.function(freq, row, point, axis, kind=uff.SPECTRUM, form=6))
    return ["ldv.uff", "--body", "stapes=ldv.uff", "--amplitude", "peak"]


def _volume(folder: Path, side: int = 2048, part: int = 512) -> list[str]:
    """Write a stapes in its oval window within a large field of air with noise."""
    import tifffile

    from sample_volumes.phantom import Ear, scene
    from sample_volumes.rendering import render

    placed = scene(Ear(voxel_mm=(0.01,) * 3, shape=(part,) * 3, gap_mm=0.1, pose_seed=3, dtype="uint8"))
    ear = render(placed)
    dark = ear[ear < (int(np.percentile(ear, 5)) + int(ear.max())) // 3]
    rng = np.random.default_rng(SEED)
    air = rng.choice(dark[:: max(1, dark.size // 100_000)], size=(side + 97, side))
    first = (side - part) // 2
    inside = slice(first, first + part)

    def planes() -> object:
        for z in range(side):
            plane = air[z % 97 : z % 97 + side].copy()
            if first <= z < first + part:
                plane[inside, inside] = ear[z - first]
            yield plane

    with tifffile.TiffWriter(folder / "scan.tif", bigtiff=True) as file:
        file.write(planes(), shape=(side,) * 3, dtype=np.uint8, contiguous=True)
    return ["scan.tif", "--spacing", "0.01", "--density", "1900+-60", "--anterior", "1,0,0"]


CASES: dict[str, tuple[str, str, Callable[[Path], list[str]]]] = {
    "rows": ("tidy table of 1 000 050 rows (50 points, 3 beams, 6667 lines)", "kinematics", _million_rows),
    "uff": ("universal file of 1 000 050 values (text, double precision)", "kinematics", _universal),
    "points": ("tidy table of 100 000 points (3 beams, 2 lines: 600 000 rows)", "kinematics", _many_points),
    "volume": ("TIFF of 2048^3 8-bit voxels with a stapes in its window", "ct_inertia", _volume),
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", action="append", choices=list(CASES))
    parser.add_argument("--folder", type=Path, help="where the inputs are made for the time of the run")
    given = parser.parse_args()
    print("| input | file | wall | processor | peak RSS | own memory |\n|-|-|-|-|-|-|")
    for name in given.only or [name for name in CASES if name != "volume"]:
        title, room, make = CASES[name]
        with tempfile.TemporaryDirectory(dir=given.folder) as place:
            folder = Path(place)
            words = make(folder)
            size = (folder / words[0]).stat().st_size / 1e6
            code = f"import os, sys; os.chdir({place!r}); from {room}.cli import main; sys.exit(main())"
            out = ["--out", "out/dof.csv" if room == "kinematics" else "out"]
            environment = os.environ | {"PYTHONPATH": str(ROOT)}
            run = measured([sys.executable, "-c", code, *words, *out, "--quiet"], folder, environment)
        print(
            f"| {title} | {size:.0f} MB | {run.wall_s:.1f} s | {run.cpu_s:.1f} s | {run.peak_mb:.0f} MB | "
            f"{run.own_mb:.0f} MB |",
            flush=True,
        )
    print(f"\n{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f} at the end")


if __name__ == "__main__":
    main()
