"""The rigid-body check of sdynpy on one body's readings: every line is a shape.

    python points_sdynpy.py FOLDER

reads value.npy (channel, freq) and positions.npy (channel, 3) in m of points with beams along x, y and z
each, and prints the processor seconds as JSON. Runs in an environment of its own.
"""

import json
import os
import resource
import sys
import time
from pathlib import Path

import numpy as np

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
import sdynpy as sdpy


def main(folder: Path) -> None:
    """Project every line on the rigid shapes and take the residuals."""
    value = np.load(folder / "value.npy", mmap_mode="r")
    places = np.load(folder / "positions.npy")[::3]
    nodes = sdpy.geometry.node_array(np.arange(1, len(places) + 1), places)
    system = sdpy.geometry.coordinate_system_array(1)
    geometry = sdpy.geometry.Geometry(nodes, system)
    names = sdpy.coordinate_array(np.arange(1, len(places) + 1)[:, None], ["X+", "Y+", "Z+"]).flatten()
    start = time.process_time()
    shapes = sdpy.shape_array(names, np.ascontiguousarray(np.array(value).T))
    prepared = time.process_time()
    _, residual = sdpy.shape.rigid_body_error(geometry, shapes)
    done = time.process_time()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    rms = float(np.sqrt(np.mean(residual**2)))
    measures = {
        "setup": prepared - start,
        "residuals": done - prepared,
        "peak_bytes": peak,
        "residual_rms": rms,
    }
    print(json.dumps(measures))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
