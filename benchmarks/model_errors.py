"""Coverage of the intervals of K and D, and naming of errors, on simulated ears.

The simulation shares no code with fitting.

    python benchmarks/model_errors.py [EARS] [--table intervals|causes|laws|branches|alarms|couplings|all]
                                      [--noise 0.5,1,3] [--height 0,0.1,0.3]

intervals: every cell draws EARS ears (benchmarks/ring_ears.py) with all shared errors, without and with
fluid, and prints how many entries lie outside their 95 % interval, K33's median bias, false alarms and the
time of a fit. causes: one error of known size an ear, 1 % noise: how often there is a warning, how often it
is named first or among the look-alikes, and the errors of K and D in their own sd before and after it is
corrected; before it also without the part of what the model lacks. laws: how often ``compare`` names the law
at 3 % noise, in a wide and a narrow band, calls it undetermined or names a wrong one, coverage, and below
which noise the right law can be told from the nearest other one in 95 %. branches:
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

from fitting.budget import MODEL_ERROR
from fitting.calibrated import calibrated
from fitting.errors import FittingError
from fitting.fit_kd import fit_kd
from fitting.kd_fit import KDFit
from fitting.model.laws import law_of
from fitting.model.parameter_vector import entry_names, join, pairs
from fitting.options import CORRECT, KDOptions

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.ring_ears import BRANCHES, ERRORS, LAWS, PISTON, EarSettings, SimulatedEar, ear

BLOCK = np.ix_(PISTON, PISTON)
PLAIN = KDOptions(bands=0)
ALARMS = {"misfit", "cause_found", "fluid_found", "fluid_contradicts"}


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


def fitted(case: SimulatedEar, options: KDOptions = PLAIN) -> KDFit | None:
    """Return the fit of an ear, None where it is refused."""
    try:
        return fit_kd(case.motion, case.mass, options)
    except FittingError:
        return None


def truth(case: SimulatedEar) -> np.ndarray:
    """Return the entries of K and D of an ear."""
    return join(case.stiffness[BLOCK], case.damping[BLOCK])


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
        for number in range(ears):
            case = ear(replace(EarSettings(0.1, 0.01), **change), np.random.default_rng([99, number]))
            fit = fitted(case)
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
            f"{100 * np.median(before):.1f}",
            shown[0],
            f"{100 * np.mean(outside[2]):.0f} %",
            f"{100 * np.mean(outside[0]):.0f} %",
            shown[1],
        )
    print(f"\nNamed first: {total} of {ears * len(cases)}.\n", flush=True)


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


BANDS = {"400 to 5000": (400.0, 5000.0), "1000 to 3000": (1000.0, 3000.0)}


def laws(ears: int) -> None:
    """Print how often the law is found, and how many entries of K and D its intervals hold."""
    table(
        "law",
        "band (Hz)",
        "named",
        "undetermined, with it",
        "without it",
        "wrong",
        "refused",
        "K inside 95 %",
        "D inside",
        "K33 bias / sd",
        "nearest other law",
        "its chi2 above",
        "95 % named below",
        "ms",
    )
    total = np.zeros(5, dtype=int)
    for band, limits in BANDS.items():
        for place, name in enumerate(LAWS):
            counts, off, spent, fits = np.zeros(5, dtype=int), [], 0.0, []
            for number in range(ears):
                settings = EarSettings(0.1, 0.03, law=name, band_hz=limits)
                case = ear(settings, np.random.default_rng([156, place, number, int(limits[0])]))
                start = time.process_time()
                fit = fitted(case, replace(PLAIN, damping="compare"))
                spent += time.process_time() - start
                counts[verdict(fit, name)] += 1
                if fit is not None:
                    fits.append(fit)
                    z = (join(fit.stiffness, fit.damping) - truth(case)) / np.sqrt(np.diag(fit.covariance))
                    if fit.law.name != name:
                        z[6:] = np.nan  # D of another law has another unit
                    off.append(z)
            total += counts
            inside = np.abs(off) < 1.96
            of_d = np.isfinite(np.array(off)[:, 6:])
            row(
                name,
                band,
                *(str(count) for count in counts),
                f"{100 * inside[:, :6].mean():.1f} %",
                f"{100 * inside[:, 6:].sum() / max(of_d.sum(), 1):.1f} %",
                f"{np.median(np.array(off)[:, 5]):+.2f}",
                *nearest(fits, name, 3.0),
                f"{1e3 * spent / ears:.0f}",
            )
    print(
        f"\nOf {total.sum()} ears: {total[0]} named, {total[1]} undetermined with the law among those named, "
        f"{total[2]} without it, {total[3]} wrong, {total[4]} refused.\n",
        flush=True,
    )


def nearest(fits: list[KDFit], name: str, noise: float) -> tuple[str, str, str]:
    """Return the closest wrong law, its mean excess of chi2, and the largest noise at which it is rejected.

    By noise alone a difference d of chi2 scatters with the standard deviation 2 sqrt(d), and it falls with
    the square of the noise. A law is told where the difference exceeds e = 6 (likelihood ratio e^3), which is
    so in 95 % where sqrt(d) = 1.645 + sqrt(1.645^2 + e). Laws that hold the right one as a special case are
    told by their unknowns alone; those that were given up lie above what noise makes.
    """
    differences = {}
    for other in LAWS:
        if other == name or name in law_of(other).includes:
            continue
        pairs_of = [
            [next((law.chi2 for law in fit.laws if law.law.name == one and law.ligament), np.inf)
             for one in (other, name)]
            for fit in fits
        ]  # fmt: skip
        both = np.array([pair for pair in pairs_of if np.isfinite(pair[1])]).reshape(-1, 2)
        differences[other] = float(np.mean(both[:, 0] - both[:, 1])) if len(both) else np.inf
    other = min(differences, key=lambda one: differences[one])
    mean = differences[other]
    if not np.isfinite(mean):
        return "none", "more than noise makes", "-"
    needed = (1.645 + np.sqrt(1.645**2 + calibrated("causes.look_alike_chi2"))) ** 2
    level = f"{noise * np.sqrt(mean / needed):.1f} % noise" if mean > 1.0 else "no noise"
    return other, f"{mean:.1f}", level


def verdict(fit: KDFit | None, name: str) -> int:
    """Return 0 for the right law, 1 and 2 for an undetermined one with and without it, 3 for a wrong one, 4
    where there is no fit."""
    if fit is None:
        return 4
    if fit.laws_alike:
        return 1 if name in (fit.law.name, *fit.laws_alike) else 2
    return 0 if fit.law.name == name else 3


def branches(ears: int, levels: list[float]) -> None:
    """Print laws chosen for ligaments with two relaxation times, whether a warning came, and errors of K."""
    table("ligament", "noise (%)", "chosen", "warned", "K11, K22, K33 off (%)", "outside 95 % of K")
    for place, name in enumerate(BRANCHES):
        for noise in levels:
            chosen, warned, errors, outside = [], 0, [], []
            for number in range(ears):
                case = ear(EarSettings(0.1, noise, law=name), np.random.default_rng([57, place, number]))
                fit = fitted(case, replace(PLAIN, damping="compare"))
                if fit is None:
                    continue
                chosen.append(fit.law.name)
                warned += bool({notice.code for notice in fit.notices} & ALARMS)
                errors.append(np.diag(fit.stiffness) / np.diag(case.stiffness[BLOCK]) - 1.0)
                off = join(fit.stiffness, fit.damping) - truth(case)
                outside.append(np.abs(off[:6]) > 1.96 * np.sqrt(np.diag(fit.covariance)[:6]))
            counts = ", ".join(f"{law} {chosen.count(law)}" for law in dict.fromkeys(chosen))
            middle = " ".join(f"{100 * value:+.1f}" for value in np.median(errors, axis=0))
            row(
                name,
                f"{100 * noise:g}",
                counts,
                f"{warned} of {ears}",
                middle,
                f"{100 * np.mean(outside):.0f} %",
            )


def table(*heads: str) -> None:
    """Print the head of a table."""
    print("| " + " | ".join(heads) + " |\n|" + "-|" * len(heads), flush=True)


def row(*cells: str) -> None:
    """Print a row."""
    print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
