"""The footplate frame of an exact mesh by its definition, independent of `ct_inertia`.

The definition (contract; scales of 60 degrees, 0.05 mm and 0.03 mm belong to it): n are the outward normals
diffused over 0.05 mm; the medial face F(y) is the largest connected part of the surface where n lies within
60 degrees of -y; y is the normal of the robust plane of F(y) towards the body, a fixed point; the origin is
the area-weighted centroid of F(y) in space; x is the long principal axis of the area within its outline.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from simulate.solids import Faces, Solid
from stapeskit.arrays import Array
from stapeskit.frames import RigidTransform, axes_matrix

FACE_ANGLE_DEG = 60.0
NORMAL_SCALE_MM = 0.05
PLANE_SCALE_MM = 0.03


def footplate_frame(solid: Solid, depth_mm: float = 0.9, edge_mm: float = 0.04) -> RigidTransform:
    """Return body_from_footplate of a stapes whose y points to the head, and x anterior, within 20 degrees.

    ``depth_mm`` above the lowest point are looked at: all of the footplate, no more than needed. No edge is
    longer than ``edge_mm``, below the scale of the diffused normals. It is solved twice: the part that is
    looked at the second time is cut off square to the footplate itself, so the result turns with the body.
    """
    first = _solve(solid, depth_mm, edge_mm)
    second = _solve(solid.moved(first.inverse()), depth_mm, edge_mm)
    return RigidTransform(first.matrix @ second.matrix, "body", "footplate")


def _solve(solid: Solid, depth_mm: float, edge_mm: float) -> RigidTransform:
    points, faces = _refined(solid, depth_mm, edge_mm)
    normals = _diffused_normals(points, faces)
    lateral = np.array([0.0, 1.0, 0.0])
    for _ in range(200):
        triangles, _ = _medial_face(points, faces, normals, lateral)
        plane = _robust_normal(triangles, lateral)
        step = float(np.linalg.norm(plane - lateral))
        lateral = plane
        if step < 1e-9:
            break
    triangles, border = _medial_face(points, faces, normals, lateral)
    areas = _areas(triangles)
    origin = areas @ triangles.mean(axis=1) / areas.sum()
    across = axes_matrix([1.0, 0.0, 0.0], lateral)
    moments = _outline_moments((border - origin) @ across[:, [0, 2]])
    long_axis = across[:, [0, 2]] @ np.linalg.eigh(moments)[1][:, 1]
    long_axis = long_axis * np.sign(long_axis[0])
    return RigidTransform.from_parts(axes_matrix(long_axis, lateral), origin, "body", "footplate")


def _refined(solid: Solid, depth_mm: float, edge_mm: float) -> tuple[Array, Faces]:
    """Return the part of the surface within a depth of the lowest point, its edges split to a length."""
    import pyvista as pv

    height = solid.vertices_mm[:, 1]
    low = np.all(height[solid.faces] < height.min() + depth_mm, axis=1)
    mesh = pv.PolyData.from_regular_faces(
        solid.vertices_mm.astype(float), solid.faces[low].astype(int)
    ).clean()
    fine = mesh.subdivide_adaptive(max_edge_len=edge_mm, max_tri_area=1e9, max_n_passes=12).clean()
    return np.asarray(fine.points, dtype=float), np.asarray(fine.regular_faces, dtype=np.int64)


def _diffused_normals(points: Array, faces: Faces) -> Array:
    """Return unit normals (n, 3) after two implicit steps of surface diffusion.

    Notes
    -----
    Linear elements with cotangent weights (Pinkall and Polthier 1993) and lumped mass; two steps are close to
    a Gaussian of standard deviation NORMAL_SCALE_MM. Slivers have their stiffness limited.
    """
    corners, count = points[faces], len(points)
    longest = np.max(np.sum((corners - np.roll(corners, -1, axis=1)) ** 2, axis=-1), axis=1)
    double = np.maximum(2.0 * _areas(corners), 0.1 * longest + 1e-30)
    rows, columns, weights = [], [], []
    for k in range(3):
        i, j = faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
        one, two = corners[:, (k + 1) % 3] - corners[:, k], corners[:, (k + 2) % 3] - corners[:, k]
        half_cotangent = 0.5 * np.einsum("ij,ij->i", one, two) / double
        rows += [i, j, i, j]
        columns += [j, i, i, j]
        weights += [-half_cotangent, -half_cotangent, half_cotangent, half_cotangent]
    entries = (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns)))
    stiffness = coo_matrix(entries, (count, count)).tocsc()
    mass = np.bincount(faces.ravel(), np.repeat(_areas(corners) / 3.0, 3), minlength=count) + 1e-15
    solve = splu((diags(mass) + 0.25 * NORMAL_SCALE_MM**2 * stiffness).tocsc()).solve
    vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 6.0
    at_vertices = np.stack(
        [np.bincount(faces.ravel(), np.repeat(vectors[:, k], 3), minlength=count) for k in range(3)], axis=1
    )
    normals = solve(mass[:, None] * solve(at_vertices))
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def _areas(triangles: Array) -> Array:
    """Return the areas (m,) of triangles (m, 3, 3)."""
    sides = triangles[:, 1:] - triangles[:, :1]
    return np.asarray(0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1))


def _medial_face(points: Array, faces: Faces, normals: Array, lateral: Array) -> tuple[Array, Array]:
    """Return the triangles (k, 3, 3) of the medial face, cut at its border, and the border (s, 2, 3)."""
    field = -(normals @ lateral) - np.cos(np.radians(FACE_ANGLE_DEG))
    inside = field > 0.0
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = edges[np.all(inside[edges], axis=1)]
    graph = coo_matrix((np.ones(len(edges)), edges.T), (len(points), len(points)))
    label = connected_components(graph, directed=False)[1]
    areas = np.bincount(faces.ravel(), np.repeat(_areas(points[faces]), 3), minlength=len(points))
    inside &= label == np.argmax(np.bincount(label, np.where(inside, areas, 0.0)))
    count = np.count_nonzero(inside[faces], axis=1)
    whole, border = [points[faces[count == 3]]], []
    for number in (1, 2):
        chosen = faces[count == number]
        odd = inside[chosen] if number == 1 else ~inside[chosen]
        turn = (np.argmax(odd, axis=1)[:, None] + np.arange(3)) % 3
        corner = np.take_along_axis(chosen, turn, axis=1)
        a, b, c = (points[corner[:, k]] for k in range(3))
        fa, fb, fc = (field[corner[:, k], None] for k in range(3))
        ab, ac = a + fa / (fa - fb) * (b - a), a + fa / (fa - fc) * (c - a)
        pieces = [(a, ab, ac)] if number == 1 else [(ab, b, c), (ab, c, ac)]
        whole += [np.stack(piece, axis=1) for piece in pieces]
        border.append(np.stack([ab, ac] if number == 1 else [ac, ab], axis=1))
    return np.concatenate(whole), np.concatenate(border)


def _robust_normal(triangles: Array, start: Array) -> Array:
    """Return the normal of the plane with the least sum of area times a smooth form of Huber's distance."""
    areas, centres = _areas(triangles), triangles.mean(axis=1)
    normal, offset = start, float(areas @ centres @ start / areas.sum())
    for _ in range(100):
        weights = areas / np.sqrt(1.0 + ((centres @ normal - offset) / PLANE_SCALE_MM) ** 2)
        centre = weights @ centres / weights.sum()
        away = centres - centre
        new = np.linalg.eigh((away * weights[:, None]).T @ away)[1][:, 0]
        new = new * np.sign(new @ start)
        step = float(np.linalg.norm(new - normal))
        normal, offset = new, float(centre @ new)
        if step < 1e-11:
            break
    return np.asarray(normal)


def _outline_moments(border: Array) -> Array:
    """Return central second moments (2, 2) of the area within the longest closed line of segments (s, 2, 2).

    By Green's theorem a sum over the segments, in any order; inner lines (holes) are left out.
    """
    ends = np.round(border.reshape(-1, 2) / 1e-7).astype(np.int64)
    _, names = np.unique(ends, axis=0, return_inverse=True)
    pairs = names.reshape(-1, 2)
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), (names.max() + 1,) * 2)
    line = connected_components(graph, directed=False)[1][pairs[:, 0]]
    length = np.bincount(line, np.linalg.norm(border[:, 1] - border[:, 0], axis=1))
    start, end = np.moveaxis(border[line == np.argmax(length)], 1, 0)
    turn = start[:, 0] * end[:, 1] - end[:, 0] * start[:, 1]
    area = 0.5 * turn.sum()
    centre = turn @ (start + end) / (6.0 * area)
    both = start + end
    second = np.einsum("s,si,sj->ij", turn, both, both)
    second += np.einsum("s,si,sj->ij", turn, start, start) + np.einsum("s,si,sj->ij", turn, end, end)
    return np.asarray(second / (24.0 * area) - np.outer(centre, centre))
