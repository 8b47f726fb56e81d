"""Points and beams on the shaded surface of the stapes, from three sides."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.report.draw_labels import label_points, written
from legacy.kinematics.report.stapes_surface import Scenery
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.page.drawings import FAULT, INK, colour, plain, shorten_name
from legacy.stapeskit.page.page import new_figure
from legacy.stapeskit.page.shaded_surface import Shaded, View, shade, views

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from legacy.kinematics.measurement import BodyChannels
    from legacy.kinematics.points2dof import Points2Dof

# Depth from which on a point counts as hidden, so that points on the surface are seen; width of the figure,
# inches.
_BEHIND_MM = 0.08
_WIDTH = 11.4


def placement_figure(result: Points2Dof, scenery: Scenery | None = None) -> Figure:
    """Draw points and beams in the footplate frame, faulty channels in red, points behind the bone hollow.

    Parameters
    ----------
    scenery : Scenery, optional
        Surface and outline to draw, and what the axes are called.
    """
    scenery = scenery or Scenery()
    bodies = result.measurement.bodies
    clouds = [body.positions_mm for body in bodies] + [np.zeros((1, 3))]
    low, high = _bounds([*clouds, scenery.vertices_mm])
    span = float(np.max(high - low)) or 1.0
    middle, half = 0.5 * (low + high), 0.5 * (high - low) + 0.17 * span
    sights = views()
    figure, axes = equal_panels(sights, half)
    bad = faulty_channels(result)
    mesh = (scenery.vertices_mm, scenery.faces)
    for view, sight in zip(axes, sights, strict=True):
        shaded = _draw_surface(view, sight, *mesh) if scenery.has_surface else None
        _draw_outline(view, sight, scenery)
        taken: list[tuple[float, float]] = []
        for number, body in enumerate(bodies):
            _draw_body(view, sight, body, number, bad, span, shaded)
            taken += [(float(a), float(b)) for a, b in sight.flat(body.positions_mm)[:, :2]]
        frame(view, sight, scenery, middle, half)
        _draw_axes(view, sight, 0.2 * span)
        label_points(view, sight, bodies, bad, taken)
    _legend(figure, [body.body for body in bodies], bool(bad), scenery)
    return figure


def equal_panels(sights: Sequence[View], half: Array, above: float = 0.75) -> tuple[Figure, list[Axes]]:
    """Return a figure with one panel per view, all in the same scale.

    Parameters
    ----------
    half : ndarray, (3,)
        Half of what every panel shows along x, y and z, mm.
    above : float
        Inches left above the panels for title and legend.
    """
    left, gap, below = 0.65, 0.75, 0.6
    wide = [2.0 * float(np.abs(sight.axes[0]) @ half) for sight in sights]
    high = [2.0 * float(np.abs(sight.axes[1]) @ half) for sight in sights]
    scale = min((_WIDTH - left - gap * (len(sights) - 1) - 0.1) / sum(wide), 4.6 / max(high))
    height = scale * max(high) + above + below
    free = (_WIDTH - left - 0.1 - scale * sum(wide)) / max(len(sights) - 1, 1)
    figure = new_figure(_WIDTH, height)
    figure.set_layout_engine("none")
    axes, place = [], left
    for across, up in zip(wide, high, strict=True):
        box = (place / _WIDTH, below / height, scale * across / _WIDTH, scale * up / height)
        axes.append(figure.add_axes(box))
        place += scale * across + min(free, 1.6)
    return figure, axes


def faulty_channels(result: Points2Dof) -> set[tuple[str, str, tuple[float, ...]]]:
    """Return (body, point, direction as reported) of the channels with a verdict in any run."""
    return {_key(v.body, v.point, v.direction) for v in result.channels if v.verdict != "ok"}


def _key(body: str, point: str, direction: Array) -> tuple[str, str, tuple[float, ...]]:
    return body, point, tuple(np.round(direction, 6).tolist())


def _bounds(clouds: list[Array]) -> tuple[Array, Array]:
    everything = np.concatenate(clouds)
    return everything.min(axis=0), everything.max(axis=0)


def _draw_surface(view: Axes, sight: View, vertices: Array, faces: NDArray[np.int64]) -> Shaded:
    shaded = shade(vertices, faces, sight)
    view.imshow(shaded.image, extent=shaded.extent, zorder=0, interpolation="antialiased", aspect="equal")
    return shaded


def _draw_outline(view: Axes, sight: View, scenery: Scenery) -> None:
    """Draw the outline of the footplate's medial face and its centre."""
    if len(scenery.outline_mm):
        closed = sight.flat(np.vstack([scenery.outline_mm, scenery.outline_mm[:1]]))
        view.plot(closed[:, 0], closed[:, 1], color=INK, lw=0.9, ls=(0, (4, 2)), alpha=0.8, zorder=1.5)
    view.plot([0.0], [0.0], "o", ms=6, mfc="white", mec=INK, mew=1.4, zorder=6)


def _draw_body(
    view: Axes,
    sight: View,
    body: BodyChannels,
    number: int,
    bad: set[tuple[str, str, tuple[float, ...]]],
    span: float,
    shaded: Shaded | None,
) -> None:
    start, toward = sight.flat(body.positions_mm), sight.flat(body.directions) * 0.15 * span
    keys = [_key(body.body, p, d) for p, d in zip(body.points, body.reported_directions, strict=True)]
    wrong = np.array([key in bad for key in keys], dtype=bool)
    common: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "units": "inches"}
    for own, shade_of, width, alpha, layer in (
        (~wrong, colour(number), 0.011, 0.65, 2.0),
        (wrong, FAULT, 0.024, 1.0, 3.0),
    ):
        if np.any(own):
            view.quiver(
                start[own, 0], start[own, 1], toward[own, 0], toward[own, 1], color=shade_of, width=width,
                headwidth=5.0, headlength=6.0, headaxislength=5.0, minlength=0.0, alpha=alpha, zorder=layer,
                **common,
            )  # fmt: skip
    behind = np.zeros(len(start), dtype=bool) if shaded is None else shaded.hides(start, _BEHIND_MM)
    dot = 4.6 if len(set(body.points)) <= 60 else 2.6
    for own, fill in ((~behind, colour(number)), (behind, "white")):
        view.plot(start[own, 0], start[own, 1], "o", ms=dot, mfc=fill, mec=colour(number), mew=1.0, zorder=4)


def frame(view: Axes, sight: View, scenery: Scenery, middle: Array, half: Array) -> None:
    """Set limits, titles and axis names; an axis that runs against its picture is reversed."""
    ticks = []
    for place, signed in ((0, sight.right), (1, sight.up)):
        centre, side = sight.flat(middle)[place], float(np.abs(sight.axes[place]) @ half)
        (view.set_xlim, view.set_ylim)[place](centre - side, centre + side)
        axis = (view.xaxis, view.yaxis)[place]
        if signed[0] == "-":
            axis.set_major_formatter(_turn_round)
        where = scenery.side("+" + signed[1])
        ticks.append(f"{signed[1]} (mm)" + (f", {where} +" if where else ""))
    view.set_aspect("equal", adjustable="box")
    view.set_xlabel(ticks[0])
    view.set_ylabel(ticks[1])
    eye = scenery.side(sight.eye)
    view.set_title(
        f"seen from {eye} ({_typeset_minus(sight.eye)})" if eye else f"seen from {_typeset_minus(sight.eye)}",
        fontsize=10,
    )
    view.tick_params(labelsize=8)


def _turn_round(value: float, _place: object = None) -> str:
    return _typeset_minus(f"{0.0 - value:g}")


def _typeset_minus(signed: str) -> str:
    return signed.replace("-", "−")


def _draw_axes(view: Axes, sight: View, length: float) -> None:
    for name, axis in zip("xyz", np.eye(3), strict=True):
        tip = sight.flat(axis * length)
        if abs(tip[2]) > 0.5 * length:
            continue
        view.annotate(
            "", (tip[0], tip[1]), (0.0, 0.0), zorder=5,
            arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.5, "shrinkA": 3.0, "shrinkB": 0.0},
        )  # fmt: skip
        written(view, name, 1.16 * tip[0], 1.16 * tip[1], INK, 10, "center", "center")


def _legend(figure: Figure, names: list[str], faults: bool, scenery: Scenery) -> None:
    from matplotlib.lines import Line2D

    def dot(tint: str, label: str, face: str = "") -> Line2D:
        return Line2D([], [], color=tint, marker="o", ms=5, mfc=face or tint, lw=1.2, label=label)

    handles = [dot(colour(k), shorten_name(plain(name), 34)) for k, name in enumerate(names)]
    if faults:
        handles.append(Line2D([], [], color=FAULT, lw=2.6, label="channel with a verdict"))
    if scenery.has_surface:
        handles.append(
            Line2D([], [], color="none", marker="o", ms=5, mfc="white", mec=INK, label="behind the bone")
        )
    if len(scenery.outline_mm):
        handles.append(Line2D([], [], color=INK, lw=0.9, ls=(0, (4, 2)), label="outline of the footplate"))
    figure.legend(handles=handles, loc="upper center", ncols=min(len(handles), 5), frameon=False, fontsize=9)
