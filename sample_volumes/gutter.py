"""A made stapes whose crura are gutters, as real ones are: walls of 0.08 mm, open towards the foramen.

Footplate and head are those of the analytic stapes; each crus is a tube with its inner side cut away. Its
mesh is the body: the moments of a polyhedron are exact.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.surface.surface import Surface, write_surface
from sample_volumes.analytic import HEAD_MM, capsule, footplate, solid_of

Array = NDArray[np.float64]

WALL_MM = 0.08
RADIUS_MM = 0.26
_FEET = ((-0.95, 0.25, 0.0), (0.95, 0.25, 0.0))
_TOPS = ((-0.3, 2.5, 0.0), (0.3, 2.5, 0.0))
_LUMEN = 0.8


@functools.lru_cache(maxsize=4)
def gutter_stapes(step_mm: float = 0.025, wall_mm: float = WALL_MM) -> Surface:
    """Return the body as a closed surface in its own footplate axes.

    Parameters
    ----------
    step_mm : float
        Size of the mesh; each size is a slightly different body with its own exact moments.
    wall_mm : float
        Thickness of the crura's walls.
    """
    return solid_of(lambda points: _distance(points, wall_mm), step_mm)


def write_gutter_stapes(path: Path, step_mm: float = 0.025) -> Path:
    """Write the body as a mesh file, for Ear.stapes, and return its path."""
    write_surface(path, gutter_stapes(step_mm))
    return path


def _distance(points: Array, wall_mm: float) -> Array:
    head = np.array(HEAD_MM)
    parts = [footplate(points), capsule(points, head - [0.0, 0.45, 0.0], head, 0.42)]
    for foot, top in zip(_FEET, _TOPS, strict=True):
        inwards = np.array([-np.sign(foot[0]), 0.0, 0.0])
        end = np.array(foot) + _LUMEN * (np.array(top) - foot)
        lumen = [
            capsule(points, foot + away * inwards, end + away * inwards, RADIUS_MM - wall_mm)
            for away in np.arange(0.0, 0.4, 0.07)
        ]
        tube = capsule(points, foot, top, RADIUS_MM)
        parts.append(np.maximum(tube, -np.minimum.reduce(lumen)))
    return np.asarray(np.minimum.reduce(parts))
