"""Figures of the recomputed paper: simulated responses."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from legacy.fitting.examples import paper
from legacy.fitting.model.model import simulate
from legacy.fitting.report.figures import MEASURED, SIMULATED
from legacy.stapeskit.page.page import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def simulated_figure() -> Figure:
    """Draw amplitude and phase of y, alpha and gamma by Eq. 8 for a piston motion of the base."""
    freq = np.linspace(*paper.PAPER_BAND_HZ, 600)
    base = np.zeros((len(freq), 3), dtype=complex)
    base[:, 0] = 1.0 / freq
    motion = simulate(paper.PAPER_MASS, paper.PAPER_STIFFNESS, paper.PAPER_DAMPING_CORRECTED, freq, base)
    scale = paper.PAPER_LARGEST_PISTON_M / float(np.max(np.abs(motion[:, 0])))
    motion, base = motion * scale, base * scale
    figure = new_figure(10.8, 4.6)
    axes = figure.subplots(2, 3, sharex=True, height_ratios=[3, 2])
    for place, name in enumerate(paper.PAPER_DOF):
        factor, unit = (1e9, "nm") if place == 0 else (1e6, "µrad")
        upper, lower = axes[0, place], axes[1, place]
        if place == 0:
            upper.plot(freq, np.abs(base[:, 0]) * factor, color=MEASURED, lw=1.1, ls="--", label="base")
            upper.legend(frameon=False, fontsize=9)
        upper.plot(freq, np.abs(motion[:, place]) * factor, color=SIMULATED, lw=1.6)
        upper.set_ylim(bottom=0.0)
        upper.set_title(f"{name} of the stapes", fontsize=11)
        upper.set_ylabel(f"amplitude ({unit})")
        lower.plot(freq, np.degrees(np.unwrap(np.angle(motion[:, place]))), color=SIMULATED, lw=1.6)
        lower.set_xlabel("frequency (Hz)")
        for axis in (upper, lower):
            axis.grid(True, color="#e6eaee", lw=0.6)
            axis.set_xlim(freq[0], freq[-1])
            for side in ("top", "right"):
                axis.spines[side].set_visible(False)
    axes[1, 0].set_ylabel("phase (°)")
    return figure
