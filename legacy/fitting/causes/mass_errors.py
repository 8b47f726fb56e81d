"""Causes that change the mass matrix: another centre, inertia or side, and a mass at the head."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from legacy.fitting.calibrated import calibrated
from legacy.fitting.causes.setting import Applied, Apply, Setting
from legacy.fitting.ligament.equations import Equations
from legacy.fitting.ligament.joint_lines import JointLines
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.page.quantities import MILLIGRAM
from legacy.stapeskit.spatial import matrix_from_parameters, parameters_from_matrix

# Where a mass at the head sits: height of a human stapes, 3.2 to 3.8 mm (Sim et al. 2013, JARO 14:159), m.
HEAD_M = (0.0, 3.4e-3, 0.0)
# Shared errors of the place of that mass.
HEAD_PLACE = "mass.head_place"
# Inertial parameters that are odd in z: m z, Jyz, Jxz.
_ODD_IN_Z = [3, 8, 9]


def changed_inertia(change: Callable[[float, Setting], Array]) -> Callable[[Setting], Apply]:
    """Change the ten inertial parameters (SI)."""

    def made(setting: Setting) -> Apply:
        root = setting.lines.root_mass

        def apply(value: float, lines: JointLines, equations: Equations) -> Applied:
            added = matrix_from_parameters(change(value, setting)) / np.outer(root, root)
            return replace(lines, mass=lines.mass + added), equations

        return apply

    return made


def _add(matrix: Array, setting: Setting) -> Apply:
    """Add a matrix (6, 6), SI, to the mass matrix."""
    scaled = matrix / np.outer(setting.lines.root_mass, setting.lines.root_mass)

    def apply(value: float, lines: JointLines, equations: Equations) -> Applied:
        return replace(lines, mass=lines.mass + value * scaled), equations

    return apply


def head_mass(setting: Setting) -> Apply:
    """Add a mass at the head, whose place is known to a standard deviation along each axis.

    Notes
    -----
    The place counts: 5 mg that sit 0.1 mm off move M12 by as much as the stapes itself has.
    """
    root = np.outer(setting.lines.root_mass, setting.lines.root_mass)
    here, steps = matrix_from_parameters(_point(np.array(HEAD_M))), _head_steps()

    def apply(value: float, lines: JointLines, equations: Equations) -> Applied:
        mass = MILLIGRAM.si(value)
        changes, slopes = lines.mass_changes.copy(), lines.mass_slopes.copy()
        own = [number for number, name in enumerate(lines.sources) if name == HEAD_PLACE]
        for number, step in zip(own, steps, strict=False):
            slopes[number] = mass * step
            changes[number] = slopes[number] / root
        heavier = lines.mass + mass * here / root
        return replace(lines, mass=heavier, mass_changes=changes, mass_slopes=slopes), equations

    return apply


def _head_steps() -> list[Array]:
    """Return the changes (6, 6) of the mass matrix of 1 kg at the head by one sd of its place, x, y and z."""
    place, sd = np.array(HEAD_M), 1e-3 * calibrated("causes.head_place_sd_mm")
    return [
        0.5 * matrix_from_parameters(_point(place + step) - _point(place - step)) for step in sd * np.eye(3)
    ]


def head_moves(setting: Setting) -> tuple[Apply, ...]:
    """Move a mass of one unit at the head by one standard deviation along x, y and z."""
    return tuple(_add(MILLIGRAM.si(1.0) * step, setting) for step in _head_steps())


def displaced(axis: int) -> Callable[[float, Setting], Array]:
    """Return the change of the inertial parameters when the body lies elsewhere (mm) in its frame.

    Notes
    -----
    Moments of inertia about the footplate centre follow by the theorem of parallel axes.
    """

    def change(value: float, setting: Setting) -> Array:
        parameters = parameters_from_matrix(setting.mass)
        mass, centre = parameters[0], parameters[1:4] / parameters[0]
        shift = 1e-3 * value * np.eye(3)[axis]
        return np.asarray(mass * (_point(centre + shift) - _point(centre)))

    return change


def share(places: slice) -> Callable[[float, Setting], Array]:
    """Return a share (%) of some of the inertial parameters."""

    def change(value: float, setting: Setting) -> Array:
        change_si = np.zeros(10)
        change_si[places] = 0.01 * value * parameters_from_matrix(setting.mass)[places]
        return change_si

    return change


def mirrored(value: float, setting: Setting) -> Array:
    """Return the way (0 to 1) to the mirror image along z, by which one side becomes the other."""
    parameters = parameters_from_matrix(setting.mass)
    change = np.zeros(10)
    change[_ODD_IN_Z] = -2.0 * value * parameters[_ODD_IN_Z]
    return change


def _point(place: Array) -> Array:
    """Return the inertial parameters of a mass of 1 kg at a place (m)."""
    return np.array([1.0, *place, *_entries(place @ place * np.eye(3) - np.outer(place, place))])


def _entries(tensor: Array) -> Array:
    """Return xx, yy, zz, xy, yz, xz of a tensor."""
    return np.asarray(tensor[[0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]])
