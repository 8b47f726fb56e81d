"""Binary glTF 2.0: metres, as the format demands, in footplate axes, whose y (lateral) is glTF's up."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from legacy.ct_inertia.exports.body import ExportBody
from legacy.ct_inertia.surface.surface import Surface

UNITS = {"length": "m", "coordinates": "footplate"}
# glTF 2.0: accessor.componentType (float, unsigned int) and bufferView.target (array, element array).
_FLOAT, _UINT = 5126, 5125
_VERTICES, _INDICES = 34962, 34963
_COLOURS = {"stapes": [0.85, 0.78, 0.65, 1.0], "plate": [0.62, 0.72, 0.78, 0.45]}


def write(body: ExportBody, folder: Path) -> list[str]:
    """Write stapes.glb, with the plate as a second node where there is one; return its name."""
    (folder / "stapes.glb").write_bytes(glb_bytes(body))
    return ["stapes.glb"]


def glb_bytes(body: ExportBody) -> bytes:
    """Return the scene as one GLB file.

    Notes
    -----
    glTF 2.0 specification, Khronos Group, sections 3.4 (metres, +Y up) and 4 (GLB).
    """
    surfaces: dict[str, Surface] = {"stapes": body.stapes}
    if body.plate is not None:
        surfaces["plate"] = body.plate
    buffer = bytearray()
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    meshes: list[dict[str, Any]] = []
    for place, (name, surface) in enumerate(surfaces.items()):
        metres = body.footplate_from_scan.points(surface.vertices_mm) * 1e-3
        position = _add(buffer, views, accessors, metres.astype("<f4"), _VERTICES)
        corners = surface.faces.astype("<u4").ravel()
        index = _add(buffer, views, accessors, corners, _INDICES)
        primitive = {"attributes": {"POSITION": position}, "indices": index, "material": place}
        meshes.append({"name": name, "primitives": [primitive]})
    content = {
        "asset": {
            "version": "2.0",
            "generator": "stapeskit",
            "extras": {"unit": "m", "coordinates": "footplate: x anterior, y lateral"},
        },
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "nodes": [{"name": mesh["name"], "mesh": place} for place, mesh in enumerate(meshes)],
        "meshes": meshes,
        "materials": [_material(name) for name in surfaces],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(buffer)}],
    }
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(buffer), b"BIN\0") + bytes(buffer)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _add(
    buffer: bytearray,
    views: list[dict[str, Any]],
    accessors: list[dict[str, Any]],
    data: NDArray[Any],
    kind: int,
) -> int:
    """Append numbers (n, 3) or (n,) to the buffer and return the index of their accessor."""
    raw = data.tobytes()
    views.append({"buffer": 0, "byteOffset": len(buffer), "byteLength": len(raw), "target": kind})
    buffer += raw
    accessor: dict[str, Any] = {"bufferView": len(views) - 1, "count": len(data)}
    if kind == _VERTICES:
        accessor |= {"componentType": _FLOAT, "type": "VEC3"}
        accessor |= {"min": data.min(axis=0).tolist(), "max": data.max(axis=0).tolist()}
    else:
        accessor |= {"componentType": _UINT, "type": "SCALAR"}
    accessors.append(accessor)
    return len(accessors) - 1


def _material(name: str) -> dict[str, Any]:
    colour = _COLOURS[name]
    material: dict[str, Any] = {
        "name": name,
        "pbrMetallicRoughness": {"baseColorFactor": colour, "metallicFactor": 0.0, "roughnessFactor": 0.8},
    }
    if colour[3] < 1.0:
        material["alphaMode"] = "BLEND"
    return material
