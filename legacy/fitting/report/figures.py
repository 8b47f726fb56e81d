"""Figures of a fit: responses (Figs. 4, 5), correlations, frequencies, principal axes (Fig. 6), residuals.

Mode shapes are drawn in mode_shapes.py. A section of sections.py shows each figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from legacy.fitting.report.responses import Responses
from legacy.fitting.uncertainty.frequency_dependence import FrequencyDependence
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.page.drawings import amplitude_axis
from legacy.stapeskit.page.page import new_figure
from legacy.stapeskit.spatial import DOF_UNITS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MEASURED = "#5d6b7a"
SIMULATED = "#0b6e99"
BASE = "#b7c0ca"
ACCENT = "#c2571a"
# A response is clear of its noise when it is so many standard deviations.
_CLEAR = 3.0


def response_figure(responses: Responses, run: int, body: str = "stapes") -> Figure:
    """Draw amplitude and phase of every degree of freedom of one run, measured and simulated."""
    chosen = responses.run == run
    freq = responses.freq_hz[chosen]
    n = len(responses.dof)
    columns = min(n, 3)
    blocks = -(-n // columns)
    figure = new_figure(3.7 * columns, 4.3 * blocks)
    axes = figure.subplots(2 * blocks, columns, sharex=True, squeeze=False, height_ratios=[3, 2] * blocks)
    for place, name in enumerate(responses.dof):
        block, column = divmod(place, columns)
        scale, unit = _unit(name, responses.measured[chosen, place])
        upper, lower = axes[2 * block, column], axes[2 * block + 1, column]
        _amplitude(upper, freq, responses, chosen, place, scale)
        upper.set_title(f"{name} of the {body}", fontsize=11)
        upper.set_ylabel(f"amplitude ({unit})")
        _phase(lower, freq, responses, chosen, place)
        lower.set_xlabel("frequency (Hz)")
        if column == 0:
            lower.set_ylabel("phase (°)")
    for place in range(n, blocks * columns):
        block, column = divmod(place, columns)
        axes[2 * block, column].set_visible(False)
        axes[2 * block + 1, column].set_visible(False)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False, fontsize=9)
    return figure


def _unit(name: str, values: NDArray[np.complex128]) -> tuple[float, str]:
    largest = float(np.nanmax(np.abs(values)))
    for scale, prefix in ((1.0, ""), (1e3, "m"), (1e6, "µ"), (1e9, "n"), (1e12, "p")):
        if largest * scale >= 1.0:
            return scale, prefix + DOF_UNITS[name]
    return 1e12, "p" + DOF_UNITS[name]


def _amplitude(
    axis: Axes, freq: Array, responses: Responses, chosen: Array, place: int, scale: float
) -> None:
    measured = np.abs(responses.measured[chosen, place]) * scale
    simulated = np.abs(responses.simulated[chosen, place]) * scale
    band = 1.96 * responses.amplitude_sd[chosen, place] * scale
    noise = responses.measured_sd[chosen, place] * scale
    style: dict[str, Any] = {"fmt": "o", "ms": 2.2, "lw": 0.6, "color": MEASURED, "alpha": 0.6, "zorder": 2}
    axis.plot(
        freq, np.abs(responses.base[chosen, place]) * scale, color=BASE, lw=1.2, label="base, transported"
    )
    axis.errorbar(freq, measured, yerr=noise, label="measured ± sd", **style)
    axis.fill_between(
        freq, np.maximum(simulated - band, 0.0), simulated + band, color=SIMULATED, alpha=0.25, lw=0
    )
    axis.plot(freq, simulated, color=SIMULATED, lw=1.3, label="simulated (Eq. 8), 95 % band", zorder=3)
    amplitude_axis(axis, 0.5)
    axis.tick_params(axis="y", which="minor", labelsize=8)
    low = float(np.nanmin(np.where(measured > 0.0, measured, np.nan)))
    high = float(max(np.nanmax(measured), np.nanmax(simulated)))
    axis.set_ylim(max(0.6 * low, high * 1e-4), 1.8 * high)
    _tidy(axis, freq)


def _phase(axis: Axes, freq: Array, responses: Responses, chosen: Array, place: int) -> None:
    simulated = _unwrap(responses.simulated[chosen, place], responses.measured_sd[chosen, place])
    measured = np.angle(responses.measured[chosen, place] * np.exp(-1j * simulated)) + simulated
    spread = responses.amplitude_sd[chosen, place] / np.maximum(
        np.abs(responses.simulated[chosen, place]), 1e-300
    )
    band = np.degrees(np.minimum(1.96 * spread, np.pi))
    degrees = np.degrees(simulated)
    axis.plot(freq, np.degrees(measured), "o", ms=2.2, color=MEASURED, alpha=0.6)
    axis.fill_between(freq, degrees - band, degrees + band, color=SIMULATED, alpha=0.25, lw=0)
    axis.plot(freq, degrees, color=SIMULATED, lw=1.3, zorder=3)
    _tidy(axis, freq)


def _unwrap(response: NDArray[np.complex128], noise: Array) -> Array:
    """Return the phase (lines,), rad, unwrapped over lines well above their noise.

    A line within its noise takes the turn of the clear line before it, so that noise cannot add turns.
    """
    phase = np.angle(response)
    clear = np.flatnonzero(np.abs(response) > _CLEAR * np.nan_to_num(noise))
    if len(clear) < 2:
        return phase
    known = np.unwrap(phase[clear])
    before = known[np.maximum(np.searchsorted(clear, np.arange(len(phase)), side="right") - 1, 0)]
    return phase + 2.0 * np.pi * np.round((before - phase) / (2.0 * np.pi))


def _tidy(axis: Axes, freq: Array) -> None:
    axis.set_xlim(freq.min(), freq.max() if freq.max() > freq.min() else freq.min() + 1.0)
    axis.grid(True, color="#e6eaee", lw=0.6)
    axis.set_axisbelow(True)
    axis.tick_params(labelsize=9)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)


def residual_figure(responses: Responses) -> Figure:
    """Draw the normalised residuals over frequency and their distribution against the normal one."""
    figure = new_figure(10.5, 3.0)
    left, right = figure.subplots(1, 2, width_ratios=[3, 1])
    values = responses.normalised
    parts = np.concatenate([values.real.ravel(), values.imag.ravel()])
    shown = np.repeat(responses.freq_hz, values.shape[1])
    left.plot(shown, values.real.ravel(), ".", ms=2.5, color=SIMULATED, alpha=0.6, label="real")
    left.plot(shown, values.imag.ravel(), ".", ms=2.5, color=ACCENT, alpha=0.6, label="imaginary")
    for level in (-2.0, 2.0):
        left.axhline(level, color=MEASURED, lw=0.8, ls="--")
    limit = max(4.0, 1.05 * float(np.max(np.abs(parts))))
    left.set_ylim(-limit, limit)
    left.set_xlabel("frequency (Hz)")
    left.set_ylabel("residual / its sd")
    left.legend(frameon=False, fontsize=9, loc="upper right", ncols=2)
    _tidy(left, responses.freq_hz)
    edges = np.linspace(-limit, limit, 41)
    right.hist(np.clip(parts, -limit, limit), edges, density=True, color=SIMULATED, alpha=0.5)
    grid = np.linspace(-limit, limit, 200)
    right.plot(grid, np.exp(-(grid**2) / 2.0) / np.sqrt(2.0 * np.pi), color=MEASURED, lw=1.3)
    right.set_xlabel("residual / its sd")
    right.set_yticks([])
    for side in ("top", "right", "left"):
        right.spines[side].set_visible(False)
    return figure


def principal_figure(
    values: Array,
    deviations: Array | None,
    outline_mm: Array | None,
    mass_centre_mm: tuple[float, float] | None,
) -> Figure:
    """Draw the principal axes over the footplate's outline, seen from lateral (y towards the reader).

    Parameters
    ----------
    values : ndarray, (6,)
        x0, z0 (m), angle (rad), three stiffnesses.
    deviations : ndarray, (6,), optional
        Their standard deviations.
    outline_mm : ndarray, (points, 2 or 3), optional
        Outline of the footplate in footplate axes, x and z (or x, y, z).
    mass_centre_mm : (float, float), optional
        Centre of mass, x and z.
    """
    figure = new_figure(6.6, 4.2)
    axis = figure.subplots()
    if outline_mm is not None and len(outline_mm):
        ring = np.asarray(outline_mm, dtype=float)[:, [0, -1]]
        ring = np.vstack([ring, ring[:1]])
        axis.fill(ring[:, 0], ring[:, 1], color="#eef2f5", zorder=0)
        axis.plot(ring[:, 0], ring[:, 1], color=MEASURED, lw=1.2, label="footplate outline", zorder=1)
    for direction, name in (((1.0, 0.0), "x"), ((0.0, 1.0), "z")):
        _arrow(axis, (0.0, 0.0), direction, MEASURED, name)
    origin = values[:2] * 1e3
    first = np.array([np.cos(values[2]), -np.sin(values[2])])
    second = np.array([np.sin(values[2]), np.cos(values[2])])
    for along, name in ((first, "x′"), (second, "z′")):
        _arrow(axis, origin, along, SIMULATED, name)
    axis.plot(0.0, 0.0, "o", color=MEASURED, ms=4, label="footplate centre")
    axis.plot(*origin, "o", color=SIMULATED, ms=5, label="stiffness centre")
    if deviations is not None and np.all(np.isfinite(deviations[:2])):
        axis.errorbar(
            origin[0],
            origin[1],
            xerr=1.96e3 * deviations[0],
            yerr=1.96e3 * deviations[1],
            color=SIMULATED,
            capsize=2,
            lw=1,
        )
    if mass_centre_mm is not None:
        axis.plot(*mass_centre_mm, "x", color=ACCENT, ms=6, mew=1.6, label="centre of mass")
    axis.set_aspect("equal")
    axis.margins(0.08)
    axis.set_xlabel("x, long axis, + anterior (mm)")
    axis.set_ylabel("z, short axis (mm)")
    axis.invert_yaxis()
    axis.legend(frameon=False, fontsize=9, loc="center left", bbox_to_anchor=(1.01, 0.5))
    axis.grid(True, color="#e6eaee", lw=0.6)
    axis.set_axisbelow(True)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
    return figure


def _arrow(axis: Axes, start: ArrayLike, direction: ArrayLike, color: str, name: str) -> None:
    begin, along = np.asarray(start, dtype=float), np.asarray(direction, dtype=float)
    tip = begin + along
    arrow = {"arrowstyle": "-|>", "color": color, "lw": 1.4}
    axis.annotate("", (tip[0], tip[1]), (begin[0], begin[1]), arrowprops=arrow)
    label = begin + 1.1 * along
    axis.plot(*(begin + 1.16 * along), alpha=0.0)
    axis.text(label[0], label[1], name, color=color, ha="center", va="center", fontsize=10)


def frequency_figure(dependence: FrequencyDependence) -> Figure:
    """Draw the local factors of K and D over frequency with 95 % intervals."""
    figure = new_figure(9.0, 2.9)
    panels = figure.subplots(1, 2, sharex=True)
    for axis, name, factor, sd in (
        (panels[0], "K", dependence.stiffness, dependence.stiffness_sd),
        (panels[1], "D", dependence.damping, dependence.damping_sd),
    ):
        middle = 0.5 * (dependence.low_hz + dependence.high_hz)
        half = 0.5 * (dependence.high_hz - dependence.low_hz)
        axis.axhline(1.0, color=BASE, lw=1.0, zorder=1)
        axis.errorbar(
            middle,
            factor,
            yerr=1.96 * sd,
            xerr=half,
            fmt="o",
            ms=4,
            color=SIMULATED,
            ecolor=SIMULATED,
            lw=1.2,
        )
        largest = float(np.max(np.abs(factor - 1.0) + 1.96 * sd))
        axis.set_ylim(1.0 - 1.15 * largest, 1.0 + 1.15 * largest)
        axis.set_xlabel("frequency (Hz)")
        axis.set_ylabel(f"{name} of the part / {name}")
    return figure


def correlation_figure(covariance: Array, names: Sequence[str]) -> Figure:
    """Draw the correlation matrix of the entries, in percent."""
    sd = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    percent = 100.0 * covariance / np.outer(sd, sd)
    side = 0.9 + 0.36 * len(names)
    figure = new_figure(side, side)
    axis = figure.subplots()
    axis.imshow(percent, cmap="RdBu_r", vmin=-100.0, vmax=100.0)
    for (row, column), value in np.ndenumerate(percent):
        color = "white" if abs(value) > 50.0 else "#1d2733"
        axis.text(column, row, f"{value:.0f}", ha="center", va="center", fontsize=7, color=color)
    axis.set_xticks(range(len(names)), names, rotation=90, fontsize=8)
    axis.set_yticks(range(len(names)), names, fontsize=8)
    axis.tick_params(length=0)
    for side_name in ("top", "right", "bottom", "left"):
        axis.spines[side_name].set_visible(False)
    return figure
