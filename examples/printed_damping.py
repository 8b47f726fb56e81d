"""The damping matrix printed in the paper is unstable; with two exponents corrected it is stable."""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from legacy.fitting.examples.paper import (
    PAPER_DAMPING_CORRECTED,
    PAPER_DAMPING_PRINTED,
    PAPER_MASS,
    PAPER_STIFFNESS,
)
from legacy.fitting.model.model import state_matrix

picture = Path(sys.argv[2] if len(sys.argv) > 2 else "printed_damping.png")

figure = Figure(figsize=(6, 3.2), layout="constrained")
axes = figure.subplots()
for name, damping in (("printed", PAPER_DAMPING_PRINTED), ("corrected", PAPER_DAMPING_CORRECTED)):
    roots = np.linalg.eigvals(
        state_matrix(np.array(PAPER_MASS), np.array(PAPER_STIFFNESS), np.array(damping))
    )
    axes.plot(roots.real, roots.imag / (2 * np.pi), "o", label=name)
    print(f"{name}: largest real part {roots.real.max():+.3g} 1/s")
axes.axvline(0.0, color="grey", linewidth=0.8)
axes.set_xscale("symlog", linthresh=1e3)
axes.set(xlabel="real part (1/s)", ylabel="imaginary part (Hz)")
axes.legend()
figure.savefig(picture, dpi=80)
