"""Wavefront OBJ: scan coordinates, mm, in full digits."""

from __future__ import annotations

from pathlib import Path

from legacy.ct_inertia.exports.body import ExportBody
from legacy.ct_inertia.surface.surface import Surface

UNITS = {"length": "mm", "coordinates": "scan"}


def write(body: ExportBody, folder: Path) -> list[str]:
    """Write stapes.obj and plate.obj; return their names."""
    names = []
    for name, surface in (("stapes", body.stapes), ("plate", body.plate)):
        if surface is not None:
            (folder / f"{name}.obj").write_text(obj_text(surface, name), encoding="utf-8")
            names.append(f"{name}.obj")
    return names


def obj_text(surface: Surface, name: str) -> str:
    """Return a surface as OBJ text."""
    lines = ["# stapeskit: scan coordinates, mm, normals outward", f"o {name}"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in surface.vertices_mm.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (surface.faces + 1).tolist()]
    return "\n".join(lines) + "\n"
