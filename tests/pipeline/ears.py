"""A small ear for the tests; its K and D are the paper's."""

from pathlib import Path

from sample_volumes import bodies
from sample_volumes.mesh_ear import write_mesh_ear
from sample_volumes.vibrometer import Vibrometry


def make_ear(
    folder: Path, name: str = "ear one", density: str = "1382.4+-14", side: str = "left", seed: int = 1
) -> Path:
    """Write an ear into a folder and return its study file."""
    about = {"name": name, "notes": "SIMULATED vibrometer data.\nIncus removed."}
    how = Vibrometry(lines=40, seed=seed, stapes_points=6, bone_points=5)
    stapes = bodies.stapes_in_footplate()
    return write_mesh_ear(folder, stapes, about, how=how, density=density, side=side)[0]
