"""A surface as it is drawn: colour, opacity, name."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.bodies import STAPES
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.report.colours import BODY_COLOURS


@dataclass(frozen=True)
class Body:
    """One surface to draw.

    Attributes
    ----------
    vertices_mm : ndarray, (n, 3)
        Scan coordinates.
    faces : ndarray, (m, 3), int
        Outward by the right-hand rule.
    color : str
        Any matplotlib colour.
    opacity : float
        1 is opaque.
    name : str
        For the legend.
    smooth : bool
        Shade over edges (bone), or leave them sharp (a plate).
    """

    vertices_mm: NDArray[np.floating]
    faces: NDArray[np.integer]
    color: str = BODY_COLOURS[STAPES]
    opacity: float = 1.0
    name: str = "stapes"
    smooth: bool = True

    def __post_init__(self) -> None:
        vertices, faces = np.asarray(self.vertices_mm), np.asarray(self.faces)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
            raise CtInertiaError.of(
                "a body to draw", "(n, 3) vertices and (m, 3) faces", (vertices.shape, faces.shape)
            )
        if len(faces) == 0 or not np.all(np.isfinite(vertices)):
            raise CtInertiaError.of(
                "a body to draw", "at least one face and finite vertices", f"{len(faces)} faces"
            )
        if np.min(faces) < 0 or np.max(faces) >= len(vertices):
            raise CtInertiaError.of(
                "the faces of a body to draw", f"indices below {len(vertices)}", int(np.max(faces))
            )
