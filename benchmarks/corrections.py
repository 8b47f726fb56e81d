"""Is the motion after ``points2dof --correct`` right within its stated uncertainty?

    python benchmarks/corrections.py --scenes 20
    python benchmarks/corrections.py --stiffness --scenes 4

Bodies and faults are those of ``fault_bodies``. For each fault: how often its channels were corrected, left
out, or not acted on; the error of the motion against the truth, as a share of the motion, before and after;
and how often it lies within 1.96 stated standard deviations (0.95 is right), over all degrees of freedom, for
single lines and for the mean over the lines in proportion to the motion, to which shared errors matter most.
``--stiffness``: the same faults of a stapes on a moving base; how often the entries of K and D, fitted to the
motion as measured and as corrected, lie within 1.96 stated standard deviations of the truth.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.fault_bodies import BODIES, FAULTS, Reading, draw, frequencies, possible
from benchmarks.faults_gate import channels, judged
from benchmarks.fitting_estimators import six_dof
from legacy.fitting.examples.paper import PAPER_DAMPING_CORRECTED, PAPER_STIFFNESS
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.model.inertia import inertia_of
from legacy.fitting.model.parameter_vector import join
from legacy.kinematics.fit_options import Options
from legacy.kinematics.measurement import Measurement
from legacy.kinematics.points2dof import Points2Dof, points2dof
from legacy.kinematics.registration.laser_errors import LaserPriors
from legacy.stapeskit.records.mass_record import MassMatrix
from legacy.stapeskit.spatial import DOF_NAMES
from sample_volumes.shaken_stapes import driven_base, simulated_motion

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
EXACT = LaserPriors(0.0, 0.0, 0.0)


def fitted(reading: Reading, correct: bool, stated: bool = True, position_sd_mm: float = 0.0) -> Points2Dof:
    """Fit a reading whose lasers agree."""
    return judged(reading, stated, position_sd_mm, Options(lasers=EXACT, correct=correct))


def errors(result: Points2Dof, truth: ComplexArray) -> tuple[Array, Array, Array]:
    """Return the rms error over the motion (m,), and errors over stated sd of lines and of their mean."""
    motion = result.motion
    error = motion.q[0, 0] - truth
    weight = truth.conj() / np.sum(np.abs(truth) ** 2, axis=0)
    shared = motion.shared
    slopes = np.zeros((0, *error.shape)) if shared is None else shared.derivatives[:, 0, 0]
    spread = np.zeros((0, 0)) if shared is None else shared.covariance
    noise = np.real(np.einsum("fmm->fm", motion.covariance[0, 0]))
    parts = []
    for part in (np.real, np.imag):
        slope = part(slopes)
        variance = 0.5 * noise + np.einsum("pfm,pq,qfm->fm", slope, spread, slope)
        parts.append(part(error) / np.sqrt(variance))
        mean = part(np.sum(weight * error, axis=0))
        slope = part(np.sum(weight * slopes, axis=1))
        variance = 0.5 * np.sum(np.abs(weight) ** 2 * noise, axis=0) + np.einsum(
            "pm,pq,qm->m", slope, spread, slope
        )
        parts.append(mean / np.sqrt(variance))
    size = np.sqrt(np.sum(np.abs(error) ** 2, axis=0) / np.sum(np.abs(truth) ** 2, axis=0))
    return size, np.concatenate([parts[0], parts[2]]), np.concatenate([parts[1], parts[3]])


def ear(seed: int, body: str, fault: str, lines: int) -> tuple[Measurement, MassMatrix, Array]:
    """Draw a stapes with a fault on a base without; return also its mass, and the entries of K and D."""
    mass, stiffness, damping = six_dof()
    freq = frequencies(lines)
    base = driven_base(freq, DOF_NAMES)
    inertia = inertia_of(mass, DOF_NAMES).rows(DOF_NAMES, ())
    moved = simulated_motion(inertia, stiffness, damping, DOF_NAMES, freq, base, 0.0, None).q[0]
    reading = draw(seed, body, fault, lines=lines, motion=moved[0].T)
    still = draw(seed + 50_000, "shell, 12 points, 3 heads", lines=lines, motion=moved[1].T)
    bodies = (channels(reading, True, 0.0, "stapes"), channels(still, True, 0.0, "base"))
    return (
        Measurement("footplate", ("1",), freq, bodies, 1),
        mass,
        join(PAPER_STIFFNESS, PAPER_DAMPING_CORRECTED),
    )


def stiffness(arguments: argparse.Namespace) -> None:
    """Print how often the entries of K and D hold the truth, by fault."""
    print("| body | fault | acted on | as measured | corrected | worst entry | error over sd, rms |")
    print("|-|-|-|-|-|-|-|")
    every = []
    for body in BODIES:
        for kind, fault in enumerate(("", *FAULTS) if arguments.body in body and BODIES[body][1] > 1 else ()):
            if arguments.fault not in fault:
                continue
            off: tuple[list[Array], list[Array]] = ([], [])
            acted = 0
            for number in range(arguments.scenes):
                seed = 1000 * arguments.seed + 40 * number + kind
                data, mass, truth = ear(seed, body, fault, arguments.lines)
                for correct, kept in enumerate(off):
                    result = points2dof(data, options=Options(lasers=EXACT, correct=bool(correct)))
                    fit = fit_kd(result.motion, mass)
                    error = join(fit.stiffness, fit.damping) - truth
                    kept.append(error / np.sqrt(np.diag(fit.covariance)))
                    acted += bool(result.corrections)
            plain, right = (np.abs(np.array(kept)) for kept in off)
            held = np.mean(right < 1.96, axis=0)
            every.append((fault, right))
            share = f"{acted / arguments.scenes:.2f} | {np.mean(plain < 1.96):.3f}"
            print(
                f"| {body} | {fault or 'none'} | {share} | {np.mean(held):.3f} | {np.min(held):.2f} "
                f"| {np.sqrt(np.mean(right**2)):.2f} |",
                flush=True,
            )
    for name, some in (("with a fault", True), ("without", False)):
        chosen = [right for fault, right in every if bool(fault) is some and fault != "bends 6 %"]
        if chosen:
            whole = np.concatenate(chosen)
            print(f"{len(whole)} files {name}: {np.mean(whole < 1.96):.3f} of the entries held.")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=int, default=10, help="per cell")
    parser.add_argument("--lines", type=int, default=120)
    parser.add_argument("--position-um", type=float, default=0.0, help="position errors, stated")
    parser.add_argument("--no-sd", action="store_true", help="do not state the noise")
    parser.add_argument("--body", default="", help="only bodies whose name holds this")
    parser.add_argument("--fault", default="", help="only faults whose name holds this")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--stiffness", action="store_true", help="of K and D")
    arguments = parser.parse_args()
    if arguments.stiffness:
        stiffness(arguments)
        return
    print(
        "| body | fault | corrected | left out | error before, % | after, % | lines covered | mean covered |"
    )
    print("|-|-|-|-|-|-|-|-|")
    mm, lines = 1e-3 * arguments.position_um, arguments.lines
    for body in BODIES:
        for fault in FAULTS if arguments.body in body else ():
            if not possible(fault, body) or arguments.fault not in fault:
                continue
            before, after, single, mean, actions = [], [], [], [], list[str]()
            for number in range(arguments.scenes):
                seed = 1000 * arguments.seed + number
                truth = draw(seed, body, lines=lines, position_sd_mm=mm).twist.T
                reading = draw(seed, body, fault, lines=lines, position_sd_mm=mm)
                plain, right = (fitted(reading, way, not arguments.no_sd, mm) for way in (False, True))
                places = [("x", "y", "z", "alpha", "beta", "gamma").index(d) for d in right.motion.dof]
                before.append(np.sqrt(np.mean(errors(plain, truth[:, places])[0] ** 2)))
                size, scaled, whole = errors(right, truth[:, places])
                after.append(np.sqrt(np.mean(size**2)))
                single.append(np.mean(np.abs(scaled) < 1.96))
                mean.append(np.mean(np.abs(whole) < 1.96))
                actions += sorted({c.action for c in right.corrections})
            share = [actions.count(name) / arguments.scenes for name in ("corrected", "left out")]
            print(
                f"| {body} | {fault} | {share[0]:.2f} | {share[1]:.2f} | {100 * np.median(before):.2g} | "
                f"{100 * np.median(after):.2g} | {np.mean(single):.3f} | {np.mean(mean):.3f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
