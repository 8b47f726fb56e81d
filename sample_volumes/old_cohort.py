"""Make a sample cohort with a planted law, and show what its study found beside the truth.

    python -m sample_volumes.old_cohort demo/cohort              12 ears: a folder each, and truth.json
    scan2kd demo/cohort/ears/*/study.toml --out demo/cohort/out --jobs 2
    python -m sample_volumes.old_cohort demo/cohort --compare    the laws beside the truth

The stapes is the real one of the OpenEar library, stretched along its axes by other amounts in each ear;
right ears are mirror images. Vibrometer data are simulated. Nothing here is a measurement of another ear.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.surface.surface import Surface, read_surface, write_surface
from legacy.fitting.examples.paper import PAPER_DAMPING_CORRECTED, PAPER_STIFFNESS
from sample_volumes import bodies
from sample_volumes.mesh_ear import DENSITY, write_mesh_ear
from sample_volumes.vibrometer import Vibrometry

Array = NDArray[np.float64]
REFERENCE_KG = 3.2e-6
# Exponents of y, alpha, gamma over the mass: a force goes with the length of the ligament, m^(1/3), in the
# planted law with m^1; a moment with two more powers of length.
STIFFNESS_EXPONENTS = (1.0, 5.0 / 3.0, 5.0 / 3.0)
DAMPING_EXPONENTS = (1.0, 5.0 / 3.0, 5.0 / 3.0)


@dataclass(frozen=True)
class Population:
    """How ears differ; every spread is a standard deviation of a natural logarithm.

    Attributes
    ----------
    ears, pairs : int
        Number of ears, and of persons with both of them.
    size, stretch : float
        Of the whole stapes and of each of its axes.
    scatter : float
        Of K and D about their laws, common to the degrees of freedom of a matrix.
    entry_scatter : float
        Of each degree of freedom on its own.
    likeness : float
        Correlation of the two ears of a person, in size and in scatter.
    seed : int
    """

    ears: int = 12
    pairs: int = 3
    size: float = 0.07
    stretch: float = 0.025
    scatter: float = 0.12
    entry_scatter: float = 0.05
    likeness: float = 0.6
    seed: int = 4


def make_cohort(folder: Path, population: Population | None = None) -> dict[str, Any]:
    """Write the ears into ``folder/ears`` and the truth into ``folder/truth.json``; return the truth."""
    population = population or Population()
    rng = np.random.default_rng(population.seed)
    people = np.r_[np.repeat(np.arange(population.pairs), 2), np.arange(population.pairs, population.ears)]
    people = people[: population.ears]
    ages = rng.integers(35, 85, people.max() + 1)

    def alike(sd: float, columns: int) -> Array:
        """Return draws (ears, columns) that ears of a person have partly in common."""
        common = rng.standard_normal((people.max() + 1, columns))[people]
        alone = rng.standard_normal((population.ears, columns))
        share = population.likeness
        return sd * (np.sqrt(share) * common + np.sqrt(1.0 - share) * alone)

    sizes = np.exp(alike(population.size, 1) + alike(population.stretch, 3))
    scatter = alike(population.scatter, 2)
    entries = alike(population.entry_scatter, 6)
    ears = []
    for k in range(population.ears):
        second = k > 0 and people[k] == people[k - 1]
        side = "right" if second or (people[k] >= population.pairs and k % 3 == 0) else "left"
        name = f"ear{k + 1:02d}"
        stapes = _stapes(folder / "ears" / name, sizes[k], mirrored=side == "right")
        size = float(np.log(DENSITY * stapes.moments().volume_mm3 * 1e-9 / REFERENCE_KG))
        matrices = {
            key: _scale(matrix, exponents, size, scatter[k, j], entries[k, 3 * j : 3 * j + 3], side)
            for j, (key, matrix, exponents) in enumerate(
                (
                    ("stiffness", PAPER_STIFFNESS, STIFFNESS_EXPONENTS),
                    ("damping", PAPER_DAMPING_CORRECTED, DAMPING_EXPONENTS),
                )
            )
        }
        about = {
            "name": f"ear {k + 1}",
            "notes": "SIMULATED on a real stapes that was stretched. Incus removed, cochlea open.",
            "side": side,
            "subject": f"P{people[k] + 1:02d}",
            "age": float(ages[people[k]]),
        }
        how = Vibrometry(lines=60, stapes_points=8, bone_points=7, position_sd_mm=0.005, seed=100 + k)
        _, mass = write_mesh_ear(
            folder / "ears" / name, stapes, about, how=how, density="1382.4+-14", side=side, **matrices
        )
        ears.append(
            {
                "folder": name,
                "mass_kg": mass,
                **{f"{key}_si": value.tolist() for key, value in matrices.items()},
            }
        )
    sd = float(np.hypot(population.scatter, population.entry_scatter))
    truth = {
        "exponents_of_mass": {
            **{f"K{j + 1}{j + 1}": b for j, b in enumerate(STIFFNESS_EXPONENTS)},
            **{f"D{j + 1}{j + 1}": b for j, b in enumerate(DAMPING_EXPONENTS)},
        },
        "intrinsic_sd_log": sd,
        "ears": ears,
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    return truth


def _stapes(folder: Path, stretch: Array, mirrored: bool) -> Surface:
    """Return the stretched stapes, mm, in the footplate frame computed from the stretched shape."""
    mesh = read_surface(bodies.OPENEAR_STAPES)
    model = bodies.stapes_in_footplate()
    vertices, faces = model.vertices_mm * stretch, mesh.faces
    if mirrored:
        vertices, faces = vertices * [1.0, 1.0, -1.0], faces[:, ::-1]
    folder.mkdir(parents=True, exist_ok=True)
    path = write_surface(folder / "true_stapes.ply", Surface(vertices, np.ascontiguousarray(faces)))
    return bodies.stapes_in_footplate(path or folder / "true_stapes.ply")


def _scale(
    matrix: Array, exponents: tuple[float, ...], size: float, scatter: float, entries: Array, side: str
) -> Array:
    """Return a matrix whose diagonal follows the law; couplings follow their two degrees of freedom."""
    factor = np.exp(0.5 * (np.array(exponents) * size + scatter + entries))
    turned = factor * ([1.0, -1.0, 1.0] if side == "right" else [1.0, 1.0, 1.0])
    return np.asarray(matrix * np.outer(turned, turned))


def compare(folder: Path) -> list[dict[str, Any]]:
    """Return, for each law with a planted exponent, the truth and what the cohort's study found."""
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    estimated = json.loads((folder / "out" / "cohort.json").read_text(encoding="utf-8"))
    planted, sd = truth["exponents_of_mass"], truth["intrinsic_sd_log"]
    rows = []
    for law in estimated["laws"]:
        if law["predictor"] != "mass_kg" or law["response"] not in planted:
            continue
        ends = law["exponent_interval_95"]
        low, high = (-np.inf if ends[0] is None else ends[0]), (np.inf if ends[1] is None else ends[1])
        exponent = planted[law["response"]]
        scatter = law["intrinsic_sd_log_interval_95"]
        rows.append(
            {
                "law": f"{law['response']} ~ mass",
                "planted": exponent,
                "found": law["exponent"],
                "low_95": low,
                "high_95": high,
                "inside": bool(low <= exponent <= high),
                "planted_scatter": sd,
                "scatter": law["intrinsic_sd_log"],
                "scatter_inside": bool(scatter[0] <= sd <= scatter[1]),
            }
        )
    return rows


def main(arguments: list[str] | None = None) -> None:
    """Make the cohort, or compare its study with the truth."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--compare", action="store_true")
    parser.add_argument("--ears", type=int, default=12)
    options = parser.parse_args(arguments)
    if not options.compare:
        make_cohort(options.folder, Population(ears=options.ears, pairs=options.ears // 4))
        print(f"{options.folder}: {options.ears} simulated ears with a planted law")
        return
    import pandas as pd

    table = pd.DataFrame(compare(options.folder))
    table.to_csv(options.folder / "truth_and_result.csv", index=False)
    print(table.to_string(index=False, float_format=lambda value: f"{value:.2f}"))


if __name__ == "__main__":
    main()
