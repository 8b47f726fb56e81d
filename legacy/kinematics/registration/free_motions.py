"""Which slides and turns points on a surface leave open, in words."""

from __future__ import annotations

import numpy as np

from legacy.kinematics.fit.beams import row_echelon
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import RigidTransform

# Sine of the angle below which points hardly resist a motion of the whole.
OPEN = 0.05


def undetermined(
    rows: Array, local_mm: Array, rotation: Array, middle_mm: Array, axes: RigidTransform | None
) -> list[str]:
    """Name the motions that move no point off its plane, or hardly any.

    Parameters
    ----------
    rows : ndarray, (n, 6)
        Derivatives of the distances by a displacement of the source frame about the centroid, mm and rad.
    local_mm : ndarray, (n, 3)
        Points relative to their centroid, source axes.
    rotation : ndarray, (3, 3)
        scan_from_source.
    middle_mm : ndarray, (3,)
        Their centroid in scan coordinates.
    axes : RigidTransform or None
        ``scan_from_<frame>`` whose axes the words use; None: the scan's own.
    """
    lever = max(float(np.sqrt(np.mean(np.sum(local_mm**2, axis=1)))), 1e-9)
    values, vectors = open_motions(rows, lever)
    into = np.eye(3) if axes is None else axes.rotation.T
    frame = "scan" if axes is None else axes.source
    place = middle_mm if axes is None else axes.inverse().points(middle_mm)
    described = []
    turn = np.kron(np.eye(2), into @ rotation)
    for vector in row_echelon(vectors[:, values < OPEN**2].T @ turn.T):
        described.append(_words(vector[:3], vector[3:] / lever, place, frame))
    return described


def open_motions(rows: Array, lever: float) -> tuple[Array, Array]:
    """Return mean squares (6,) of the points' motion along their normals, and the motions (6, 6), columns."""
    scaled = rows / np.array([1.0] * 3 + [lever] * 3)
    values, vectors = np.linalg.eigh(scaled.T @ scaled / max(len(rows), 1))
    return values, vectors


def _words(slide: Array, turn: Array, place: Array, frame: str) -> str:
    moved, turned = float(np.linalg.norm(slide)), float(np.linalg.norm(turn))
    lever = 1.0 / max(np.max(np.abs(np.concatenate([slide, turn]))), 1e-12)
    if turned * lever < 0.05 * moved * lever or turned < 0.05 * moved:
        return f"a slide along {_axis(slide)} of the {frame}"
    centre = place + np.cross(turn, slide) / turned**2
    at = ", ".join(f"{value:.2g}" for value in centre)
    return f"a turn about {_axis(turn)} of the {frame} through ({at}) mm"


def _axis(vector: Array) -> str:
    unit = vector / np.linalg.norm(vector)
    place = int(np.argmax(np.abs(unit)))
    if abs(unit[place]) > 0.995:
        return "xyz"[place]
    unit = unit * np.sign(unit[place])
    return f"({', '.join(f'{value:.2f}' for value in unit)})"
