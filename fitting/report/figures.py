"""Figures of a fit: responses (paper, Figs. 4 and 5), footplate with rim and axes (Fig. 6), residuals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fitting.ring import rim_of
from fitting.uncertainty import known_exactly
from stapeskit.arrays import Array, ComplexArray
from stapeskit.report.colours import BODY_COLOURS, FITTED, MEASURED, PAGE_COLOURS, lighten
from stapeskit.report.figures import amplitude_axis, decimate_lines, dof_unit, frequency_axis, panels, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from fitting.result import KDFit
    from fitting.ring import Rim

_CLEAR = 3.0  # standard deviations from which a response is clear of its noise
MOST_RUNS = 4  # whose responses are drawn


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
    """Simulate the structure from measured base motion and load (paper, Eq. 8).

    The uncertainty is that of K and D beside the M of the fit: an error of M scales all three, and the
    response stays.
    """
    found, data = fit.found, fit.found.data
    lines, rows = data.run == run, np.array(data.rows)
    simulated, slopes = (part[lines] for part in found.likelihood.response(found.theta))
    along = (slopes * (simulated / np.maximum(np.abs(simulated), 1e-300)).conj()[..., None]).real
    count, start = found.at["entries"].stop, found.at["shared"].start
    others = [place for place, source in enumerate(data.sources) if not source.startswith("mass.")]
    covariance = known_exactly(found, np.concatenate([np.arange(start), start + np.array(others, dtype=int)]))
    variance = np.einsum("lip,pq,liq->li", along, covariance[:count, :count], along)
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
    width, margins = max(12.0, 3.5 * n), (0.62, 0.12, 0.5, 0.46)
    drawing, axes = panels(2, n, width=width, height=2.3, margins=margins, share_x=True)
    for place, name in enumerate(fit.dof):
        _amplitudes(axes[0, place], shown, order, place, dof_unit(name))
        axes[0, place].set_title(f"{name} of the {fit.options.structure}")
        _phases(axes[1, place], shown, order, place)
        frequency_axis(axes[1, place], shown.freq_hz[order])
    drawing.legend(*axes[0, 0].get_legend_handles_labels(), loc="upper center", ncols=3)
    axes[1, 0].set_ylabel("phase (°)")
    return drawing


@style()
def amplitude_figure(fit: KDFit) -> Figure:
    """Draw the amplitudes of the first run below each other, small: for the first screen."""
    shown = responses(fit)
    order = np.argsort(shown.freq_hz)
    margins = (0.62, 0.06, 0.24, 0.42)
    drawing, axes = panels(len(fit.dof), 1, width=4.4, height=1.0, margins=margins, share_x=True)
    for place, name in enumerate(fit.dof):
        _amplitudes(axes[place, 0], shown, order, place, dof_unit(name))
        axes[place, 0].set_ylabel(f"|{name}| ({dof_unit(name)[1]})")
        frequency_axis(axes[place, 0], shown.freq_hz[order], label=place == len(fit.dof) - 1)
    drawing.legend(*axes[0, 0].get_legend_handles_labels(), loc="upper right", ncols=3, columnspacing=1.0)
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
    axes.plot(freq, base, color=lighten(BODY_COLOURS["base"]), lw=1.2, label="base")
    axes.plot(freq[kept], measured[kept], ".", ms=3, color=MEASURED, alpha=0.7, label="measured")
    lower = np.maximum(simulated - spread, 1e-12)
    axes.fill_between(freq, lower, simulated + spread, color=FITTED, alpha=0.25, lw=0)
    axes.plot(freq, simulated, color=FITTED, lw=1.2, label="fitted, with 95 %")
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
    """Draw the normalised residuals over frequency."""
    data = fit.found.data
    white = fit.found.likelihood.look(fit.found.theta)[0] * np.sqrt(2.0 * fit.found.noise)
    drawing, grid = panels(height=2.6)
    axes = grid[0, 0]
    freq = np.repeat(data.freq_hz, white.shape[1]) / 1e3
    for part, colour, label in (
        (white.real, MEASURED, "real"),
        (white.imag, PAGE_COLOURS["information"], "imaginary"),
    ):
        axes.plot(freq, part.ravel(), ".", color=colour, alpha=0.6, label=label, ms=2.5, rasterized=True)
    for level in (-1.96, 1.96):
        axes.axhline(level, color=MEASURED, lw=0.7, ls=":")
    frequency_axis(axes, np.sort(data.freq_hz))
    axes.set_ylabel("residual over its noise")
    axes.legend(ncols=2)
    return drawing


@style()
def footplate_figure(fit: KDFit) -> Figure | None:
    """Draw the footplate with the stiffness along its rim and the principal axes of K (paper, Fig. 6).

    Of a mass without a scan the axes stand alone, about the footplate centre.
    """
    axes_of_k, outline, rim = fit.derived.axes, fit.inertia.outline_mm, rim_of(fit)
    if axes_of_k is None and rim is None:
        return None
    drawing, grid = panels(1, 1, width=4.4, height=2.45, margins=(0.58, 0.16, 0.06, 0.42))
    axes = grid[0, 0]
    shown = [np.zeros((1, 2))] if outline is None else [outline]
    if rim is not None:
        _rim(axes, rim)
    elif outline is not None:
        axes.plot(*np.vstack([outline, outline[:1]]).T, color=BODY_COLOURS["stapes"], lw=1.2)
    if axes_of_k is not None:
        origin, angle = 1e3 * axes_of_k[:2], axes_of_k[2]
        for turn in (angle, angle + 0.5 * np.pi):
            ends = origin + np.outer([-0.45, 0.45], [np.cos(turn), -np.sin(turn)])
            axes.plot(*ends.T, color=FITTED, lw=1.3)
            shown += [ends] if outline is None else []
    axes.plot(0.0, 0.0, "+", color=MEASURED, ms=8)
    low, high = np.min(np.concatenate(shown), axis=0), np.max(np.concatenate(shown), axis=0)
    x, z = 0.5 * (low + high)
    up, down = {"left": ("superior", "inferior"), "right": ("inferior", "superior")}.get(
        fit.inertia.side, ("+z", "-z")
    )
    for text, place in (
        ("anterior", (high[0] + 0.34, z)),
        ("posterior", (low[0] - 0.36, z)),
        (up, (x, high[1] + 0.17)),
        (down, (x, low[1] - 0.17)),
    ):
        axes.text(*place, text, color=PAGE_COLOURS["soft"], ha="center", va="center", fontsize=9)
    axes.set(xlabel="x (mm)", ylabel="z (mm)", xlim=(low[0] - 0.7, high[0] + 0.7), aspect="equal")
    axes.set_ylim(low[1] - 0.3, high[1] + 0.3)
    return drawing


def _rim(axes: Axes, rim: Rim) -> None:
    """Draw the rim with its stiffness as colour and width, and the largest and the smallest as numbers."""
    from matplotlib.collections import LineCollection

    shade = (rim.ratio - rim.ratio.min()) / max(float(np.ptp(rim.ratio)), 1e-9)
    pieces = list(np.stack([rim.points_mm, np.roll(rim.points_mm, -1, axis=0)], axis=1))
    lines = LineCollection(pieces, array=shade, cmap="viridis", linewidths=2.0 + 7.0 * shade)
    lines.set_capstyle("round")
    axes.add_collection(lines)
    middle = rim.points_mm.mean(axis=0)
    for place in (rim.stiffest, int(np.argmin(rim.ratio))):
        inward = middle + 0.76 * (rim.points_mm[place] - middle)
        axes.annotate(f"{rim.ratio[place]:.2f}", inward, ha="center", va="center", fontsize=9)


def all_figures(fit: KDFit) -> dict[str, Figure]:
    """Return every figure of the page by its file name; the responses of up to four runs."""
    runs = range(min(len(fit.found.data.runs), MOST_RUNS))
    drawn = {
        **{f"responses_run_{run + 1}": response_figure(fit, run) for run in runs},
        "footplate": footplate_figure(fit),
        "residuals": residual_figure(fit),
    }
    return {name: one for name, one in drawn.items() if one is not None}
