"""The intervals of K and D hold on ears with all errors, wrong inputs are named, right ones raise no alarm.

intervals: ligaments as they are expected beforehand (uneven rings), four levels of noise, without and with
0.5 mg of fluid. alarms: ears
without an error, of any height, noise, law and fluid, whose law and fluid are stated. causes: one error of
known size at 1 % noise: how often there is a warning, how often the error is named first, and the errors of K
and D before it is taken into the model.

    python -m benchmarks.model_errors --table intervals --ears 18
    python -m benchmarks.model_errors --table alarms --ears 200
"""

from __future__ import annotations

import itertools

import numpy as np

from benchmarks._ears import Measured, RingEar, draw_ear, fluid_mg, has_alarm
from benchmarks._table import NOTHING, arguments, covers, percent, print_table, root_mean_square
from fitting.laws import LAWS
from fitting.result import KDFit
from stapeskit.arrays import Array

ERRORS = {
    "delay of 1 us": ("delay", 1.0),
    "phase of 0.5 deg": ("phase", 0.5),
    "gain of 1 %": ("gain", 1.0),
    "fluid, 0.5 mg": ("fluid", 0.5),
    "5 mg at the head": ("head_mass", 5.0),
    "centre 0.3 mm too low": ("centre_z", 0.3),
    "mirrored mass": ("mirrored", 1.0),
    "inertia 25 % off": ("inertia", 25.0),
    "drift of K by 8 %": ("drift", 8.0),
    "second run, K 5 % off": ("second_run", 5.0),
    "second run, K 20 % off": ("second_run", 20.0),
    "step of K by 8 %": ("step", 8.0),
    "resonance of the holder": ("holder", 2.0),
}
"""Errors and sizes, which 1 % of noise lets see."""


def print_coverage(groups: dict[str, list[Array]]) -> None:
    """Print how often the intervals of the entries hold."""
    rows = list[list[object]]()
    for name, deviations in groups.items():
        z = np.array(deviations)
        held, scatter = 100.0 * covers(z), root_mean_square(z)
        spread = f"{scatter.min():.2f} to {scatter.max():.2f}"
        rows.append([name, len(z), f"{held.min():.1f} to {held.max():.1f} %", spread])
    print_table(("ears", "number", "95 % intervals hold, by entry", "rms error/sd, by entry"), rows)
    z = np.concatenate([np.array(part) for part in groups.values()])
    error = 100.0 * np.sqrt(0.0475 / len(z))
    print(f"All entries: {percent(covers(z))}; standard error of an entry {error:.1f} %;", end=" ")
    print(f"K33 bias / sd {np.median(z[:, 5]):+.2f}.", flush=True)


def intervals(ears: int) -> None:
    """Print coverage over all ears, the worst cell, and false alarms."""
    groups: dict[str, list[Array]] = {"without fluid": [], "with fluid": []}
    outside, masses, alarms = list[float](), list[float](), 0
    for noise, fluid in itertools.product((0.5, 1.0, 3.0, 5.0), (0.0, 0.5)):
        ear = RingEar(height_mm=None, noise=noise / 100.0, cause="fluid" if fluid else "", size=fluid)
        off = list[Array]()
        for number in range(ears):
            case = draw_ear(ear, number, round(1e3 * noise), int(fluid > 0))
            fit = case.fit()
            if fit is None:
                continue
            off.append(case.deviations(fit))
            alarms += has_alarm(fit, frozenset({"fluid_found"} if fluid else ()))
            found = fluid_mg(fit)
            masses += [] if found is None else [(found[0] - fluid) / found[1]]
        groups["with fluid" if fluid else "without fluid"] += off
        outside.append(100.0 - 100.0 * float(covers(np.array(off)).mean()))
    print_coverage(groups)
    count = sum(map(len, groups.values()))
    print(f"Outside 95 %, by noise and fluid: {min(outside):.1f} to {max(outside):.1f} %.", end=" ")
    print(f"Alarms: {alarms} of {count}. Fluid found: {len(masses)} of {len(groups['with fluid'])}.\n")


def alarms(ears: int) -> None:
    """Print alarms and coverage of ears that have no error, with their law and fluid stated."""
    seen, raised = list[Array](), list[str]()
    for number in range(ears):
        rng = np.random.default_rng([2003, number])
        law, fluid = list(LAWS)[number % len(LAWS)], (number // len(LAWS)) % 2
        ear = RingEar(
            height_mm=0.3 * rng.uniform(), noise=0.005 * 10.0 ** rng.uniform(), law=law,
            cause="fluid" if fluid else "", size=rng.uniform(0.2, 1.0),
        )  # fmt: skip
        case = draw_ear(ear, 2003, number)
        fit = case.fit(damping=law, unknowns=("fluid",) if fluid else ())
        if fit is None:
            raised.append(f"ear {number}: refused")
            continue
        seen.append(case.deviations(fit))
        if has_alarm(fit):
            codes = " and ".join(sorted({notice.code for notice in fit.notices}))
            raised.append(f"ear {number}, {law}, {100 * ear.noise:.1f} % noise: {codes}, {named(fit)}")
    print_coverage({"no error": seen})
    print(f"Alarms: {len(raised)} of {ears}. {'; '.join(raised)}\n")


def named(fit: KDFit) -> str:
    """Return the cause that is named first, or fluid in the model."""
    best = fit.search.best
    return best.name if best is not None else "fluid" if fluid_mg(fit) else ""


def _matches(cause: str, name: str) -> bool:
    """Return whether a cause is the simulated one; a step or a resonance is named with its place."""
    family = {"holder": "holder_", "step": "step_", "second_run": "step_"}.get(name)
    return cause == name or (family is not None and cause.startswith(family))


def causes(ears: int) -> None:
    """Print how errors are warned of and named, and what they do to K and D."""
    cases = {label: (name, RingEar(cause=name, size=size)) for label, (name, size) in ERRORS.items()}
    for law in ("hysteretic", "fractional"):
        cases[f"{law} damping"] = (f"law_{law}", RingEar(law=law))
    total = 0

    def row(label: str) -> list[object]:
        nonlocal total
        name, ear = cases[label]
        counts, largest, outside = np.zeros(2, dtype=int), list[float](), list[Array]()
        for number in range(ears):
            case: Measured = draw_ear(ear, 99, number)
            fit = case.fit()
            if fit is None:
                continue
            counts += [has_alarm(fit), _matches(named(fit), name)]
            largest.append(float(np.abs(case.relative_errors(fit)).max()))
            outside.append(np.abs(case.deviations(fit)) > 1.96)
        total += int(counts[1])
        error = f"{100 * np.median(largest):.1f}" if largest else NOTHING
        return [label, *counts, error, percent(outside, 0)]

    print_table(("error", "warned", "named first", "largest error, %", "outside 95 %"), map(row, cases))
    print(f"{ears} ears each; errors as long as the cause is not in the model.", end=" ")
    print(f"Named first: {total} of {ears * len(cases)}.\n")


TABLES = {"intervals": intervals, "alarms": alarms, "causes": causes}

if __name__ == "__main__":
    given = arguments(__doc__, table="all", ears=4)
    for title, table in TABLES.items():
        if given.table in (title, "all"):
            table(given.ears)
