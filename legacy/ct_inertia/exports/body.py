"""What every export writes: one rigid body about its centre of mass, its surfaces, its frames."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations
from typing import TYPE_CHECKING

import numpy as np

from legacy.ct_inertia.surface.surface import Surface
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import RigidTransform
from legacy.stapeskit.records.mass_record import MassMatrix
from legacy.stapeskit.spatial import central_tensor

if TYPE_CHECKING:
    from legacy.ct_inertia.ct2mass import MassMeasurement


@dataclass(frozen=True)
class ExportBody:
    """The stapes, added masses included, as the formats need it.

    Attributes
    ----------
    source : str
        Name of the file of the scan, labels or mesh.
    matrix : MassMatrix
        About the footplate centre in footplate axes, SI.
    plate_matrix : MassMatrix or None
        About the footplate centre in plate axes.
    scan_from_footplate : RigidTransform
    scan_from_plate : RigidTransform or None
    stapes : Surface
        Scan coordinates, mm; the display surface where one was made.
    plate : Surface or None
    density_kg_m3, volume_m3 : float
        Of the bone alone.
    """

    source: str
    matrix: MassMatrix
    plate_matrix: MassMatrix | None
    scan_from_footplate: RigidTransform
    scan_from_plate: RigidTransform | None
    stapes: Surface
    plate: Surface | None
    density_kg_m3: float
    volume_m3: float

    @property
    def mass_kg(self) -> float:
        """Mass, kg."""
        return float(self.matrix.parameters[0])

    @property
    def com_m(self) -> Array:
        """Centre of mass (3,) in footplate coordinates, m."""
        return np.asarray(self.matrix.parameters[1:4] / self.matrix.parameters[0])

    @property
    def inertia_kg_m2(self) -> Array:
        """Inertia tensor (3, 3) about the centre of mass in footplate axes, kg m2."""
        return central_tensor(self.matrix.parameters)[1]

    @property
    def footplate_from_scan(self) -> RigidTransform:
        """Pose of the scan in footplate coordinates, mm."""
        return self.scan_from_footplate.inverse()

    def principal(self) -> tuple[Array, Array]:
        """Return the principal moments (3,), kg m2, and footplate_from_principal (3, 3), a rotation.

        Of the possible orders and signs the one nearest to the footplate axes is taken.
        """
        moments, axes = np.linalg.eigh(self.inertia_kg_m2)
        order = max(permutations(range(3)), key=lambda o: sum(abs(axes[k, o[k]]) for k in range(3)))
        moments, axes = moments[list(order)], axes[:, list(order)]
        axes = axes * np.where(np.diag(axes) < 0.0, -1.0, 1.0)
        if np.linalg.det(axes) < 0.0:
            weakest = int(np.argmin(np.abs(np.diag(axes))))
            axes[:, weakest] *= -1.0
        return moments, axes


def body_of(result: MassMeasurement, stapes: Surface | None = None) -> ExportBody:
    """Return what the exports need of a result; ``stapes`` replaces the surface by a lighter one."""
    source = result.options.scan or result.options.labels
    return ExportBody(
        source="" if source is None else printable(source.name),
        matrix=result.matrix,
        plate_matrix=result.plate_matrix,
        scan_from_footplate=result.footplate.scan_from_footplate,
        scan_from_plate=None if result.plate_frame is None else result.plate_frame.scan_from_plate,
        stapes=stapes or result.stapes,
        plate=result.plate,
        density_kg_m3=result.body.density_kg_m3,
        volume_m3=result.body.volume_m3,
    )


def printable(name: str) -> str:
    """Return a file name with ``?`` for line ends and for bytes that are no UTF-8."""
    return "".join(letter if letter.isprintable() else "?" for letter in name)


def quaternion(rotation: Array) -> Array:
    """Return the unit quaternion (w, x, y, z), w >= 0, of a rotation matrix (3, 3).

    Notes
    -----
    The eigenvector of the largest eigenvalue of Bar-Itzhack's symmetric matrix (2000, J. Guid. Control
    Dyn. 23:1085), which has no branch where digits are lost.
    """
    r = np.asarray(rotation, dtype=float)
    k = np.zeros((4, 4))
    k[0, 0] = np.trace(r)
    k[0, 1:] = k[1:, 0] = [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]
    k[1:, 1:] = r + r.T - np.trace(r) * np.eye(3)
    vector = np.linalg.eigh(k)[1][:, -1]
    return np.asarray(-vector if vector[0] < 0.0 else vector)


def roll_pitch_yaw(rotation: Array) -> Array:
    """Return the angles (3,), rad, about the fixed axes x, y, z in this order, of a rotation (3, 3)."""
    r = np.asarray(rotation, dtype=float)
    flat = float(np.hypot(r[0, 0], r[1, 0]))
    pitch = np.arctan2(-r[2, 0], flat)
    if flat < 1e-9:
        return np.array([np.arctan2(-r[1, 2], r[1, 1]), pitch, 0.0])
    return np.array([np.arctan2(r[2, 1], r[2, 2]), pitch, np.arctan2(r[1, 0], r[0, 0])])


def listed(values: Array) -> str:
    """Return numbers separated by spaces, with every digit that a double holds."""
    return " ".join(f"{value:.17g}" for value in np.asarray(values, dtype=float) + 0.0)
