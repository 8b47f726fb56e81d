"""The mass matrix as every room reads it: from ``mass.json``, after a check of its content."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import StapeskitError, raise_all
from legacy.stapeskit.frames import RigidTransform, rotation_from_vector
from legacy.stapeskit.json_toml import read_json
from legacy.stapeskit.own_files import check_whole
from legacy.stapeskit.records.mass_checks import MADE_BY, check
from legacy.stapeskit.spatial import (
    check_inertia,
    matrix_from_parameters,
    parameter_basis,
    parameters_from_matrix,
    twist_transfer,
)
from legacy.stapeskit.warnings import Notice, from_json

SCHEMA = "stapeskit.mass/1"
FRAME_SOURCE = "frame"
_SOURCE_WORDS = {
    "levels": "grey levels of air and bone",
    "noise": "voxel noise",
    "psf": "blur of the scan",
    "coat": "soft coat on the bone",
    "grey_scale": "grey scale that is not linear",
    "surroundings": "fluid or tissue around the stapes",
    "separation": "cut between stapes and what touches it",
    "border": "what the border of the scan cuts",
    "plate": "face of the plate",
    "inhomogeneity": "uneven bone",
    "cupping": "cupping of bone",
    "threshold": "threshold that made the scan",
    "voxel_size": "voxel size",
    "density": "density",
    "mass": "measured mass",
    "calibration": "grey-to-density calibration",
    "added_mass": "added masses",
    "frame": "footplate frame",
}


def mass_source_words(source: str) -> str:
    """Return the words for a source of error of a mass matrix."""
    return _SOURCE_WORDS.get(source, source.replace("_", " "))


@dataclass(frozen=True)
class MassMatrix:
    """Generalized mass matrix of a rigid body with its uncertainty by source.

    Attributes
    ----------
    about, axes : str
        Reference point and axes, e.g. ``footplate_centre`` and ``footplate``.
    parameters : ndarray, (10,)
        Inertial parameters about that point in those axes (kg, kg m, kg m2; PARAMETER_NAMES).
    contributions : mapping of str to ndarray, (10, 10)
        Covariance of the parameters by independent source (``levels``, ``density``, ...). The source
        ``frame`` is what an error of the footplate frame itself adds.

    Raises
    ------
    StapeskitError
        The parameters are not those of a possible body, or a covariance has another shape.
    """

    about: str
    axes: str
    parameters: Array
    contributions: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        parameters = np.asarray(self.parameters, dtype=float)
        if parameters.shape != (10,):
            raise StapeskitError.of("the inertial parameters", "10 numbers", f"shape {parameters.shape}")
        check_inertia(matrix_from_parameters(parameters))
        for name, covariance in self.contributions.items():
            if np.shape(covariance) != (10, 10) or not np.all(np.isfinite(covariance)):
                raise StapeskitError.of(
                    f"the covariance {name}", "a finite 10x10 matrix", np.shape(covariance)
                )
        object.__setattr__(self, "parameters", parameters)

    @property
    def matrix(self) -> Array:
        """The 6x6 matrix, SI, in the order of DOF_NAMES."""
        return matrix_from_parameters(self.parameters)

    @property
    def covariance(self) -> Array:
        """Total covariance of the ten parameters, (10, 10), SI."""
        return sum((np.asarray(part) for part in self.contributions.values()), np.zeros((10, 10)))

    @property
    def standard_deviation(self) -> Array:
        """Standard deviation of every entry of the matrix, (6, 6), SI."""
        basis = parameter_basis()
        return np.sqrt(np.maximum(np.einsum("aij,ab,bij->ij", basis, self.covariance, basis), 0.0))

    def moved(self, axes_from_here: Array, shift_m: Array, about: str, axes: str) -> MassMatrix:
        """Return the same body about another point and in other axes, uncertainty included.

        Parameters
        ----------
        axes_from_here : ndarray, (3, 3)
            Rotation from the present axes to the new ones.
        shift_m : ndarray, (3,)
            New reference point minus present one, in present axes, m.
        about, axes : str
            Their new names.

        Notes
        -----
        M' = X^-T M X^-1 with q' = X q: kinetic energy does not depend on the frame.
        """
        linear = parameter_transfer(axes_from_here, shift_m)
        moved = {name: linear @ part @ linear.T for name, part in self.contributions.items()}
        return MassMatrix(about, axes, linear @ self.parameters, moved)


def parameter_transfer(axes_from_here: Array, shift_m: Array) -> Array:
    """Return the linear map (10, 10) of inertial parameters under a change of point and axes."""
    inverse = np.linalg.inv(twist_transfer(axes_from_here, shift_m))
    return np.stack(
        [parameters_from_matrix(inverse.T @ part @ inverse) for part in parameter_basis()], axis=1
    )


def frame_derivative(parameters: Array) -> Array:
    """Return d(parameters)/d(frame displacement), (10, 6), per m and rad in the order of DOF_NAMES.

    The displacement is that of the reference frame, in its own axes (RigidTransform.perturbed).
    """
    base = np.asarray(parameters, dtype=float)
    step = 1e-6
    columns = []
    for axis in range(6):
        values = []
        for sign in (1.0, -1.0):
            motion = np.zeros(6)
            motion[axis] = sign * step
            rotation = rotation_from_vector(motion[3:]).T
            values.append(parameter_transfer(rotation, motion[:3]) @ base)
        columns.append((values[0] - values[1]) / (2.0 * step))
    return np.column_stack(columns)


@dataclass(frozen=True)
class MassRecord:
    """What a ``mass.json`` says, checked.

    Attributes
    ----------
    mass_matrix : MassMatrix
        About the footplate centre, in footplate axes.
    scan_from_footplate : RigidTransform
        Pose of the footplate frame in scan coordinates (mm).
    plate_from_footplate : RigidTransform or None
        Pose of the footplate frame in the plate frame; None when the scan holds no plate.
    footplate_covariance : ndarray, (6, 6)
        Covariance of the footplate frame's own displacement in footplate axes (m, rad).
    plate_covariance : ndarray, (6, 6) or None
        The same of the plate frame in plate axes.
    notices : tuple of Notice
        Warnings of ct2mass.
    raw : mapping
        The whole file.
    """

    mass_matrix: MassMatrix
    scan_from_footplate: RigidTransform
    plate_from_footplate: RigidTransform | None
    footplate_covariance: Array
    plate_covariance: Array | None
    notices: tuple[Notice, ...]
    raw: Mapping[str, Any]


def read_mass_record(path: Path) -> MassRecord:
    """Read and check a ``mass.json``.

    Raises
    ------
    StapeskitError
        The file is missing, is no JSON, has another schema, lacks a key, contradicts itself, or holds a
        matrix that no rigid body can have. Every fault found is listed.
    """
    path = Path(path)
    check_whole(path)
    return mass_record(_load(path), path.name)


def mass_record(raw: Mapping[str, Any], name: str = "mass.json") -> MassRecord:
    """Check the content of a ``mass.json``, read from a file or just computed.

    Parameters
    ----------
    name : str
        What it is called in messages.

    Raises
    ------
    StapeskitError
        As in `read_mass_record`.
    """
    schema = raw.get("schema")
    if schema != SCHEMA:
        raise StapeskitError.of("schema", f'"{SCHEMA}"', schema, name, MADE_BY)
    return _record(dict(raw), name)


def _load(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise StapeskitError.of("the mass file", "an existing mass.json", path, next_step="Run ct2mass first")
    try:
        return read_json(path)
    except ValueError as fault:
        raise StapeskitError.of(
            "the mass file", "mass.json, a JSON object", fault, path.name, MADE_BY
        ) from fault


def _record(raw: dict[str, Any], name: str) -> MassRecord:
    checked = check(raw, name)
    raise_all(StapeskitError, checked.faults)
    if checked.parameters is None or checked.covariance is None:
        raise StapeskitError.of("a mass.json", "complete", "a part of it", name, MADE_BY)
    return MassRecord(
        MassMatrix(
            "footplate_centre",
            "footplate",
            checked.parameters,
            checked.contributions or {"unspecified": checked.covariance},
        ),
        checked.transforms["scan_from_footplate"],
        checked.transforms.get("plate_from_footplate"),
        checked.poses.get("scan_from_footplate", np.zeros((6, 6))),
        checked.poses.get("scan_from_plate", np.zeros((6, 6)))
        if "plate_from_footplate" in checked.transforms
        else None,
        from_json(raw.get("warnings", [])),
        raw,
    )
