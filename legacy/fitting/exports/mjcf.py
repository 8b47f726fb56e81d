"""A MuJoCo model: the stapes on three joints, K and D as tendons that couple them.

A fixed tendon of length c^T q with a stiffness of 1 adds c c^T to K, and one with a damping of 1 to D. So
three tendons each, with the columns of Cholesky factors as coefficients, make K and D exactly, couplings
included.
"""

from __future__ import annotations

from xml.etree import ElementTree as Tree

import numpy as np

from legacy.fitting.errors import FittingError
from legacy.fitting.kd_fit import KDFit
from legacy.fitting.model.principal_axes import PRINCIPAL_DOF
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.spatial import parameters_from_matrix

_JOINTS = {"y": ("slide", "0 1 0"), "alpha": ("hinge", "1 0 0"), "gamma": ("hinge", "0 0 1")}
# A thousandth of the period of the fastest motion that a stapes shows, 10 kHz.
_STEP_S = "1e-7"


def content(fit: KDFit) -> bytes:
    """Return the model in m, N, kg, s; its coordinates are the deflections of the footplate centre.

    Raises
    ------
    FittingError
        The degrees of freedom are not y, alpha, gamma with a complete mass matrix, the damping is not
        viscous, or K or D is not positive definite.
    """
    complete = fit.dof == PRINCIPAL_DOF and fit.problem.inertia.complete
    definite = complete and all(np.linalg.eigvalsh(part)[0] > 0.0 for part in (fit.stiffness, fit.damping))
    if not definite or not fit.law.law.polynomial:
        wanted = "for y,alpha,gamma with viscous damping, positive definite K and D and a mass of six degrees"
        shown = f"{','.join(fit.dof)}, {fit.law.name}"
        raise FittingError.of("the export mjcf", wanted, shown, "", "Leave it out of {export}")
    root = Tree.Element("mujoco", model="stapes")
    root.append(Tree.Comment("Units m, N, kg, s, rad; footplate axes about the footplate centre."))
    Tree.SubElement(root, "compiler", angle="radian")
    Tree.SubElement(root, "option", timestep=_STEP_S, gravity="0 0 0", integrator="implicitfast")
    body = Tree.SubElement(Tree.SubElement(root, "worldbody"), "body", name="stapes")
    mass, centre, tensor = _inertia(parameters_from_matrix(fit.problem.inertia.matrix))
    fluid = 0.0 if fit.problem.fluid is None else fit.problem.fluid[0, 0]
    for name, (kind, axis) in _JOINTS.items():
        joint = Tree.SubElement(body, "joint", name=name, type=kind, axis=axis)
        if name == "y" and fluid > 0.0:
            joint.set("armature", f"{fluid:.10e}")
    full = tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    Tree.SubElement(body, "inertial", pos=_text(centre), mass=f"{mass:.10e}", fullinertia=_text(full))
    tendons = Tree.SubElement(root, "tendon")
    for letter, kind, matrix in (("k", "stiffness", fit.stiffness), ("d", "damping", fit.damping)):
        for number, column in enumerate(cholesky_of(matrix).T, 1):
            fixed = Tree.SubElement(tendons, "fixed", {"name": f"{letter}{number}", kind: "1"})
            for name, share in zip(_JOINTS, column, strict=True):
                Tree.SubElement(fixed, "joint", joint=name, coef=f"{share:.10e}")
    Tree.indent(root)
    return Tree.tostring(root, encoding="utf-8") + b"\n"


def cholesky_of(matrix: Array) -> Array:
    """Return L with L L^T = X of a positive definite matrix of different units."""
    size = np.sqrt(np.diag(matrix))
    return np.asarray(size[:, None] * np.linalg.cholesky(matrix / np.outer(size, size)))


def _inertia(parameters: Array) -> tuple[float, Array, Array]:
    """Return mass, centre of mass and the inertia tensor about it."""
    mass, centre = float(parameters[0]), parameters[1:4] / parameters[0]
    xx, yy, zz, xy, yz, xz = parameters[4:]
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return mass, centre, tensor - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))


def _text(values: Array) -> str:
    return " ".join(f"{value:.10e}" for value in values)
