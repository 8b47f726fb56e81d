"""The intervals of K and D hold on ears with all errors, wrong inputs are named, right ones raise no alarm.

intervals: three heights of the ligament, four levels of noise, without and with 0.5 mg of fluid. alarms: ears
without an error, of any height, noise, law and fluid, whose law and fluid are stated. couplings: even rings,
and rings as uneven as the prior of the plane allows for. laws: how often ``--damping compare`` names the law
at 3 % noise. causes: one error of known size at 1 % noise: how often there is a warning, how often the error
is named first or among its look-alikes, and the errors of K and D before it is taken into the model.

0.2 drew its ears by another simulator (see _ears.py) and had the law ``two_relaxations``.

    python -m benchmarks.model_errors --table intervals --ears 9
    python -m benchmarks.model_errors --table alarms --ears 200
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks._ears import Measured, RingEar, draw_ear, fluid_mg, has_alarm
from benchmarks._table import (
    NOTHING,
    PISTON_ENTRIES,
    Before,
    arguments,
    covers,
    percent,
    print_table,
    root_mean_square,
)
from fitting.laws import LAWS
from fitting.result import KDFit
from stapeskit.arrays import Array

BANDS = {"400 to 5000": (400.0, 5000.0), "1000 to 3000": (1000.0, 3000.0)}
ERRORS = {
    "delay": 1.0, "phase": 0.5, "gain": 1.0, "fluid": 0.5, "head_mass": 5.0, "centre_z": 0.3, "mirrored": 1.0,
    "inertia": 25.0, "drift": 8.0, "second_run": 5.0, "step": 8.0, "holder": 2.0,
}  # fmt: skip
"""Sizes that 1 % of noise lets see: us, degrees, %, mg, mg, mm, 1 (whole), %, %, %, %, %."""
INTERVALS = Before("model_errors_9_table_intervals")
ALARMS = Before("model_errors_200_table_alarms")
COUPLINGS = Before("model_errors_200_table_couplings")
LAW_TABLE = Before("model_errors_12_table_laws")
CAUSES = Before("model_errors_8_table_causes")


def print_coverage(groups: dict[str, list[Array]], old: dict[str, tuple[Before, tuple[str, ...]]]) -> None:
    """Print how often the intervals of each entry hold, with the figures of 0.2 below."""
    lines = list[list[object]]()
    for name, deviations in groups.items():
        z = np.array(deviations)
        lines.append([f"{name}, {len(z)} ears", *(f"{100 * value:.1f}" for value in covers(z))])
        before, first = old[name]
        lines.append(["0.2", *(before.cell(entry, *first) for entry in PISTON_ENTRIES)])
        lines.append(["rms error / sd", *(f"{value:.2f}" for value in root_mean_square(z))])
    print_table(("held by 95 %, in %", *PISTON_ENTRIES), lines)
    z = np.concatenate([np.array(part) for part in groups.values()])
    error = 100.0 * np.sqrt(0.0475 / len(z))
    print(f"All entries: {percent(covers(z))}; K33 bias / sd {np.median(z[:, 5]):+.2f}.", end=" ")
    print(f"Standard error of an entry: {error:.1f} %.\n", flush=True)


def intervals(ears: int) -> None:
    """Print coverage, bias and false alarms, cell by cell and over all."""
    groups: dict[str, list[Array]] = {"without fluid": [], "with fluid": []}

    def rows() -> Iterator[list[object]]:
        for height in (0.0, 0.1, 0.3):
            for noise in (0.5, 1.0, 3.0, 5.0):
                yield [
                    f"{height:g}", f"{noise:g}", *cells(height, noise, 0.0), *cells(height, noise, 0.5)
                ]  # fmt: skip

    def cells(height: float, noise: float, fluid: float) -> list[object]:
        ear = RingEar(height_mm=height, noise=noise / 100.0, cause="fluid" if fluid else "", size=fluid)
        off, masses, alarms = list[Array](), list[float](), 0
        for number in range(ears):
            case = draw_ear(ear, number, round(1e3 * height), round(1e3 * noise), int(fluid > 0))
            fit = case.fit()
            if fit is None:
                continue
            off.append(case.deviations(fit))
            alarms += has_alarm(fit, frozenset({"fluid_found"} if fluid else ()))
            found = fluid_mg(fit)
            masses += [] if found is None else [(found[0] - fluid) / found[1]]
        groups["with fluid" if fluid else "without fluid"] += off
        z = np.array(off)
        seen = [f"{100 - 100 * covers(z).mean():.1f}", f"{np.median(z[:, 5]):+.2f}", f"{alarms} of {len(z)}"]
        found_by = f"{len(masses)}" + (f", rms {root_mean_square(masses):.2f} sd" if masses else "")
        return [*seen, found_by] if fluid else list(seen)

    columns = ("outside 95 % (%)", "K33 bias / sd", "alarms")
    head = ("height (mm)", "noise (%)", *columns, *(f"with fluid: {word}" for word in columns), "found")
    print_table(head, rows())
    print_coverage(groups, {name: (INTERVALS, (f"{name}, 108",)) for name in groups})
    print(f"0.2, alarms: {INTERVALS.cell('alarms', 'all, 216')}; K33 bias / sd ", end="")
    print(f"{INTERVALS.cell('K33 bias / sd', 'all, 216')}.\n")


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
            raised.append(f"ear {number}, {law}, {100 * ear.noise:.1f} % noise: {codes}, {named(fit)[0]}")
    print_coverage({"no error": seen}, {"no error": (ALARMS, ("200",))})
    print(f"Alarms: {len(raised)} of {ears}; 0.2: {ALARMS.line('Alarms:')} {'; '.join(raised)}\n")


def couplings(ears: int) -> None:
    """Print how many entries the intervals hold for even rings, and for those that the prior allows for."""
    kinds = {"even, tilted by 1°": {}, "30 % uneven, tilted by 3°": {"uneven": 0.3, "tilt_sd_deg": 3.0}}
    groups: dict[str, list[Array]] = {name: [] for name in kinds}
    for place, (name, change) in enumerate(kinds.items()):
        for number in range(ears):
            rng = np.random.default_rng([404, place, number])
            height, noise = 0.3 * rng.uniform(), 0.005 * 10.0 ** rng.uniform()
            case = draw_ear(RingEar(height_mm=height, noise=noise, **change), 404, place, number)
            fit = case.fit()
            groups[name] += [] if fit is None else [case.deviations(fit)]
    print_coverage(groups, {name: (COUPLINGS, (name,)) for name in groups})


def laws(ears: int) -> None:
    """Print how often the law is found, and how many entries of K and D the intervals hold."""
    counted = ("named", "undetermined, with it", "without it", "wrong", "refused")

    def row(band: str, place: int, name: str) -> list[object]:
        counts, inside_k, inside_d = np.zeros(5, dtype=int), list[Array](), list[Array]()
        for number in range(ears):
            ear = RingEar(noise=0.03, law=name, band_hz=BANDS[band])
            case = draw_ear(ear, 156, place, number, int(BANDS[band][0]))
            fit = case.fit(damping="compare")
            counts[_verdict(fit, name)] += 1
            if fit is not None:
                z = np.abs(case.deviations(fit)) < 1.96
                inside_k.append(z[:6])
                inside_d += [z[6:]] if fit.law.name == name else []  # D of another law has another unit
        old = [LAW_TABLE.cell(column, name, band) for column in counted]
        pairs = (f"{count} ({before})" for count, before in zip(counts, old, strict=True))
        held = [LAW_TABLE.cell(column, name, band) for column in ("K inside 95 %", "D inside")]
        return [
            name, band, *pairs, f"{percent(inside_k)} ({held[0]})", f"{percent(inside_d)} ({held[1]})",
        ]  # fmt: skip

    head = ("law", "band (Hz)", *counted, "K inside 95 %", "D inside")
    print_table(head, (row(band, place, name) for band in BANDS for place, name in enumerate(LAWS)))
    print(f"{ears} ears a row; in brackets 0.2, 12 ears a row.\n")


def _verdict(fit: KDFit | None, name: str) -> int:
    """Return the place of a fit among the columns of `laws`."""
    if fit is None:
        return 4
    alike = fit.solution.laws_alike
    if alike:
        return 1 if name in (fit.law.name, *alike) else 2
    return 0 if fit.law.name == name else 3


def named(fit: KDFit) -> tuple[str, tuple[str, ...]]:
    """Return the cause that is named or part of the model, and its look-alikes."""
    search = fit.solution.search
    if search.best is not None:
        return search.best.name, tuple(other.name for other in search.look_alikes)
    return ("fluid" if fluid_mg(fit) else ""), ()


def _matches(cause: str, name: str) -> bool:
    """Return whether a cause is the simulated one; a step or a resonance is named with its place."""
    family = {"holder": "holder_", "step": "step_", "second_run": "step_"}.get(name)
    return cause == name or (family is not None and cause.startswith(family))


def causes(ears: int) -> None:
    """Print how errors are warned of and named, and what they do to K and D."""
    cases: dict[str, tuple[str, RingEar]] = {
        f"{name} {size}": (name, RingEar(cause=name, size=size)) for name, size in ERRORS.items()
    }
    cases["second_run 20.0"] = ("second_run", RingEar(cause="second_run", size=20.0))
    for law in ("hysteretic", "fractional"):
        cases[f"law_{law}"] = (f"law_{law}", RingEar(law=law))
    total = 0

    def row(label: str) -> list[object]:
        nonlocal total
        name, ear = cases[label]
        counts, largest, outside = np.zeros(3, dtype=int), list[float](), list[Array]()
        for number in range(ears):
            case: Measured = draw_ear(ear, 99, number)
            fit = case.fit()
            if fit is None:
                continue
            first, others = named(fit)
            hit = _matches(first, name)
            counts += [has_alarm(fit), hit, hit or any(_matches(other, name) for other in others)]
            largest.append(float(np.abs(case.relative_errors(fit)).max()))
            outside.append(np.abs(case.deviations(fit)) > 1.96)
        total += int(counts[1])
        columns = ("warned", "named first", "among look-alikes", "largest error before (%)", "before")
        old = [CAUSES.cell(column, label) for column in columns]
        return [
            label, f"{counts[0]} of {ears}", old[0], counts[1], old[1], counts[2], old[2],
            f"{100 * np.median(largest):.1f}" if largest else NOTHING, old[3], percent(outside, 0), old[4],
        ]  # fmt: skip

    head = (
        "error", "warned", "0.2", "named first", "0.2", "among look-alikes", "0.2", "largest error (%)",
        "0.2", "outside 95 %", "0.2",
    )  # fmt: skip
    print_table(head, map(row, cases))
    print(f"Named first: {total} of {ears * len(cases)}; 0.2: {CAUSES.line('Named first:')}\n")


TABLES = {"intervals": intervals, "alarms": alarms, "couplings": couplings, "laws": laws, "causes": causes}

if __name__ == "__main__":
    given = arguments(__doc__, table="all", ears=4)
    for title, table in TABLES.items():
        if given.table in (title, "all"):
            table(given.ears)
