"""Figures of the recomputed paper: simulated responses and mode shapes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fitting.examples import paper
from fitting.model.model import Modes, simulate
from fitting.report.figures import MEASURED, SIMULATED, SYMBOLS
from stapeskit.page.page import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Half axes of a typical footplate, mm, only to draw shapes on.
_HALF_LENGTH_MM, _HALF_WIDTH_MM = 1.35, 0.62


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
        upper.set_title(f"{SYMBOLS.get(name, name)} of the stapes", fontsize=11)
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


def shape_figure(mode_list: Modes) -> Figure:
    """Draw the piston motion of the footplate plane in every mode."""
    x, z = np.meshgrid(
        np.linspace(-_HALF_LENGTH_MM, _HALF_LENGTH_MM, 501), np.linspace(-_HALF_WIDTH_MM, _HALF_WIDTH_MM, 251)
    )
    inside = (x / _HALF_LENGTH_MM) ** 2 + (z / _HALF_WIDTH_MM) ** 2 <= 1.0
    figure = new_figure(10.8, 2.6)
    axes = figure.subplots(1, len(mode_list.pairs), squeeze=False)[0]
    for place, (axis, mode) in enumerate(zip(axes, mode_list.pairs, strict=True)):
        y, alpha, gamma = mode.shape
        motion = np.where(inside, y - z * 1e-3 * alpha + x * 1e-3 * gamma, np.nan)
        phases = np.exp(1j * np.linspace(0.0, np.pi, 181))
        reach = [np.nanmax(np.abs((motion * phase).real)) for phase in phases]
        shown = (motion * phases[int(np.argmax(reach))]).real
        shown = shown / np.nanmax(np.abs(shown))
        drawn = axis.pcolormesh(
            x, z, shown, cmap="RdBu_r", vmin=-1.0, vmax=1.0, shading="auto", rasterized=True
        )
        axis.contour(x, z, shown, levels=[0.0], colors="#1d2733", linewidths=0.8)
        axis.set_aspect("equal")
        axis.invert_yaxis()
        axis.set_title(f"mode {place + 1}, {mode.frequency_hz:.0f} Hz", fontsize=10)
        axis.set_xlabel("x (mm)")
        axis.tick_params(labelsize=8)
    axes[0].set_ylabel("z (mm)")
    figure.colorbar(drawn, ax=list(axes), shrink=0.8, label="y, scaled")
    return figure
