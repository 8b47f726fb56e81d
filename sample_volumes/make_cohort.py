"""Make a sample cohort with a planted law, and show what its study found beside the truth.

    python -m sample_volumes.make_cohort demo/cohort              12 ears: a folder each, and truth.json
    scan2kd demo/cohort/ears/*/study.toml --out demo/cohort/out --jobs 2
    python -m sample_volumes.make_cohort demo/cohort --compare    the laws beside the truth

The stapes is the real one of the OpenEar library, stretched along its axes by other amounts in each ear;
right ears are mirror images. Vibrometer data are simulated. Nothing here is a measurement of another ear.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from simulate import Ear, Experiment, Population, Scan, cohort, simulate_study

RESPONSES = (("K11", 0), ("K22", 1), ("K33", 2), ("D11", 0), ("D22", 1), ("D33", 2))


def make_cohort(folder: Path, population: Population, scan: Scan) -> dict[str, Any]:
    """Write the ears into ``folder/ears`` and the truth into ``folder/truth.json``; return the truth."""
    ears = []
    for number, member in enumerate(cohort(population)):
        experiment = Experiment(
            lines=60,
            stapes_points=8,
            bone_points=7,
            position_sd_mm=0.005,
            fiducial_sd_mm=0.005,
            seed=100 + number,
        )
        place = folder / "ears" / member.name
        own = replace(scan, seed=100 + number)
        truth = simulate_study(member.ear, own, experiment, place, name=member.name, about=member.about())
        matrices = {"stiffness_si": truth.stiffness_si.tolist(), "damping_si": truth.damping_si.tolist()}
        ears.append({"folder": member.name, "mass_kg": truth.mass.mass_kg, **matrices})
    known = {
        "exponents_of_mass": {name: population.exponents[place] for name, place in RESPONSES},
        "intrinsic_sd_log": population.intrinsic_sd,
        "ears": ears,
    }
    (folder / "truth.json").write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
    return known


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
        exponent, scatter = planted[law["response"]], law["intrinsic_sd_log_interval_95"]
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
    parser.add_argument("--voxel-um", type=float, help="scans of this voxel size in place of exact surfaces")
    options = parser.parse_args(arguments)
    if options.compare:
        import pandas as pd

        table = pd.DataFrame(compare(options.folder))
        table.to_csv(options.folder / "truth_and_result.csv", index=False)
        print(table.to_string(index=False, float_format=lambda value: f"{value:.2f}"))
        return
    scanned = options.voxel_um is not None
    population = Population(ears=options.ears, pairs=options.ears // 4, ear=Ear(plate=scanned))
    make_cohort(
        options.folder, population, Scan(voxel_um=options.voxel_um) if scanned else Scan(format="ply")
    )
    print(f"{options.folder}: {options.ears} simulated ears with a planted law")


if __name__ == "__main__":
    main()
