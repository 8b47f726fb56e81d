"""Name faults in bodies that no search was developed on, and count false alarms in files without any.

    python benchmarks/faults_gate.py faults --scenes 10
    python benchmarks/faults_gate.py faults --no-sd --gaps 0.2
    python benchmarks/faults_gate.py faults --scatter
    python benchmarks/faults_gate.py clean --scenes 50
    python benchmarks/faults_gate.py clean --only-lines 800 --scenes 300
    python benchmarks/faults_gate.py clean --only-lines 34 --runs 3 --scenes 300

``faults``: for each body and fault, how often anything was found, the culprits named, and the kind right;
with ``--scatter`` the heads differ by 1 %, 0.5 degrees and 1 us (sd), as is taken of them by default.
``clean``: how often a file without fault raised an alarm, for 2 to 800 lines, stated and unstated noise,
stated position errors, and gaps, in one run or several of the same motion; 1 % is right.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.fault_bodies import BODIES, FAULTS, Reading, draw, possible
from legacy.kinematics.fit_options import Options
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.kinematics.points2dof import Points2Dof, points2dof
from legacy.kinematics.registration.laser_errors import LaserPriors


def channels(reading: Reading, stated: bool, position_sd_mm: float, name: str = "incus") -> BodyChannels:
    """Return a reading, of one run or (run, channel, freq), as a body of a measurement."""
    values = reading.value.reshape(-1, *reading.sd.shape)
    return BodyChannels(
        name,
        tuple(reading.points),
        reading.positions_mm,
        reading.directions,
        values,
        np.broadcast_to(reading.sd, values.shape) if stated else None,
        not stated,
        np.full(len(reading.points), position_sd_mm or np.nan),
    )


def judged(
    reading: Reading, stated: bool = True, position_sd_mm: float = 0.0, options: Options | None = None
) -> Points2Dof:
    """Run the diagnosis on a reading; one head sees three degrees of freedom."""
    body = channels(reading, stated, position_sd_mm)
    runs = tuple(str(run + 1) for run in range(len(body.displacement)))
    data = Measurement("footplate", runs, reading.freq_hz, (body,), 1)
    options = options or Options()
    if reading.head.max() == 0:
        options = replace(options, dof=("y", "alpha", "gamma"))
    return points2dof(data, options=options)


def scattered(reading: Reading, seed: int) -> Reading:
    """Return a reading of heads that differ in gain, phase and delay as `LaserPriors` has it by default."""
    prior = LaserPriors()
    rng = np.random.default_rng([seed, 17])
    gain, phase, delay = rng.normal(size=(3, reading.head.max() + 1, 1))
    lag = np.radians(prior.phase_sd_deg) * phase
    lag = lag - 2.0 * np.pi * reading.freq_hz * prior.delay_sd_us * 1e-6 * delay
    factor = (1.0 + prior.gain_sd_percent / 100.0 * gain) * np.exp(1j * lag)
    return replace(reading, value=reading.value * factor[reading.head])


def repeated(seed: int, body: str, runs: int, noise: float, **given: float) -> Reading:
    """Simulate readings (run, channel, freq): one motion of the body, and independent noise in each value."""
    reading = draw(seed, body, noise=_QUIET, **given)
    rng = np.random.default_rng([seed, 3])
    sd = noise / _QUIET * reading.sd
    error = rng.normal(size=(runs, *sd.shape)) + 1j * rng.normal(size=(runs, *sd.shape))
    return replace(reading, value=reading.value + sd * error, sd=sd)


def faults(arguments: argparse.Namespace) -> Iterator[str]:
    """Yield the rows of the table of faults."""
    yield "| body | fault | found | culprit named | right kind |\n|-|-|-|-|-|"
    for body in BODIES:
        for fault in FAULTS if arguments.body in body else ():
            if not possible(fault, body) or arguments.fault not in fault:
                continue
            detected = named = right = 0
            for number in range(arguments.scenes):
                seed = 1000 * arguments.seed + number
                reading = draw(
                    seed, body, fault, lines=arguments.lines, gaps=arguments.gaps,
                    position_sd_mm=1e-3 * arguments.position_um,
                )  # fmt: skip
                if arguments.scatter:
                    reading = scattered(reading, seed)
                result = judged(reading, not arguments.no_sd, 1e-3 * arguments.position_um)
                accused = {c: v.verdict for c, v in enumerate(result.channels) if v.verdict != "ok"}
                detected += bool(accused)
                named += sorted(accused) == reading.culprits
                right += accused == reading.expected
                if arguments.show and accused != reading.expected:
                    verdicts = {(v.verdict, v.estimate) for v in result.channels if v.verdict != "ok"}
                    print(
                        f"  {body}; {fault}; {seed}; {reading.culprits[:6]}: {sorted(accused)[:8]} {verdicts}"
                    )
            n = arguments.scenes
            yield f"| {body} | {fault} | {detected / n:.2f} | {named / n:.2f} | {right / n:.2f} |"


# Noise of a reading before that of several runs is added: negligible, but not zero, for the sd scale with it.
_QUIET = 1e-9
# Lines, standard deviation of the positions (um), share missing.
CONDITIONS = (
    (2, 0.0, 0.0),
    (8, 0.0, 0.0),
    (8, 30.0, 0.0),
    (12, 30.0, 0.0),
    (34, 0.0, 0.0),
    (34, 30.0, 0.0),
    (200, 0.0, 0.0),
    (200, 30.0, 0.0),
    (60, 0.0, 0.2),
    (60, 30.0, 0.2),
    (800, 0.0, 0.0),
)


def clean(arguments: argparse.Namespace) -> Iterator[str]:
    """Yield the rows of the table of false alarms."""
    yield "| body | lines | positions um | missing | alarms, sd stated | alarms, no sd |\n|-|-|-|-|-|-|"
    for body in BODIES:
        for lines, um, gaps in CONDITIONS if arguments.body in body else ():
            if arguments.only_lines and lines != arguments.only_lines:
                continue
            alarms = {True: 0, False: 0}
            for number in range(arguments.scenes):
                seed = (
                    700_000 + 1000 * arguments.seed + number + 100_000 * CONDITIONS.index((lines, um, gaps))
                )
                given = {"lines": lines, "position_sd_mm": 1e-3 * um, "gaps": gaps, "noise": arguments.noise}
                reading = (
                    draw(seed, body, **given)
                    if arguments.runs == 1
                    else repeated(seed, body, arguments.runs, **given)
                )
                for stated in alarms:
                    result = judged(reading, stated, 1e-3 * um)
                    wrong = [v for v in result.channels if v.verdict != "ok"]
                    alarms[stated] += bool(wrong)
                    if wrong and arguments.show:
                        print(
                            "  ",
                            body,
                            lines,
                            um,
                            gaps,
                            seed,
                            stated,
                            {(v.verdict, v.estimate) for v in wrong},
                        )
            n = arguments.scenes
            shares = f"{alarms[True] / n:.3f} | {alarms[False] / n:.3f}"
            yield f"| {body} | {lines} | {um:g} | {gaps:g} | {shares} |"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("faults", "clean"))
    parser.add_argument("--scenes", type=int, default=10, help="per cell")
    parser.add_argument("--lines", type=int, default=120)
    parser.add_argument("--only-lines", type=int, default=0, help="clean files of this number of lines")
    parser.add_argument("--runs", type=int, default=1, help="runs of a clean file")
    parser.add_argument("--noise", type=float, default=0.01, help="of clean files")
    parser.add_argument("--gaps", type=float, default=0.0, help="share of values missing")
    parser.add_argument("--position-um", type=float, default=0.0, help="position errors, stated")
    parser.add_argument("--scatter", action="store_true", help="of the heads, in readings with a fault")
    parser.add_argument("--no-sd", action="store_true", help="do not state the noise")
    parser.add_argument("--body", default="", help="only bodies whose name holds this")
    parser.add_argument("--fault", default="", help="only faults whose name holds this")
    parser.add_argument("--show", action="store_true", help="list every scene that went wrong")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    start = time.process_time()
    for row in (faults if arguments.what == "faults" else clean)(arguments):
        print(row, flush=True)
    print(f"\n{time.process_time() - start:.0f} s of processor time, seed {arguments.seed}.")


if __name__ == "__main__":
    main()
