"""Spectra of the degrees of freedom with their bands, and chi2 over frequency."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array
from legacy.stapeskit.page.drawings import (
    GRID,
    INK,
    RUN_STYLES,
    amplitude_axis,
    colour,
    decimate_lines,
    frequency_axis,
    run_label,
    unit,
)
from legacy.stapeskit.page.page import new_figure
from legacy.stapeskit.records.motion import RigidMotion
from legacy.stapeskit.records.motion_files import standard_deviation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Quantile of the normal distribution.
TWO_SIDED_95 = 1.96
# Beyond, a picture is smaller than SVG.
_MOST_VERTICES = 25_000


def vertices_of(motion: RigidMotion, runs: int) -> int:
    """Return about how many vertices the curves of some runs have: many are better drawn as pixels."""
    return (
        6 * runs * len(motion.bodies) * len(motion.dof) * min(len(motion.freq_hz), _count_lines(motion, runs))
    )


def is_light(motion: RigidMotion, runs: int) -> bool:
    """Return whether a vector drawing of some runs stays small."""
    return vertices_of(motion, runs) <= _MOST_VERTICES


def _count_lines(motion: RigidMotion, runs: int) -> int:
    """Return how many lines of a curve are drawn."""
    curves = max(1, runs * len(motion.bodies) * len(motion.dof))
    return int(np.clip(40_000 // curves, 400, 1600))


def spectra_figure(motion: RigidMotion, runs: tuple[int, ...] = (0,)) -> Figure:
    """Draw amplitude and phase of every degree of freedom with bands that hold 95 % of the channel noise.

    Parameters
    ----------
    runs : tuple of int
        At most four.
    """
    count = len(motion.dof)
    figure = new_figure(11.0, 1.85 * count + 0.8)
    axes = figure.subplots(count, 2, sharex=True, squeeze=False)
    sd = standard_deviation(motion)
    most = _count_lines(motion, len(runs))
    for place, name in enumerate(motion.dof):
        scale, label = unit(name, motion.reference)
        amplitude, phase = axes[place]
        for body, body_name in enumerate(motion.bodies):
            for style, run in enumerate(runs):
                q = motion.q[run, body, :, place] * scale
                lines = decimate_lines(np.abs(q), most)
                look: dict[str, Any] = {"color": colour(body), "ls": RUN_STYLES[style % len(RUN_STYLES)]}
                curve = (motion.freq_hz[lines] / 1e3, q[lines], sd[run, body, lines, place] * scale)
                _bands(
                    amplitude, phase, *curve, run_label(body_name, motion.runs[run], len(motion.runs)), look
                )
        amplitude_axis(amplitude)
        per = f" / {motion.reference}" if motion.reference else ""
        amplitude.set_ylabel(f"|{name}{per}| ({label})", fontsize=9)
        amplitude.tick_params(axis="y", which="minor", labelsize=7)
        phase.set_ylabel(f"phase of {name} (°)", fontsize=9)
        phase.set_ylim(-190, 190)
        phase.set_yticks([-180, -90, 0, 90, 180])
        for view in (amplitude, phase):
            view.grid(True, color=GRID, lw=0.6)
            view.tick_params(labelsize=8)
    for view in axes[-1]:
        frequency_axis(view, motion.freq_hz)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    if handles:
        figure.legend(
            handles,
            labels,
            loc="outside upper center",
            ncols=2 if len(labels) > 3 else 3,
            frameon=False,
            fontsize=9,
        )
    return figure


def _bands(
    amplitude: Axes,
    phase: Axes,
    freq: Array,
    q: NDArray[np.complex128],
    sd: Array,
    label: str,
    style: dict[str, Any],
) -> None:
    size = np.abs(q)
    good = np.isfinite(size) & (size > 0.0)
    if not np.any(good):
        return
    marker = "." if np.sum(good) < 8 else ""
    freq, q, sd, size = freq[good], q[good], np.nan_to_num(sd[good]), size[good]
    wide = TWO_SIDED_95 * sd
    floor = float(np.min(size)) * 0.2
    amplitude.fill_between(
        freq, np.maximum(size - wide, floor), size + wide, color=style["color"], alpha=0.22, lw=0
    )
    amplitude.plot(freq, size, label=label, lw=1.1, marker=marker, **style)
    angle = np.degrees(np.angle(q))
    spread = np.minimum(np.degrees(wide / size), 180.0)
    phase.fill_between(freq, angle - spread, angle + spread, color=style["color"], alpha=0.16, lw=0)
    jump = np.abs(np.diff(angle, prepend=angle[0])) > 180.0
    phase.plot(freq, np.where(jump, np.nan, angle), lw=1.0, marker=marker, **style)


def chi2_figure(motion: RigidMotion, runs: tuple[int, ...] = (0,)) -> Figure:
    """Draw chi2 per degree of freedom over frequency with the 95 % range of a rigid body."""
    from matplotlib.ticker import FormatStrFormatter, LogLocator
    from scipy.special import chdtri

    figure = new_figure(11.0, 2.9)
    view = figure.subplots()
    freq = motion.freq_hz / 1e3
    markers = ("o", "^", "s", "x")
    for body, name in enumerate(motion.bodies):
        for style, run in enumerate(runs):
            n_dof = motion.n_dof[run, body]
            good = (n_dof > 0) & np.isfinite(motion.chi2[run, body])
            if not np.any(good):
                continue
            ratio = np.where(good, motion.chi2[run, body] / np.maximum(n_dof, 1), np.nan)
            lines = decimate_lines(ratio, _count_lines(motion, len(runs)))
            label = run_label(name, motion.runs[run], len(motion.runs))
            view.plot(
                freq[lines],
                ratio[lines],
                markers[style % 4],
                ms=2.6,
                mew=0.6,
                color=colour(body),
                alpha=0.75,
                label=label,
            )
            typical = float(np.median(n_dof[good]))
            for level in (0.975, 0.025):
                view.axhline(float(chdtri(typical, level)) / typical, color=colour(body), lw=0.9, ls="--")
    view.axhline(1.0, color=INK, lw=0.8)
    view.set_yscale("log")
    view.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    view.yaxis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
    view.yaxis.set_minor_formatter(FormatStrFormatter("%g"))
    frequency_axis(view, motion.freq_hz)
    view.set_ylabel("chi2 / degrees of freedom", fontsize=9)
    view.grid(True, color=GRID, lw=0.6)
    view.tick_params(labelsize=8)
    figure.legend(loc="outside upper center", ncols=3, frameon=False, fontsize=9)
    return figure
