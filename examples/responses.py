"""Measured and fitted responses, and the stiffness against piston motion."""

import sys
from pathlib import Path

import legacy.stapeskit as sk

results = Path(sys.argv[1] if len(sys.argv) > 1 else "results")
picture = Path(sys.argv[2] if len(sys.argv) > 2 else "responses.png")

fit = sk.dof2kd(results / "dof.h5", mass=results / "mass.json", bands=0)
fit.plot().savefig(picture, dpi=80)
sd = fit.standard_deviation[0]
print(f"K(y) = {fit.stiffness[0, 0]:.0f} +- {sd[0, 0]:.0f} N/m")
