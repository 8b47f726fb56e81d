"""The power of the best possible tests for the faults of simulated readings, and what can be named at all."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from benchmarks.fault_scenes import FAULTS, Array, Scene, measured, possible, readings, scene

# Share of clean files in which the bounds may raise an alarm, as the search does.
ALARM = 0.01
# Default sd of gain, phase (rad) and delay (s) of a laser: faults that large are none.
LASER_SD = (0.01, np.radians(0.5), 1e-6)
# Faults that change no mean, or are found without a test; and draws behind a power.
_NO_CHANGE, _DRAWS = ("noise x4", "zeros"), 2000


def bound(case: Scene, position_sd_mm: float = 0.0) -> float:
    """Return the power of the most powerful test (Neyman and Pearson 1933) of exactly this fault, at 1 %.

    Its kind, place and size are taken as known; the motion is not, and position errors of the stated sd
    are noise of known covariance. No real test can do better. Faults of the noise alone are tested by
    the energy of their channel.
    """
    from scipy.stats import chi2, norm

    span, scale = _span(case), 1.0 / (np.sqrt(2.0) * case.sd[:, 0])
    if np.any(case.loud > 1.0):
        channel = int(np.argmax(case.loud))
        left = 1.0 - float(np.sum(span[channel] ** 2))
        number = 2 * case.sd.shape[1]
        ratio = left * case.loud[channel] ** 2 + 1.0 - left
        return float(chi2.sf(chi2.isf(ALARM, number) / ratio, number))
    change = scale[:, None] * (case.faulty() - readings(case.placed, case.directions, case.q))
    change = change - span @ (span.T @ change)
    energy = 2.0 * float(np.sum(np.abs(change) ** 2))
    if position_sd_mm > 0.0:
        energy -= _explained_part(case, change, span, scale, position_sd_mm)
    return float(norm.sf(norm.isf(ALARM) - np.sqrt(max(energy, 0.0))))


def nameable(seed: int, geometry: str, fault: str, *, noise: float = 0.01, lines: int = 120) -> bool:
    """Return whether the likeliest culprit is the true one when only the place of the fault is unknown.

    Kind, size and course of the fault, the direction of a shift or tilt, the noise and the share of the
    motion in the readings are taken as known. No search can name culprits more often.
    """
    case = scene(seed, geometry, fault, noise=noise, lines=lines)
    span, scale = _span(case), 1.0 / (np.sqrt(2.0) * case.sd[:, 0])
    held = scale[:, None] * (measured(case, seed) - case.clean())
    held = held - span @ (span.T @ held)
    likely: dict[tuple[int, ...], float] = {}
    for at in range(len(case.points)):
        other = scene(seed, geometry, fault, noise=noise, lines=lines, at=at)
        if np.any(other.loud > 1.0):
            left = 1.0 - float(np.sum(span[at] ** 2))
            variance = 1.0 + (other.loud[at] ** 2 - 1.0) * left
            energy = float(np.sum(np.abs(held[at]) ** 2)) / left
            value = energy * (1.0 - 1.0 / variance) - lines * float(np.log(variance))
        else:
            change = scale[:, None] * (other.faulty() - other.clean())
            change = change - span @ (span.T @ change)
            value = float(2.0 * np.real(np.vdot(change, held)) - np.sum(np.abs(change) ** 2))
        key = tuple(sorted(other.culprits))
        likely[key] = max(likely.get(key, -np.inf), value)
    return max(likely, key=lambda key: likely[key]) == tuple(sorted(case.culprits))


@dataclass(frozen=True)
class _Catalogue:
    """Likelihood ratios of all faults at all places of one scene.

    Attributes
    ----------
    number : dict of (fault, culprits) to int
        Of n faults.
    moved : ndarray, (n, n)
        What each fault (row) adds to the log likelihood ratio of each, in the mean.
    ratios : ndarray, (draws, n)
        Log likelihood ratios of readings without fault, weighted: kinds alike, places of a kind alike.
    least : float
        The mean ratio that 1 % of the readings without fault exceed where lasers scatter by LASER_SD.
    """

    number: dict[tuple[str, tuple[int, ...]], int]
    moved: Array
    ratios: Array
    least: float


@lru_cache(maxsize=64)
def _catalogue(seed: int, geometry: str, noise: float, lines: int) -> _Catalogue:
    case = scene(seed, geometry, noise=noise, lines=lines)
    span, scale = _span(case), 1.0 / (np.sqrt(2.0) * case.sd[:, 0])

    def flat(change: NDArray[np.complex128]) -> Array:
        left = scale[:, None] * change
        left = left - span @ (span.T @ left)
        return np.asarray(np.sqrt(2.0) * np.concatenate([left.real.ravel(), left.imag.ravel()]))

    number: dict[tuple[str, tuple[int, ...]], int] = {}
    changes, errors = [], []
    for fault in FAULTS:
        for at in range(len(case.points) if possible(fault, geometry) and fault not in _NO_CHANGE else 0):
            other = scene(seed, geometry, fault, noise=noise, lines=lines, at=at)
            key = (fault, tuple(sorted(other.culprits)))
            if key not in number:
                number[key] = len(changes)
                changes.append(flat(other.faulty() - other.clean()))
    beams = np.unique(case.directions, axis=0)
    for beam in beams if len(beams) > 1 else ():
        own = np.where(np.all(case.directions == beam, axis=1)[:, None], case.clean(), 0.0)
        parts = (own, 1j * own, -2j * np.pi * case.freq_hz * own)
        errors += [sd * flat(part) for sd, part in zip(LASER_SD, parts, strict=True)]
    h, a = np.array(changes), np.array(errors).reshape(-1, len(changes[0]))
    white = h - (h @ a.T) @ np.linalg.solve(np.eye(len(a)) + a @ a.T, a)
    moved = h @ white.T
    kinds = [fault for fault, _ in number]
    offset = -np.log([kinds.count(fault) for fault in kinds]) - 0.5 * np.diag(moved)
    rng = np.random.default_rng([seed, 71])

    def drawn(covariance: Array) -> Array:
        values, vectors = np.linalg.eigh(covariance)
        draws = rng.normal(size=(_DRAWS, len(values))) * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(draws @ vectors.T + offset)

    least = np.quantile(np.logaddexp.reduce(drawn(moved), axis=1), 1.0 - ALARM)
    return _Catalogue(number, moved, drawn(white @ white.T), float(least))


def bound_of_search(
    case: Scene, seed: int, geometry: str, fault: str, *, noise: float = 0.01, lines: int = 120
) -> float:
    """Return the power at 1 % of the best test that knows the sizes of faults, not their kind and place.

    It compares the mean likelihood ratio over all kinds and places of these scenes: no other test finds more
    of their faults on the average. Its level is 1 % where the lasers scatter by LASER_SD, as by default.
    """
    if fault in _NO_CHANGE:
        return bound(case) if fault != "zeros" else 1.0
    held = _catalogue(seed, geometry, noise, lines)
    shift = held.moved[held.number[fault, tuple(sorted(case.culprits))]]
    return float(np.mean(np.logaddexp.reduce(held.ratios + shift, axis=1) > held.least))


def _span(case: Scene) -> Array:
    """Return orthonormal columns (channel, m) of what rigid motions can read."""
    rows = np.hstack([case.directions, np.cross(case.reported * 1e-3, case.directions)])
    u, s, _ = np.linalg.svd(rows / np.linalg.norm(rows, axis=0).clip(1e-12), full_matrices=False)
    return np.asarray(u[:, s > 1e-6 * s[0]])


def _explained_part(
    case: Scene, change: NDArray[np.complex128], span: Array, scale: Array, sd_mm: float
) -> float:
    """Return the part of a change that position errors explain."""
    columns = []
    for point in dict.fromkeys(case.points):
        own = np.array([name == point for name in case.points])
        for axis in np.eye(3):
            rows = np.hstack([np.zeros_like(case.directions), np.cross(axis, case.directions)])
            moved = np.where(own[:, None], scale[:, None] * (rows @ case.q.T), 0.0)
            columns.append((moved - span @ (span.T @ moved)).ravel())
    j = np.array(columns)
    j = np.hstack([j.real, j.imag]) * sd_mm * 1e-3
    flat = np.concatenate([change.ravel().real, change.ravel().imag])
    inner = j @ j.T + 0.5 * np.eye(len(j))
    seen = j @ flat
    return float(2.0 * seen @ np.linalg.solve(inner, seen))
