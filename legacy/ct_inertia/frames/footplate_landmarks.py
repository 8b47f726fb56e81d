"""Whether landmarks given by a person fit the body and the footplate found on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.frames.anatomy import AnatomyHints
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault

# Largest distance of the landmark head from the bone, mm. Chosen by judgement: about the width of the head,
# so that a point set inside it or beside it passes and one in other coordinates does not.
_HEAD_MM = 1.0
_LANDMARK_STEP = "Check the landmarks and their coordinate system (LPS or RAS), or {mirror}"


def check_head(vertices_mm: Array, faces: NDArray[np.integer], hints: AnatomyHints) -> None:
    """Refuse a landmark head that lies on no bone of this body.

    Parameters
    ----------
    vertices_mm : ndarray, (n, 3)
        Scan coordinates.
    faces : ndarray of int, (m, 3)
    hints : AnatomyHints

    Raises
    ------
    CtInertiaError
        It lies more than 1 mm off the surface.
    """
    head = hints.landmarks.get("head")
    if head is None:
        return
    from trimesh.triangles import closest_point

    corners = vertices_mm[faces]
    nearest = closest_point(corners, np.broadcast_to(head, (len(corners), 3)))
    distance = float(np.min(np.linalg.norm(nearest - head, axis=1)))
    if distance > _HEAD_MM:
        raise CtInertiaError.of(
            "landmark head",
            f"within {_HEAD_MM:g} mm of the surface of the stapes",
            f"{distance:.2f} mm",
            next_step=_LANDMARK_STEP,
        )


def contradiction(origin_mm: Array, axes: Array, hints: AnatomyHints) -> Fault | None:
    """Return how landmarks contradict a footplate, or None.

    Parameters
    ----------
    origin_mm : ndarray, (3,)
        Centre of the footplate, scan coordinates.
    axes : ndarray, (3, 3)
        Its axes x, y, z in columns.
    hints : AnatomyHints
    """
    head = hints.landmarks.get("head")
    if head is not None:
        height = float((head - origin_mm) @ axes[:, 1])
        if height < 0.3:
            return Fault(
                "landmark head",
                "on the lateral side of the footplate, at least 0.3 mm above its centre",
                f"{height:.2f} mm along the found lateral direction",
                next_step=_LANDMARK_STEP,
            )
    centre = hints.landmarks.get("footplate_centre")
    if centre is not None:
        distance = float(np.linalg.norm(centre - origin_mm))
        if distance > 1.0:
            return Fault(
                "landmark footplate_centre",
                "within 1 mm of the found footplate centre",
                f"{distance:.2f} mm",
                next_step=_LANDMARK_STEP,
            )
    return None
