"""The figures of a motion: spectra, and residuals of every channel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from kinematics.fit.rigid_fit import LineFit
from stapeskit.arrays import Array, ComplexArray
from stapeskit.report.colours import VERDICT_COLOURS, colour_of
from stapeskit.report.figures import (
    RUN_STYLES,
    amplitude_axis,
    decimate_lines,
    dof_unit,
    frequency_axis,
    log_spaced,
    panels,
    plain,
    shorten_name,
    style,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from kinematics.results import MotionResult
    from stapeskit.records.rigid_motion import RigidMotion

MOST_RUNS = 4  # drawn: more styles of lines cannot be told apart
_TWO_SIDED_95 = 1.96
_MOST_LINES = 400  # of all curves of a panel together, so that the figure stays a vector drawing
_COLUMNS = 240  # of the map of residuals
_MOST_ROWS = 90  # channels of a map; the worst of more
_TICKED_ROWS = 45


@style()
def spectra_figure(motion: RigidMotion) -> Figure:
    """Draw amplitude and phase of every degree of freedom over frequency, with 95 % bands of the noise."""
    count = len(motion.dof)
    drawing, axes = panels(count, 2, height=1.75, share_x=True, margins=(0.62, 0.12, 0.34, 0.46))
    sd = motion.standard_deviation
    runs = range(min(len(motion.runs), MOST_RUNS))
    most = max(60, _MOST_LINES // (len(motion.bodies) * len(runs)))
    for place, name in enumerate(motion.dof):
        factor, unit = dof_unit(name, motion.reference)
        amplitude, phase = axes[place]
        extent: list[float] = []
        for body, body_name in enumerate(motion.bodies):
            for run in runs:
                q, spread = factor * motion.q[run, body, :, place], factor * sd[run, body, :, place]
                lines = decimate_lines(np.abs(q), most)
                look = {"color": colour_of(body_name, motion.bodies), "ls": RUN_STYLES[run % len(RUN_STYLES)]}
                label = body_name if len(motion.runs) == 1 else f"{body_name}, run {motion.runs[run]}"
                _curve(
                    amplitude, phase, motion.freq_hz[lines] / 1e3, q[lines], spread[lines], plain(label), look
                )
                size = np.abs(q)[np.isfinite(q) & (q != 0.0)]
                extent += [float(size.min()), float(size.max())] if size.size else []
        per = f" / {motion.reference}" if motion.reference else ""
        amplitude.set_ylabel(plain(f"|{name}{per}| ({unit})"))
        phase.set_ylabel(f"phase of {name} (°)")
        phase.set_ylim(-190, 190)
        phase.set_yticks([-180, 0, 180])
        if extent:
            amplitude_axis(amplitude, min(extent), max(extent))
    for view in axes[:, :].flat:
        frequency_axis(view, motion.freq_hz, label=view in axes[-1])
    handles, labels = axes[0, 0].get_legend_handles_labels()
    if handles:
        drawing.legend(handles, labels, loc="upper center", ncols=min(len(labels), 5))
    return drawing


def _curve(
    amplitude: Axes,
    phase: Axes,
    freq_khz: Array,
    q: ComplexArray,
    sd: Array,
    label: str,
    look: dict[str, Any],
) -> None:
    """Draw amplitude and phase of one motion with their bands."""
    size = np.abs(q)
    good = np.isfinite(size) & (size > 0.0)
    if not np.any(good):
        return
    freq_khz, q, size, wide = freq_khz[good], q[good], size[good], _TWO_SIDED_95 * np.nan_to_num(sd[good])
    look = {**look, "marker": "." if len(q) < 8 else ""}
    low = np.maximum(size - wide, 0.2 * float(size.min()))
    amplitude.fill_between(freq_khz, low, size + wide, color=look["color"], alpha=0.22, lw=0)
    amplitude.plot(freq_khz, size, label=label, **look)
    angle = np.rad2deg(np.angle(q))
    spread = np.minimum(np.rad2deg(wide / size), 180.0)
    phase.fill_between(freq_khz, angle - spread, angle + spread, color=look["color"], alpha=0.16, lw=0)
    jump = np.abs(np.diff(angle, prepend=angle[0])) > 180.0
    phase.plot(freq_khz, np.where(jump, np.nan, angle), **look)


@style()
def residual_figure(result: MotionResult, run: int = 0) -> Figure:
    """Draw the residual of every channel over frequency in units of its noise, and its mean as bars."""
    bodies = result.measurement.bodies
    rows = [min(len(body.points), _MOST_ROWS) for body in bodies]
    drawing, axes = panels(len(bodies), 2, height=1.0, margins=(1.15, 0.9, 0.34, 0.46), gaps=(0.16, 0.5))
    total = drawing.get_size_inches()[0]
    heights = [max(0.9, 0.085 * count) for count in rows]
    tall = sum(heights) + 0.62 * (len(bodies) - 1) + 0.86
    drawing.set_size_inches(total, tall)
    top = 1.0 - 0.4 / tall
    image = None
    for number, body in enumerate(bodies):
        grid, bars = axes[number]
        share = heights[number] / tall
        grid.set_position((0.11, top - share, 0.66, share))
        bars.set_position((0.785, top - share, 0.12, share))
        top -= share + 0.62 / tall
        size, edges, rms = _residual_map(result.fits[run, number], result.motion.freq_hz)
        order = np.arange(len(body.points))
        if len(order) > _MOST_ROWS:
            order = np.sort(np.argsort(-rms)[:_MOST_ROWS])
        verdicts = [
            one for one in result.channels if one.body == body.body and one.run == result.motion.runs[run]
        ]
        image = grid.pcolormesh(
            edges / 1e3,
            np.arange(len(order) + 1),
            size[order],
            vmin=0.0,
            vmax=4.0,
            cmap="magma_r",
            rasterized=True,
        )
        colours = [VERDICT_COLOURS[verdicts[channel].verdict] for channel in order]
        bars.barh(np.arange(len(order)) + 0.5, np.nan_to_num(rms[order]), height=0.8, color=colours)
        bars.axvline(1.0, color="#56636f", lw=0.7)
        bars.set_xlim(0.0, max(1.6, min(6.0, 1.1 * float(np.nanmax(rms, initial=1.0)))))
        step = max(1, int(np.ceil(len(order) / _TICKED_ROWS)))
        ticks = np.arange(0, len(order), step)
        labels = [shorten_name(body.points[order[tick]], 10) for tick in ticks]
        labels = ["" if k and labels[k - 1] == label else plain(label) for k, label in enumerate(labels)]
        grid.set_yticks(ticks + 0.5, labels, fontsize=7)
        bars.set_yticks([])
        for view in (grid, bars):
            view.set_ylim(len(order), 0)
            view.grid(False)
        frequency_axis(grid, result.motion.freq_hz, label=number == len(bodies) - 1)
        grid.set_title(plain(f"{body.body}: |residual| / sd, every point and beam"))
        bars.set_title("rms")
    if image is not None:
        scale = drawing.colorbar(image, cax=drawing.add_axes((0.925, 1.0 - 0.4 / tall - share, 0.012, share)))
        scale.outline.set_visible(False)
    return drawing


def _residual_map(fit: LineFit, freq_hz: Array) -> tuple[Array, Array, Array]:
    """Return sizes of residuals over noise (c, columns), edges of columns (Hz), and their rms (c,)."""
    parts = np.array_split(np.arange(len(freq_hz)), min(_COLUMNS, len(freq_hz)))
    size = np.empty((len(fit.beams.rows), len(parts)))
    squares, counts = np.zeros(len(size)), np.zeros(len(size))
    for column, lines in enumerate(parts):
        with np.errstate(invalid="ignore"):
            own = np.abs(fit.residual(lines)) ** 2 / (2.0 * fit.sd_m(lines) ** 2)
        known = np.isfinite(own)
        total, number = np.where(known, own, 0.0).sum(axis=1), known.sum(axis=1)
        squares, counts = squares + total, counts + number
        with np.errstate(invalid="ignore", divide="ignore"):
            size[:, column] = np.sqrt(total / number)
    first = np.array([freq_hz[lines[0]] for lines in parts])
    last = float(freq_hz[-1])
    if len(first) > 1:
        middle = np.sqrt(first[1:] * first[:-1]) if log_spaced(freq_hz) else 0.5 * (first[1:] + first[:-1])
        edges = np.concatenate([[first[0]], middle, [last]])
    else:
        edges = np.array([0.99 * first[0], 1.01 * last])
    with np.errstate(invalid="ignore", divide="ignore"):
        return size, edges, np.sqrt(squares / counts)
