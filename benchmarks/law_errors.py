"""How often ``--damping compare`` finds the law of simulated ears: tables of benchmarks/model_errors.py."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from benchmarks.ring_ears import BRANCHES, LAWS, EarSettings, ear
from benchmarks.simulated_fits import ALARMS, BLOCK, PLAIN, fitted, row, table, truth
from legacy.fitting.calibrated import calibrated
from legacy.fitting.kd_fit import KDFit
from legacy.fitting.model.laws import law_of
from legacy.fitting.model.parameter_vector import join

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
