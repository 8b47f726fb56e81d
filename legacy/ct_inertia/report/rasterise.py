"""Draw shaded surfaces with a depth buffer in numpy: the same on every machine, without a GL driver."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array
from legacy.stapeskit.page.depth_buffer import fragments, nearest, vertex_normals

if TYPE_CHECKING:
    from legacy.ct_inertia.report.drawn_body import Body

# Directions to the lamp and the eye in the picture's axes, and the shares of ambient and diffuse light.
_LAMP, _EYE = np.array([-0.33, 0.44, 0.835]), np.array([0.0, 0.0, 1.0])
_AMBIENT, _BY_LAMP, _BY_EYE = 0.22, 0.58, 0.28


def rasterise(
    bodies: Sequence[Body], picture_from_scan: Array, centre_mm: Array, half_mm: float, pixels: int
) -> NDArray[np.uint8]:
    """Draw surfaces in parallel projection.

    Parameters
    ----------
    bodies : sequence of Body
        Closed and outward: faces that look away are left out.
    picture_from_scan : ndarray, (4, 4)
        Scan coordinates to right, up and towards the eye, mm.
    centre_mm : ndarray, (2,)
        Right and up of the picture's centre.
    half_mm : float
        Half of its width and height.
    pixels : int
        Its width and height.

    Returns
    -------
    ndarray of uint8, (pixels, pixels, 3)
        The top row first, on white.
    """
    from matplotlib.colors import to_rgb

    picture = np.ones((pixels * pixels, 3))
    depth = np.full(pixels * pixels, -np.inf)
    # Opaque bodies first; what shines through them is blended over what lies behind.
    for body in sorted(bodies, key=lambda body: body.opacity < 1.0):
        points = body.vertices_mm @ picture_from_scan[:3, :3].T + picture_from_scan[:3, 3]
        faces = np.asarray(body.faces)
        a, b, c = (points[faces[:, k]] for k in range(3))
        areas = np.cross(b - a, c - a)
        seen = areas[:, 2] > 0.0
        faces, areas = faces[seen], areas[seen]
        normals = vertex_normals(points, np.asarray(body.faces)) if body.smooth else None
        flat = points.copy()
        scale = pixels / (2.0 * half_mm)
        flat[:, 0] = (points[:, 0] - centre_mm[0] + half_mm) * scale - 0.5
        flat[:, 1] = (half_mm - points[:, 1] + centre_mm[1]) * scale - 0.5
        place, height, face, shares = fragments(flat[faces], (pixels, pixels))
        front = height > depth[place]
        place, height, face, shares = place[front], height[front], face[front], shares[front]
        top = nearest(place, height, pixels * pixels)
        place, face, shares = place[top], face[top], shares[top]
        across = areas[face] if normals is None else np.einsum("nk,nkj->nj", shares, normals[faces[face]])
        across = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
        light = _AMBIENT + _BY_LAMP * np.clip(across @ _LAMP, 0, 1) + _BY_EYE * np.clip(across @ _EYE, 0, 1)
        colour = np.clip(np.array(to_rgb(body.color)) * light[:, None], 0.0, 1.0)
        picture[place] += body.opacity * (colour - picture[place])
        if body.opacity >= 1.0:
            depth[place] = height[top]
    return np.rint(255.0 * picture).astype(np.uint8).reshape(pixels, pixels, 3)
