"""A fault put into any one channel of the sample study: is it found, and named?

    python benchmarks/points_sample.py

Every channel of both bodies in turn reads 5 % too much, with the opposite sign, from a beam 5 degrees off,
with five
times its noise, or zero; every point in turn lies 200 um off or exchanges its name with the next one.
Position errors
of the stated size are in the data.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from kinematics.frames import rotation_from_vector
from kinematics.measurement import BodyChannels, Measurement
from kinematics.points2dof import points2dof

KINDS = ("gain", "sign", "direction", "noise", "zeros", "position", "label_swap")
SAMPLE = Path(__file__).resolve().parents[1] / "sample_volumes"


def sample() -> Measurement:
    """Return the recording of the sample study in its own frame."""
    from kinematics.readers import read_measurement

    data = read_measurement((SAMPLE / "ldv.csv",), SAMPLE / "points.csv", "vibrometer")
    return replace(data, frame="footplate")


def spoiled(body: BodyChannels, kind: str, channel: int, seed: int) -> tuple[BodyChannels, list[int]]:
    """Return the body with a fault at a channel, or at its point, and the culprits."""
    rng = np.random.default_rng([seed, channel, 61])
    value, positions, directions = body.displacement.copy(), body.positions_mm.copy(), body.directions.copy()
    own = [c for c, name in enumerate(body.points) if name == body.points[channel]]
    culprits = [channel]
    if kind == "gain":
        value[:, channel] *= 1.05
    elif kind == "sign":
        value[:, channel] *= -1.0
    elif kind == "zeros":
        value[:, channel] = 0.0
    elif kind == "noise":
        noise = rng.normal(size=(*value[:, channel].shape, 2)) @ np.array([1.0, 1j])
        value[:, channel] += np.sqrt(24.0) * np.asarray(body.sd)[:, channel] * noise
    elif kind == "direction":
        axis = np.cross(directions[channel], rng.normal(size=3))
        turn = rotation_from_vector(np.radians(5.0) * axis / np.linalg.norm(axis))
        directions[channel] = turn @ directions[channel]
    elif kind == "position":
        shift = rng.normal(size=3)
        positions[own] += 0.2 * shift / np.linalg.norm(shift)
        culprits = own
    else:
        names = list(dict.fromkeys(body.points))
        partner = names[(names.index(body.points[channel]) + 1) % len(names)]
        others = [c for c, name in enumerate(body.points) if name == partner]
        positions[own], positions[others] = body.positions_mm[others[0]], body.positions_mm[own[0]]
        culprits = sorted(own + others)
    made = replace(
        body,
        displacement=value,
        positions_mm=positions,
        directions=directions,
        reported_directions=body.reported_directions,
    )
    return made, culprits


def judged(
    data: Measurement, number: int, kind: str, channel: int, seed: int
) -> tuple[tuple[bool, bool, bool], str]:
    """Return whether a fault was found, at the culprit alone, and as what it is; and what was said."""
    body, culprits = spoiled(data.bodies[number], kind, channel, seed)
    bodies = tuple(body if k == number else other for k, other in enumerate(data.bodies))
    result = points2dof(replace(data, bodies=bodies))
    start = sum(len(other.points) for other in data.bodies[:number])
    wrong = {k: v for k, v in enumerate(result.channels) if v.verdict != "ok"}
    named = set(wrong) == {start + c for c in culprits}
    said = "; ".join(sorted({f"{v.body} {v.point} {v.verdict}: {v.estimate}" for v in wrong.values()}))
    right = named and {v.verdict for v in wrong.values()} == {kind}
    return (bool(wrong), named, right), said


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--body", default="", help="only this body")
    parser.add_argument("--kind", default="", help="only this kind of fault")
    parser.add_argument("--show", action="store_true", help="tell every case that went wrong")
    arguments = parser.parse_args()
    start = time.process_time()
    data = sample()
    print("| body | fault | cases | found | culprit named | right kind |\n|-|-|-|-|-|-|")
    for number, body in enumerate(data.bodies):
        for kind in KINDS if arguments.body in ("", body.body) else ():
            if arguments.kind not in ("", kind):
                continue
            step = 3 if kind in ("position", "label_swap") else 1
            cases = range(0, len(body.points), step)
            told = [judged(data, number, kind, channel, arguments.seed) for channel in cases]
            sums = [sum(case[0][k] for case in told) for k in range(3)]
            print(f"| {body.body} | {kind} | {len(told)} | " + " | ".join(map(str, sums)) + " |", flush=True)
            if arguments.show:
                for channel, case in zip(cases, told, strict=True):
                    if not case[0][2]:
                        print(f"    {body.channel_name(channel)}: {case[1] or 'nothing'}")
    print(f"\n{time.process_time() - start:.0f} s of processor time, seed {arguments.seed}.")


if __name__ == "__main__":
    main()
