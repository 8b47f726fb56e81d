"""What a ``mass.json`` says, and everything in it that follows from what defines the body.

The ten inertial parameters, their covariance and the frames define the file. `statements` derives every
other number from them: one function that both the writer and the checker use.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array
from stapeskit.frames import RigidTransform
from stapeskit.records.mass_matrix import MassMatrix
from stapeskit.spatial import DOF_NAMES, PARAMETER_NAMES, central_tensor, dof_indices
from stapeskit.warnings import Notice

REDUCED = ("y", "alpha", "gamma")
"""Degrees of freedom of the stapes in the paper: those of the reduced matrix."""

Mesh = tuple[Array, NDArray[np.int64]]
"""Vertices (n, 3) in scan coordinates, mm, and faces (m, 3)."""

_POSE = "frames.pose_covariance.scan_from_"

# Relative differences by which redundant numbers of a file may round: seven digits pass, and less digits of
# standard deviations, correlations and eigenvalues.
SAME, FLOOR = 1e-6, 1e-5


@dataclass(frozen=True)
class MassRecord:
    """Mass, frames and surfaces of a stapes: a checked ``mass.json``, or the same in memory.

    Attributes
    ----------
    mass_matrix : MassMatrix
        About the footplate centre, in footplate axes.
    footplate_covariance, plate_covariance : ndarray, (6, 6)
        Of the displacement of each frame in its own axes (m, rad).
    density_kg_m3, volume_m3
        Of the bone, without added masses.
    raw, file
        The whole content, and where it was read: surfaces are in its folder.
    meshes, source
        In memory alone: surfaces ``stapes`` and ``plate``, and the entry of ``inputs`` in a provenance.
    """

    mass_matrix: MassMatrix
    scan_from_footplate: RigidTransform
    footplate_covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))
    scan_from_plate: RigidTransform | None = None
    plate_covariance: Array | None = None
    density_kg_m3: float | None = None
    volume_m3: float | None = None
    notices: tuple[Notice, ...] = ()
    raw: Mapping[str, Any] = field(default_factory=dict, repr=False)
    file: Path | None = None
    meshes: Mapping[str, Mesh] = field(default_factory=dict, repr=False)
    source: Mapping[str, Any] = field(default_factory=dict, repr=False)

    @property
    def provenance_input(self) -> Path | Mapping[str, Any] | None:
        """What an input of `stapeskit.provenance.record` is: the file, or the source of a mass in memory."""
        return self.file or self.source or None

    @property
    def plate_from_footplate(self) -> RigidTransform | None:
        """Pose of the footplate frame in the plate frame; None when the scan holds no plate."""
        plate = self.scan_from_plate
        return None if plate is None else plate.inverse() @ self.scan_from_footplate

    @property
    def plate_mass_matrix(self) -> MassMatrix | None:
        """The mass matrix about the footplate centre in plate axes.

        The footplate frame gives its origin and the plate frame its axes, and so do their errors.
        """
        plate = self.plate_from_footplate
        if plate is None:
            return None
        pose = np.zeros((6, 6))
        pose[:3, :3] = plate.rotation @ self.footplate_covariance[:3, :3] @ plate.rotation.T
        if self.plate_covariance is not None:
            pose[3:, 3:] = self.plate_covariance[3:, 3:]
        return self.mass_matrix.moved(
            plate.rotation, np.zeros(3), "footplate_centre", "plate"
        ).with_frame_error(pose)


def statements(record: MassRecord) -> dict[str, tuple[Any, Any]]:
    """Return, by dotted key, what in a mass.json follows from parameters, covariance and frames.

    Each value stands with the size (of each entry) that rounding is measured by; None of text.
    """
    parameters = record.mass_matrix.parameters
    mass, tensor = central_tensor(parameters)
    scan = record.scan_from_footplate
    centre_mm = scan.points(parameters[1:4] / mass * 1e3)
    turned = scan.rotation @ tensor @ scan.rotation.T
    found = {
        "mass_kg": (mass, mass),
        "center_of_mass_in_scan_mm": (centre_mm, max(100.0, float(np.max(np.abs(centre_mm))))),
        "inertia_about_center_of_mass_in_scan_axes_kg_m2": (turned, np.trace(turned)),
        "inertial_parameters.names": (list(PARAMETER_NAMES), None),
        "inertial_parameters.about": ("footplate_centre", None),
        "inertial_parameters.axes": ("footplate", None),
        f"{_POSE}footplate.names": (list(DOF_NAMES), None),
        **_block("mass_matrix", record.mass_matrix, DOF_NAMES),
        **_block("mass_matrix_reduced", record.mass_matrix, REDUCED),
    }
    plate, in_plate_axes = record.plate_from_footplate, record.plate_mass_matrix
    if plate is not None and in_plate_axes is not None:
        lengths = [float(np.linalg.norm(pose.translation_mm)) for pose in (plate, scan)]
        found["frames.plate_from_footplate"] = (plate.matrix, np.array([1.0, 1.0, 1.0, max(1.0, *lengths)]))
        found |= _block("mass_matrix_plate_axes", in_plate_axes, DOF_NAMES)
        found[f"{_POSE}plate.names"] = (list(DOF_NAMES), None)
    return found


def _block(path: str, mass: MassMatrix, dof: Sequence[str]) -> dict[str, tuple[Any, Any]]:
    """Return the content of one mass matrix."""
    places = np.ix_(*[dof_indices(tuple(dof))] * 2)
    root = np.sqrt(np.diag(mass.matrix))
    scale = np.outer(root, root)[places]
    return {
        f"{path}.about": (mass.about, None),
        f"{path}.axes": (mass.axes, None),
        f"{path}.dof": (list(dof), None),
        f"{path}.matrix_si": (mass.matrix[places], scale),
        f"{path}.standard_deviation_si": (mass.standard_deviation[places], scale * (FLOOR / SAME)),
    }
