"""The virtual point transformation of pyFBS and its consistency indicators on one body's readings.

    python points_pyfbs.py FOLDER

reads value.npy (channel, freq), positions.npy (channel, 3) in m and directions.npy, writes
pyfbs.npy (6, freq) and prints the processor seconds of each part as JSON. Runs in an environment of its own.
"""

import json
import resource
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd

try:
    from pyFBS import VPT
except ImportError:
    from pyfbs.interface import VPT


def frame(positions, directions, descriptions, quantity):
    """Return a table of channels as pyFBS wants it."""
    table = pd.DataFrame({"Grouping": np.ones(len(descriptions), dtype=int), "Description": descriptions})
    table["Quantity"] = quantity
    for axis in range(3):
        table[f"Position_{axis + 1}"] = positions[:, axis]
    for axis in range(3):
        table[f"Direction_{axis + 1}"] = directions[:, axis]
    return table


def main(folder: Path) -> None:
    """Transform, judge, write."""
    value = np.load(folder / "value.npy", mmap_mode="r")
    positions, directions = np.load(folder / "positions.npy"), np.load(folder / "directions.npy")
    channels, lines = value.shape
    frf = np.ascontiguousarray(value.T)[:, :, None]
    start = time.process_time()
    names = ["ux", "uy", "uz", "rx", "ry", "rz"]
    axes = np.vstack([np.eye(3), np.eye(3)])
    inputs = frame(np.zeros((1, 3)), np.eye(3)[:1], ["in"], "Force")
    point = VPT(
        frame(positions, directions, [str(c) for c in range(channels)], "Acceleration"),
        inputs,
        frame(np.zeros((6, 3)), axes, names, "Acceleration"),
        frame(np.zeros((1, 3)), np.eye(3)[:1], ["fx"], "Force"),
    )
    setup = time.process_time()
    point.apply_vpt(np.arange(1.0, lines + 1.0), frf)
    applied = time.process_time()
    np.save(folder / "pyfbs.npy", point.frf[:, :, 0].T)
    print(json.dumps({"setup": setup - start, "fit": applied - setup}), flush=True)
    start = time.process_time()
    point.consistency([1], [1])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(json.dumps({"consistency": time.process_time() - start, "peak_bytes": peak}), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
