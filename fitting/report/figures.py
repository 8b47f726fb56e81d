"""Figures of a fit: responses (paper, Figs. 4 and 5), principal axes (Fig. 6), residuals, rim."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fitting import entries
from fitting.model import principal_axes
from stapeskit.arrays import Array, ComplexArray
from stapeskit.report.colours import BODY_COLOURS, FITTED, MEASURED, lighten
from stapeskit.report.figures import amplitude_axis, decimate_lines, dof_unit, frequency_axis, panels, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from fitting.result import KDFit
    from fitting.ring import Rim

_CLEAR = 3.0  # standard deviations from which a response is clear of its noise
_MOST_RUNS = 4  # whose responses are drawn


@dataclass(frozen=True)
class Responses:
    """Measured and simulated motion of the structure and base, a run; m and rad.

    ``measured``, ``simulated`` and ``base`` are (lines, n), complex. ``measured_sd`` is that of the real
    (= imaginary) part, ``simulated_sd`` that of the simulated amplitude by the uncertainty of K and D.
    """

    freq_hz: Array
    measured: ComplexArray
    simulated: ComplexArray
    base: ComplexArray
    measured_sd: Array
    simulated_sd: Array


def responses(fit: KDFit, run: int = 0) -> Responses:
    """Simulate the structure from measured base motion and load (paper, Eq. 8)."""
    found, data = fit.found, fit.found.data
    lines, rows = data.run == run, np.array(data.rows)
    simulated, slopes = (part[lines] for part in found.likelihood.response(found.theta))
    along = (slopes * (simulated / np.maximum(np.abs(simulated), 1e-300)).conj()[..., None]).real
    count = found.at["entries"].stop
    variance = np.einsum("lip,pq,liq->li", along, found.covariance[:count, :count], along)
    noise = np.einsum("lii->li", data.covariance[lines]).real[:, rows] / 2.0
    scale, y = data.amplitude / data.root_mass[rows], data.y[lines]
    return Responses(
        data.freq_hz[lines],
        y[:, rows] * scale,
        simulated * scale,
        y[:, len(data.measured) + rows] * scale,
        np.sqrt(np.maximum(noise, 0.0)) * scale,
        np.sqrt(np.maximum(variance, 0.0)) * scale,
    )


@style()
def response_figure(fit: KDFit, run: int = 0) -> Figure:
    """Draw amplitude and phase of every degree of freedom of one run, measured and simulated."""
    shown = responses(fit, run)
    order = np.argsort(shown.freq_hz)
    n = len(fit.dof)
    drawing, axes = panels(2, n, width=max(10.4, 3.3 * n), height=2.3, share_x=True)
    for place, name in enumerate(fit.dof):
        _amplitudes(axes[0, place], shown, order, place, dof_unit(name))
        axes[0, place].set_title(f"{name} of the {fit.options.structure}")
        _phases(axes[1, place], shown, order, place)
        frequency_axis(axes[1, place], shown.freq_hz[order])
    axes[0, 0].legend()
    axes[1, 0].set_ylabel("phase (°)")
    return drawing


def _amplitudes(
    axes: Axes, shown: Responses, order: NDArray[np.intp], place: int, unit: tuple[float, str]
) -> None:
    scale, symbol = unit
    freq = shown.freq_hz[order] / 1e3
    measured, simulated, base = (
        np.abs(part[order, place]) * scale for part in (shown.measured, shown.simulated, shown.base)
    )
    kept, spread = decimate_lines(measured), 1.96 * shown.simulated_sd[order, place] * scale
    axes.plot(freq, base, color=lighten(BODY_COLOURS["base"]), lw=1.2, label="base, at the same point")
    axes.plot(freq[kept], measured[kept], ".", ms=3, color=MEASURED, alpha=0.7, label="measured")
    lower = np.maximum(simulated - spread, 1e-12)
    axes.fill_between(freq, lower, simulated + spread, color=FITTED, alpha=0.25, lw=0)
    axes.plot(freq, simulated, color=FITTED, lw=1.2, label="simulated (Eq. 8), 95 %")
    axes.set_ylabel(f"amplitude ({symbol})")
    largest = float(measured.max())
    amplitude_axis(axes, max(float(measured.min()), 1e-4 * largest), max(largest, float(simulated.max())))


def _phases(axes: Axes, shown: Responses, order: NDArray[np.intp], place: int) -> None:
    freq = shown.freq_hz[order] / 1e3
    simulated, noise = shown.simulated[order, place], shown.measured_sd[order, place]
    phase = np.angle(simulated)
    clear = np.flatnonzero(np.abs(simulated) > _CLEAR * noise)
    if len(clear) > 1:  # a line within its noise takes the turn of the clear line before it
        known = np.unwrap(phase[clear])
        before = known[np.maximum(np.searchsorted(clear, np.arange(len(phase)), side="right") - 1, 0)]
        phase = phase + 2.0 * np.pi * np.round((before - phase) / (2.0 * np.pi))
    measured = np.angle(shown.measured[order, place] * np.exp(-1j * phase)) + phase
    kept = decimate_lines(np.abs(shown.measured[order, place]))
    axes.plot(freq[kept], np.degrees(measured)[kept], ".", ms=3, color=MEASURED, alpha=0.7)
    axes.plot(freq, np.degrees(phase), color=FITTED, lw=1.2)


@style()
def residual_figure(fit: KDFit) -> Figure:
    """Draw the normalised residuals over frequency, and their distribution against the normal one."""
    from scipy.special import ndtri

    data = fit.found.data
    white = fit.found.likelihood.look(fit.found.theta)[0] * np.sqrt(2.0 * fit.found.noise)
    drawing, axes = panels(1, 2, height=2.8)
    left, right = axes[0]
    freq, small = np.repeat(data.freq_hz, white.shape[1]) / 1e3, {"ms": 2.5, "rasterized": True}
    for part, colour, label in ((white.real, MEASURED, "real"), (white.imag, FITTED, "imaginary")):
        left.plot(freq, part.ravel(), ".", color=colour, alpha=0.6, label=label, **small)
    for level in (-1.96, 1.96):
        left.axhline(level, color=MEASURED, lw=0.7, ls=":")
    frequency_axis(left, np.sort(data.freq_hz))
    left.set_ylabel("residual over its noise")
    left.legend(ncols=2)
    values = np.sort(np.concatenate([white.real.ravel(), white.imag.ravel()]))
    expected = ndtri((np.arange(len(values)) + 0.5) / len(values))
    right.plot(expected, values, ".", color=MEASURED, **small)
    right.plot(expected[[0, -1]], expected[[0, -1]], color=FITTED, lw=1.0)
    right.set_xlabel("normal distribution")
    return drawing


@style()
def axes_figure(fit: KDFit) -> Figure | None:
    """Draw the footplate with origin and principal axes of the stiffness (paper, Fig. 6) and their draws."""
    values = fit.derived.axes
    if values is None:
        return None
    drawing, panel = panels(1, 1, width=6.2, height=4.2)
    axes = panel[0, 0]
    if fit.outline_mm is not None:
        outline = fit.outline_mm
        axes.fill(*outline.T, color=lighten(BODY_COLOURS["stapes"], 0.8), lw=0)
        axes.plot(*np.vstack([outline, outline[:1]]).T, color=BODY_COLOURS["stapes"], lw=1.2)
    stiffness = entries.split(fit.draws.draws[:400], len(fit.dof))[0]
    drawn = principal_axes(stiffness[stiffness[:, 0, 0] > 0.0])
    axes.plot(
        1e3 * drawn[:, 0], 1e3 * drawn[:, 1], ".", ms=1.5, color=FITTED, alpha=0.3, label="origin, draws"
    )
    origin, angle = 1e3 * values[:2], values[2]
    for turn, name in ((angle, "near x"), (angle + 0.5 * np.pi, "near z")):
        along = np.array([np.cos(turn), -np.sin(turn)])
        ends = origin + np.outer([-0.8, 0.8], along)
        axes.plot(*ends.T, color=FITTED, lw=1.4)
        axes.annotate(name, ends[1], color=FITTED, fontsize=8)
    axes.plot(0.0, 0.0, "+", color=MEASURED, ms=9, label="footplate centre")
    axes.set_aspect("equal")
    axes.set_xlabel("x (mm), + anterior")
    axes.set_ylabel("z (mm)")
    axes.legend(loc="best")
    return drawing


@style()
def rim_figure(rim: Rim) -> Figure:
    """Draw the rim with its stiffness as colour and width, and the names of its sides."""
    from matplotlib.collections import LineCollection

    drawing, grid = panels(1, 1, width=6.4, height=3.8)
    axes = grid[0, 0]
    shade = (rim.ratio - rim.ratio.min()) / max(float(np.ptp(rim.ratio)), 1e-9)
    pieces = list(np.stack([rim.points_mm, np.roll(rim.points_mm, -1, axis=0)], axis=1))
    axes.add_collection(LineCollection(pieces, array=shade, cmap="viridis", linewidths=3.0 + 7.0 * shade))
    low, high = rim.points_mm.min(axis=0), rim.points_mm.max(axis=0)
    x, z = 0.5 * (low + high)
    named = {"left": ("superior", "inferior"), "right": ("inferior", "superior")}
    up, down = named.get(rim.side, ("+z", "-z"))
    middle = {"ha": "center", "va": "center", "fontsize": 9}
    axes.annotate(f"{rim.ratio[rim.stiffest]:.2f}", rim.points_mm[rim.stiffest], **middle)
    for text, place in (
        ("anterior", (high[0] + 0.25, z)),
        ("posterior", (low[0] - 0.25, z)),
        (up, (x, high[1] + 0.2)),
        (down, (x, low[1] - 0.2)),
    ):
        axes.text(*place, text, color="#52606d", **middle)
    axes.set_aspect("equal")
    axes.set(xlabel="x (mm)", ylabel="z (mm)", xlim=(low[0] - 0.7, high[0] + 0.7))
    axes.set_ylim(low[1] - 0.45, high[1] + 0.45)
    return drawing


def all_figures(fit: KDFit) -> dict[str, Figure]:
    """Return every figure of the page by its file name; the responses of up to four runs."""
    runs = range(min(len(fit.found.data.runs), _MOST_RUNS))
    drawn = {
        **{f"responses_run_{run + 1}": response_figure(fit, run) for run in runs},
        "principal_axes": axes_figure(fit),
        "residuals": residual_figure(fit),
    }
    return {name: one for name, one in drawn.items() if one is not None}
