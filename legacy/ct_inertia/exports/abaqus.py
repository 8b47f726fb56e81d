"""Abaqus and CalculiX: six point masses that move with the footplate frame as one rigid body."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.exports.body import ExportBody

UNITS = {
    "length": "mm",
    "mass": "tonne",
    "time": "s",
    "force": "N",
    "inertia": "tonne mm2",
    "coordinates": "footplate",
}
# The usual consistent units of these programs, mm, N, s and t: 1 kg in t, and 1 kg m2 in t mm2.
_TONNE = 1e-3
_TONNE_MM2 = 1e3
CENTRE, ROTATION, FIRST_POINT = 900001, 900002, 900003
"""Nodes: the footplate centre, the rotation vector of the footplate, and the first of six point masses."""
_TEXT = """** Stapes made by stapeskit from {source}
** Consistent units: tonne, mm, s (N, MPa). 1 kg = 1e-3 tonne, 1 kg m2 = 1e3 tonne mm2.
** Coordinates: the footplate frame (x anterior, y lateral, origin at the footplate centre).
** scan = R footplate + t, R and t (mm) by rows:
{pose}
** Node {centre} is the footplate centre. Degrees of freedom 1, 2, 3 of node {rotation} are the small
** rotations alpha, beta, gamma of the footplate about its axes, in rad: a spring there is in N mm / rad.
** Mass {mass} tonne, centre of mass (mm) {com}
** Inertia about the centre of mass in footplate axes, tonne mm2 (tensor, Jxy = -integral of x y dm):
{tensor}
** Six equal masses on its principal axes have this mass, this centre and this inertia. Equations tie them to
** the two nodes: u = u_centre + rotation x r, for small rotations.
*NODE, NSET=STAPES_FOOTPLATE
{centre}, 0., 0., 0.
*NODE, NSET=STAPES_ROTATION
{rotation}, 0., 0., 0.
*NODE, NSET=STAPES_POINTS
{points}
*ELEMENT, TYPE=MASS, ELSET=STAPES_MASS
{elements}
*MASS, ELSET=STAPES_MASS
{sixth}
** Springs along each axis, which no rigid motion stretches, show CalculiX which unknowns are coupled.
*ELEMENT, TYPE=SPRINGA, ELSET=STAPES_AXES
{springs}
*SPRING, ELSET=STAPES_AXES

1.
*EQUATION
{equations}
"""


def write(body: ExportBody, folder: Path) -> list[str]:
    """Write stapes.inp; return its name.

    Notes
    -----
    Masses m / 6 at distances +-d_k along the principal axes: the second moment along axis k is m d_k^2 / 3,
    which is (J_1 + J_2 + J_3) / 2 - J_k. CalculiX has no *ROTARY INERTIA, and the two programs write rigid
    bodies differently; *MASS, *SPRING and *EQUATION are the same in both (Abaqus Keywords Guide; CalculiX
    CrunchiX User's Manual, section 7).
    """
    moments, axes = body.principal()
    pose = np.hstack([body.scan_from_footplate.rotation, body.scan_from_footplate.translation_mm[:, None]])
    second = np.maximum(0.5 * moments.sum() - moments, 0.0)
    distances_mm = np.sqrt(3.0 * second / body.mass_kg) * 1e3
    places = [sign * distances_mm[k] * axes[:, k] for k in range(3) for sign in (1.0, -1.0)]
    points = body.com_m * 1e3 + np.array(places)
    nodes = range(FIRST_POINT, FIRST_POINT + len(points))
    text = _TEXT.format(
        source=body.source,
        centre=CENTRE,
        rotation=ROTATION,
        pose="\n".join(f"**   {_format_data_line(row)}" for row in pose),
        tensor="\n".join(f"**   {_format_data_line(row)}" for row in body.inertia_kg_m2 * _TONNE_MM2),
        mass=f"{body.mass_kg * _TONNE:.12e}",
        com=_format_data_line(body.com_m * 1e3),
        points="\n".join(
            f"{node}, {_format_data_line(point)}" for node, point in zip(nodes, points, strict=True)
        ),
        elements="\n".join(f"{node}, {node}" for node in nodes),
        springs="\n".join(f"{nodes[-1] + 1 + k}, {nodes[2 * k]}, {nodes[2 * k + 1]}" for k in range(3)),
        sixth=f"{body.mass_kg * _TONNE / len(points):.12e}",
        equations="\n".join(
            line for node, point in zip(nodes, points, strict=True) for line in _equations(node, point)
        ),
    )
    (folder / "stapes.inp").write_text(text, encoding="utf-8")
    return ["stapes.inp"]


def _equations(node: int, point_mm: NDArray[np.floating]) -> list[str]:
    """Return u_node - u_centre - rotation x point = 0 along x, y, z."""
    lines = []
    for axis in range(3):
        second, third = (axis + 1) % 3, (axis + 2) % 3
        terms = [
            (node, axis, 1.0),
            (CENTRE, axis, -1.0),
            (ROTATION, second, -point_mm[third]),
            (ROTATION, third, point_mm[second]),
        ]
        terms = [term for term in terms if term[2] != 0.0]
        lines += [
            str(len(terms)),
            ", ".join(f"{where}, {along + 1}, {factor:.12e}" for where, along, factor in terms),
        ]
    return lines


def _format_data_line(values: NDArray[np.floating]) -> str:
    """Return a data line; Abaqus reads up to 20 characters a field."""
    return ", ".join(f"{value + 0.0:.12e}" for value in values)
