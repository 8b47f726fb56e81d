"""The figures of a motion: spectra, and residuals of every channel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

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
                look["label"] = plain(label)
                _curve((amplitude, phase), motion.freq_hz[lines] / 1e3, q[lines], spread[lines], look)
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
    axes: tuple[Axes, Axes], freq_khz: Array, q: ComplexArray, sd: Array, look: dict[str, Any]
) -> None:
    """Draw amplitude and phase of one motion with their bands."""
    amplitude, phase = axes
    size = np.abs(q)
    good = np.isfinite(size) & (size > 0.0)
    if not np.any(good):
        return
    freq_khz, q, size, wide = freq_khz[good], q[good], size[good], _TWO_SIDED_95 * np.nan_to_num(sd[good])
    look = {**look, "marker": "." if len(q) < 8 else ""}
    low = np.maximum(size - wide, 0.2 * float(size.min()))
    amplitude.fill_between(freq_khz, low, size + wide, color=look["color"], alpha=0.22, lw=0)
    amplitude.plot(freq_khz, size, **look)
    angle = np.rad2deg(np.angle(q))
    spread = np.minimum(np.rad2deg(wide / size), 180.0)
    phase.fill_between(freq_khz, angle - spread, angle + spread, color=look["color"], alpha=0.16, lw=0)
    jump = np.abs(np.diff(angle, prepend=angle[0])) > 180.0
    phase.plot(freq_khz, np.where(jump, np.nan, angle), **look)


@style()
def residual_figure(result: MotionResult, run: int = 0) -> Figure:
    """Draw the residual of every channel over frequency in units of its noise; verdicts colour the names."""
    bodies, freq_hz = result.measurement.bodies, result.motion.freq_hz
    parts = np.array_split(np.arange(len(freq_hz)), min(_COLUMNS, len(freq_hz)))
    size = np.vstack([_residual_sizes(result.fits[run, number], parts) for number in range(len(bodies))])
    points = [(body.body, point) for body in bodies for point in body.points]
    verdicts = [one.verdict for one in result.channels if one.run == result.motion.runs[run]]
    worst = np.argsort(-np.nansum(size**2, axis=1), kind="stable")
    order = np.sort(worst[:_MOST_ROWS])
    inches = max(1.0, 0.085 * len(order))
    drawing, axes = panels(height=inches + 0.62, margins=(1.15, 0.9, 0.34, 0.46))
    grid = axes[0, 0]
    first = np.array([freq_hz[lines[0]] for lines in parts]) / 1e3
    middle = np.sqrt(first[1:] * first[:-1]) if log_spaced(freq_hz) else 0.5 * (first[1:] + first[:-1])
    ends = (first[0], freq_hz[-1] / 1e3) if len(freq_hz) > 1 else (0.99 * first[0], 1.01 * first[0])
    image = grid.pcolormesh(
        np.concatenate([ends[:1], middle, ends[1:]]), np.arange(len(order) + 1), size[order], vmin=0.0,
        vmax=4.0, cmap="magma_r", rasterized=True,
    )  # fmt: skip
    ticks, labels, colours = [], [], []
    for row, channel in enumerate(order.tolist()):
        fine = verdicts[channel] == "ok"
        if not fine or points[channel] != points[channel - 1]:  # else it has the name of the row above
            ticks.append(row + 0.5)
            labels.append(plain(shorten_name(" ".join(points[channel]), 14)))
            colours.append("#1d2733" if fine else VERDICT_COLOURS[verdicts[channel]])
    grid.set_yticks(ticks, labels, fontsize=6)
    for text, colour in zip(grid.get_yticklabels(), colours, strict=True):
        text.set_color(colour)
    grid.set_ylim(len(order), 0)
    grid.grid(False)
    frequency_axis(grid, freq_hz)
    grid.set_title("|residual| / sd, every point and beam")
    scale = drawing.colorbar(image, cax=drawing.add_axes((0.925, 0.46 / (inches + 0.8), 0.012, 0.5)))
    scale.outline.set_visible(False)
    return drawing


def _residual_sizes(fit: LineFit, parts: Sequence[NDArray[np.intp]]) -> Array:
    """Return the root mean square of residuals over noise in groups of lines, (c, groups)."""
    size = np.empty((len(fit.beams.rows), len(parts)))
    for column, lines in enumerate(parts):
        with np.errstate(invalid="ignore", divide="ignore"):
            own = np.abs(fit.residual(lines)) ** 2 / (2.0 * fit.sd_m(lines) ** 2)
            known = np.isfinite(own)
            size[:, column] = np.sqrt(np.where(known, own, 0.0).sum(axis=1) / known.sum(axis=1))
    return size
