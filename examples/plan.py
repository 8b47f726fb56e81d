"""Before measuring: less noise of the vibrometer helps until errors of points, lasers and density lead."""

import sys
from dataclasses import replace
from pathlib import Path

from matplotlib.figure import Figure

from legacy.fitting.plan.plan import Plan, expect

picture = Path(sys.argv[2] if len(sys.argv) > 2 else "plan.png")

noise = (2e-6, 2e-5, 1e-4, 5e-4)
relative = []
for level in noise:
    planned = expect(replace(Plan(), noise_m_s=level, lines=60)).planned
    relative.append(100.0 * planned.standard_deviation[0][1, 1] / planned.fit.stiffness[1, 1])
figure = Figure(figsize=(6, 3.2), layout="constrained")
axes = figure.subplots()
axes.loglog([1e6 * level for level in noise], relative, "o-")
axes.set(xlabel="noise of a reading (µm/s)", ylabel="sd of K(alpha) (%)")
figure.savefig(picture, dpi=80)
print(f"K(alpha) to {relative[1]:.2g} % with a noise of 20 µm/s")
