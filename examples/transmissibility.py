"""How much more than the bone the footplate moves, and at which frequency most."""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from legacy.stapeskit.records.motion_files import read_motion

results = Path(sys.argv[1] if len(sys.argv) > 1 else "results")
picture = Path(sys.argv[2] if len(sys.argv) > 2 else "transmissibility.png")

motion = read_motion(results / "dof.h5")
piston = motion.dof.index("y")
stapes, base = (motion.q[0, motion.bodies.index(body), :, piston] for body in ("stapes", "base"))
ratio = np.abs(stapes / base)
figure = Figure(figsize=(6, 3.2), layout="constrained")
axes = figure.subplots()
axes.plot(motion.freq_hz, ratio)
axes.set(xlabel="frequency (Hz)", ylabel="|y of stapes / y of bone|")
figure.savefig(picture, dpi=80)
most = int(np.argmax(ratio))
print(f"largest ratio {ratio[most]:.2f} at {motion.freq_hz[most]:.0f} Hz")
