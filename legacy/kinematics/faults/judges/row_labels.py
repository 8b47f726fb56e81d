"""Rows that carry another body's, run's or frequency's label, and rows in the other phase convention.

A point whose rows do not fit its own body is compared with every place that they could belong to.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.faults.alternatives import Proposal, proposed
from legacy.kinematics.faults.diagnose import diagnose
from legacy.kinematics.faults.diagnosis import Diagnosis
from legacy.kinematics.faults.findings import Finding
from legacy.kinematics.faults.proposals.clean_motion import CleanMotion, Lines, chosen_lines, fit_clean_motion
from legacy.kinematics.faults.proposals.row_places import Place, Rows
from legacy.kinematics.fit.line_noise import LineNoise
from legacy.kinematics.fit.neglected_motion import extended_beams
from legacy.kinematics.fit.noise_spectrum import noise_course
from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.kinematics.measurement import Measurement
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.spatial import point_rows

Key = tuple[int, int]
# Rows belong where they leave twice their noise at most, or a hundredth of what they leave at home.
_NOISE, _LEFT = 2.0, 0.01
# How many times the usual chi2 a line that agrees much worse has at least.
_LOUD = 3.0
# By how much the log likelihood must be better beyond the price of its parameters: odds of 20 000.
_MARGIN = 10.0


@dataclass(frozen=True)
class _Suspect:
    home: CleanMotion
    channels: tuple[int, ...]
    scores: dict[int, float]
    places: list[Proposal]
    bar: float
    own: float


_Entry = tuple[_Suspect, Proposal, float]


def label_findings(motions: Mapping[Key, CleanMotion], runs: Sequence[str]) -> dict[Key, list[Finding]]:
    """Name the rows of one point or channel that carry the label of another body, point, run or frequency.

    Notes
    -----
    Rows y are held against rows p of a motion that other channels measured, with the variance of both:
    S = sum |y - p|^2 / var is the negative log likelihood of complex normal noise, and 2 S is chi-squared
    when they belong there. That is accepted when S is as small as noise makes it, or a hundredth of what it
    was, and lies by more than the Bayesian information criterion (Schwarz 1978,
    doi:10.1214/aos/1176344136) below the best real change of the rows and the best course of a factor over
    frequency, the faults that a single point can have.
    """
    motions = {key: motion for key, motion in motions.items() if motion.level > 0.0}
    suspects = [
        suspect
        for home in motions.values()
        for channels in home.suspects
        if (suspect := _suspect(home, channels, motions, runs)) is not None
    ]
    findings: dict[Key, list[Finding]] = {}
    for suspect, place, score in _pair(suspects):
        home = suspect.home
        p = float(np.exp(-min(suspect.own - score, 700.0)) * len(suspect.places))
        finding = Finding(
            place.entry.verdict, list(suspect.channels), min(p, 1.0), text=place.text, step=place.step
        )
        findings.setdefault((home.run, home.number), []).append(finding)
    return findings


def _suspect(
    home: CleanMotion, channels: tuple[int, ...], motions: Mapping[Key, CleanMotion], runs: Sequence[str]
) -> _Suspect | None:
    """Score every place that rows could belong to; None when a fault of their own explains them as well."""
    arms = home.body.positions_mm[channels[0]] * 1e-3
    at_home = Place(home, arms, home.lines)
    own, count = _misfit(home, channels, at_home)
    if count == 0:
        return None
    two = len(home.lines) == 2
    bar = own if two else _fault_of_its_own(home, channels, at_home)
    rows = Rows(home, home.body.points[channels[0]], arms, motions, runs)
    places = list(proposed("two rows" if two else "rows", rows))
    scores = {}
    for number, place in enumerate(places):
        score, used = _misfit(home, channels, place.value)
        level = max(home.level, place.value.at.level)
        if used > 0.8 * count and score < max(_NOISE * level * used, _LEFT * own):
            scores[number] = score * count / used / level
    level = home.level
    bar, own = bar / level, own / level
    margin = _MARGIN + np.log(max(len(places), 1))
    scores = {k: v for k, v in scores.items() if v < min(bar, own) - margin}
    return _Suspect(home, channels, scores, places, bar, own) if scores else None


def _predict(home: CleanMotion, channels: tuple[int, ...], place: Place) -> tuple[Lines, ComplexArray, Array]:
    """Return which lines compare, what rows would read at a place, and its variance."""
    at = place.at
    here = np.minimum(np.searchsorted(at.lines, place.source), len(at.lines) - 1)
    same = np.flatnonzero(at.lines[here] == place.source)
    here = here[same]
    # What was read belongs to another line, not the displacement that was made of it.
    ratio = at.rate[here] / home.rate[same]
    directions = home.body.directions[list(channels)]
    rows = point_rows(np.broadcast_to(place.arms_m, directions.shape), directions)
    q = (place.conjugate * at.q[here].conj() if place.conjugate else at.q[here]) * ratio[:, None]
    variance = np.einsum("ka,fab,kb->kf", rows, at.covariance[here], rows, optimize=True) * ratio**2
    prior = home.body.position_sd_mm[channels[0]] * 1e-3
    if np.isfinite(prior) and prior > 0.0:
        across = np.cross(directions[:, None], q[None, :, 3:])
        variance = variance + prior**2 * np.sum(np.abs(across) ** 2, axis=-1)
    return same, rows @ q.T, variance


def _misfit(home: CleanMotion, channels: tuple[int, ...], place: Place) -> tuple[float, int]:
    """Return the squared misfit of rows at a place over its variance, and how many values it sums."""
    lines, expected, variance = _predict(home, channels, place)
    own = list(channels)
    value, noise = home.value[own][:, lines], home.variance[own][:, lines]
    used = np.isfinite(noise)
    share = np.where(used, np.abs(value - expected) ** 2 / np.where(used, noise + variance, 1.0), 0.0)
    return float(np.sum(share)), int(np.sum(used))


def _fault_of_its_own(home: CleanMotion, channels: tuple[int, ...], place: Place) -> float:
    """Return the least misfit, with the price of its parameters, that a fault of the rows could leave."""
    lines, expected, variance = _predict(home, channels, place)
    course = np.linspace(-1.0, 1.0, len(lines))[:, None] ** np.arange(3)
    observed = np.any(np.abs(home.q) > 0.0, axis=0)
    motion = home.q[lines][:, observed]
    static, factor = 0.0, 0.0
    for k, channel in enumerate(channels):
        noise = home.variance[channel, lines]
        used = np.isfinite(noise)
        if not np.any(used):
            continue
        root = 1.0 / np.sqrt(noise[used] + variance[k, used])
        value = home.value[channel, lines][used] * root
        whole = motion[used] * root[:, None]
        single = expected[k, used, None] * course[used] * root[:, None]
        price = 0.5 * np.log(2.0 * len(value))
        parts = np.vstack([whole.real, whole.imag])
        static += _left(parts, np.concatenate([value.real, value.imag])) + parts.shape[1] * price
        factor += _left(single, value) + 2.0 * single.shape[1] * price
    return min(static, factor)


def _left(columns: NDArray[Any], value: NDArray[Any]) -> float:
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    coefficients = np.linalg.lstsq(columns / scale, value, rcond=1e-10)[0]
    return float(np.sum(np.abs(value - columns / scale @ coefficients) ** 2))


def _pair(suspects: list[_Suspect]) -> list[_Entry]:
    """Choose where each suspect belongs: two that belong to each other's places before all others."""
    candidates: list[tuple[float, list[tuple[int, Proposal, float]]]] = []
    for number, suspect in enumerate(suspects):
        for k, score in suspect.scores.items():
            place = suspect.places[k]
            if not place.value.partner:
                candidates.append((score - suspect.bar, [(number, place, score)]))
                continue
            for other, partner in enumerate(suspects[number + 1 :], start=number + 1):
                back = _back(suspect, place.value, partner)
                if back is not None:
                    total = score - suspect.bar + partner.scores[back] - partner.bar
                    both = [(number, place, score), (other, partner.places[back], partner.scores[back])]
                    candidates.append((total, both))
    taken: set[int] = set()
    chosen: list[_Entry] = []
    for _, entries in sorted(candidates, key=lambda entry: entry[0]):
        if not taken & {entry[0] for entry in entries}:
            taken |= {entry[0] for entry in entries}
            chosen += [(suspects[number], place, score) for number, place, score in entries]
    return chosen


def _back(suspect: _Suspect, place: Place, partner: _Suspect) -> int | None:
    """Return the place of ``partner`` at the suspect's point, when ``place`` is the point of ``partner``."""
    if place.at is not partner.home or not set(partner.channels) <= set(place.partner):
        return None
    if len(suspect.channels) != len(partner.channels):
        return None
    for k in partner.scores:
        back = partner.places[k].value
        if back.at is suspect.home and set(suspect.channels) <= set(back.partner):
            return k
    return None


def find_mislabelled(
    placed: Measurement,
    fits: Mapping[Key, LineFit],
    diagnoses: Mapping[Key, Diagnosis],
    known: Mapping[Key, bool],
) -> dict[Key, Diagnosis]:
    """Return the diagnoses in which rows under a wrong body, point, run or frequency are named.

    Nothing is looked at when no body has a fault.
    """
    if not any(diagnosis.findings for diagnosis in diagnoses.values()):
        return {}
    motions: dict[Key, CleanMotion] = {}
    findings_of: dict[Key, list[Finding]] = {}
    for key, fit in fits.items():
        if fit.is_rounding() or not np.any(fit.solution.good):
            continue
        body = placed.bodies[key[1]]
        beams = extended_beams(body, fit.beams.dof)
        noise = fit.noise
        if not known[key]:
            noise = LineNoise(noise.stated, noise_course(fit, placed.freq_hz))
        lines = chosen_lines(fit.solution.good)
        motions[key] = fit_clean_motion(key, fit, placed, beams, noise.at(lines), lines)
        for pair in _loud_lines(fit):
            both = np.array(pair)
            single = {key: fit_clean_motion(key, fit, placed, beams, noise.at(both), both)}
            findings_of |= label_findings(single, placed.runs)
            if key in findings_of:
                break
    findings_of = {**findings_of, **label_findings(motions, placed.runs)}
    diagnoses_with_labels = {}
    for key, findings in findings_of.items():
        out = [c for finding in findings for c in finding.channels]
        rest = diagnose(placed, placed.bodies[key[1]], fits[key], known[key], out)
        unexplained = 0.0 if not rest.findings else rest.kept
        diagnoses_with_labels[key] = replace(rest, findings=(*findings, *rest.findings), kept=unexplained)
    return diagnoses_with_labels


def _loud_lines(fit: LineFit) -> list[tuple[int, int]]:
    """Return pairs of the few lines at which a body agrees much worse than at the others."""
    good = np.isfinite(fit.chi2) & (fit.n_dof > 0)
    if np.sum(good) < 12:
        return []
    ratio = np.where(good, fit.chi2 / np.maximum(fit.n_dof, 1), 0.0)
    freedom = float(np.median(fit.n_dof[good]))
    typical = max(float(np.median(ratio[good])), 1e-300)
    loud = np.flatnonzero(ratio > typical * max(_LOUD, 1.0 + 10.0 * np.sqrt(2.0 / freedom)))
    if not 2 <= len(loud) <= max(4, len(ratio) // 20):
        return []
    worst = loud[np.argsort(-ratio[loud], kind="stable")[:4]]
    return [(int(min(pair)), int(max(pair))) for pair in combinations(worst, 2)]
