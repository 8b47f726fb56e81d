"""Does one K hold over the whole band? Fit it in parts."""

import sys
from itertools import pairwise
from pathlib import Path

from matplotlib.figure import Figure

import legacy.stapeskit as sk

results = Path(sys.argv[1] if len(sys.argv) > 1 else "results")
picture = Path(sys.argv[2] if len(sys.argv) > 2 else "bands.png")

edges = (400, 2000, 3500, 5000)
figure = Figure(figsize=(6, 3.2), layout="constrained")
axes = figure.subplots()
values = []
for low, high in pairwise(edges):
    fit = sk.dof2kd(results / "dof.h5", mass=results / "mass.json", band=(low, high), inplane="load", bands=0)
    values.append(fit.stiffness[0, 0])
    axes.errorbar(0.5 * (low + high), values[-1], 1.96 * fit.standard_deviation[0][0, 0], fmt="o", capsize=4)
axes.set(xlabel="middle of the band (Hz)", ylabel="K(y), N/m, 95 % interval")
figure.savefig(picture, dpi=80)
print(f"K(y) over the bands: {min(values):.0f} to {max(values):.0f} N/m")
