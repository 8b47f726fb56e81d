"""Pictures of surfaces seen from three sides along the axes of the footplate, as PNG bytes."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.report.colours import AXIS_COLOURS
from legacy.ct_inertia.report.drawn_body import Body
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import RigidTransform
from legacy.stapeskit.page.shaded_surface import View, views

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Pixels along an edge of a view: about 300 an inch where three views share the width of a page.
_PIXELS = 720
# Width of a view over that of what it shows: room for the names of the axes.
_MARGIN = 1.22


VIEWS = views()


@dataclass(frozen=True)
class Scene:
    """What one picture shows.

    Attributes
    ----------
    bodies : sequence of Body
        All in scan coordinates.
    frame : RigidTransform
        scan_from_footplate: the three views look along its axes.
    plate_frame : RigidTransform or None
        scan_from_plate, drawn as a second triad.
    side : str or None
        ``left`` or ``right`` ear; names superior and inferior (z is superior in a left ear).
    anterior_known : bool
        False when the sign of x was chosen without a hint: anterior and posterior are then not written.
    """

    bodies: Sequence[Body]
    frame: RigidTransform
    plate_frame: RigidTransform | None = None
    side: str | None = None
    anterior_known: bool = True

    def directions(self) -> dict[str, str]:
        """Name the ends of the footplate axes, ``+x`` to ``-z``."""
        names = {sign + axis: f"{sign}{axis}" for sign in "+-" for axis in "xyz"}
        names["+y"], names["-y"] = "lateral (+y)", "medial (−y)"
        names["-x"], names["-z"] = "−x", "−z"
        if self.anterior_known:
            names["+x"], names["-x"] = "anterior (+x)", "posterior (−x)"
            if self.side in ("left", "right"):
                up, down = ("superior", "inferior") if self.side == "left" else ("inferior", "superior")
                names["+z"], names["-z"] = f"{up} (+z)", f"{down} (−z)"
        return names


def render_scenes(scenes: Sequence[Scene]) -> list[bytes]:
    """Draw several pictures as PNG.

    Raises
    ------
    CtInertiaError
        A scene without bodies.
    """
    pictures = []
    for scene in scenes:
        drawing = draw_scene(scene)
        stream = io.BytesIO()
        drawing.savefig(stream, format="png", dpi=150)
        drawing.clear()
        pictures.append(stream.getvalue())
    return pictures


def _picture_from_scan(frame: RigidTransform, view: View) -> Array:
    """Return the 4x4 that maps scan coordinates to right, up and towards the eye, in mm."""
    turn = np.eye(4)
    turn[:3, :3] = view.axes
    return np.asarray(turn @ frame.inverse().matrix)


def _frame_views(scene: Scene) -> tuple[list[Array], float]:
    """Return the picture centres of the three views (2,) and the common half width, in mm."""
    inside = scene.frame.inverse()
    corners = np.vstack([inside.points(body.vertices_mm) for body in scene.bodies])
    corners = np.stack([corners.min(axis=0), corners.max(axis=0)])
    span = float(np.ptp(corners, axis=0).max())
    middle = corners.mean(axis=0)
    for frame in (scene.frame, scene.plate_frame):
        if frame is None:
            continue
        origin = inside.points(frame.translation_mm)
        tips = origin + 0.25 * span * (inside.rotation @ frame.rotation).T
        if np.all(np.abs(origin - middle) < 1.2 * span):
            corners = np.vstack([corners, origin, tips])
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    half = 0.5 * float(np.ptp(corners, axis=0).max()) * _MARGIN
    return [view.axes[:2] @ middle for view in VIEWS], half


def draw_scene(scene: Scene) -> Figure:
    """Draw three views of a scene side by side with axes, scale, anatomical names and a legend.

    Raises
    ------
    CtInertiaError
        A scene without bodies.
    """
    if not scene.bodies:
        raise CtInertiaError.of("a picture", "of at least one body", "none")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    from legacy.ct_inertia.report.rasterise import rasterise
    from legacy.stapeskit.page.page import new_figure

    drawing = new_figure(12.6, 4.75)
    FigureCanvasAgg(drawing)
    names = scene.directions()
    centres, half = _frame_views(scene)
    for place, (view, centre) in enumerate(zip(VIEWS, centres, strict=True)):
        axes = drawing.add_subplot(1, 3, place + 1)
        extent = (centre[0] - half, centre[0] + half, centre[1] - half, centre[1] + half)
        raster = rasterise(scene.bodies, _picture_from_scan(scene.frame, view), centre, half, _PIXELS)
        axes.imshow(raster, extent=extent, interpolation="antialiased", aspect="equal")
        axes.set(xlim=extent[:2], ylim=extent[2:], aspect="equal", xticks=[], yticks=[])
        for spine in axes.spines.values():
            spine.set_color("#d9dfe6")
        _directions(axes, view, names)
        _triad(axes, scene.frame, scene.frame, view, 0.34 * half, "")
        if scene.plate_frame is not None:
            _triad(axes, scene.plate_frame, scene.frame, view, 0.34 * half, "p")
        _scale_bar(axes, extent, half)
    handles: list[Patch | Line2D] = [
        Patch(facecolor=body.color, alpha=max(body.opacity, 0.35), label=body.name) for body in scene.bodies
    ]
    handles.append(Line2D([], [], color="#444444", linewidth=2.2, label="footplate frame x, y, z"))
    if scene.plate_frame is not None:
        handles.append(
            Line2D([], [], color="#444444", linewidth=1.3, linestyle="--", label="plate frame xp, yp, zp")
        )
    drawing.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=9)
    return drawing


def _directions(axes: Axes, view: View, names: dict[str, str]) -> None:
    """Write what lies to the right, left, top and bottom of a panel, and from where it is seen."""
    style: dict[str, Any] = {"transform": axes.transAxes, "fontsize": 8.5, "color": "#5d6b7a"}
    right, up = names[view.right], names[view.up]
    left, down = (names["-+"[end[0] == "-"] + end[1]] for end in (view.right, view.up))
    axes.text(0.985, 0.5, right, ha="right", va="center", rotation=90, **style)
    axes.text(0.015, 0.5, left, ha="left", va="center", rotation=90, **style)
    axes.text(0.5, 0.985, up, ha="center", va="top", **style)
    axes.text(0.5, 0.015, down, ha="center", va="bottom", **style)
    axes.set_title(f"seen from {names[view.eye]}", fontsize=10)


def _triad(
    axes: Axes,
    scan_from_frame: RigidTransform,
    footplate: RigidTransform,
    view: View,
    length: float,
    mark: str,
) -> None:
    """Draw the three axes of a frame; one that points at the eye or away is a ring with a dot or a cross."""
    inside = footplate.inverse()
    origin = view.axes @ inside.points(scan_from_frame.translation_mm)
    tips = (inside.rotation @ scan_from_frame.rotation).T @ view.axes.T
    dashes = "--" if mark else "-"
    for axis in np.argsort(tips[:, 2]):
        colour, tip = AXIS_COLOURS[axis], tips[axis]
        label = "xyz"[axis] + mark
        flat = float(np.hypot(tip[0], tip[1]))
        if flat < 0.12:
            axes.plot(*origin[:2], "o", mfc="white", mec=colour, ms=7, mew=1.4, clip_on=True)
            axes.plot(*origin[:2], "." if tip[2] > 0 else "x", color=colour, ms=3.5, clip_on=True)
            place = origin[:2] - 0.16 * length * np.ones(2)
        else:
            end = origin[:2] + length * tip[:2]
            axes.annotate(
                "",
                xy=(end[0], end[1]),
                xytext=(origin[0], origin[1]),
                arrowprops={
                    "arrowstyle": "-|>",
                    "color": colour,
                    "lw": 1.3 if mark else 2.0,
                    "linestyle": dashes,
                    "shrinkA": 0,
                    "shrinkB": 0,
                },
                annotation_clip=True,
            )
            place = end + 0.13 * length * tip[:2] / flat
        axes.text(
            float(place[0]),
            float(place[1]),
            label,
            color=colour,
            fontsize=9,
            ha="center",
            va="center",
            fontweight="bold",
            path_effects=_halo(),
            clip_on=True,
        )


def _halo() -> list[Any]:
    """Return the white rim that keeps letters legible on a surface."""
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=2.6, foreground="white")]


def _scale_bar(axes: Axes, extent: tuple[float, ...], half: float) -> None:
    """Draw a bar of a round length near a quarter of the width, lower left."""
    rough = 0.5 * half
    power = 10.0 ** np.floor(np.log10(rough))
    length = max(step * power for step in (1.0, 2.0, 5.0) if step * power <= rough)
    x, y = extent[0] + 0.10 * half, extent[2] + 0.20 * half
    axes.plot([x, x + length], [y, y], color="#1d2733", lw=3, solid_capstyle="butt")
    text = f"{length:g} mm" if length >= 0.1 else f"{length * 1e3:g} µm"
    axes.text(
        x + 0.5 * length,
        y + 0.03 * half,
        text,
        ha="center",
        va="bottom",
        fontsize=8.5,
        color="#1d2733",
        path_effects=_halo(),
    )
