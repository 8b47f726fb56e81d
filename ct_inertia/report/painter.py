"""Shaded surfaces by matplotlib alone: painter's order, one colour per triangle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ct_inertia.report.drawn_body import Body

Array = NDArray[np.float64]
_LIGHT = np.array([-0.35, 0.45, 0.82])


def paint_bodies(axes: Axes, bodies: Sequence[Body], picture_from_scan: Array) -> None:
    """Paint surfaces into axes whose data are picture coordinates (right, up), mm.

    Triangles that face away are left out when the body is opaque; the others are painted from far to near.

    Parameters
    ----------
    picture_from_scan : ndarray, (4, 4)
        Scan coordinates to right, up and towards the eye.
    """
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_rgb

    corners, colours, depths = [], [], []
    light = _LIGHT / np.linalg.norm(_LIGHT)
    for body in bodies:
        points = body.vertices_mm @ picture_from_scan[:3, :3].T + picture_from_scan[:3, 3]
        triangles = points[body.faces]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        size = np.linalg.norm(normals, axis=1)
        normals /= np.where(size > 0.0, size, 1.0)[:, None]
        seen = normals[:, 2] > 0.0
        shade = 0.38 + 0.62 * np.clip(normals[seen] @ light, 0.0, 1.0)
        colour = np.empty((int(seen.sum()), 4))
        colour[:, :3] = np.clip(np.array(to_rgb(body.color)) * shade[:, None] * 1.08, 0.0, 1.0)
        colour[:, 3] = body.opacity
        corners.append(triangles[seen, :, :2])
        depths.append(triangles[seen, :, 2].mean(axis=1))
        colours.append(colour)
    order = np.argsort(np.concatenate(depths))
    faces = np.concatenate(colours)[order]
    opaque = bool(np.all(faces[:, 3] >= 1.0))
    axes.add_collection(
        PolyCollection(
            list(np.concatenate(corners)[order]),
            facecolors=faces,
            edgecolors=faces if opaque else "none",
            linewidths=0.3 if opaque else 0.0,
            antialiaseds=False,
            rasterized=True,
        )
    )
