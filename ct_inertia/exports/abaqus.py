"""Abaqus: a point mass with rotary inertia at the centre of mass, tied rigidly to the footplate centre."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ct_inertia.exports.body import ExportBody

UNITS = {
    "length": "mm",
    "mass": "tonne",
    "time": "s",
    "force": "N",
    "inertia": "tonne mm2",
    "coordinates": "footplate",
}
_TONNE = 1e-3
_TONNE_MM2 = 1e3
_TEXT = """** Stapes made by stapeskit from {source}
** Consistent units: tonne, mm, s (N, MPa). 1 kg = 1e-3 tonne, 1 kg m2 = 1e3 tonne mm2.
** Coordinates: the footplate frame (x anterior, y lateral, origin at the footplate centre).
** scan = R footplate + t, R and t (mm) by rows:
{pose}
** Node 900001 is the footplate centre, node 900002 the centre of mass. The rigid body ties both, so that
** loads, springs and boundary conditions of the footplate go to node 900001.
** Inertia about the centre of mass in footplate axes, tonne mm2 (tensor elements, Jxy = -integral of x y dm):
{tensor}
** It is given in its principal axes, where no product is left whose sign could be mistaken.
*NODE, NSET=STAPES_FOOTPLATE
900001, 0., 0., 0.
*NODE, NSET=STAPES_COM
900002, {com}
*ORIENTATION, NAME=STAPES_PRINCIPAL, SYSTEM=RECTANGULAR
{axes}
*ELEMENT, TYPE=MASS, ELSET=STAPES_MASS
900001, 900002
*MASS, ELSET=STAPES_MASS
{mass}
*ELEMENT, TYPE=ROTARYI, ELSET=STAPES_ROTARY
900002, 900002
*ROTARY INERTIA, ELSET=STAPES_ROTARY, ORIENTATION=STAPES_PRINCIPAL
{moments}, 0., 0., 0.
*RIGID BODY, REF NODE=900001, TIE NSET=STAPES_COM
"""


def write(body: ExportBody, folder: Path) -> list[str]:
    """Write stapes.inp; return its name.

    Notes
    -----
    *ORIENTATION: a point on the local x axis, then one in the local xy plane: here the first two principal
    axes. *ROTARY INERTIA: I11, I22, I33 and the products, at a node that is the centre of mass (Abaqus
    Analysis User's Guide, Rotary inertia). *RIGID BODY with TIE NSET carries mass and rotary inertia of a
    tied node to the reference node.
    """
    moments, axes = body.principal()
    pose = np.hstack([body.scan_from_footplate.rotation, body.scan_from_footplate.translation_mm[:, None]])
    text = _TEXT.format(
        source=body.source,
        pose="\n".join(f"**   {_numbers(row)}" for row in pose),
        tensor="\n".join(f"**   {_numbers(row)}" for row in body.inertia_kg_m2 * _TONNE_MM2),
        com=_numbers(body.com_m * 1e3),
        axes=_numbers(axes[:, :2].T.ravel()),
        mass=f"{body.mass_kg * _TONNE:.12e}",
        moments=_numbers(moments * _TONNE_MM2),
    )
    (folder / "stapes.inp").write_text(text, encoding="utf-8")
    return ["stapes.inp"]


def _numbers(values: NDArray[np.floating]) -> str:
    """Return a data line; Abaqus reads up to 20 characters a field."""
    return ", ".join(f"{value + 0.0:.12e}" for value in values)
