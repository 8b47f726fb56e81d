"""Whether what was measured can be a human stapes, by sizes far wider than those of real ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.frames.footplate import FootplateFrame
from legacy.ct_inertia.surface.surface import Surface
from legacy.ct_inertia.volume.mesh_graphs import graph_pieces
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

# Real ones: 2.9 to 3.9 mm high, footplate 2.4 to 3.4 by 1.1 to 1.7 mm, 0.9 to 2.6 mm3.
HEIGHT_MM = (2.4, 5.0)
FOOTPLATE_LENGTH_MM = (1.8, 4.0)
FOOTPLATE_WIDTH_MM = (0.7, 2.2)
VOLUME_MM3 = (0.3, 6.0)
# Longest extent that a mesh of a stapes in mm can have; another one is in the unit of length that brings it
# nearest to a usual one.
_MESH_MM = (1.0, 12.0)
_TYPICAL_MM = 3.5
_UNITS = {"metres": 1e3, "centimetres": 10.0, "inches": 25.4, "micrometres": 1e-3, "nanometres": 1e-6}
# Volume of a body of a mesh, as a share of the largest, below which it is a speck of rounding.
_LEAST_BODY = 1e-6


def implausible(footplate: FootplateFrame, volume_mm3: float) -> list[str]:
    """Return every size that no human stapes has, with what it could be; empty when all can be.

    Parameters
    ----------
    footplate : FootplateFrame
    volume_mm3 : float
    """
    sizes = (
        ("a height", footplate.height_mm, HEIGHT_MM, "mm"),
        ("a footplate length", footplate.length_mm, FOOTPLATE_LENGTH_MM, "mm"),
        ("a footplate width", footplate.width_mm, FOOTPLATE_WIDTH_MM, "mm"),
        ("a volume", volume_mm3, VOLUME_MM3, "mm3"),
    )
    return [
        f"{name} of {value:.3g} {unit} ({low:g} to {high:g} is possible)"
        for name, value, (low, high), unit in sizes
        if not low <= value <= high
    ]


def unsuitable(reasons: Sequence[str], notices: Sequence[Notice]) -> CtInertiaError:
    """Return the error for a body that cannot be a stapes, with the warnings about the scan's border."""
    border = [notice.text for notice in notices if notice.code == "touches_border"]
    step = (
        f"Name the stapes with {named('seed')} X,Y,Z (a point inside it, scan mm) or {named('labels')}, "
        "leave other bone out "
        f"with {named('box')} or {named('threshold')}, and check the voxel spacing"
    )
    return CtInertiaError.of(
        "the scan",
        "one with a body that can be a stapes",
        f"no object that can be a stapes: the likeliest has {', '.join(reasons)}",
        next_step=" ".join([f"{step}.", *border]),
    )


def size_notice(reasons: Sequence[str]) -> Notice:
    """Return the warning for a body that somebody named."""
    text = (
        f"The body has {', '.join(reasons)}: it cannot be a whole human stapes. Check what was measured in "
        f"the report, the voxel spacing, and the unit of a mesh."
    )
    return Notice("size_implausible", text)


def check_mesh(surface: Surface, name: str) -> None:
    """Refuse a mesh of several bodies, and one that is written in another unit than mm.

    Parameters
    ----------
    surface : Surface
    name : str
        Its file, for the message.

    Raises
    ------
    CtInertiaError
        A triangle is there more than once, more than one piece encloses a positive volume (a cavity does
        not), or the longest extent is below 1 or above 12 mm.
    """
    twice = repeated_faces(surface)
    if twice:
        raise CtInertiaError.of(
            "the mesh",
            "a surface that holds each triangle once",
            f"{twice} of {len(surface.faces)} triangles repeated: parts of the surface count twice",
            name,
            "Remove doubled shells and faces, and export it again",
        )
    volumes = body_volumes(surface)
    bodies = [volume for volume in volumes if volume > _LEAST_BODY * max(volumes)]
    if len(bodies) > 1:
        listed = ", ".join(f"{volume:.3g}" for volume in sorted(bodies, reverse=True)[:4])
        raise CtInertiaError.of(
            "the mesh",
            "one closed body, the stapes",
            f"{len(bodies)} bodies (of {listed}{' ...' if len(bodies) > 4 else ''} mm3)",
            name,
            "Remove the others, or join them into one closed body, and export it again",
        )
    size = float(np.max(np.ptp(surface.vertices_mm, axis=0)))
    if _MESH_MM[0] <= size <= _MESH_MM[1]:
        return
    unit, factor = min(_UNITS.items(), key=lambda entry: abs(np.log(size * entry[1] / _TYPICAL_MM)))
    known = _TYPICAL_MM / 2.0 < size * factor < _TYPICAL_MM * 2.0
    probable = f"it is probably in {unit}" if known else "its unit may be that of the voxels"
    step = f"Export it in mm (multiply it by {factor:g})" if known else "Export it in mm"
    raise CtInertiaError.of(
        "the mesh", "in mm: a stapes is 3 to 4 mm long", f"{size:.3g} mm; {probable}", name, step
    )


def repeated_faces(surface: Surface) -> int:
    """Return how many triangles repeat an earlier one, whatever its sense of rotation."""
    corners = np.sort(surface.faces, axis=1)
    order = corners[np.lexsort(corners.T)]
    return int(np.count_nonzero(np.all(order[1:] == order[:-1], axis=1)))


def body_volumes(surface: Surface) -> list[float]:
    """Return the enclosed volume, mm3, of every connected piece of a surface; negative for a cavity."""
    faces, count = surface.faces, len(surface.vertices_mm)
    number, piece = graph_pieces(count, np.concatenate([faces[:, :2], faces[:, 1:]]))
    points = surface.vertices_mm - surface.vertices_mm.mean(axis=0)
    a, b, c = (points[faces[:, k]] for k in range(3))
    parts = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
    sums = np.bincount(piece[faces[:, 0]], parts, minlength=number)
    return [float(volume) for volume in sums if volume != 0.0]
