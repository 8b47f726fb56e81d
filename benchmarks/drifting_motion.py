"""Distinguish a motion that drifts while the points are measured from a body that bends.

    python benchmarks/drifting_motion.py --scenes 40

Two simulators that share no code. ``fault_bodies``: a stiffness that rises by 3 %, against a bending of 6 %
measured in any order and along the longest axis of the body. ``fault_scenes``: a motion that becomes another
one by 5 % (points of a stapes are in a ring), against a bending of 3 %. Of each file: it is said to drift; it
is said that a drift and a bending would look alike; nothing is said of a drift.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import fault_bodies, fault_scenes
from benchmarks.fault_bodies import Reading
from legacy.kinematics.faults.proposals.drifting_motion import drifting_motion
from legacy.kinematics.faults.proposals.misfitting_body import MisfittingBody
from legacy.kinematics.faults.proposals.outliers import with_far_values
from legacy.kinematics.fit.beams import beam_set
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.stapeskit.spatial import DOF_NAMES

ONE_HEAD = ("y", "alpha", "gamma")
# The share of a motion that becomes another one from the first point to the last: that of a stiffness that
# rises by 3 % is .05 to .3.
_DRIFT = 0.05
# What is made of ``fault_bodies``, and whether the points are measured along the body.
_MADE = (("drying 3 %", False), ("bends 6 %", False), ("bends 6 %", True))


def said(body: BodyChannels, freq_hz: np.ndarray, dof: tuple[str, ...]) -> str:
    """Return what is said of a drift of a body whose misfit is to be explained."""
    data = Measurement("footplate", ("1",), freq_hz, (body,), 0)
    beams = beam_set(body.body, body.positions_mm, body.directions, dof)
    suspect = with_far_values(MisfittingBody(data, 0, body, beams, True))
    return next(("alike" if remedy.alike else "drift" for remedy, _ in drifting_motion(suspect)), "none")


def of_reading(reading: Reading, along: bool) -> str:
    """Return what is said of a reading of ``fault_bodies``, its points as drawn or along the body."""
    order = np.arange(len(reading.points))
    if along:
        axis = int(np.argmax(np.ptp(reading.positions_mm, axis=0)))
        order = np.argsort(reading.positions_mm[:, axis], kind="stable")
    names = ("positions_mm", "directions", "value", "sd")
    made = replace(reading, **{name: getattr(reading, name)[order] for name in names})
    points = tuple(reading.points[c] for c in order)
    body = BodyChannels("incus", points, made.positions_mm, made.directions, made.value[None], made.sd[None])
    return said(body, made.freq_hz, DOF_NAMES)


def of_scene(geometry: str, seed: int, bends: bool) -> str:
    """Return what is said of a scene of ``fault_scenes`` that bends, or whose motion drifts."""
    made = fault_scenes.scene(910_000 + seed, geometry, "flexible 3 %" if bends else "")
    value = fault_scenes.measured(made, seed)
    if not bends:
        other = fault_scenes.scene(920_000 + seed, geometry, "").q
        names = list(dict.fromkeys(made.points))
        place = np.array([names.index(point) for point in made.points]) / (len(names) - 1)
        rows = np.hstack([made.directions, np.cross(made.reported * 1e-3, made.directions)])
        size = np.sqrt(np.mean(np.abs(made.q) ** 2) / np.mean(np.abs(other) ** 2))
        value = value + _DRIFT * size * place[:, None] * (rows @ other.reshape(len(made.freq_hz), -1).T)
    body = BodyChannels("s", made.points, made.reported, made.directions, value[None], made.sd[None])
    return said(body, made.freq_hz, ONE_HEAD if geometry.startswith("1D") else DOF_NAMES)


def rows() -> Iterator[tuple[str, str, Callable[[int], str]]]:
    """Yield the name of a row, what is wrong, and what is said of a file by its number."""
    for body, (_, heads, *_rest) in fault_bodies.BODIES.items():
        for fault, along in _MADE if heads > 1 else ():
            name = f"{body}, along the body" if along else body
            yield (
                name,
                fault,
                lambda k, body=body, fault=fault, along=along: of_reading(
                    fault_bodies.draw(50_000 + k, body, fault), along
                ),
            )
    for geometry in fault_scenes.GEOMETRIES:
        for bends in (False, True):
            fault = "bends 3 %" if bends else "drifts 5 %"
            yield geometry, fault, lambda k, geometry=geometry, bends=bends: of_scene(geometry, k, bends)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=int, default=40, help="of a row")
    arguments = parser.parse_args()
    start = time.process_time()
    print("| body | what is wrong | said to drift | would look alike | nothing |\n|-|-|-|-|-|")
    for body, fault, judge in rows():
        count = Counter(judge(number) for number in range(arguments.scenes))
        cells = " | ".join(f"{count[word] / arguments.scenes:.2f}" for word in ("drift", "alike", "none"))
        print(f"| {body} | {fault} | {cells} |", flush=True)
    print(f"\n{time.process_time() - start:.0f} s of processor time.")


if __name__ == "__main__":
    main()
