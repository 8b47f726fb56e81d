"""Coverage of the intervals of K and D, and naming of errors, on simulated ears.

The simulation shares no code with fitting.

    python benchmarks/model_errors.py [EARS] [--table intervals|causes|laws|branches|alarms|couplings|all]
                                      [--noise 0.5,1,3] [--height 0,0.1,0.3]

intervals: every cell draws EARS ears (benchmarks/ring_ears.py) with all shared errors, without and with
fluid, and prints how many entries lie outside their 95 % interval, K33's median bias, false alarms and the
time of a fit. causes: one error of known size an ear, 1 % noise: how often there is a warning, how often it
is named first or among the look-alikes, in how many ears it could be (where the mass matrix is wrong: chi2
falls by more than ln(number of data) when it is right), and the errors of K and D in their own sd
before and after it is corrected; before it also without the part of what the model lacks. laws: how often
``compare`` names the law at 3 % noise, in a wide and a narrow band, calls it undetermined or names a wrong
one, coverage, and below which noise the right law can be told from the nearest other one in 95 %. branches:
which law ``compare`` chooses for a ligament with two relaxation times. alarms: EARS ears without any error,
whose height, noise, law and mass of fluid are drawn and whose law and fluid are stated: how often there is an
alarm, and how many entries the 95 % intervals hold. couplings: the latter for even rings tilted by 1 degree,
and for rings as the prior of the ligament's plane allows for (benchmarks/ligament_prior.py).
"""

from __future__ import annotations

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy is loaded: times are of one thread

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from legacy.fitting.budget import MODEL_ERROR
from legacy.fitting.causes.refits import rarity_penalty
from legacy.fitting.kd_fit import KDFit
from legacy.fitting.model.parameter_vector import entry_names, join, pairs
from legacy.fitting.options import CORRECT

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.law_errors import branches, laws
from benchmarks.ring_ears import (
    ERRORS,
    LAWS,
    EarSettings,
    SimulatedEar,
    ear,
    point_mass,
)
from benchmarks.simulated_fits import ALARMS, BLOCK, PLAIN, fitted, row, table, truth


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("ears", type=int, nargs="?", default=20)
    tables = ["intervals", "causes", "laws", "branches", "alarms", "couplings", "all"]
    parser.add_argument("--table", choices=tables, default="all")
    parser.add_argument("--noise", default="0.5,1,3,5")
    parser.add_argument("--height", default="0,0.1,0.3")
    chosen = parser.parse_args()
    if chosen.table in ("intervals", "all"):
        intervals(chosen)
    if chosen.table in ("causes", "all"):
        causes(chosen.ears)
    if chosen.table in ("laws", "all"):
        laws(chosen.ears)
    if chosen.table in ("alarms", "all"):
        alarms(chosen.ears)
    if chosen.table in ("couplings", "all"):
        couplings(chosen.ears)
    if chosen.table in ("branches", "all"):
        branches(chosen.ears, [float(value) / 100.0 for value in chosen.noise.split(",")])


def relative(fit: KDFit, case: SimulatedEar) -> np.ndarray:
    """Return the errors over sqrt(Xii Xjj), (12,)."""
    sizes = []
    for part in (case.stiffness[BLOCK], case.damping[BLOCK]):
        root = np.sqrt(np.diag(part))
        sizes += [root[row] * root[column] for row, column in pairs(3)]
    return (join(fit.stiffness, fit.damping) - truth(case)) / np.array(sizes)


def intervals(chosen: argparse.Namespace) -> None:
    """Print coverage, bias and false alarms, cell by cell and over all."""
    table(
        "height (mm)",
        "noise (%)",
        "fluid (mg)",
        "outside 95 % (%)",
        "worst",
        "K33 bias (%)",
        "bias / sd",
        "alarms",
        "ms",
    )
    kept: dict[str, list[np.ndarray]] = {"without fluid": [], "with fluid": [], "all": []}
    alarms = dict.fromkeys(kept, 0)
    for height in (float(value) for value in chosen.height.split(",")):
        for noise in (float(value) for value in chosen.noise.split(",")):
            for fluid in (0.0, 0.5):
                settings = EarSettings(height, noise / 100.0, cause="fluid" if fluid else "", size=fluid)
                off, bias, spent, raised, mass_off = [], [], 0.0, 0, []
                for number in range(chosen.ears):
                    case = ear(
                        settings,
                        np.random.default_rng([number, round(1e3 * height), round(1e3 * noise), fluid > 0]),
                    )
                    start = time.process_time()
                    fit = fitted(case)
                    spent += time.process_time() - start
                    if fit is None:
                        continue
                    off.append(
                        (join(fit.stiffness, fit.damping) - truth(case)) / np.sqrt(np.diag(fit.covariance))
                    )
                    bias.append(fit.stiffness[2, 2] / case.stiffness[5, 5] - 1.0)
                    codes = {notice.code for notice in fit.notices}
                    raised += bool(codes & (ALARMS - {"fluid_found"} if fluid else ALARMS))
                    if fluid and fit.fluid is not None and fit.fluid.mass_kg is not None:
                        mass_off.append((1e6 * fit.fluid.mass_kg - fluid) / (1e6 * fit.fluid.mass_sd_kg))
                z = np.array(off)
                outside = np.mean(np.abs(z) > 1.96, axis=0)
                worst = int(np.argmax(outside))
                for group in ("all", "with fluid" if fluid else "without fluid"):
                    kept[group].append(z)
                    alarms[group] += raised
                seen = (
                    f"{fluid:g} (found {len(mass_off)}, rms {np.sqrt(np.mean(np.square(mass_off))):.2f} sd)"
                    if mass_off
                    else f"{fluid:g}"
                )
                row(f"{height:g}", f"{noise:g}", seen, f"{100 * outside.mean():.1f}",
                    f"{entry_names(3)[worst]} {100 * outside[worst]:.0f}", f"{100 * np.median(bias):+.1f}",
                    f"{np.median(z[:, 5]):+.2f}", f"{raised} of {len(off)}",
                    f"{1e3 * spent / chosen.ears:.0f}")  # fmt: skip
    print(flush=True)
    table("ears", *entry_names(3), "K33 bias / sd", "alarms")
    for name in kept:
        z, raised = np.concatenate(kept[name]), alarms[name]
        held = [f"{100 * value:.1f}" for value in np.mean(np.abs(z) < 1.96, axis=0)]
        bias = f"{np.median(z[:, 5]):+.2f} ± {1.25 * np.std(z[:, 5]) / np.sqrt(len(z)):.2f}"
        row(f"{name}, {len(z)}", *held, bias, f"{raised} of {len(z)}")
    n = len(np.concatenate(kept["all"]))
    print(
        f"\nStandard error of an entry inside in 95 %: {100 * np.sqrt(0.95 * 0.05 / n):.1f} %.\n", flush=True
    )


def alarms(ears: int) -> None:
    """Print alarms and coverage of ears that have no error, with their law and fluid stated."""
    kept: dict[str, list[np.ndarray]] = {}
    raised: dict[str, list[str]] = {}
    for number in range(ears):
        rng = np.random.default_rng([2003, number])
        law, fluid = list(LAWS)[number % len(LAWS)], (number // len(LAWS)) % 2
        noise = 0.005 * 10.0 ** rng.uniform()
        error = {"cause": "fluid", "size": rng.uniform(0.2, 1.0)} if fluid else {}
        case = ear(EarSettings(0.3 * rng.uniform(), noise, law=law, **error), rng)
        fit = fitted(case, replace(PLAIN, damping=law, fluid="y" if fluid else "auto"))
        group = f"{law}, {'fluid stated' if fluid else 'without fluid'}"
        found, seen = raised.setdefault(group, []), kept.setdefault(group, [])
        if fit is None:
            found.append("refused")
            continue
        seen.append((join(fit.stiffness, fit.damping) - truth(case)) / np.sqrt(np.diag(fit.covariance)))
        codes = sorted({notice.code for notice in fit.notices} & ALARMS)
        if codes:
            found.append(f"{' and '.join(codes)} ({named(fit)[0] or 'no cause'}, {100 * noise:.1f} % noise)")
    table("law", "ears", "alarms", "K inside 95 %", "D inside")
    for group, seen in kept.items():
        inside = np.abs(seen) < 1.96
        held = [f"{100 * part.mean():.1f} %" for part in (inside[:, :6], inside[:, 6:])]
        row(group, str(len(seen)), "; ".join(raised[group]) or "none", *held)
    z = np.concatenate(list(kept.values()))
    count = sum(len(found) for found in raised.values())
    print(f"\nAlarms: {count} of {ears} ({100 * count / ears:.1f} %).\n")
    table("ears", *entry_names(3))
    row(str(len(z)), *(f"{100 * value:.1f}" for value in np.mean(np.abs(z) < 1.96, axis=0)))
    row("rms error / sd", *(f"{value:.2f}" for value in np.sqrt(np.mean(z**2, axis=0))))
    print(
        f"\nStandard error of an entry inside in 95 %: {100 * np.sqrt(0.0475 / len(z)):.1f} %.\n", flush=True
    )


def couplings(ears: int) -> None:
    """Print how many entries the intervals hold for even rings, and for those that the prior allows for."""
    table("ring", "ears", *entry_names(3))
    for place, (name, change) in enumerate(
        (("even, tilted by 1°", {}), ("30 % uneven, tilted by 3°", {"uneven": 0.3, "tilt_sd_deg": 3.0}))
    ):
        off = []
        for number in range(ears):
            rng = np.random.default_rng([404, place, number])
            settings = EarSettings(0.3 * rng.uniform(), 0.005 * 10.0 ** rng.uniform(), **change)
            case = ear(settings, rng)
            fit = fitted(case)
            if fit is not None:
                off.append(
                    (join(fit.stiffness, fit.damping) - truth(case)) / np.sqrt(np.diag(fit.covariance))
                )
        z = np.array(off)
        row(name, str(len(z)), *(f"{100 * value:.1f}" for value in np.mean(np.abs(z) < 1.96, axis=0)))
        row("rms error / sd", "", *(f"{value:.2f}" for value in np.sqrt(np.mean(z**2, axis=0))))
    print(f"\nStandard error of an entry inside in 95 %: {100 * np.sqrt(0.0475 / ears):.1f} %.\n", flush=True)


def causes(ears: int) -> None:
    """Print how errors are warned of, named and corrected."""
    table(
        "error",
        "warned",
        "named first",
        "among look-alikes",
        "could be",
        "largest error before (%)",
        "after (%)",
        "outside 95 %, noise alone",
        "before",
        "after",
    )
    cases = [(name, {"cause": name, "size": size}) for name, size in ERRORS.items()]
    cases[[name for name, _ in cases].index("mirrored")][1]["head_mm"] = 0.4  # centre as in the paper's M
    cases += [("second_run", {"cause": "second_run", "size": 20.0})]
    cases += [(f"law_{name}", {"law": name}) for name in ("hysteretic", "fractional")]
    total = 0
    for name, change in cases:
        warned, first, among, before, after, outside = 0, 0, 0, [], [], ([], [], [])
        could: list[bool] = []
        for number in range(ears):
            settings = replace(EarSettings(0.1, 0.01), **change)
            case = ear(settings, np.random.default_rng([99, number]))
            fit = fitted(case)
            if name in MASS_ERRORS and fit is not None:
                could.append(seen_at_best(fit, case, settings, number))
            if fit is None:
                continue
            warned += bool({notice.code for notice in fit.notices} & ALARMS)
            cause, others = named(fit)
            first += matches(cause, name)
            among += matches(cause, name) or any(matches(other, name) for other in others)
            before.append(np.abs(relative(fit, case)).max())
            off = np.abs(join(fit.stiffness, fit.damping) - truth(case))
            outside[0].append(off > 1.96 * np.sqrt(np.diag(fit.covariance)))
            noise = fit.covariance - fit.budget.sources.get(MODEL_ERROR, 0.0)
            outside[2].append(off > 1.96 * np.sqrt(np.diag(noise)))
            again = fit if name == "fluid" else None
            if name[4:] in LAWS:
                again = fitted(case, replace(PLAIN, damping=name[4:]))
            elif again is None and name in CORRECT:
                again = fitted(case, replace(PLAIN, correct=name))
            if again is not None:
                after.append(np.abs(relative(again, case)).max())
                outside[1].append(
                    np.abs(join(again.stiffness, again.damping) - truth(case))
                    > 1.96 * np.sqrt(np.diag(again.covariance))
                )
        total += first
        shown = (
            [f"{100 * np.median(after):.1f}", f"{100 * np.mean(outside[1]):.0f} %"] if after else ["-", "-"]
        )
        label = f"{name} {change.get('size', '')}"
        row(
            label,
            f"{warned} of {ears}",
            str(first),
            str(among),
            str(sum(could)) if could else "-",
            f"{100 * np.median(before):.1f}",
            shown[0],
            f"{100 * np.mean(outside[2]):.0f} %",
            f"{100 * np.mean(outside[0]):.0f} %",
            shown[1],
        )
    print(f"\nNamed first: {total} of {ears * len(cases)}.\n", flush=True)


MASS_ERRORS = ("head_mass", "centre_z", "mirrored", "inertia")


def seen_at_best(fit: KDFit, case: SimulatedEar, settings: EarSettings, number: int) -> bool:
    """Return whether the right mass matrix has a clearly lower chi2 than the stated one.

    Both are fitted to the same data. No search does better: this one knows the error and its size.
    """
    if settings.cause == "head_mass":
        added = point_mass(1e-6 * settings.size, np.array([0.1e-3, 3.3e-3, 0.1e-3]))
        mass = replace(case.mass, parameters=case.mass.parameters + added)
    else:
        mass = ear(replace(settings, cause=""), np.random.default_rng([99, number])).mass
    right = fitted(replace(case, mass=mass))
    if right is None:
        return False
    least = rarity_penalty() if settings.cause == "mirrored" else np.log(2 * len(fit.dof) * settings.lines)
    return bool(fit.chi2 - right.chi2 > least)


def named(fit: KDFit) -> tuple[str, tuple[str, ...]]:
    """Return the cause that is named or part of the model, and its look-alikes."""
    if fit.diagnosis is not None and fit.diagnosis.named is not None:
        return fit.diagnosis.named.name, fit.diagnosis.look_alikes
    return ("fluid" if fit.fluid is not None and fit.fluid.used else ""), ()


def matches(cause: str, name: str) -> bool:
    """Return whether a cause is the simulated one; resonances of the holder and steps are named with their
    place, and a second run with another stiffness is a step."""
    family = {"holder": "holder_", "step": "step_", "second_run": "step_"}.get(name)
    return cause == name or (family is not None and cause.startswith(family))


if __name__ == "__main__":
    main()
