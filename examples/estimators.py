"""Four estimators on the same data: the pseudo-inverse of the paper is biased by noise."""

import sys
from pathlib import Path

from matplotlib.figure import Figure

import legacy.stapeskit as sk

results = Path(sys.argv[1] if len(sys.argv) > 1 else "results")
picture = Path(sys.argv[2] if len(sys.argv) > 2 else "estimators.png")

figure = Figure(figsize=(6, 3.2), layout="constrained")
axes = figure.subplots()
stiffness = {}
for name in ("ml", "irls", "pinv", "constrained"):
    fit = sk.dof2kd(results / "dof.h5", mass=results / "mass.json", estimator=name, bands=0)
    stiffness[name] = fit.stiffness[1, 1]
    axes.errorbar(
        name, 1e3 * fit.stiffness[1, 1], 1.96e3 * fit.standard_deviation[0][1, 1], fmt="o", capsize=4
    )
axes.set_ylabel("K(alpha), N mm/rad, 95 % interval")
figure.savefig(picture, dpi=80)
print(f"pinv differs from ml by {100 * (stiffness['pinv'] / stiffness['ml'] - 1):+.1f} % in K(alpha)")
