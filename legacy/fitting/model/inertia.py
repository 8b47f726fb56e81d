"""The mass matrix as a fit uses it: rows of the chosen degrees of freedom, and how its errors enter them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from legacy.fitting.errors import FittingError
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import raise_all
from legacy.stapeskit.records.mass_record import FRAME_SOURCE, MassMatrix, frame_derivative
from legacy.stapeskit.spatial import (
    dof_indices,
    inertia_faults,
    matrix_from_parameters,
    parameter_basis,
    parameters_from_matrix,
)

# No body that is measured here has a mass or moment of inertia beyond these.
SMALLEST, LARGEST = 1e-30, 1e6


@dataclass(frozen=True)
class Inertia:
    """A mass matrix about the footplate centre in footplate axes, with its parameters if they are known.

    Attributes
    ----------
    matrix : ndarray, (k, k)
        SI; of the chosen degrees of freedom, or of all six.
    complete : bool
        True when all six degrees of freedom are there.
    parameters : ndarray, (10,), or None
        Inertial parameters, when the matrix came with an uncertainty.
    contributions : mapping of str to ndarray, (10, 10)
        Their covariance by source.
    """

    matrix: Array
    complete: bool
    parameters: Array | None = None
    contributions: Mapping[str, Array] = field(default_factory=dict)

    def rows(self, dof: tuple[str, ...], load_dof: tuple[str, ...], change: Array | None = None) -> Array:
        """Return [M_rr, M_rc], (n, n + c), with the inertial parameters changed by ``change`` (10,)."""
        matrix = self.matrix
        if change is not None:
            matrix = matrix + matrix_from_parameters(change)
        if not self.complete:
            return matrix
        columns = dof_indices((*dof, *load_dof))
        return matrix[np.ix_(dof_indices(dof), columns)]

    def parameter_derivatives(self, dof: tuple[str, ...]) -> Array:
        """Return the derivative of M_rr by the ten parameters, (10, n, n)."""
        places = dof_indices(dof)
        return parameter_basis()[:, places][:, :, places]

    def frame_derivative(self) -> Array:
        """Return the derivative of the ten parameters by the footplate frame's displacement, (10, 6).

        Zero when only a part of the matrix is known.
        """
        if not self.complete:
            return np.zeros((10, 6))
        return frame_derivative(parameters_from_matrix(self.matrix))

    def without_frame(self) -> dict[str, Array]:
        """Return the contributions other than that of the frame."""
        return {name: part for name, part in self.contributions.items() if name != FRAME_SOURCE}


def inertia_of(mass: MassMatrix | Array, dof: tuple[str, ...]) -> Inertia:
    """Take a mass matrix in either form and check it against the chosen degrees of freedom.

    Parameters
    ----------
    mass : MassMatrix or ndarray
        About the footplate centre in footplate axes; an array (SI) is (n, n) in the order of
        ``dof``, or (6, 6).
    dof : tuple of str
        Chosen degrees of freedom, n.

    Raises
    ------
    FittingError
        Its shape does not fit, it is about another point or in other axes, not positive definite, or, of six
        degrees of freedom where fewer are fitted, that of no rigid body.
    """
    if isinstance(mass, MassMatrix):
        if (mass.about, mass.axes) != ("footplate_centre", "footplate"):
            raise FittingError.of(
                "the mass matrix",
                "about footplate_centre in footplate axes",
                f"about {mass.about} in {mass.axes} axes",
                next_step="Take the block mass_matrix of mass.json",
            )
        return Inertia(mass.matrix, True, mass.parameters, mass.contributions)
    matrix = np.asarray(mass, dtype=float)
    n = len(dof)
    if matrix.shape not in ((n, n), (6, 6)):
        shape = " x ".join(str(size) for size in matrix.shape) or "a single number"
        raise FittingError.of(
            "the mass matrix",
            f"{n} x {n} for {{dof}} {','.join(dof)}, or 6 x 6",
            shape,
            next_step="Give M in the order of {dof}, or change {dof}",
        )
    check_mass(matrix)
    if n != 6 and matrix.shape == (6, 6):
        raise_all(FittingError, inertia_faults(matrix))
    return Inertia(matrix, matrix.shape == (6, 6))


def check_mass(matrix: Array, where: str = "") -> None:
    """Refuse a mass matrix that is not finite, of a body's size, symmetric and positive definite.

    Raises
    ------
    FittingError
        Any of these.
    """
    if not np.all(np.isfinite(matrix)):
        raise FittingError.of("the mass matrix", "finite numbers", "NaN or infinite values", where)
    diagonal = np.diag(matrix)
    if np.any(diagonal <= 0.0):
        raise FittingError.of(
            "the diagonal of the mass matrix", "positive", diagonal.min(), where, "Check its units"
        )
    if np.any((diagonal < SMALLEST) | (diagonal > LARGEST)):
        worst = diagonal[np.argmax(np.abs(np.log(diagonal)))]
        want = f"within {SMALLEST:g} and {LARGEST:g} (kg, kg m2)"
        raise FittingError.of("the diagonal of the mass matrix", want, f"{worst:g}", where, "Check its units")
    root = np.sqrt(diagonal)
    scaled = matrix / np.outer(root, root)
    if np.max(np.abs(scaled - scaled.T)) > 1e-6:
        raise FittingError.of(
            "the mass matrix", "symmetric", "an asymmetric one", where, "Check the order of its rows"
        )
    smallest = float(np.linalg.eigvalsh(scaled)[0])
    if smallest <= 1e-9:
        raise FittingError.of(
            "the mass matrix",
            "positive definite",
            f"a smallest scaled eigenvalue of {smallest:.3g}",
            where,
            "Check units and signs (M(y, alpha) = -m z, M(y, gamma) = +m x)",
        )
