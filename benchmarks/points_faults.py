"""Are faults of channels found, the culprit named, and the kind of fault right? Random scenes tell.

    python benchmarks/points_faults.py --scenes 40 --seed 1

For each geometry and fault: how often anything was found; the power that no test can exceed (known: Neyman
and Pearson's test of this very fault, its kind, place and size known); that of the best test that looks for
all kinds at all places and lets lasers scatter as stated (sought); how often the culprit was named; how often
the likeliest culprit is the true one when all but its place is known (bound); how often the kind was right;
and in what share of the scenes other channels are accused. Clean files: how often any alarm was raised, which
is to be 1 %, and how the p-values of the channels are spread.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.fault_bounds import bound, bound_of_search, nameable
from benchmarks.fault_scenes import FAULTS, GEOMETRIES, Scene, measured, possible, scene
from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.fit_options import Options
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.kinematics.points2dof import Points2Dof, points2dof


def judged(
    case: Scene,
    seed: int,
    stated: bool = True,
    position_sd_mm: float = 0.0,
    value: NDArray[np.complex128] | None = None,
) -> Points2Dof:
    """Run the diagnosis on a scene, by default on readings (channel, freq) with noise of this seed."""
    flat = len({tuple(d) for d in case.directions}) == 1
    body = BodyChannels(
        "stapes",
        case.points,
        case.reported,
        case.directions,
        (measured(case, seed) if value is None else value)[None],
        case.sd[None] if stated else None,
        not stated,
        np.full(len(case.points), position_sd_mm or np.nan),
    )
    data = Measurement("footplate", ("1",), case.freq_hz, (body,), 0)
    return points2dof(data, options=Options(("y", "alpha", "gamma")) if flat else None)


def table(arguments: argparse.Namespace) -> Iterator[str]:
    """Yield the lines of the markdown table of one setting as they come."""
    columns = "found | known | sought | culprit named | bound | right kind | others accused"
    yield f"| geometry | fault | {columns} |"
    yield "|-|-|-|-|-|-|-|-|-|"
    sd = arguments.position_um * 1e-3
    for geometry in GEOMETRIES:
        for fault in FAULTS if arguments.geometry in geometry else ():
            if not possible(fault, geometry) or (arguments.fault and arguments.fault not in fault):
                continue
            detected = named = right = beside = likeliest = 0
            best, sought = [], []
            for number in range(arguments.scenes):
                seed = 1000 * arguments.seed + number
                case = scene(
                    seed, geometry, fault, noise=arguments.noise, lines=arguments.lines, position_sd_mm=sd
                )
                stated = 0.0 if arguments.positions_unstated else sd
                try:
                    result = judged(case, seed, not arguments.no_sd, stated)
                except KinematicsError as refused:  # found, and no culprit named
                    detected += 1
                    if arguments.show:
                        print(f"{geometry}; {fault}; {seed}; {case.culprits[:6]}: {refused}")
                    continue
                accused = {c: v.verdict for c, v in enumerate(result.channels) if v.verdict != "ok"}
                detected += bool(accused)
                named += set(accused) == set(case.culprits)
                right += accused == dict.fromkeys(case.culprits, case.verdict)
                beside += bool(set(accused) - set(case.culprits))
                best.append(bound(case, stated) if fault != "zeros" else 1.0)
                sought.append(
                    bound_of_search(case, seed, geometry, fault, noise=arguments.noise, lines=arguments.lines)
                )
                likeliest += nameable(seed, geometry, fault, noise=arguments.noise, lines=arguments.lines)
                if arguments.show and accused != dict.fromkeys(case.culprits, case.verdict):
                    verdicts = {(v.verdict, v.estimate) for v in result.channels if v.verdict != "ok"}
                    print(
                        f"{geometry}; {fault}; {seed}; {case.culprits[:6]}: {sorted(accused)[:8]} {verdicts}"
                    )
            n = arguments.scenes
            yield (
                f"| {geometry} | {fault} | {detected / n:.3f} | {np.mean(best or 1.0):.3f} | "
                f"{'-' if sd else f'{np.mean(sought or 1.0):.3f}'} | "
                f"{named / n:.3f} | {likeliest / n:.3f} | {right / n:.3f} | {beside / n:.2f} |"
            )


def clean(arguments: argparse.Namespace) -> list[str]:
    """Return the false alarms and the spread of the p-values of clean files."""
    from scipy.stats import kstest

    rows = ["| geometry | files with an alarm | p of channels < 0.05 | p-values uniform (KS) |", "|-|-|-|-|"]
    sd = arguments.position_um * 1e-3
    for geometry in GEOMETRIES:
        if arguments.geometry not in geometry:
            continue
        alarms, chances = 0, []
        for number in range(arguments.clean):
            seed = 500_000 + 1000 * arguments.seed + number
            case = scene(seed, geometry, noise=arguments.noise, lines=arguments.lines, position_sd_mm=sd)
            stated = 0.0 if arguments.positions_unstated else sd
            result = judged(case, seed, not arguments.no_sd, stated)
            wrong = [v for v in result.channels if v.verdict != "ok"]
            alarms += bool(wrong)
            if wrong and arguments.show:
                print(geometry, seed, {(v.point, v.verdict, v.estimate, v.p_value) for v in wrong})
            chances += [v.p_value for v in result.channels]
        p = np.array(chances)
        rows.append(
            f"| {geometry} | {alarms / max(arguments.clean, 1):.4f} | {np.mean(p < 0.05):.4f} | "
            f"{kstest(p, 'uniform').pvalue:.2g} |"
        )
    return rows


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=int, default=40, help="scenes per fault")
    parser.add_argument("--clean", type=int, default=200, help="clean scenes per geometry")
    parser.add_argument("--noise", type=float, default=0.01, help="noise over the rms of the signal")
    parser.add_argument("--lines", type=int, default=120)
    parser.add_argument("--position-um", type=float, default=0.0, help="position errors, standard deviation")
    parser.add_argument("--positions-unstated", action="store_true", help="do not state them")
    parser.add_argument("--no-sd", action="store_true", help="do not state the noise")
    parser.add_argument("--geometry", default="", help="only geometries whose name holds this")
    parser.add_argument("--fault", default="", help="only faults whose name holds this")
    parser.add_argument("--show", action="store_true", help="tell every scene that went wrong")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    start = time.process_time()
    if arguments.scenes:
        for line in table(arguments):
            print(line, flush=True)
    if arguments.clean:
        print("\n".join(["", *clean(arguments)]))
    print(f"\n{time.process_time() - start:.0f} s of processor time, seed {arguments.seed}.")


if __name__ == "__main__":
    main()
