"""The motion of rigid bodies at one frequency, as a stroboscope shows it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.report.draw_geometry import equal_panels
from legacy.kinematics.report.stapes_surface import Scenery, coarse
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.page.drawings import INK, colour, plain, shorten_name
from legacy.stapeskit.page.shaded_surface import View, shade, silhouette, views
from legacy.stapeskit.spatial import DOF_NAMES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from legacy.kinematics.points2dof import Points2Dof
    from legacy.stapeskit.records.motion import RigidMotion

# Phases drawn, largest drawn motion as a share of the picture, and triangles of the surface.
PHASES = 8
SHARE = 0.12
_MOST_FACES = 5000
# Points drawn of a body.
_MOST_POINTS = 400


@dataclass(frozen=True)
class Moment:
    """One line of one run, ready to be drawn.

    Attributes
    ----------
    q : ndarray, (body, 6), complex
        m and rad, or per unit of the reference; degrees of freedom that were not fitted are zero.
    exaggeration : float
        Factor from m (or m per unit) to drawn m.
    largest_m : float
        Largest displacement of any drawn point, m, peak.
    """

    run: int
    line: int
    q: ComplexArray
    exaggeration: float
    largest_m: float


def full_motion(motion: RigidMotion) -> ComplexArray:
    """Return q with all six degrees of freedom, (run, body, freq, 6); zero where not fitted or determined."""
    q = np.zeros((*motion.q.shape[:3], 6), dtype=complex)
    q[..., [DOF_NAMES.index(name) for name in motion.dof]] = np.nan_to_num(motion.q)
    return q


def surface_body(bodies: tuple[str, ...]) -> int | None:
    """Return which body the surface belongs to: the one called stapes, or the only one."""
    for number, name in enumerate(bodies):
        if name.strip().lower() == "stapes":
            return number
    return 0 if len(bodies) == 1 else None


def shown_points(result: Points2Dof, scenery: Scenery) -> list[Array]:
    """Return, by body, its outermost points (n, 3), mm, measured or of the surface: one moves most."""
    own = surface_body(result.motion.bodies)
    clouds = []
    for number, body in enumerate(result.measurement.bodies):
        cloud = np.unique(body.positions_mm, axis=0)
        if number == own and scenery.has_surface:
            cloud = np.vstack([cloud, scenery.vertices_mm])
        clouds.append(_corners(cloud))
    return clouds


def displacement_of(q: ComplexArray, points_mm: Array) -> ComplexArray:
    """Return the displacement (..., n, 3), m, of points (n, 3), mm, for motions q (..., 6): d + theta x r."""
    return np.asarray(q[..., None, :3] + np.cross(q[..., None, 3:], points_mm * 1e-3))


def largest_over_lines(result: Points2Dof, scenery: Scenery) -> Array:
    """Return the largest displacement of any point, m, peak, (run, body, freq)."""
    q = full_motion(result.motion)
    size = np.zeros(q.shape[:3])
    for number, cloud in enumerate(shown_points(result, scenery)):
        for point in cloud:
            moved = displacement_of(q[:, number], point[None])[..., 0, :]
            np.maximum(size[:, number], np.linalg.norm(np.abs(moved), axis=-1), out=size[:, number])
    return size


def _corners(cloud: Array) -> Array:
    """Return the points farthest out along 26 directions."""
    from itertools import product

    directions = np.array([d for d in product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
    return np.asarray(cloud[np.unique(np.argmax(cloud @ directions.T, axis=0))])


def _fewer(cloud: Array) -> Array:
    """Return every n-th point, and the outermost ones, so that about _MOST_POINTS are drawn."""
    step = -(-len(cloud) // _MOST_POINTS)
    return cloud if step == 1 else np.unique(np.vstack([cloud[::step], _corners(cloud)]), axis=0)


def chosen_line(result: Points2Dof, scenery: Scenery) -> tuple[int, int]:
    """Return run and line with the largest motion of the stapes, or of the first body."""
    own = surface_body(result.motion.bodies) or 0
    size = largest_over_lines(result, scenery)[:, own]
    run, line = np.unravel_index(int(np.argmax(size)), size.shape)
    return int(run), int(line)


def moment(result: Points2Dof, scenery: Scenery, run: int, line: int) -> Moment:
    """Return a line with the exaggeration that makes its largest motion a readable part of the picture."""
    q = full_motion(result.motion)[run, :, line]
    clouds = shown_points(result, scenery)
    sizes = [np.linalg.norm(np.abs(displacement_of(q[k], cloud)), axis=-1) for k, cloud in enumerate(clouds)]
    largest = float(max(np.max(size) for size in sizes))
    span = float(np.max(np.ptp(np.concatenate(clouds), axis=0))) or 1.0
    exact = SHARE * span * 1e-3 / max(largest, 1e-300)
    digits = 10.0 ** np.floor(np.log10(exact))
    return Moment(run, line, q, float(np.round(exact / digits, 1) * digits), largest)


def stroboscope_figure(result: Points2Dof, now: Moment, scenery: Scenery | None = None) -> Figure:
    """Draw outlines and points at PHASES equal steps of one period, from three sides.

    Parameters
    ----------
    scenery : Scenery, optional
    """
    import matplotlib
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import BoundaryNorm

    scenery = scenery or Scenery()
    clouds = [_fewer(np.unique(body.positions_mm, axis=0)) for body in result.measurement.bodies]
    everything = np.concatenate([*clouds, scenery.vertices_mm, np.zeros((1, 3))])
    low, high = everything.min(axis=0), everything.max(axis=0)
    span = float(np.max(high - low)) or 1.0
    middle, half = 0.5 * (low + high), 0.5 * (high - low) + 0.16 * span
    sights = views()
    figure, axes = equal_panels(sights, half, above=1.0)
    tints = matplotlib.colormaps["twilight_shifted"](np.linspace(0.06, 0.94, PHASES + 1)[:-1])
    phases = 2.0 * np.pi * np.arange(PHASES) / PHASES
    own = surface_body(result.motion.bodies)
    mesh = coarse(scenery.vertices_mm, scenery.faces, _MOST_FACES)
    for view, sight in zip(axes, sights, strict=True):
        if scenery.has_surface:
            _draw_outlines(
                view, sight, mesh, None if own is None else now.q[own], now.exaggeration, phases, tints
            )
        for number, cloud in enumerate(clouds):
            moved = displacement_of(now.q[number], cloud)
            _draw_paths(view, sight, cloud, moved, now.exaggeration, phases, tints, number)
        _frame(view, sight, scenery, middle, half)
    height = figure.get_size_inches()[1]
    bar = figure.add_axes((0.30, 1.0 - 0.42 / height, 0.40, 0.14 / height))
    steps = np.degrees(np.append(phases, 2.0 * np.pi))
    shades = ScalarMappable(BoundaryNorm(steps, PHASES), matplotlib.colors.ListedColormap(tints))
    figure.colorbar(shades, cax=bar, orientation="horizontal")
    bar.set_xticks(steps[:-1] + 180.0 / PHASES, [f"{step:g}°" for step in steps[:-1]], fontsize=8)
    bar.tick_params(length=0)
    bar.set_title("phase", fontsize=8.5, pad=3)
    _names(figure, result)
    return figure


def _draw_outlines(
    view: Axes, sight: View, mesh: tuple[Array, NDArray[np.int64]], q: ComplexArray | None,
    exaggeration: float, phases: Array, tints: Array,
) -> None:  # fmt: skip
    """Draw the surface at rest, pale, and the edge of its picture at every phase."""
    vertices, faces = mesh
    rest = shade(vertices, faces, sight, 260)
    pale = rest.image.copy()
    pale[..., :3] = 1.0 - 0.45 * (1.0 - pale[..., :3])
    view.imshow(pale, extent=rest.extent, zorder=0, aspect="equal", interpolation="antialiased")
    if q is None:
        return
    moved = displacement_of(q, vertices)
    for phase, tint in zip(phases, tints, strict=True):
        shifted = vertices + np.real(moved * np.exp(1j * phase)) * exaggeration * 1e3
        across, up, covered = silhouette(shifted, faces, sight, 220)
        view.contour(across, up, covered, levels=[0.5], colors=[tint], linewidths=0.9, zorder=1)


def _draw_paths(
    view: Axes, sight: View, cloud: Array, moved: ComplexArray, exaggeration: float, phases: Array,
    tints: Array, number: int,
) -> None:  # fmt: skip
    """Draw the ellipse of every point and where it is at every phase."""
    round_trip = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 49))
    path = sight.flat(cloud + np.real(moved * round_trip[:, None, None]) * exaggeration * 1e3)
    view.plot(path[..., 0], path[..., 1], color=colour(number), lw=0.8, alpha=0.8, zorder=2)
    at = sight.flat(cloud + np.real(moved * np.exp(1j * phases)[:, None, None]) * exaggeration * 1e3)
    small = 9.0 if len(cloud) <= 40 else 2.5
    for place, tint in zip(at, tints, strict=True):
        view.scatter(place[:, 0], place[:, 1], s=small, color=tint, lw=0, zorder=3)


def _frame(view: Axes, sight: View, scenery: Scenery, middle: Array, half: Array) -> None:
    from legacy.kinematics.report.draw_geometry import frame

    frame(view, sight, scenery, middle, half)
    view.plot([0.0], [0.0], "+", ms=9, mew=1.3, color=INK, zorder=4)


def _names(figure: Figure, result: Points2Dof) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=colour(k), lw=1.4, label=shorten_name(plain(body.body), 30))
        for k, body in enumerate(result.measurement.bodies)
    ]
    figure.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.03, 1.0), frameon=False, fontsize=9)
