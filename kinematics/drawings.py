"""Figures of a rigid-motion fit: points and beams, spectra with bands, residual map, chi2."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from kinematics.motion import RigidMotion
from kinematics.motion_files import standard_deviation
from kinematics.page import new_figure
from kinematics.spatial import DOF_UNITS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from kinematics.points2dof import Points2Dof

Array = NDArray[np.float64]
COLOURS = ("#0b6e99", "#c2571a", "#3f8f4f", "#7a4fa3", "#8a6d1f", "#4d4d4d")
FAULT = "#c81e3a"
_VIEWS = (("x", "y", "+z"), ("z", "y", "−x"), ("x", "z", "lateral (+y)"))
_MOST_LINES = 1500


def placement_figure(result: Points2Dof, surface_mm: Array | None = None) -> Figure:
    """Draw points and beams from three sides in the footplate frame, faulty channels in red.

    From lateral, y points to the reader and x to the right, so z points down.

    Parameters
    ----------
    result : Points2Dof
    surface_mm : ndarray, (n, 3), optional
        Vertices of the stapes in the footplate frame, drawn as a shadow.
    """
    figure = new_figure(11.0, 4.4)
    axes = figure.subplots(1, 3)
    bodies = result.measurement.bodies
    everything = np.concatenate([body.positions_mm for body in bodies] + [np.zeros((1, 3))])
    span = float(np.max(np.ptp(everything, axis=0))) or 1.0
    bad = {(v.body, v.point, tuple(np.round(v.direction, 6))) for v in result.channels if v.verdict != "ok"}
    for view, (across, up, eye) in zip(axes, _VIEWS, strict=True):
        i, j = "xyz".index(across), "xyz".index(up)
        if surface_mm is not None:
            view.plot(
                surface_mm[:, i], surface_mm[:, j], ".", ms=1.2, color="#c9ced6", zorder=0, rasterized=True
            )
        for number, body in enumerate(bodies):
            colour = COLOURS[number % len(COLOURS)]
            for channel in range(len(body.points)):
                start = body.positions_mm[channel]
                end = start + 0.16 * span * body.directions[channel]
                reported = tuple(np.round(body.reported_directions[channel], 6))
                key = (body.body, body.points[channel], reported)
                faulty = key in bad
                view.plot(
                    [start[i], end[i]],
                    [start[j], end[j]],
                    color=FAULT if faulty else colour,
                    lw=1.8 if faulty else 0.8,
                    alpha=1.0 if faulty else 0.55,
                    zorder=3 if faulty else 2,
                )
            view.plot(
                body.positions_mm[:, i], body.positions_mm[:, j], "o", ms=4, color=colour, label=body.body
            )
            if len(set(body.points)) <= 40:
                _label_points(view, body.points, body.positions_mm[:, [i, j]], colour)
        _draw_axes(view, i, j, 0.22 * span, (across, up))
        view.plot([0.0, 0.26 * span, 0.0], [0.0, 0.0, 0.26 * span], alpha=0.0)
        view.set_aspect("equal", adjustable="datalim")
        view.set_xlabel(f"{across} (mm)")
        view.set_ylabel(f"{up} (mm)")
        view.set_title(f"seen from {eye}", fontsize=10)
        view.margins(0.08)
        if up == "z":
            view.invert_yaxis()
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(bodies), frameon=False)
    return figure


def _label_points(view: Axes, points: tuple[str, ...], places: Array, colour: str) -> None:
    for name in dict.fromkeys(points):
        where = places[points.index(name)]
        view.annotate(
            name, tuple(where), xytext=(-3, -3), textcoords="offset points", fontsize=7, color=colour,
            ha="right", va="top",
        )  # fmt: skip


def _draw_axes(view: Axes, i: int, j: int, length: float, names: tuple[str, str]) -> None:
    for place, name in ((i, names[0]), (j, names[1])):
        tip = np.zeros(3)
        tip[place] = length
        view.annotate(
            "", (tip[i], tip[j]), (0.0, 0.0), arrowprops={"arrowstyle": "-|>", "color": "#1d2733", "lw": 1.4},
            zorder=5,
        )  # fmt: skip
        view.text(1.12 * tip[i], 1.12 * tip[j], name, ha="center", va="center", fontsize=9, zorder=5)


def spectra_figure(motion: RigidMotion) -> Figure:
    """Draw amplitude and phase of every degree of freedom with bands of two standard deviations."""
    from matplotlib.ticker import NullFormatter

    count = len(motion.dof)
    figure = new_figure(11.0, 1.9 * count + 0.6)
    axes = figure.subplots(count, 2, sharex=True, squeeze=False)
    sd = standard_deviation(motion)
    step = max(1, len(motion.freq_hz) // _MOST_LINES)
    freq = motion.freq_hz[::step] / 1e3
    for place, name in enumerate(motion.dof):
        scale, unit = _unit(name, bool(motion.reference))
        for body, body_name in enumerate(motion.bodies):
            for run in range(min(len(motion.runs), 4)):
                q, s = motion.q[run, body, ::step, place] * scale, sd[run, body, ::step, place] * scale
                label = body_name + (f", run {motion.runs[run]}" if len(motion.runs) > 1 else "")
                style: dict[str, Any] = {
                    "color": COLOURS[body % len(COLOURS)],
                    "ls": ("-", "--", ":", "-.")[run],
                }
                _bands(axes[place, 0], axes[place, 1], freq, q, s, label, style)
        axes[place, 0].set_yscale("log")
        axes[place, 0].set_ylabel(f"|{name}| ({unit})")
        axes[place, 1].set_ylabel(f"phase {name} (deg)")
        axes[place, 1].set_ylim(-190, 190)
        axes[place, 1].set_yticks([-180, -90, 0, 90, 180])
        axes[place, 0].yaxis.set_minor_formatter(NullFormatter())
        for view in axes[place]:
            view.grid(True, color="#e6e9ee", lw=0.6)
    for view in axes[-1]:
        view.set_xlabel("frequency (kHz)")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(len(labels), 6), frameon=False)
    return figure


def _unit(name: str, per_reference: bool) -> tuple[float, str]:
    base = DOF_UNITS[name]
    if per_reference:
        return 1.0, f"{base} per reference"
    return (1e9, "nm") if base == "m" else (1e6, "µrad")


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
    floor = float(np.min(size)) * 0.2
    amplitude.fill_between(
        freq, np.maximum(size - 2 * sd, floor), size + 2 * sd, color=style["color"], alpha=0.2, lw=0
    )
    amplitude.plot(freq, size, label=label, lw=1.1, marker=marker, **style)
    angle = np.degrees(np.angle(q))
    spread = np.minimum(np.degrees(2 * sd / size), 180.0)
    phase.fill_between(freq, angle - spread, angle + spread, color=style["color"], alpha=0.15, lw=0)
    jump = np.abs(np.diff(angle, prepend=angle[0])) > 180.0
    phase.plot(freq, np.where(jump, np.nan, angle), lw=1.0, marker=marker, **style)


def residual_figure(result: Points2Dof) -> Figure:
    """Draw |residual| / sd of every channel over frequency, body by body, for the first run."""
    bodies = result.measurement.bodies
    rows = [min(len(body.points), 90) for body in bodies]
    figure = new_figure(11.0, 0.8 * len(bodies) + 0.16 * sum(rows) + 0.6)
    axes = figure.subplots(len(bodies), 1, squeeze=False, height_ratios=rows, sharex=True)[:, 0]
    freq = result.motion.freq_hz / 1e3
    step = max(1, len(freq) // _MOST_LINES)
    picture = None
    for number, body in enumerate(bodies):
        fit = result.fits[0, number]
        used = np.isfinite(fit.sd)
        size = np.where(used, np.abs(fit.residual) / np.where(used, fit.sd, 1.0), np.nan)[:, ::step]
        edges = np.arange(len(body.points) + 1)
        picture = axes[number].pcolormesh(
            _edges(freq[::step]), edges, size, cmap="magma_r", vmin=0.0, vmax=6.0, rasterized=True
        )
        axes[number].invert_yaxis()
        thin = max(1, len(body.points) // 45)
        axes[number].set_yticks(edges[:-1][::thin] + 0.5)
        axes[number].set_yticklabels(
            [_short(result, number, c) for c in range(0, len(body.points), thin)], fontsize=7
        )
        axes[number].set_ylabel(body.body)
    axes[-1].set_xlabel("frequency (kHz)")
    if picture is not None:
        figure.colorbar(picture, ax=list(axes), label="|residual| / sd", pad=0.01, shrink=0.8)
    return figure


def _short(result: Points2Dof, number: int, channel: int) -> str:
    body = result.measurement.bodies[number]
    same = [c for c, point in enumerate(body.points) if point == body.points[channel]]
    return f"{body.points[channel]} beam {same.index(channel) + 1}" if len(same) > 1 else body.points[channel]


def _edges(values: Array) -> Array:
    if len(values) == 1:
        return np.array([values[0] * 0.99, values[0] * 1.01])
    middle = 0.5 * (values[1:] + values[:-1])
    return np.concatenate([[2 * values[0] - middle[0]], middle, [2 * values[-1] - middle[-1]]])


def chi2_figure(motion: RigidMotion) -> Figure:
    """Draw chi2 per degree of freedom over frequency with its 95 % range."""
    from scipy.special import chdtri

    figure = new_figure(11.0, 2.8)
    view = figure.subplots()
    freq = motion.freq_hz / 1e3
    for body, name in enumerate(motion.bodies):
        for run in range(min(len(motion.runs), 4)):
            n_dof = motion.n_dof[run, body]
            good = (n_dof > 0) & np.isfinite(motion.chi2[run, body])
            if not np.any(good):
                continue
            colour = COLOURS[body % len(COLOURS)]
            label = name + (f", run {motion.runs[run]}" if len(motion.runs) > 1 else "")
            ratio = motion.chi2[run, body][good] / n_dof[good]
            view.plot(freq[good], ratio, ".", ms=4, color=colour, alpha=0.8, label=label)
            typical = float(np.median(n_dof[good]))
            for level in (0.975, 0.025):
                view.axhline(float(chdtri(typical, level)) / typical, color=colour, lw=0.8, ls="--")
    view.axhline(1.0, color="#5d6b7a", lw=0.8)
    view.set_yscale("log")
    view.set_xlabel("frequency (kHz)")
    view.set_ylabel("chi2 / degrees of freedom")
    view.grid(True, color="#e6e9ee", lw=0.6)
    figure.legend(loc="outside upper center", ncols=6, frameon=False)
    return figure
