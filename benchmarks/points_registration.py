"""How well is the vibrometer tied to the scan, and does the room say so? Simulated, with known truth.

    python benchmarks/points_registration.py [--draws 2000] [--clouds 40] [--ears 150] [--seed 1] [table ...]

Tables: target, faults, plate, moved, calibrate (all when none is named). Every row follows from the seed.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from legacy.kinematics.fit_options import Options
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.registration.geometry_model import GeometryPriors
from legacy.kinematics.registration.icp import fit_to_surface
from legacy.kinematics.registration.icp_refine import Cloud
from legacy.stapeskit.alignment.registration import displacement, fit_rigid
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.frames import RigidTransform, rotation_from_vector
from tests.kinematics.registration.test_calibrate import COUNT, ear, nees
from tests.kinematics.surfaces import box, on_faces, wedge
from tests.stapeskit.alignment.test_registration import fitzpatrick_west

Array = np.ndarray
CORNERS = np.array([[-10.0, 0, -8], [10, 0, -8], [10, 0, 8], [-10, 0, 8]])
MARKS = {
    "3 corners of a 20 x 16 mm plate": CORNERS[:3],
    "4 corners": CORNERS,
    "4 corners, 1 mark 3 mm above": np.vstack([CORNERS, [[0.0, 3.0, 0.0]]]),
    "4 corners, 2 marks above": np.vstack([CORNERS, [[0.0, 3.0, 0.0], [4.0, 5.0, -3.0]]]),
    "sample study: 4 corners and 2 pins of a 4 mm plate": np.array(
        [
            [-2.1, 0, -1.4],
            [2.1, 0, -1.4],
            [2.1, 0, 1.4],
            [-2.1, 0, 1.4],
            [-1.95, 0.7, 1.3],
            [1.95, 0.45, -1.3],
        ]
    ),
    "10 marks in the volume": np.random.default_rng(3).uniform(-8.0, 8.0, (10, 3)),
}
FOOTPLATE = np.array([[0.0, 8.0, 0.0]])
UP = np.array([0.3, 0.9, 0.3])


def pose_of(rng: np.random.Generator) -> RigidTransform:
    """Return a random scan_from_vibrometer."""
    turn = rotation_from_vector(rng.uniform(-1.8, 1.8, 3))
    return RigidTransform.from_parts(turn, rng.uniform(-60.0, 60.0, 3), "plate", "vibrometer")


def target_rows(draws: int, seed: int) -> list[str]:
    """Return the table of target registration errors at the footplate centre."""
    rows = [
        "| fiducials | sd, um | error at the footplate, um: Monte Carlo | predicted | Fitzpatrick-West "
        "| predicted / Monte Carlo | pose: squared distance / 6 |",
        "|-|-|-|-|-|-|-|",
    ]
    for name, marks in MARKS.items():
        for spread in ((0.05,) * 3, (0.02, 0.02, 0.2)):
            rng = np.random.default_rng([seed, len(rows)])
            sd = np.array(spread)
            misses, distances, stated = [], [], []
            for _ in range(draws):
                pose = pose_of(rng)
                seen = pose.inverse().points(marks) + sd * rng.normal(size=marks.shape)
                fit = fit_rigid(seen, marks, np.tile(sd, (len(marks), 1)), to="plate", source="vibrometer")
                there = pose.inverse().points(FOOTPLATE)
                misses.append(np.linalg.norm(fit.transform.points(there) - FOOTPLATE))
                error = displacement(fit.transform, pose)
                distances.append(error @ np.linalg.solve(fit.covariance_si, error))
                stated.append(fit.target_registration_error(there)[0])
            rms, predicted = (1e3 * np.sqrt(np.mean(np.square(part))) for part in (misses, stated))
            alike = len(set(spread)) == 1
            formula = f"{1e3 * fitzpatrick_west(marks, FOOTPLATE[0], spread[0]):.1f}" if alike else ""
            words = f"{spread[0] * 1e3:g}" if alike else f"{spread[0] * 1e3:g}, depth {spread[2] * 1e3:g}"
            rows.append(
                f"| {name} | {words} | {rms:.1f} | {predicted:.1f} | {formula} | {predicted / rms:.3f} "
                f"| {np.mean(distances) / 6.0:.3f} |"
            )
    return rows


def fault_rows(draws: int, seed: int) -> list[str]:
    """Return the table of fiducials with one fault: how often it is told, and the culprit named."""
    rows = [
        "| fiducials | fault | sd stated: told, culprit named | not stated: told, culprit named |",
        "|-|-|-|-|",
    ]
    for name, marks in list(MARKS.items())[2:]:
        for fault in (
            "none",
            "one coordinate 0.3 mm off",
            "one coordinate 1 mm off",
            "two exchanged",
            "mirrored",
        ):
            cells = []
            for stated in (True, False):
                warned, named = 0, 0
                for draw in range(draws):
                    rng = np.random.default_rng([seed, draw, 7])
                    text, culprits = _with_fault(rng, marks, fault, stated)
                    warned += bool(text)
                    named += bool(text) and all(
                        f" {culprit} " in text.replace(",", " ") for culprit in culprits
                    )
                cells.append(
                    f"{100 * warned / draws:.1f} %" + (f", {100 * named / draws:.1f} %" if culprits else "")
                )
            rows.append(f"| {name} | {fault} | {cells[0]} | {cells[1]} |")
    return rows


def _with_fault(rng: np.random.Generator, marks: Array, fault: str, stated: bool) -> tuple[str, list[str]]:
    names = tuple(f"m{k}" for k in range(len(marks)))
    pose = pose_of(rng)
    seen = pose.inverse().points(marks) + 0.02 * rng.normal(size=marks.shape)
    known, culprits = marks.copy(), []
    i, j = rng.choice(len(marks), 2, replace=False)
    if fault.startswith("one"):
        known[i, rng.integers(3)] += 0.3 if "0.3" in fault else 1.0
        culprits = [names[i]]
    elif fault == "two exchanged":
        known[[i, j]] = known[[j, i]]
        culprits = [names[i], names[j]]
    elif fault == "mirrored":
        seen = seen * [1.0, -1.0, 1.0]
        culprits = ["--mirror"]
    try:
        fit = fit_rigid(seen, known, 0.02 if stated else None, to="plate", source="vibrometer", names=names)
    except StapeskitError as refused:
        return f" {refused} ", culprits
    texts = [notice.text for notice in fit.notices if notice.code == "fiducials_inconsistent"]
    return (f" {texts[0]} " if texts else ""), culprits


def plate_rows(clouds: int, seed: int) -> list[str]:
    """Return the table of plate points laid on the plate without a first guess."""
    rows = [
        "| plate | points, sd um | refused | wrong by > 0.1 mm | error 1 mm above the plate, um: found / "
        "predicted | pose: squared distance / 6 | CPU s |",
        "|-|-|-|-|-|-|-|",
    ]
    plain = box([-2.1, -1.0, -1.4], [2.1, 0.0, 1.4])
    stapes = box([0.3, 1.0, -0.4], [1.9, 3.5, 0.2])
    every = (("with leaning sides", wedge(), False), ("box, 8 points on the stapes decide", plain, True))
    for name, plate, decided in every:
        for count, sd in ((20, 0.01), (50, 0.01), (50, 0.03), (200, 0.03)):
            refused, wrong, misses, stated, distances = 0, 0, [], [], []
            start = time.process_time()
            for draw in range(clouds):
                rng = np.random.default_rng([seed, draw, count])
                pose = pose_of(rng)
                seen = pose.inverse().points(on_faces(plate, rng, count)) + sd * rng.normal(size=(count, 3))
                towards = pose.inverse().vectors(UP / np.linalg.norm(UP))
                others = [(pose.inverse().points(on_faces(stapes, rng, 8)), stapes)] if decided else []
                cloud = Cloud(tuple(str(k) for k in range(count)), seen, np.full(count, sd))
                try:
                    fit = fit_to_surface(cloud, plate, towards=towards, witnesses=others, surface_sd_mm=0.0)
                except StapeskitError:
                    refused += 1
                    continue
                there = pose.inverse().points([[0.0, 1.0, 0.0]])
                miss = float(np.linalg.norm(fit.registration.transform.points(there) - [[0.0, 1.0, 0.0]]))
                if miss > 0.1:
                    wrong += 1
                    continue
                misses.append(miss)
                stated.append(fit.registration.target_registration_error(there)[0])
                error = displacement(fit.registration.transform, pose)
                distances.append(error @ np.linalg.solve(fit.registration.covariance_si, error))
            spent = (time.process_time() - start) / clouds
            rms, predicted = (1e3 * np.sqrt(np.mean(np.square(part))) for part in (misses, stated))
            rows.append(
                f"| {name} | {count}, {1e3 * sd:g} | {refused} of {clouds} | {wrong} | {rms:.1f} / "
                f"{predicted:.1f} | {np.mean(distances) / 6.0:.2f} | {spent:.1f} |"
            )
    return rows


def moved_rows(clouds: int, seed: int) -> list[str]:
    """Return the table of a bone that shifted between scan and measurement."""
    import tempfile

    from tests.kinematics.registration import test_sample_displacement as scenes

    rows = [
        "| 9 points on bone, shifted along its normal by | told (sd stated) | shift found, um "
        "| told (sd not stated) | points of the stapes in their place: told |",
        "|-|-|-|-|-|",
    ]
    with tempfile.TemporaryDirectory() as folder:
        scan = scenes.write_scan(Path(folder))
        for shift in (0.0, 0.03, 0.05, 0.1, 0.2):
            cells, sizes, others = [], [], 0
            for stated in (True, False):
                warned = 0
                for draw in range(clouds):
                    given = scenes.setting(1000 * seed + draw, shift=(0.0, 0.0, shift), stated=stated)
                    stapes, base = scenes.checked(scan, *given).checks
                    warned += any(notice.code == "sample_moved" for notice in base.notices)
                    others += bool(stapes.notices)
                    if stated:
                        sizes.append(1e3 * float((scenes.SCAN_FROM_FOOTPLATE.rotation @ base.shift_mm)[2]))
                cells.append(f"{100 * warned / clouds:.0f} %")
            rows.append(
                f"| {1e3 * shift:.0f} um | {cells[0]} | {np.mean(sizes):.0f} ± {np.std(sizes):.0f} "
                f"| {cells[1]} | {100 * others / (2 * clouds):.1f} % |"
            )
    return rows


def calibrate_rows(ears: int, seed: int) -> list[str]:
    """Return the table of joint estimates of geometry and motion."""
    rows = [
        f"| {COUNT} points x 3 lasers on each of 2 bodies; sd of positions, axes, lasers, gains | peak/noise "
        "| squared distance per degree of freedom: fitted as stated | with --calibrate | error of q "
        "against fitted as stated | sd of the axes after |",
        "|-|-|-|-|-|-|",
    ]
    cases: tuple[dict[str, float], ...] = (
        {},
        {"snr": 10.0},
        {"pos": 0.02, "axes": 2.0},
        {"pos": 0.01, "axes": 1.0, "beam": 0.2},
        {"gain": 1.0},
    )
    for case in cases:
        full = {"pos": 0.05, "axes": 1.0, "beam": 0.5, "gain": 0.0, "snr": 100.0} | case
        priors = GeometryPriors(full["axes"], full["beam"], full["gain"])
        plain, joint, ratio, spread = [], [], [], []
        for draw in range(ears):
            measurement, truth, _ = ear(100_000 * seed + draw, **full)
            before = points2dof(measurement)
            after = points2dof(measurement, options=Options(calibrate=priors))
            plain.append(nees(before, truth))
            joint.append(nees(after, truth))
            errors = [
                np.sum(np.abs(result.motion.q[0] - truth) ** 2, axis=(0, 1)) for result in (before, after)
            ]
            ratio.append(np.median(errors[1] / errors[0]))
            fit = after.calibration
            if fit is not None:
                spread.append(np.rad2deg(fit.sd[:3].mean()))
        rows.append(
            f"| {full['pos'] * 1e3:g} um, {full['axes']:g}°, {full['beam']:g}°, {full['gain']:g} % "
            f"| {full['snr']:g} | {np.mean(plain):.2f} | {np.mean(joint):.2f} "
            f"± {np.std(joint) / np.sqrt(ears):.2f} "
            f"| {np.sqrt(np.median(ratio)):.2f} | {np.mean(spread):.2f}° |"
        )
    return rows


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tables", nargs="*", metavar="table")
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--clouds", type=int, default=40)
    parser.add_argument("--ears", type=int, default=150)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    tables: dict[str, Callable[[], list[str]]] = {
        "target": lambda: target_rows(options.draws, options.seed),
        "faults": lambda: fault_rows(max(options.draws // 5, 1), options.seed),
        "plate": lambda: plate_rows(options.clouds, options.seed),
        "moved": lambda: moved_rows(options.clouds, options.seed),
        "calibrate": lambda: calibrate_rows(options.ears, options.seed),
    }
    unknown = [name for name in options.tables if name not in tables]
    if unknown:
        parser.error(f"tables are {', '.join(tables)}; got {', '.join(unknown)}")
    for name in options.tables or tables:
        print(f"\n**{name}** (seed {options.seed})\n", *tables[name](), sep="\n", flush=True)


if __name__ == "__main__":
    main()
