"""The generalized mass matrix of a rigid body with its uncertainty by source."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError, raise_all
from stapeskit.frames import cross_matrix
from stapeskit.spatial import (
    inertia_faults,
    matrix_from_parameters,
    parameter_basis,
    parameters_from_matrix,
    twist_transfer,
)

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
    "slices": "slices that are missing or doubled",
    "plate": "face of the plate",
    "inhomogeneity": "uneven bone",
    "cupping": "cupping of bone",
    "threshold": "threshold that made the scan",
    "voxel_size": "voxel size",
    "density": "density",
    "mass": "measured mass",
    "calibration": "grey-to-density calibration",
    "added_mass": "added masses",
    FRAME_SOURCE: "footplate frame",
}


def source_words(source: str) -> str:
    """Return the words for a source of uncertainty, for tables."""
    return _SOURCE_WORDS.get(source, source.replace("_", " "))


@dataclass(frozen=True, repr=False)
class MassMatrix:
    """Generalized mass matrix of a rigid body about a point in some axes, with its uncertainty by source.

    Attributes
    ----------
    parameters : ndarray, (10,)
        Inertial parameters (kg, kg m, kg m2; PARAMETER_NAMES).
    covariance, contributions : ndarray, (10, 10), and mapping of str to ndarray, (10, 10)
        SI: the sum of the contributions, and these by independent source; the source ``frame`` is what an
        error of the footplate frame itself adds. A covariance given alone has the source ``unspecified``.

    Raises
    ------
    StapeskitError
        The parameters are not those of a possible body, or a covariance has another shape.
    """

    parameters: Array
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    contributions: Mapping[str, Array] = field(default_factory=dict)
    about: str = "footplate_centre"
    axes: str = "footplate"

    def __post_init__(self) -> None:
        parameters = np.asarray(self.parameters, dtype=float)
        if parameters.shape != (10,):
            raise StapeskitError.of("the inertial parameters", "10 numbers", f"shape {parameters.shape}")
        raise_all(inertia_faults(matrix_from_parameters(parameters)))
        parts = {name: np.asarray(part, dtype=float) for name, part in self.contributions.items()}
        if not parts and np.size(self.covariance):
            parts["unspecified"] = np.asarray(self.covariance, dtype=float)
        for name, part in parts.items():
            if part.shape != (10, 10) or not np.all(np.isfinite(part)):
                raise StapeskitError.of(f"the covariance {name}", "a finite 10x10 matrix", part.shape)
        object.__setattr__(self, "parameters", parameters)
        object.__setattr__(self, "contributions", parts)
        object.__setattr__(self, "covariance", sum(parts.values(), np.zeros((10, 10))))

    def __repr__(self) -> str:
        mass, sd = 1e6 * self.parameters[0], 1e6 * self.standard_deviation[0, 0]
        frame = f"about {self.about}, axes {self.axes}"
        return f"MassMatrix({mass:.4g} mg, sd {sd:.2g} mg, {frame}, sources {list(self.contributions)})"

    @property
    def matrix(self) -> Array:
        """The 6x6 matrix, SI, in the order of DOF_NAMES."""
        return matrix_from_parameters(self.parameters)

    @property
    def standard_deviation(self) -> Array:
        """Standard deviation of every entry of the matrix, (6, 6), SI."""
        basis = parameter_basis()
        return np.sqrt(np.maximum(np.einsum("aij,ab,bij->ij", basis, self.covariance, basis), 0.0))

    def moved(self, axes_from_here: Array, shift_m: Array, about: str, axes: str) -> MassMatrix:
        """Return the same body about another point and in other axes, uncertainty included.

        ``shift_m`` is the new reference point minus the present one in present axes. M' = X^-T M X^-1 with
        q' = X q: kinetic energy does not depend on the frame.
        """
        linear = parameter_transfer(axes_from_here, shift_m)
        parts = {name: linear @ part @ linear.T for name, part in self.contributions.items()}
        return MassMatrix(linear @ self.parameters, contributions=parts, about=about, axes=axes)

    def with_frame_error(self, pose_covariance: Array) -> MassMatrix:
        """Return the matrix with another covariance (6, 6) of its frame's own displacement, m and rad."""
        linear = frame_derivative(self.parameters)
        parts = dict(self.contributions) | {FRAME_SOURCE: linear @ pose_covariance @ linear.T}
        return MassMatrix(self.parameters, contributions=parts, about=self.about, axes=self.axes)


def parameter_transfer(axes_from_here: Array, shift_m: Array) -> Array:
    """Return the linear map (10, 10) of inertial parameters under a change of point and axes."""
    inverse = np.linalg.inv(twist_transfer(axes_from_here, shift_m))
    moved = [parameters_from_matrix(inverse.T @ part @ inverse) for part in parameter_basis()]
    return np.stack(moved, axis=1)


def frame_derivative(parameters: Array) -> Array:
    """Return d(parameters)/d(frame displacement), (10, 6), per m and rad in the order of DOF_NAMES.

    The displacement is that of the reference frame, in its own axes (RigidTransform.perturbed). With
    M' = X^-T M X^-1 and q' = X q, dM = -(G^T M + M G), where G = dX is the derivative of `twist_transfer` by
    its shift, and by its rotation, which is minus the rotation of the frame.
    """
    matrix, columns = matrix_from_parameters(parameters), []
    for axis in range(6):
        turn = -cross_matrix(np.eye(3)[axis % 3])
        place = np.eye(2) if axis > 2 else np.array([[0.0, 1.0], [0.0, 0.0]])
        transfer = np.kron(place, turn)
        columns.append(parameters_from_matrix(-(transfer.T @ matrix + matrix @ transfer)))
    return np.column_stack(columns)
