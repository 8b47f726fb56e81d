"""Mass properties straight from a surface: principal moments about the centre of mass."""

import sys
from pathlib import Path

import numpy as np

import legacy.stapeskit as sk

results = Path(sys.argv[1] if len(sys.argv) > 1 else "results")
picture = Path(sys.argv[2] if len(sys.argv) > 2 else "principal_inertia.png")

mass = sk.ct2mass(results / "stapes.ply", density=(1900.0, 60.0), anterior=(1.0, 0.0, 0.0))
mass.plot().savefig(picture, dpi=80)
matrix = mass.matrix.matrix
m, moment = matrix[0, 0], np.array([matrix[2, 4], matrix[0, 5], matrix[1, 3]]) * -1.0
offset = moment / m
about_centre = matrix[3:, 3:] - m * (offset @ offset * np.eye(3) - np.outer(offset, offset))
print("principal moments, mg mm2:", np.round(1e12 * np.linalg.eigvalsh(about_centre), 2))
