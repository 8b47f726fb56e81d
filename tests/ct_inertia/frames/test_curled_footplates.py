"""The outline of the medial face is closed on a population of curled footplates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import foreign_shapes as shapes
from legacy.ct_inertia.frames.anatomy import AnatomyHints
from legacy.ct_inertia.frames.footplate import footplate_frame
from legacy.ct_inertia.frames.footplate_face import FACE_ANGLE_DEG
from legacy.ct_inertia.surface.isosurface import iso_surface
from legacy.ct_inertia.surface.surface import Surface

VOXEL_MM = 0.06
# A side of such a body can be as large as the face of its footplate.
HEAD = AnatomyHints(landmarks={"head": np.array([0.0, 3.0, 0.0])})


def curled(seed: int) -> Surface:
    """Return the surface of a stapes whose footplate rises by 0.3 to 0.5 mm towards its ends."""
    rng = np.random.default_rng(seed)
    drawn = shapes.draw("curved", rng)
    anatomy = replace(drawn, curl=rng.uniform(0.3, 0.5), thickness=0.2)
    low, high = np.array([-1.9, -0.4, -1.1]), np.array([1.9, 4.0, 1.1])
    axes = [np.arange(low[k], high[k], VOXEL_MM, dtype=np.float32) for k in (2, 1, 0)]
    z, y, x = np.meshgrid(*axes, indexing="ij")
    place = np.diag([VOXEL_MM, VOXEL_MM, VOXEL_MM, 1.0])
    place[:3, 3] = low
    return iso_surface(-np.clip(shapes.body(anatomy, (x, y, z)), -0.2, 0.2), 0.0, place)


@pytest.mark.parametrize("seed", range(6))
def test_the_outline_encloses_the_projected_area_of_the_face(seed):
    surface = curled(seed)
    frame = footplate_frame(surface, HEAD)
    u, w = frame.outline_mm[:, 0], frame.outline_mm[:, 2]
    enclosed = 0.5 * abs(u @ np.roll(w, -1) - w @ np.roll(u, -1))
    y_axis = frame.scan_from_footplate.rotation[:, 1]
    corners = np.asarray(surface.vertices_mm)[np.asarray(surface.faces)]
    areas = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    below = frame.scan_from_footplate.inverse().points(corners.mean(axis=1))[:, 1] < 0.9
    facing = -(areas @ y_axis) / np.linalg.norm(areas, axis=1)
    seen = -(areas @ y_axis)[(facing > np.cos(np.radians(FACE_ANGLE_DEG))) & below].sum()
    assert enclosed == pytest.approx(seen, rel=0.06)
    gaps = np.linalg.norm(np.diff(frame.outline_mm, axis=0, append=frame.outline_mm[:1]), axis=1)
    assert gaps.max() < 0.2
