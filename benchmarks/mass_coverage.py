"""Do the stated uncertainties of the mass matrix cover the truth? Random simulated ears tell.

    python benchmarks/mass_coverage.py --ears 40 --voxel-um 25 --seed 1 --phantom openear

Every ear has its own pose, noise (2 to 6 % of the contrast between bone and air), distance and tilt of the
plate, and gap to the bone around it. Frames are found as ct2mass finds them; density is exact, so that the
budget holds levels, noise, blur, separation and frame. For each entry of M the table gives the mean of
(found - true) / stated sd, its standard deviation, and how often the 95 % interval holds the truth.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

_DENSITY = 1382.4
_NAMES = ("x", "y", "z", "alpha", "beta", "gamma")


def random_ear(seed: int, voxel_mm: float, stapes: Path | None) -> object:
    """Return the ear of a seed."""
    from sample_volumes.phantom import Ear

    rng = np.random.default_rng([seed, 77])
    chosen = {} if stapes is None else {"stapes": stapes}
    return Ear(
        voxel_mm=(voxel_mm,) * 3,
        gap_mm=float(rng.uniform(0.06, 0.25)),
        psf_voxels=float(rng.uniform(1.0, 1.5)),
        noise=float(rng.uniform(0.02, 0.06)),
        plate_distance_mm=float(rng.uniform(0.25, 0.9)),
        plate_tilt_deg=tuple(rng.uniform(-5.0, 5.0, 2)),
        plate_turn_deg=float(rng.uniform(-20.0, 20.0)),
        tilt_deg=25.0,
        upright=str(rng.choice(["x", "y", "z"])),
        bone=stapes is None,
        density_kg_m3=_DENSITY,
        pose_seed=seed,
        noise_seed=seed,
        **chosen,
    )


def measured(seed: int, voxel_mm: float, stapes: Path | None) -> dict[str, np.ndarray]:
    """Return errors and stated standard deviations of one ear."""
    from legacy.ct_inertia.frames.anatomy import AnatomyHints
    from legacy.ct_inertia.frames.footplate import footplate_frame
    from legacy.ct_inertia.labelling.from_scan import find_bodies
    from legacy.ct_inertia.mass.mass_properties import footplate_mass_matrix, from_density
    from legacy.ct_inertia.volume.volume import Volume
    from sample_volumes.phantom import render, scene, truth

    ear = random_ear(seed, voxel_mm, stapes)
    placed = scene(ear)
    known = truth(placed)
    volume = Volume(render(placed), np.array(ear.voxel_mm), np.zeros(3), np.eye(3))
    started = time.process_time()
    bodies = find_bodies(volume)
    pose = np.array(known["scan_from_footplate"])
    frame = footplate_frame(
        bodies.frame_surface,
        AnatomyHints(pose[:3, 0], {}, None),
        bodies.frame_blur_mm,
        bodies.frame_noise_mm4,
    )
    body = from_density(bodies.moments, ear.density_kg_m3, None)
    matrix = footplate_mass_matrix(body, frame.scan_from_footplate, frame.covariance)
    seconds = time.process_time() - started
    exact = np.array(known["mass_matrix_si"])
    volume_sd = np.sqrt(sum(part[0, 0] for part in bodies.moments.contributions.values()))
    com_sd = np.sqrt(np.diag(sum(part[1:4, 1:4] for part in bodies.moments.contributions.values())))
    com = bodies.moments.centroid_mm - np.array(known["center_of_mass_in_scan_mm"])
    moved = np.linalg.inv(pose) @ frame.scan_from_footplate.matrix
    turned = [moved[2, 1], moved[0, 2], moved[1, 0]]
    return {
        "error": matrix.matrix - exact,
        "sd": matrix.standard_deviation,
        "exact": exact,
        "volume": np.array([bodies.moments.volume_mm3 * 1e-9 / known["volume_m3"] - 1.0]),
        "volume_sd": np.array([volume_sd / bodies.moments.volume_mm3]),
        "com_mm": com,
        "com_sd_mm": com_sd,
        "frame": np.concatenate([moved[:3, 3] * 1e-3, turned]),
        "frame_sd": np.sqrt(np.diag(frame.covariance)),
        "seconds": np.array([seconds]),
        "blur": np.array([bodies.psf_sigma_mm / (voxel_mm * np.hypot(ear.psf_voxels, 12.0**-0.5)) - 1.0]),
    }


def row(name: str, score: np.ndarray, size: np.ndarray, unit: str) -> str:
    """Return a line of the table: scores in stated standard deviations, and the error's size."""
    inside = np.mean(np.abs(score) < 1.96) * 100.0
    rms = float(np.sqrt(np.mean(size**2)))
    return f"| {name} | {rms:.3g} {unit} | {score.mean():+.2f} | {score.std():.2f} | {inside:.0f} % |"


def report(ears: list[dict[str, np.ndarray]]) -> None:
    """Print the tables."""

    def stacked(key: str) -> np.ndarray:
        return np.array([ear[key] for ear in ears])

    error, sd, exact = stacked("error"), stacked("sd"), stacked("exact")
    diagonal = np.sqrt(np.einsum("nii->ni", exact))
    share = error / (diagonal[:, :, None] * diagonal[:, None, :]) * 100.0
    print("| | error (rms) | mean / sd | scatter / sd | 95 % interval holds |")
    print("|-|-|-|-|-|")
    print(row("volume", (stacked("volume") / stacked("volume_sd"))[:, 0], stacked("volume") * 100.0, "%"))
    for axis in range(3):
        score = stacked("com_mm")[:, axis] / stacked("com_sd_mm")[:, axis]
        print(row(f"centre of mass, scan {'xyz'[axis]}", score, stacked("com_mm")[:, axis] * 1e3, "um"))
    frame, frame_sd = stacked("frame"), stacked("frame_sd")
    for k, name in enumerate(_NAMES):
        scale, unit = (1e6, "um") if k < 3 else (np.degrees(1.0), "deg")
        print(row(f"footplate frame, {name}", frame[:, k] / frame_sd[:, k], frame[:, k] * scale, unit))
    scores = []
    for i in range(6):
        for j in range(i, 6):
            if not np.any(sd[:, i, j] > 0.0):
                continue
            score = error[:, i, j] / sd[:, i, j]
            scores.append(score)
            mark = ", reduced" if i in (1, 3, 5) and j in (1, 3, 5) else ""
            print(row(f"M {_NAMES[i]} {_NAMES[j]}{mark}", score, share[:, i, j], "% of sqrt"))
    every = np.concatenate(scores)
    print(row("all entries of M", every, share[:, sd[0] > 0.0].ravel(), "% of sqrt"))
    print(f"largest error of an entry: {np.abs(share).max():.3f} % of sqrt(Mii Mjj)")
    print(f"blur: {100.0 * stacked('blur').mean():+.2f} % +- {100.0 * stacked('blur').std():.2f} %")
    print(f"CPU per ear, scan to mass matrix: {stacked('seconds').mean():.2f} s")


def main() -> None:
    """Measure the ears and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--ears", type=int, default=40)
    parser.add_argument("--voxel-um", type=float, default=25.0)
    parser.add_argument("--seed", type=int, default=1, help="of the first ear")
    parser.add_argument("--phantom", choices=("openear", "analytic", "gutter"), default="openear")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        stapes = None
        if options.phantom == "analytic":
            from sample_volumes.analytic import write_analytic_stapes

            stapes = write_analytic_stapes(Path(folder) / "stapes.ply")
        elif options.phantom == "gutter":
            from sample_volumes.gutter import write_gutter_stapes

            stapes = write_gutter_stapes(Path(folder) / "stapes.ply")
        ears = []
        for k in range(options.ears):
            try:
                ears.append(measured(options.seed + k, options.voxel_um * 1e-3, stapes))
            except ValueError as fault:
                print(f"ear {options.seed + k}: {fault}", file=sys.stderr)
    report(ears)


if __name__ == "__main__":
    main()
