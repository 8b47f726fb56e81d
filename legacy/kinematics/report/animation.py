"""The moving picture of ``dof.html``: the bodies at a chosen frequency, drawn by a script in the page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.kinematics.report.draw_motion import (
    SHARE,
    Moment,
    full_motion,
    largest_over_lines,
    shown_points,
    surface_body,
)
from legacy.kinematics.report.stapes_surface import Scenery, packed, packed_mesh
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.page import page
from legacy.stapeskit.page.drawings import colour, decimate_lines, log_spaced, shorten_name
from legacy.stapeskit.page.shaded_surface import View, views
from legacy.stapeskit.spatial import DOF_UNITS

if TYPE_CHECKING:
    from markupsafe import Markup

    from legacy.kinematics.points2dof import Points2Dof

# Sizes of the picture, which keep the page small.
_MOST_FACES = 2200
_MOST_NUMBERS = 200_000
_MOST_POINTS = 120
_PICTURE = 1010.0

_PARTS = Path(__file__).with_name("motion_picture")


def moving_picture(result: Points2Dof, now: Moment, scenery: Scenery) -> Markup:
    """Return the picture with its controls, data and script.

    Parameters
    ----------
    now : Moment
        What is shown first.

    Notes
    -----
    Of very many lines so many are kept that the data stay small: of neighbours those with the largest and
    the smallest motion. Positions are rounded to 16 bits of the span, motions to single precision.
    """
    data = picture_data(result, now, scenery)
    names = ", ".join(result.motion.bodies)
    shown = [
        {
            "title": view["title"],
            "size": view["size"],
            "alt": f"Moving picture of {names}, {view['title']}; described in words below.",
        }
        for view in data["views"]
    ]
    block = page.template(
        _part("motion.html"),
        views=shown,
        last=len(data["freq"]) - 1,
        runs=data["runs"],
        bodies=result.motion.bodies,
        start=now.run,
    )
    text = json.dumps(data, separators=(",", ":"))
    return page.with_script(block, _part("motion.css"), "motion-data", text, _part("motion.js"))


def _part(name: str) -> str:
    return (_PARTS / name).read_text(encoding="utf-8")


def picture_data(result: Points2Dof, now: Moment, scenery: Scenery) -> dict[str, Any]:
    """Return what the script draws, JSON-able."""
    motion = result.motion
    q = full_motion(motion)
    own = surface_body(motion.bodies) if scenery.has_surface else None
    size = largest_over_lines(result, scenery)
    curves = q.shape[0] * q.shape[1]
    lines = decimate_lines(np.max(size, axis=(0, 1)), max(40, _MOST_NUMBERS // (12 * curves)))
    lines = np.unique(np.append(lines, now.line))
    clouds = shown_points(result, scenery)
    everything = np.concatenate([*clouds, scenery.vertices_mm, np.zeros((1, 3))])
    low, high = everything.min(axis=0), everything.max(axis=0)
    span = float(np.max(np.ptp(np.concatenate(clouds), axis=0))) or 1.0
    numbers = np.concatenate([q[:, :, lines].real, q[:, :, lines].imag], axis=-1).astype("<f4")
    bodies = [_body(result, k, clouds[k]) for k in range(len(motion.bodies))]
    reference = DOF_UNITS[motion.reference.rpartition(":")[2]] if motion.reference else ""
    return {
        "views": _views(views(), scenery, 0.5 * (low + high), 0.5 * (high - low) + 0.16 * span),
        "freq": [float(f"{f:.9g}") for f in motion.freq_hz[lines]],
        "log": log_spaced(motion.freq_hz),
        "runs": list(motion.runs),
        "bodies": bodies,
        "own": -1 if own is None else own,
        "outline": []
        if own is None
        else np.round(scenery.outline_mm[:: max(1, len(scenery.outline_mm) // 90)], 4).tolist(),
        "mesh": packed_mesh(scenery.vertices_mm, scenery.faces, _MOST_FACES) if scenery.has_surface else None,
        "q": [[packed(numbers[run, body]) for body in range(q.shape[1])] for run in range(q.shape[0])],
        "share": SHARE,
        "span": round(span, 4),
        "reference": motion.reference,
        "unit": f"m/{reference}" if reference else "m",
        "start": {"run": now.run, "line": int(np.searchsorted(lines, now.line))},
    }


def _body(result: Points2Dof, number: int, outermost: Array) -> dict[str, Any]:
    body = result.measurement.bodies[number]
    names = list(dict.fromkeys(body.points))
    names = names[:: int(np.ceil(len(names) / _MOST_POINTS))]
    places = body.positions_mm[[body.points.index(name) for name in names]]
    beams = [
        [names.index(name), *np.round(way, 4).tolist()]
        for name, way in zip(body.points, body.directions, strict=True)
        if name in names
    ]
    return {
        "name": shorten_name(body.body, 40),
        "colour": colour(number),
        "points": np.round(places, 4).tolist(),
        "edges": _edges(places),
        "beams": beams,
        "outermost": np.round(outermost, 4).tolist(),
    }


def _edges(places: Array) -> list[list[int]]:
    """Return pairs of neighbours: every point with its two nearest, which makes a body look rigid."""
    distance = np.linalg.norm(places[:, None] - places[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    near = np.argsort(distance, axis=1)[:, : min(2, len(places) - 1)]
    pairs = {(min(a, int(b)), max(a, int(b))) for a in range(len(places)) for b in near[a]}
    return [list(pair) for pair in sorted(pairs)]


def _views(sights: tuple[View, ...], scenery: Scenery, middle: Array, half: Array) -> list[dict[str, Any]]:
    """Return the views with the sizes of their pictures, pixels; all in one scale."""
    wide = [2.0 * float(np.abs(sight.axes[0]) @ half) for sight in sights]
    high = [2.0 * float(np.abs(sight.axes[1]) @ half) for sight in sights]
    scale = min(_PICTURE / sum(wide), 420.0 / max(high))
    return [
        {
            "title": f"seen from {scenery.side(sight.eye) or sight.eye}",
            "right": sight.axes[0].tolist(),
            "up": sight.axes[1].tolist(),
            "eye": sight.axes[2].tolist(),
            "size": [round(scale * across), round(scale * up)],
            "scale": scale,
            "middle": sight.flat(middle)[:2].tolist(),
        }
        for sight, across, up in zip(sights, wide, high, strict=True)
    ]
