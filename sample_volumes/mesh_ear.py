"""A small ear: a closed mesh as its scan, simulated vibrometer data, and a study file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.mass.mass_properties import footplate_mass_matrix, from_density
from legacy.ct_inertia.surface.surface import Surface, write_surface
from legacy.fitting.examples.paper import PAPER_DAMPING_CORRECTED, PAPER_STIFFNESS
from legacy.stapeskit.frames import RigidTransform, rotation_from_vector
from legacy.stapeskit.option_values import toml
from sample_volumes.old_study import write_recording
from sample_volumes.vibrometer import Vibrometry, record

Array = NDArray[np.float64]
DENSITY = 1382.4


def write_mesh_ear(
    folder: Path,
    stapes: Surface,
    about: Mapping[str, Any],
    *,
    how: Vibrometry,
    density: str,
    side: str = "left",
    stiffness: Array = PAPER_STIFFNESS,
    damping: Array = PAPER_DAMPING_CORRECTED,
) -> tuple[Path, float]:
    """Write an ear into a folder, and return its study file and its true mass in kg.

    Parameters
    ----------
    folder : Path
        Made when missing.
    stapes : Surface
        In its own footplate frame, mm.
    about : mapping
        The keys of [study].
    how : Vibrometry
    density : str
        As stated in the study; the true one is 1382.4 kg/m^3.
    side : str
    stiffness, damping : ndarray, (3, 3)
        Of y, alpha, gamma, SI.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pose = RigidTransform.from_parts(
        rotation_from_vector([0.3, -0.5, 0.2]), [4.0, 5.0, 6.0], "scan", "footplate"
    )
    write_surface(folder / "stapes.ply", Surface(pose.points(stapes.vertices_mm), stapes.faces))
    here = RigidTransform.identity("scan", "footplate")
    body = from_density(stapes.moments(), DENSITY, None)
    mass = footplate_mass_matrix(body, here, np.zeros((6, 6))).matrix
    marks = [(f"f{k}", np.array(place)) for k, place in enumerate(np.eye(3) * 4.0)] + [("f3", np.zeros(3))]
    recording = record(
        mass, RigidTransform.identity("footplate", "plate"), how, marks, stiffness, damping, stapes
    )
    write_recording(folder, recording, how, "footplate")
    anterior = [round(float(part), 3) for part in pose.rotation[:, 0]]
    scan = {"file": "stapes.ply", "density_kg_m3": density, "side": side, "anterior": anterior}
    ldv = {"file": "ldv.csv", "points": "points.csv", "fiducials": "fiducials.csv"}
    tables = {"study": about, "scan": scan, "ldv": ldv, "fit": {"dof": "y,alpha,gamma"}}
    lines = [
        line
        for name, table in tables.items()
        for line in (f"[{name}]", *(f"{key} = {toml(value)}" for key, value in table.items()))
    ]
    study = folder / "study.toml"
    study.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return study, float(mass[0, 0])
