"""Springs, dashpots and point masses for CalculiX and Abaqus.

A symmetric positive definite matrix X of y, alpha and gamma is that of four equal springs X11 / 4 along
y, two on each of its principal axes: at +-a with 2 (X11 / 4) a^2 = the rocking stiffness across that axis.
A rigid body of ten inertial parameters is six equal point masses on the principal axes of inertia through its
centre of mass, at +-sqrt(3 P_i / m) with the principal second moments P_i = (J_j + J_k - J_i) / 2. A rigid
body ties them to the footplate; springs 1e4 times stiffer hold x, z and beta. CalculiX looks for more vectors
than the six freedoms of the body have when it is asked for three modes (ARPACK): masses on springs of their
own, tied to nothing, fill them up far above in frequency.
"""

from __future__ import annotations

import numpy as np

from legacy.fitting.errors import FittingError
from legacy.fitting.kd_fit import KDFit
from legacy.fitting.model.principal_axes import PRINCIPAL_DOF, principal_axes
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.spatial import parameters_from_matrix

# Length of the springs to the ground, without effect: they have one direction each.
_GROUND_M = 1e-3
# In-plane over piston and rocking stiffness: changes the natural frequencies by less than 1e-3.
_RIGID = 1e4
# Mass of an oscillator over that of the stapes. Computation, without effect: nothing ties them to the body,
# and their springs follow their mass. CalculiX 2.20 prints the same modes of the deck of
# tests/fitting/exports/test_exports.py from 1e-9 to 1e-3.
_SMALL = 1e-6
# Number of oscillators. Computation: ARPACK, as CalculiX calls it, makes four vectors to each of the three
# modes, and the body has six freedoms. On the same deck CalculiX stops with 7 oscillators and finds the same
# modes with 10, 20 and 40.
_OTHERS = 20


def spring_points(matrix: Array) -> Array:
    """Return the places (4, 2), x and z in m, of four equal springs along y that make a matrix (3, 3)."""
    axes = principal_axes(matrix)
    angle = axes.angle_rad
    axis, other = np.array([np.cos(angle), -np.sin(angle)]), np.array([np.sin(angle), np.cos(angle)])
    origin = np.array([axes.origin_x_m, axes.origin_z_m])
    about_axis, about_other = np.sqrt(2.0 * np.maximum(axes.stiffness[1:], 0.0) / matrix[0, 0])
    return np.array(
        [
            origin + about_other * axis,
            origin - about_other * axis,
            origin + about_axis * other,
            origin - about_axis * other,
        ]
    )


def mass_points(parameters: Array) -> Array:
    """Return the places (6, 3), m, of six equal point masses that make ten inertial parameters (SI)."""
    mass, centre = parameters[0], parameters[1:4] / parameters[0]
    xx, yy, zz, xy, yz, xz = parameters[4:]
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    central = tensor - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    moments, axes = np.linalg.eigh(central)
    second = 0.5 * moments.sum() - moments
    arms = np.sqrt(3.0 * np.maximum(second, 0.0) / mass)
    return np.concatenate([centre + axes.T * arms[:, None], centre - axes.T * arms[:, None]])


def _write_oscillators(node: int, element: int, stiffness: float, mass: float) -> list[str]:
    """Return oscillators along x, 3000 times higher in frequency than the stapes on its ligament."""
    nodes = range(node, node + _OTHERS)
    return [
        "** Far above in frequency and tied to nothing: with them CalculiX finds three modes.",
        *("*NODE, NSET=far", *(f"{place}, {_GROUND_M:g}, 0., 0." for place in nodes)),
        "*ELEMENT, TYPE=MASS, ELSET=far_mass",
        *(f"{element + k}, {place}" for k, place in enumerate(nodes)),
        f"*MASS, ELSET=far_mass\n{_SMALL * mass:.10e}",
        "*ELEMENT, TYPE=SPRING1, ELSET=far_spring",
        *(f"{element + _OTHERS + k}, {place}" for k, place in enumerate(nodes)),
        f"*SPRING, ELSET=far_spring\n1\n{1e7 * _SMALL * stiffness:.10e}",
        "*BOUNDARY\nfar, 2, 3",
    ]


def content(fit: KDFit) -> bytes:
    """Return an input deck in m, N, kg, s with a step that finds the three natural frequencies.

    Raises
    ------
    FittingError
        The degrees of freedom are not y, alpha, gamma, or K is not positive semidefinite.
    """
    if fit.dof != PRINCIPAL_DOF or not fit.passive[0]:
        wanted = "for y,alpha,gamma with a positive semidefinite K"
        raise FittingError.of("the export inp", wanted, ",".join(fit.dof), "", "Leave it out of {export}")
    nodes: list[tuple[float, float, float]] = [(0.0, 0.0, 0.0), (0.0, 0.0, 0.0)]
    moving: list[int] = []
    elements: list[str] = []
    count = 0

    def node(x: float, y: float, z: float) -> int:
        nodes.append((float(x), float(y), float(z)))
        return len(nodes)

    def axial(kind: str, keyword: str, matrix: Array) -> None:
        nonlocal count
        name = keyword.lower()
        elements.append(f"*ELEMENT, TYPE={kind}, ELSET={name}")
        for x, z in spring_points(matrix):
            foot, ground = node(x, 0.0, z), node(x, _GROUND_M, z)
            moving.append(foot)
            fixed.append(ground)
            count += 1
            elements.append(f"{count}, {foot}, {ground}")
        blank = "\n" if keyword == "SPRING" else ""
        elements.append(f"*{keyword}, ELSET={name}\n{blank}{matrix[0, 0] / 4.0:.10e}")

    fixed: list[int] = []
    axial("SPRINGA", "SPRING", fit.stiffness)
    comments = ["** Stiffness and damping of the annular ligament; units m, N, kg, s, rad; footplate axes."]
    if fit.law.law.polynomial and fit.passive[1]:
        axial("DASHPOTA", "DASHPOT", fit.damping)
    else:
        comments.append(f"** No dashpots: the dynamic stiffness is {fit.law.formula}, or D is not passive.")
    if fit.problem.inertia.complete:
        parameters = parameters_from_matrix(fit.problem.inertia.matrix)
        elements.append("*ELEMENT, TYPE=MASS, ELSET=stapes")
        for place in mass_points(parameters):
            moving.append(node(*place))
            count += 1
            elements.append(f"{count}, {moving[-1]}")
        elements.append(f"*MASS, ELSET=stapes\n{parameters[0] / 6.0:.10e}")
        if fit.problem.fluid is not None:
            moving.append(node(0.0, 0.0, 0.0))
            count += 1
            elements.append(f"*ELEMENT, TYPE=MASS, ELSET=fluid\n{count}, {moving[-1]}")
            elements.append(f"*MASS, ELSET=fluid\n{fit.problem.fluid[0, 0]:.10e}")
    else:
        comments.append("** No masses: the mass matrix has three degrees of freedom only.")
    stiffest = float(max(fit.stiffness[1, 1], fit.stiffness[2, 2]))
    rigid_springs = ((1, 1, fit.stiffness[0, 0]), (1, 3, fit.stiffness[0, 0]), (2, 2, stiffest))
    for number, (at, direction, value) in enumerate(rigid_springs, 1):
        count += 1
        elements.append(f"*ELEMENT, TYPE=SPRING1, ELSET=held{number}\n{count}, {at}")
        elements.append(f"*SPRING, ELSET=held{number}\n{direction}\n{_RIGID * value:.10e}")
    lines = [
        *comments,
        "** Node 1: footplate centre (translations); node 2: its rotations in degrees of freedom 1 to 3.",
        "*NODE, NSET=all",
        *(f"{place}, {x:.10e}, {y:.10e}, {z:.10e}" for place, (x, y, z) in enumerate(nodes, 1)),
        *elements,
        "*NSET, NSET=footplate",
        *(f"{place}," for place in moving),
        "*NSET, NSET=bone",
        *(f"{place}," for place in fixed),
        "*RIGID BODY, NSET=footplate, REF NODE=1, ROT NODE=2",
        "*BOUNDARY",
        "bone, 1, 3",
    ]
    if fit.problem.inertia.complete:
        mass = float(fit.problem.inertia.matrix[0, 0])
        lines += _write_oscillators(len(nodes) + 1, count + 1, float(fit.stiffness[0, 0]), mass)
        lines += ["*STEP", "*FREQUENCY", "3", "*NODE FILE", "U", "*END STEP"]
    return ("\n".join(lines) + "\n").encode()
