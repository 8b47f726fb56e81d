"""Do the intervals of K and D hold for a ligament beside the reference plane? Coverage on simulated ears.

    python benchmarks/model_errors.py [EARS] [--inplane auto,load,ignore] [--noise 0.5,1,3] [--height 0,0.1]

Every cell draws EARS ears (default 40; benchmarks/ring_ears.py, which shares no code with fitting) with all
shared errors, and prints how many entries lie outside their 95 % interval, K33's median bias and root mean
square error, how often there is a warning of misfit, and the processor time of a fit.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from fitting.kd import fit_kd
from fitting.model.symmetric import entry_names, join
from fitting.options import KDOptions

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.ring_ears import PISTON, EarSettings, ear

HEADER = (
    "| height (mm) | noise (%) | in-plane | outside 95 % (%) | worst entry | K33 bias, rms (%) | bias / sd | "
    "height off / sd | misfit | ms |"
)


def main() -> None:
    """Print one row a cell."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("ears", type=int, nargs="?", default=40)
    parser.add_argument("--inplane", default="auto,ignore")
    parser.add_argument("--noise", default="0.5,1,3")
    parser.add_argument("--height", default="0,0.1,0.2")
    chosen = parser.parse_args()
    print(HEADER)
    print("|" + "-|" * (HEADER.count("|") - 1))
    for height in (float(value) for value in chosen.height.split(",")):
        for noise in (float(value) / 100.0 for value in chosen.noise.split(",")):
            for inplane in chosen.inplane.split(","):
                print(cell(EarSettings(height, noise), inplane, chosen.ears), flush=True)


def cell(settings: EarSettings, inplane: str, ears: int) -> str:
    """Return the row of one case."""
    block = np.ix_(PISTON, PISTON)
    deviations, relative, heights, alarms, spent = [], [], [], 0, 0.0
    for number in range(ears):
        seed = [number, round(1e3 * settings.height_mm), round(1e5 * settings.noise)]
        case = ear(settings, np.random.default_rng(seed))
        start = time.process_time()
        fit = fit_kd(case.motion, case.mass, KDOptions(inplane=inplane, bands=0))
        spent += time.process_time() - start
        wanted = join(case.stiffness[block], case.damping[block])
        found = join(fit.stiffness, fit.damping)
        deviations.append((found - wanted) / np.sqrt(np.diag(fit.covariance)))
        relative.append(found[5] / wanted[5] - 1.0)
        alarms += "misfit" in [notice.code for notice in fit.notices]
        if fit.ligament is not None:
            value, sd = fit.ligament.height
            heights.append((value - 1e-3 * settings.height_mm) / sd)
    off = np.array(deviations)
    outside = np.mean(np.abs(off) > 1.96, axis=0)
    worst = int(np.argmax(outside))
    columns = (
        f"{settings.height_mm:g}",
        f"{100.0 * settings.noise:g}",
        inplane,
        f"{100.0 * outside.mean():.1f}",
        f"{entry_names(3)[worst]} {100.0 * outside[worst]:.0f}",
        f"{100.0 * np.median(relative):+.1f}, {100.0 * np.sqrt(np.mean(np.square(relative))):.1f}",
        f"{np.median(off[:, 5]):+.2f}",
        f"{np.sqrt(np.mean(np.square(heights))):.2f} (rms)" if heights else "",
        f"{alarms} of {ears}",
        f"{1e3 * spent / ears:.0f}",
    )
    return "| " + " | ".join(columns) + " |"


if __name__ == "__main__":
    main()
