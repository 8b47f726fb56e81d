"""What the three-dimensional picture shows, as data of the page; viewer.js draws it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.kinematics.report.stapes_surface import packed_mesh
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.page import page
from legacy.stapeskit.spatial import DOF_NAMES

if TYPE_CHECKING:
    from markupsafe import Markup

    from legacy.stapeskit.records.measured_mass import MeasuredMass

# Triangles that a page of a few megabytes holds and a telephone turns smoothly.
_MOST_FACES = {"stapes": 14000, "plate": 5000}
_AXIS_MM = 1.4
_PARTS = Path(__file__).parent


def viewer(mass: MeasuredMass, kd: Mapping[str, Any]) -> Markup:
    """Return the picture with its controls, data and script; points and beams come from the page's motion.

    Parameters
    ----------
    kd : mapping
        Content of kd.json.
    """
    data = json.dumps(scene(mass, kd), separators=(",", ":"))
    modes = [f"mode {k + 1}: {mode['frequency_hz']:.0f} Hz" for k, mode in enumerate(kd["modes"])]
    block = page.template(_part("viewer.html"), modes=modes)
    return page.with_script(block, _part("viewer.css"), "viewer-data", data, _part("viewer.js"))


def _part(name: str) -> str:
    return (_PARTS / name).read_text(encoding="utf-8")


def scene(mass: MeasuredMass, kd: Mapping[str, Any]) -> dict[str, Any]:
    """Return surfaces, lines and modes in the footplate frame, mm, JSON-able."""
    from legacy.kinematics.registration.scan_surfaces import ScanSurfaces

    frames, landmarks = mass.record.raw["frames"], mass.record.raw.get("found", {})
    scan_from_footplate = np.asarray(frames["scan_from_footplate"], dtype=float)
    surfaces = ScanSurfaces.of(mass)
    meshes = []
    for name in _MOST_FACES:
        surface = surfaces.mesh(name)
        if surface is not None:
            vertices = _map_back(scan_from_footplate, surface.vertices_mm)
            meshes.append({"name": name, **packed_mesh(vertices, surface.faces, _MOST_FACES[name])})
    return {
        "meshes": meshes,
        "lines": _lines(frames, scan_from_footplate, kd),
        "outline": landmarks.get("footplate_outline_in_footplate_mm") or [],
        "z_is": frames.get("z_is", ""),
        "modes": [_mode(mode, kd["dof"]) for mode in kd["modes"]],
    }


def _map_back(a_from_b: Array, points: Array) -> Array:
    """Return points given in a in the coordinates of b."""
    return np.asarray((points - a_from_b[:3, 3]) @ a_from_b[:3, :3])


def _lines(
    frames: Mapping[str, Any], scan_from_footplate: Array, kd: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Return the axes of the frames and of the stiffness: name, ends, colour key."""
    lines = [
        {
            "name": name,
            "from": [0.0, 0.0, 0.0],
            "to": (_AXIS_MM * axis).tolist(),
            "colour": name,
            "kind": "axes",
        }
        for name, axis in zip("xyz", np.eye(3), strict=True)
    ]
    if frames.get("scan_from_plate"):
        plate = np.asarray(frames["scan_from_plate"], dtype=float)
        origin = _map_back(scan_from_footplate, plate[:3, 3])
        for name, axis in zip("xyz", plate[:3, :3].T, strict=True):
            end = origin + _AXIS_MM * (scan_from_footplate[:3, :3].T @ axis)
            lines.append(_line(f"plate {name}", origin, end, name, "plate"))
    axes = kd.get("principal_axes")
    if axes:
        origin = np.array([axes["origin_x_mm"], 0.0, axes["origin_z_mm"]])
        turn = np.deg2rad(axes["angle_deg"])
        long = np.array([np.cos(turn), 0.0, -np.sin(turn)])
        for name, way in (
            ("stiffness axis 1", long),
            ("stiffness axis 3", np.cross(long, [0.0, 1.0, 0.0])),
            ("stiffness axis 2", np.array([0.0, 1.0, 0.0])),
        ):
            lines.append(_line(name, origin - 0.9 * way, origin + 0.9 * way, "principal", "principal"))
    return lines


def _line(name: str, start: Array, end: Array, colour: str, kind: str) -> dict[str, Any]:
    ends = {"from": np.round(start, 5).tolist(), "to": np.round(end, 5).tolist()}
    return {"name": name, **ends, "colour": colour, "kind": kind}


def _mode(mode: Mapping[str, Any], dof: Sequence[str]) -> dict[str, Any]:
    """Return a mode shape with all six degrees of freedom: real parts, then imaginary parts, m and rad."""
    shape = np.zeros((2, 6))
    for place, name in enumerate(dof):
        shape[:, DOF_NAMES.index(name)] = mode["shape_re"][place], mode["shape_im"][place]
    return {"hz": mode["frequency_hz"], "shape": (shape / np.abs(shape).max()).ravel().tolist()}
