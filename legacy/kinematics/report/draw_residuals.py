"""The residual map: every channel over frequency, in units of its noise, with the verdicts on the margin."""

from __future__ import annotations

import re
import textwrap
from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from legacy.kinematics.fit.rigid_fit import fit_noise
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.page.drawings import (
    FAULT,
    INK,
    colour,
    distinct_short_names,
    frequency_axis,
    log_spaced,
    plain,
    shorten_name,
)
from legacy.stapeskit.page.page import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

    from legacy.kinematics.faults.verdicts import ChannelVerdict
    from legacy.kinematics.fit.rigid_fit import LineFit
    from legacy.kinematics.measurement import BodyChannels
    from legacy.kinematics.points2dof import Points2Dof

# Columns of the picture, values at a time, and sizes in inches.
COLUMNS = 700
_PIECE = 500_000
_WIDTH, _LEFT, _RIGHT, _BARE, _BELOW, _ABOVE, _GAP = 11.4, 1.8, 2.95, 1.0, 0.55, 0.35, 0.42
_BAR = 0.75
# Verdicts that are no fault of the channel itself.
_NOT_ITS_OWN = ("ok", "flexible", "zeros", "unused")
_ROW, _TALLEST, _LETTER, _LETTERS = 0.17, 6.2, 0.15, 36


@dataclass(frozen=True)
class ResidualMap:
    """|residual| / sd of one body in one run.

    Attributes
    ----------
    size : ndarray, (channel, column)
        Largest of the lines of each column; NaN where none was used.
    edges_hz : ndarray, (column + 1,)
    lines : int
        Most lines in one column.
    rms : ndarray, (channel,)
        As of relative_rms.
    """

    size: Array
    edges_hz: Array
    lines: int
    rms: Array

    @property
    def noise(self) -> float:
        """What noise alone gives in a column as a median (of the largest of ``lines`` Rayleigh numbers)."""
        return float(np.sqrt(-2.0 * np.log(1.0 - 0.5 ** (1.0 / self.lines))))


def residual_map(fit: LineFit, freq_hz: Array, columns: int = COLUMNS) -> ResidualMap:
    """Reduce residuals to a picture that loses no peak.

    Parameters
    ----------
    freq_hz : ndarray, (freq,)
    columns : int
        At most; neighbouring lines share one, which shows the largest of them.
    """
    lines = len(freq_hz)
    count = min(lines, columns)
    start = np.linspace(0, lines, count + 1).round().astype(int)
    channels = len(fit.beams.rows)
    size = np.empty((channels, count))
    step = max(1, int(_PIECE / max(channels * lines / count, 1.0)))
    for first in range(0, count, step):
        last = min(first + step, count)
        residual, sd, _ = fit.at(slice(int(start[first]), int(start[last])))
        used = np.isfinite(sd)
        ratio = np.where(used, np.abs(residual) / np.where(used, sd, 1.0), -1.0)
        size[:, first:last] = np.maximum.reduceat(ratio, start[first:last] - start[first], axis=1)
    size[size < 0.0] = np.nan
    rms = _rms_of_unused(fit, relative_rms(fit))
    return ResidualMap(size, _edges(freq_hz)[start], int(np.max(np.diff(start))), rms)


def relative_rms(fit: LineFit) -> Array:
    """Return the root mean square of each channel's residual in units of its sd, corrected for leverage.

    Noise alone gives 1; NaN where a channel was not used or decides the fit alone.
    """
    return np.asarray(np.sqrt(np.where(fit.solution.used > 0, fit.channel_energy, np.nan)))


def without_culprits(fit: LineFit, culprits: list[int]) -> LineFit:
    """Return a fit that shows the residuals of all channels against the motion of those without a fault.

    A faulty channel pulls the motion, so that others look faulty too. The fit itself where the other channels
    do not determine the motion at all lines.
    """
    if not culprits or len(culprits) > len(fit.beams.rows) // 2:
        return fit
    value = fit.value.copy()
    value[culprits] = np.nan
    again = fit_noise(fit.beams, value, fit.noise, fit.robust)
    if not np.array_equal(again.solution.good, fit.solution.good):
        return fit
    return replace(fit, solution=again.solution)


def _rms_of_unused(fit: LineFit, rms: Array) -> Array:
    """Return the rms with that of channels which are shown and were not fitted."""
    for channel in np.flatnonzero(np.isnan(rms)):
        residual, sd, _ = fit.at(slice(None), np.arange(len(rms)) == channel)
        used = np.isfinite(sd)
        if np.any(used):
            rms[channel] = np.sqrt(0.5 * np.mean((np.abs(residual[used]) / sd[used]) ** 2))
    return rms


def _edges(values: Array) -> Array:
    """Return the borders (n + 1,) halfway between ascending values."""
    if len(values) == 1:
        return np.array([values[0] * 0.99, values[0] * 1.01])
    middle = 0.5 * (values[1:] + values[:-1])
    first = max(1.5 * values[0] - 0.5 * values[1], 0.5 * values[0])
    return np.concatenate([[first], middle, [1.5 * values[-1] - 0.5 * values[-2]]])


def residual_figure(result: Points2Dof, run: int = 0) -> tuple[Figure, ResidualMap]:
    """Draw the map of one run, one panel a body; return it with the map of the first body."""
    bodies = result.measurement.bodies
    maps = []
    for k in range(len(bodies)):
        culprits = [c for c, v in enumerate(_verdicts(result, run, k)) if v.verdict not in _NOT_ITS_OWN]
        maps.append(residual_map(without_culprits(result.fits[run, k], culprits), result.motion.freq_hz))
    heights = [float(np.clip(_ROW * len(body.points), 0.6, _TALLEST)) for body in bodies]
    total = sum(heights) + _GAP * (len(bodies) - 1) + _BELOW + _ABOVE
    figure = new_figure(_WIDTH, total)
    figure.set_layout_engine("none")
    highest = max(8.0, 1.5 * maps[0].noise + 3.0)
    top, picture, view = total - _ABOVE, None, None
    name = result.motion.runs[run]
    wrong = any(v.verdict != "ok" and v.run == name for v in result.channels)
    wide = _WIDTH - _LEFT - (_RIGHT if wrong else _BARE)
    for number, (body, residuals, height) in enumerate(zip(bodies, maps, heights, strict=True)):
        top -= height
        box = (_LEFT / _WIDTH, top / total, wide / _WIDTH, height / total)
        view = figure.add_axes(box)
        picture = _draw_map(view, residuals, highest, result.motion.freq_hz)
        view.set_title(shorten_name(plain(body.body), 60), loc="left", fontsize=10, color=colour(number))
        verdicts = _verdicts(result, run, number)
        _row_names(view, body, height, verdicts)
        side = figure.add_axes(((_LEFT + wide + 0.08) / _WIDTH, box[1], _BAR / _WIDTH, box[3]))
        _draw_rms(side, residuals, verdicts, number, last=number == len(bodies) - 1)
        _margin(side, verdicts, height)
        frequency_axis(view, result.motion.freq_hz)
        view.set_xlim(residuals.edges_hz[0] / 1e3, residuals.edges_hz[-1] / 1e3)
        if number < len(bodies) - 1:
            view.set_xlabel("")
            view.tick_params(labelbottom=False)
        top -= _GAP
    if view is not None and picture is not None:
        bar = figure.add_axes((0.30 / _WIDTH, _BELOW / total, 0.13 / _WIDTH, min(2.4, heights[-1]) / total))
        figure.colorbar(picture, cax=bar, extend="max", orientation="vertical")
        bar.set_yticks([0.0, *np.arange(2.0, highest + 0.1, max(1.0, np.round(highest / 8.0)))])
        bar.set_title("|residual|\n/ sd", fontsize=7.5, loc="left")
        bar.tick_params(labelsize=7.5)
    return figure, maps[0]


def _draw_map(view: Axes, residuals: ResidualMap, highest: float, freq_hz: Array) -> ScalarMappable:
    import matplotlib
    from matplotlib.colors import PowerNorm

    # noise stays pale, what stands out of it turns dark
    norm = PowerNorm(1.8, vmin=0.0, vmax=highest)
    shades = matplotlib.colormaps["magma_r"].with_extremes(bad="#dfe5ec")
    across, down = residuals.edges_hz / 1e3, np.arange(len(residuals.size) + 1)
    values = np.ma.masked_invalid(residuals.size)
    if log_spaced(freq_hz):
        drawn: ScalarMappable = view.pcolormesh(across, down, values, cmap=shades, norm=norm, rasterized=True)
    else:
        drawn = view.pcolorfast(across, down, values, cmap=shades, norm=norm)
    view.set_ylim(len(residuals.size), 0)
    view.set_xlim(across[0], across[-1])
    view.tick_params(labelsize=8)
    return drawn


def _verdicts(result: Points2Dof, run: int, number: int) -> list[ChannelVerdict]:
    """Return the verdicts of one body and run in the order of its channels."""
    name, body = result.motion.runs[run], result.measurement.bodies[number].body
    return [v for v in result.channels if v.run == name and v.body == body]


def channel_labels(body: BodyChannels) -> list[str]:
    """Return a short name of every channel: its point, and which of its beams when there are several."""
    short, beams = distinct_short_names(body.points, 12), dict.fromkeys(body.points, 0)
    several = {name for name, count in Counter(body.points).items() if count > 1}
    labels = []
    for name in body.points:
        beams[name] += 1
        labels.append(f"{short[name]}, beam {beams[name]}" if name in several else short[name])
    return labels


def _row_names(view: Axes, body: BodyChannels, height: float, verdicts: list[ChannelVerdict]) -> None:
    """Name as many rows as can be read; those with a verdict in any case."""
    count = len(body.points)
    labels = channel_labels(body)
    step = int(np.ceil(_LETTER * count / height))
    wrong = {k for k, v in enumerate(verdicts) if v.verdict != "ok"} if step == 1 else set()
    shown = list(range(0, count, step))
    view.set_yticks(np.array(shown) + 0.5, [plain(labels[k]) for k in shown], fontsize=7.5)
    for tick, k in zip(view.get_yticklabels(), shown, strict=True):
        if k in wrong:
            tick.set_color(FAULT)
            tick.set_fontweight("bold")


def _draw_rms(
    view: Axes, residuals: ResidualMap, verdicts: list[ChannelVerdict], number: int, last: bool
) -> None:
    from matplotlib.ticker import MaxNLocator

    rows, width = np.arange(len(residuals.rms)) + 0.5, np.nan_to_num(residuals.rms)
    wrong = np.array([v.verdict != "ok" for v in verdicts], dtype=bool)
    wrong = wrong if len(wrong) else np.zeros(len(rows), dtype=bool)
    if len(rows) <= 120:
        view.barh(rows[~wrong], width[~wrong], height=0.8, color=colour(number), lw=0)
    else:  # one shape: thousands of bars take minutes
        edges = np.arange(len(rows) + 1.0)
        view.stairs(
            np.where(wrong, 0.0, width), edges, orientation="horizontal", fill=True, color=colour(number)
        )
    view.barh(rows[wrong], width[wrong], height=0.8 if len(rows) <= 120 else 1.0, color=FAULT, lw=0)
    view.axvline(1.0, color=INK, lw=0.7)
    view.set_ylim(len(rows), 0)
    most = float(np.nanmax(np.append(residuals.rms, 1.0)))
    view.set_xlim(0.0, 1.08 * max(1.4, most))
    view.set_yticks([])
    steps = [step for step in MaxNLocator(2).tick_values(0.0, 1.05 * most) if 1.5 < step <= 1.05 * most]
    view.set_xticks([1.0, *steps[-1:]])
    view.tick_params(labelsize=7.5)
    for side in ("top", "right"):
        view.spines[side].set_visible(False)
    if last:
        view.set_xlabel("rms / sd", fontsize=8)


def _margin(view: Axes, verdicts: list[ChannelVerdict], height: float) -> None:
    """Write the verdicts next to their rows, shifted where they would overlap."""
    rows = [k for k, v in enumerate(verdicts) if v.verdict != "ok"]
    if not rows:
        return
    count = len(verdicts)
    kinds = {(v.verdict, v.estimate) for v in verdicts}
    if len(rows) == count and len(kinds) == 1:
        _note(view, count / 2.0, count / 2.0, _words(verdicts[0]))
        return
    shown = _join(rows, verdicts)
    room = int(height / _LETTER)
    if sum(1 + words.count("\n") for _, words in shown) > room:
        shown = [(row, words.replace("\n", " ")[:_LETTERS]) for row, words in shown]
    left_out = max(0, len(shown) - room + 1) if len(shown) > room else 0
    shown = shown[: len(shown) - left_out]
    per_line = _LETTER * count / height
    tall = [per_line * (1 + words.count("\n")) for _, words in shown]
    places = [row for row, _ in shown]
    for k in range(1, len(places)):
        places[k] = max(places[k], places[k - 1] + 0.5 * (tall[k - 1] + tall[k]))
    bottom = count - (per_line if left_out > 0 else 0.0)
    for k in range(len(places) - 1, -1, -1):
        places[k] = min(places[k], bottom - 0.5 * tall[k])
        bottom = places[k] - 0.5 * tall[k]
    for place, (row, words) in zip(places, shown, strict=True):
        _note(view, row, place, words)
    if left_out > 0:
        end = count - 0.5 * per_line
        _note(view, end, end, f"and {left_out} more: see the table")


def _join(rows: list[int], verdicts: list[ChannelVerdict]) -> list[tuple[float, str]]:
    """Return middle and words of every stretch of neighbouring rows with the same verdict."""
    groups: list[tuple[float, str]] = []
    start = 0
    while start < len(rows):
        end = start
        while (
            end + 1 < len(rows)
            and rows[end + 1] == rows[end] + 1
            and _words(verdicts[rows[end + 1]]) == _words(verdicts[rows[start]])
        ):
            end += 1
        groups.append((0.5 * (rows[start] + rows[end]) + 0.5, _words(verdicts[rows[start]])))
        start = end + 1
    return groups


def _words(verdict: ChannelVerdict) -> str:
    detail = re.sub(r" \+- \S+", "", verdict.estimate.partition("; not told apart")[0])
    words = f"{verdict.verdict}: {detail}" if detail else verdict.verdict
    lines = textwrap.wrap(words, _LETTERS)
    return "\n".join([*lines[:1], shorten_name(lines[1], _LETTERS - 2)] if len(lines) > 1 else lines)


def _note(view: Axes, row: float, place: float, words: str) -> None:
    transform = view.get_yaxis_transform()
    view.annotate(
        plain(words), (1.02, row), (1.16, place), xycoords=transform, textcoords=transform, fontsize=7.5,
        color=FAULT, va="center", ha="left", annotation_clip=False,
        arrowprops={"arrowstyle": "-", "color": FAULT, "lw": 0.7, "shrinkA": 1.0, "shrinkB": 0.0},
    )  # fmt: skip
