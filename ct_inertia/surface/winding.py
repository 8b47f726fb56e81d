"""Close an open mesh of many pieces by the surface where its winding number passes one half."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ct_inertia.surface.contour import contour
from ct_inertia.surface.surface import Cap, Surface
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError

Single = NDArray[np.float32]

_CELLS = 80  # of the grid along the longest side: 40 um of a stapes
_MARGIN = 3  # cells around the mesh
_UNSURE = 0.25  # distance of a winding number from 0 and 1 from which on inside is open
_CLUSTER = 8  # faces that are summed one by one
_FAR = 2.5  # radii of a cluster from which on it is a dipole: error below 1 % of its share
_POINTS = 1 << 14  # points at a time


def winding_surface(vertices: Array, faces: NDArray[np.int64], name: str) -> Surface:
    """Return the closed surface of winding number one half, on a grid.

    ``vertices`` (n, 3) in mm, ``faces`` (m, 3); ``name`` of the file, for messages.

    Returns
    -------
    Surface
        Its cap holds half the volume where the number is neither 0 nor 1: what is missing there is open.

    Raises
    ------
    StapeskitError
        The mesh encloses nothing, or what is missing may be as large as what is there.

    Notes
    -----
    A. Jacobson, L. Kavan, O. Sorkine-Hornung, ACM Trans. Graph. 32 (2013), doi:10.1145/2461912.2461916; faces
    far away as dipoles: G. Barill et al., ACM Trans. Graph. 37 (2018), doi:10.1145/3197517.3201337.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    step = float((high - low).max()) / _CELLS
    count = np.ceil((high - low) / step).astype(int) + 1 + 2 * _MARGIN
    scan_from_index = np.diag([step, step, step, 1.0])
    scan_from_index[:3, 3] = low - (_MARGIN + 0.5) * step  # no plane of grid points lies in a flat side
    index = np.indices(count[::-1]).reshape(3, -1)[::-1].T
    points = index * step + scan_from_index[:3, 3]
    field = np.minimum(np.abs(winding_number(vertices, faces, points)), 1.0).astype(np.float32)
    within, open_part = field > 0.5, (field > _UNSURE) & (field < 1.0 - _UNSURE)
    missing = 0.5 * float(np.count_nonzero(open_part)) * step**3
    if 2.0 * missing >= np.count_nonzero(within) * step**3:
        step_text = "Export it again as one closed surface"
        raise StapeskitError.of("the surface", "one that encloses a volume", "open pieces", name, step_text)
    surface = contour(field.reshape(count[::-1]), scan_from_index, 0.5, largest=False)
    if not missing:
        return surface
    width = (12.0 / np.pi * missing) ** (1.0 / 3.0)
    return replace(surface, caps=(Cap(points[open_part].mean(axis=0), width, 0.0, missing),))


def winding_number(vertices: Array, faces: NDArray[np.int64], points: Array) -> Array:
    """Return how often faces wind around points (k, 3): 1 inside an outward surface, 0 outside."""
    corners = vertices[faces]
    middle = corners.mean(axis=1)
    normal = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.maximum(np.linalg.norm(normal, axis=1), np.finfo(float).tiny)
    total = np.zeros(len(points))
    waiting = [(np.arange(len(faces)), np.arange(len(points)))]
    while waiting:
        some, seen = waiting.pop()
        centre = np.average(middle[some], axis=0, weights=area[some])
        reach = _FAR * float(np.linalg.norm(corners[some] - centre, axis=2).max())
        away = points[seen] - centre
        distance = np.sqrt(np.einsum("ij,ij->i", away, away))
        far = distance > reach
        total[seen[far]] -= away[far] @ normal[some].sum(axis=0) / (4.0 * np.pi * distance[far] ** 3)
        near = seen[~far]
        if len(some) > _CLUSTER and len(near):
            axis = int(np.argmax(np.ptp(middle[some], axis=0)))
            order = some[np.argsort(middle[some, axis])]
            waiting += [(order[: len(order) // 2], near), (order[len(order) // 2 :], near)]
            continue
        for first in range(0, len(near), _POINTS):
            part = near[first : first + _POINTS]
            total[part] += _solid_angles(corners[some], points[part]) / (4.0 * np.pi)
    return total


def _solid_angles(corners: Array, points: Array) -> Array:
    """Return the summed solid angle (k,) of triangles (m, 3, 3), seen from points (k, 3).

    Notes
    -----
    A. van Oosterom, J. Strackee, IEEE Trans. Biomed. Eng. 30 (1983), doi:10.1109/TBME.1983.325207.
    """
    # Axes first and single precision: three times as fast, and exact to 1e-6 about a near centre.
    centre = corners.mean(axis=(0, 1))
    seen = (points - centre).astype(np.float32).T[:, :, None]
    a, b, c = ((corners[:, k] - centre).astype(np.float32).T[:, None, :] - seen for k in range(3))
    la, lb, lc = (np.sqrt(_dot(one, one)) for one in (a, b, c))
    cross = (b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0])
    bottom = la * lb * lc + _dot(a, b) * lc + _dot(b, c) * la + _dot(c, a) * lb
    return np.asarray(2.0 * np.arctan2(_dot(a, cross), bottom).sum(axis=1), dtype=float)


def _dot(one: Single, two: Single | Sequence[Single]) -> Single:
    return one[0] * two[0] + one[1] * two[1] + one[2] * two[2]
