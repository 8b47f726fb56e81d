"""A small ear for the tests: a closed mesh as the scan, simulated vibrometer data, a study file."""

from pathlib import Path

import numpy as np

from ct_inertia.mass.mass_properties import footplate_mass_matrix, from_density
from ct_inertia.surface.surface import Surface, write_surface
from sample_volumes import bodies
from sample_volumes.make_sample import write_recording
from sample_volumes.vibrometer import Vibrometry, record
from stapeskit.frames import RigidTransform, rotation_from_vector

DENSITY = 1382.4
TEXT = """
[study]
name = "{name}"
notes = "SIMULATED vibrometer data.\\nIncus removed."
[scan]
file = "stapes.ply"
density_kg_m3 = "{density}"
side = "{side}"
anterior = [{anterior}]
[ldv]
file = "ldv.csv"
points = "points.csv"
fiducials = "fiducials.csv"
[fit]
dof = "y,alpha,gamma"
"""


def make_ear(
    folder: Path, name: str = "ear one", density: str = "1382.4+-14", side: str = "left", seed: int = 1
) -> Path:
    """Write an ear into a folder and return its study file; its K and D are the paper's."""
    folder.mkdir(parents=True, exist_ok=True)
    stapes = bodies.stapes_in_footplate()
    pose = RigidTransform.from_parts(
        rotation_from_vector([0.3, -0.5, 0.2]), [4.0, 5.0, 6.0], "scan", "footplate"
    )
    write_surface(folder / "stapes.ply", Surface(pose.points(stapes.vertices_mm), stapes.faces))
    anterior = tuple(pose.rotation[:, 0])
    here = RigidTransform.identity("scan", "footplate")
    body = from_density(stapes.moments(), DENSITY, None)
    mass = footplate_mass_matrix(body, here, np.zeros((6, 6))).matrix
    how = Vibrometry(lines=40, seed=seed, stapes_points=6, bone_points=5)
    marks = [(f"f{k}", np.array(place)) for k, place in enumerate(np.eye(3) * 4.0)] + [("f3", np.zeros(3))]
    recording = record(mass, RigidTransform.identity("footplate", "plate"), how, marks, stapes=stapes)
    write_recording(folder, recording, how)
    fiducials = folder / "fiducials.csv"
    fiducials.write_text(fiducials.read_text(encoding="utf-8").replace(",plate", ",footplate"))
    study = folder / "study.toml"
    study.write_text(
        TEXT.format(name=name, density=density, side=side, anterior=", ".join(f"{v:.3f}" for v in anterior))
    )
    return study
