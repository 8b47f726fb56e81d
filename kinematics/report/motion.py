"""The moving bodies for the three-dimensional view of a page."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stapeskit.arrays import ComplexArray
from stapeskit.report.colours import BODY_COLOURS, colour_of
from stapeskit.report.scene3d import Line, Mesh, Motion, Point, Scene
from stapeskit.spatial import dof_indices

if TYPE_CHECKING:
    from kinematics.results import MotionResult

_MOST_POINTS = 400
_MOST_LINES = 160  # of the slider
_MOST_RUNS = 3
_BEAM_MM = 0.8


def motion_scene(result: MotionResult) -> Scene:
    """Return bodies, points, beams and motion in footplate axes."""
    bodies = result.measurement.bodies
    names = [body.body for body in bodies]
    worst = {(one.body, one.point): one.verdict for one in reversed(result.channels) if one.verdict != "ok"}
    points, lines = [], []
    for body in bodies:
        own = list(dict.fromkeys(body.points))
        for point in own[:: max(1, len(own) * len(bodies) // _MOST_POINTS)]:
            channels = body.channels_of(point)
            at = 1e3 * body.arms_m[channels[0]]
            points.append(Point(point, at, body.body, worst.get((body.body, point), "ok")))
            for channel in channels:
                ends = np.stack([at, at + _BEAM_MM * body.directions[channel]])
                colour = colour_of(body.body, names)
                lines.append(Line(point, ends, colour, "beams", shown=False, width=1.0, body=body.body))
    directions = ("anterior", "lateral", "")
    if result.mass is not None:
        z_is = (result.mass.raw.get("frames") or {}).get("z_is") or ""
        directions = ("anterior", "lateral", "" if z_is == "unknown" else str(z_is))
    caption = (
        "Measured motion in footplate axes, enlarged; colours of points are their verdicts. Choose a "
        "frequency with the slider."
    )
    return Scene(
        surfaces=_surfaces(result),
        points=points,
        motions=_motions(result),
        lines=lines,
        directions=directions,
        title="The moving bodies",
        caption=caption,
    )


def _surfaces(result: MotionResult) -> list[Mesh]:
    if result.mass is None:
        return []
    footplate_from_scan = result.mass.scan_from_footplate.inverse()
    moves_with = {"stapes": "stapes", "plate": "base" if "base" in result.motion.bodies else "plate"}
    return [
        Mesh(
            name,
            footplate_from_scan.points(surface.vertices_mm),
            surface.faces,
            BODY_COLOURS[name],
            opacity=1.0 if name == "stapes" else 0.45,
            body=moves_with[name],
            most_faces=4000 if name == "stapes" else 1500,
        )
        for name, surface in result.surfaces.items()
    ]


def _motions(result: MotionResult) -> list[Motion]:
    motion = result.motion
    lines = np.unique(
        np.linspace(0, len(motion.freq_hz) - 1, min(_MOST_LINES, len(motion.freq_hz))).astype(int)
    )
    places = dof_indices(motion.dof)
    found = []
    for run, name in enumerate(motion.runs[:_MOST_RUNS]):
        amplitudes: dict[str, ComplexArray] = {}
        for number, body in enumerate(motion.bodies):
            six = np.zeros((len(lines), 6), dtype=complex)
            six[:, places] = motion.q[run, number, lines]
            amplitudes[body] = six
        label = "measured motion" if len(motion.runs) == 1 else f"run {name}"
        found.append(Motion(label, amplitudes, motion.freq_hz[lines], measured=not motion.reference))
    return found
