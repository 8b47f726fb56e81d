"""The mode shapes as motion of the footplate's ends and of the head."""

import json
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

results = Path(sys.argv[1] if len(sys.argv) > 1 else "results")
picture = Path(sys.argv[2] if len(sys.argv) > 2 else "mode_shapes.png")

kd = json.loads((results / "kd.json").read_text(encoding="utf-8"))
places = np.linspace(-1.3e-3, 1.3e-3, 21)  # along the long axis x, m
figure = Figure(figsize=(6, 3.2), layout="constrained")
axes = figure.subplots()
for mode in kd["modes"]:
    shape = np.array(mode["shape_re"]) + 1j * np.array(mode["shape_im"])
    y, alpha, gamma = (shape[kd["dof"].index(name)] for name in ("y", "alpha", "gamma"))
    along = (y + gamma * places).real
    axes.plot(
        1e3 * places,
        along / np.max(np.abs([y, 1e-3 * alpha, 1e-3 * gamma])),
        label=f"{mode['frequency_hz']:.0f} Hz",
    )
axes.set(xlabel="x on the footplate (mm)", ylabel="y motion (of the largest part)")
axes.legend()
figure.savefig(picture, dpi=80)
print(f"{len(kd['modes'])} modes, the first at {kd['modes'][0]['frequency_hz']:.0f} Hz")
