"""Rigid transforms between named right-handed frames.

``a_from_b`` maps b-coordinates to a-coordinates: ``p_a = R p_b + t`` with t in mm. The names travel with
the transform, so that composing frames that do not meet is an error and not a wrong sign.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError

_ROTATION_TOLERANCE = 1e-6  # matrices written with seven digits pass


def cross_matrix(vector: ArrayLike) -> Array:
    """Return the (3, 3) matrix ``[v]x`` with ``[v]x u = v x u``."""
    x, y, z = np.asarray(vector, dtype=float)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def axis_vector(name: str) -> Array | None:
    """Return the unit vector (3,) of ``x``, ``+y``, ``-Z`` and the like; None for other text."""
    sign, letter = (name[:1], name[1:]) if name[:1] in ("+", "-") else ("+", name)
    if letter.lower() not in ("x", "y", "z"):
        return None
    return np.eye(3)["xyz".index(letter.lower())] * (-1.0 if sign == "-" else 1.0)


def rotation_from_vector(rotation_vector: ArrayLike) -> Array:
    """Return the matrix (3, 3) of a rotation vector in rad: Rodrigues' formula, by sinc exact near 0."""
    vector = np.asarray(rotation_vector, dtype=float)
    angle = float(np.linalg.norm(vector))
    k = cross_matrix(vector)
    half = np.sinc(angle / (2.0 * np.pi))
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * k + 0.5 * half * half * (k @ k))


def vector_from_rotation(rotation: ArrayLike) -> Array:
    """Return the rotation vector (3,), in rad, of a rotation matrix: the inverse of rotation_from_vector."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_rotvec())


@dataclass(frozen=True)
class RigidTransform:
    """A proper rigid transform ``to_from_source``, (4, 4): rotation without unit, translation in mm.

    Raises
    ------
    StapeskitError
        The matrix is not 4x4, not finite, not orthonormal, or a reflection.
    """

    matrix: Array
    to: str
    source: str

    def __post_init__(self) -> None:
        matrix, name = np.array(self.matrix, dtype=float), f"{self.to}_from_{self.source}"
        if matrix.shape != (4, 4) or not np.all(np.isfinite(matrix)):
            got = f"shape {matrix.shape}, or NaN or infinity"
            raise StapeskitError.of(name, "a finite 4x4 matrix", got)
        if np.max(np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0])) > _ROTATION_TOLERANCE:
            raise StapeskitError.of(f"the last row of {name}", "0, 0, 0, 1", matrix[3].tolist())
        rotation = matrix[:3, :3]
        if np.max(np.abs(rotation @ rotation.T - np.eye(3))) > _ROTATION_TOLERANCE:
            step = "Give a rigid transform without scale or shear"
            thing, got = f"the rotation of {name}", str(rotation.tolist())
            raise StapeskitError.of(thing, "orthonormal", got, "", step)
        if np.linalg.det(rotation) < 0.0:
            step = "Undo the mirrored axis with --mirror x, y or z"
            raise StapeskitError.of(name, "right-handed (determinant +1)", "a reflection", "", step)
        matrix.setflags(write=False)
        object.__setattr__(self, "matrix", matrix)

    @classmethod
    def from_parts(
        cls, rotation: ArrayLike, translation_mm: ArrayLike, to: str, source: str
    ) -> RigidTransform:
        """Build a transform from a rotation (3, 3) and a translation (3,) in mm."""
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        matrix[:3, 3] = translation_mm
        return cls(matrix, to, source)

    @classmethod
    def identity(cls, to: str, source: str) -> RigidTransform:
        """Return the transform between two frames that coincide."""
        return cls(np.eye(4), to, source)

    @property
    def rotation(self) -> Array:
        """Rotation (3, 3): its columns are the axes of the source frame in target coordinates."""
        return np.asarray(self.matrix[:3, :3])

    @property
    def translation_mm(self) -> Array:
        """Origin of the source frame in target coordinates, (3,), mm."""
        return np.asarray(self.matrix[:3, 3])

    def __matmul__(self, other: RigidTransform) -> RigidTransform:
        if self.source != other.to:
            thing = f"the frame to the right of {self.to}_from_{self.source}"
            raise StapeskitError.of(thing, self.source, f"{other.to}_from_{other.source}")
        return RigidTransform(self.matrix @ other.matrix, self.to, other.source)

    def inverse(self) -> RigidTransform:
        """Return ``source_from_to``."""
        rotation = self.rotation.T
        return RigidTransform.from_parts(rotation, -rotation @ self.translation_mm, self.source, self.to)

    def points(self, points_mm: ArrayLike) -> Array:
        """Map points (..., 3) in mm."""
        return np.asarray(np.asarray(points_mm, dtype=float) @ self.rotation.T + self.translation_mm)

    def vectors(self, vectors: ArrayLike) -> Array:
        """Map free vectors (..., 3): rotated, not shifted."""
        return np.asarray(np.asarray(vectors, dtype=float) @ self.rotation.T)

    def perturbed(self, small: ArrayLike) -> RigidTransform:
        """Return this transform with its SOURCE frame displaced by a small motion (6,) in source axes.

        Translation in m and rotation vector in rad: order and units of every pose covariance.
        """
        motion, frame = np.asarray(small, dtype=float), self.source
        turn = rotation_from_vector(motion[3:])
        return self @ RigidTransform.from_parts(turn, motion[:3] * 1e3, frame, frame)


def axes_matrix(x: Sequence[float] | Array, y: Sequence[float] | Array) -> Array:
    """Return the rotation whose columns are a right-handed triad: ``y`` exact, ``x`` made square to it.

    Raises
    ------
    StapeskitError
        The two directions (3,) are parallel or zero.
    """
    y_axis, x_axis = np.asarray(y, dtype=float), np.asarray(x, dtype=float)
    length = float(np.linalg.norm(y_axis))
    if not length > 0.0:
        raise StapeskitError.of("the y direction", "a non-zero vector", y_axis.tolist())
    y_axis = y_axis / length
    across = x_axis - (x_axis @ y_axis) * y_axis
    if not float(np.linalg.norm(across)) > 1e-9 * float(np.linalg.norm(x_axis)):
        raise StapeskitError.of("the x direction", "not parallel to y", x_axis.tolist())
    across = across / np.linalg.norm(across)
    return np.column_stack([across, y_axis, np.cross(across, y_axis)])
