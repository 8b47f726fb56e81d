"""Positions that are all somewhat off, though nobody said so: how far, and whether that explains a misfit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.fault_model import solve
from kinematics.faults.findings import Finding
from kinematics.faults.noise.few_lines import shift_information
from kinematics.faults.packed.compact import Compact
from kinematics.faults.search import Search

Array = NDArray[np.float64]
# Fewer points than this tell no scatter.
_LEAST_POINTS = 4
# The range of position errors that is searched, the larger end in levers of the body.
_SMALLEST_M, _OF_LEVER = 1e-7, 0.2
# How many times the stated error it must be.
_MORE = 1.5
# What each parameter of a single fault, and the choice of its place, cost of log likelihood beside it.
_PER_PARAMETER = 5.0


def scatter(data: Compact) -> tuple[float, float]:
    """Return the likeliest standard deviation of all positions, per axis, m, and its log likelihood gain.

    Notes
    -----
    Marginal likelihood of independent normal shifts of the points beside the motion, linear in the shifts
    (Harville 1977, doi:10.1080/01621459.1977.10480998): with score g and information N of the shifts, the
    gain over none at a variance v is the sum over eigenvectors of
    g_i^2 / (N_i + 1 / 2 v) - log(1 + 2 v N_i) / 2.
    """
    names: dict[str, list[int]] = {}
    for channel in data.live:
        names.setdefault(data.points[channel], []).append(channel)
    score, information = shift_information(solve(data), list(names.values()))
    values, vectors = np.linalg.eigh(information)
    along, values = vectors.T @ score, np.maximum(values, 0.0)
    sizes = np.geomspace(_SMALLEST_M, _OF_LEVER * data.beams.lever_m, 80)
    twice = 2.0 * sizes[:, None] ** 2
    gains = np.sum(along**2 * twice / (1.0 + twice * values) - 0.5 * np.log1p(twice * values), axis=1)
    best = int(np.argmax(gains))
    return float(sizes[best]), float(gains[best])


def scattered(first: Search, prior_m: Array, doubt: Array | None, findings: list[Finding]) -> Finding | None:
    """Return that the positions are off by more than stated, when that explains what was found better.

    Parameters
    ----------
    first : Search
        Before anything was left out.
    prior_m : ndarray, (channel,)
        Stated standard deviations of the positions, m.
    doubt : ndarray or None
        As of the search.
    findings : list of Finding
        What was found otherwise.
    """
    if len(first.by_point) < _LEAST_POINTS or len(first.live) <= first.state.span.shape[1]:
        return None
    flat = replace(first.flat, a=first.flat.a / np.sqrt(first.scale))
    size, gain = scatter(flat)
    if not _MORE * float(np.max(prior_m, initial=0.0)) < size < first.data.beams.lever_m:
        return None
    fits = [finding.fit for finding in findings if finding.fit is not None]
    others = sum(fit.drop / first.scale - _PER_PARAMETER * (1 + fit.fault.size) for fit in fits)
    if gain < others:
        return None
    search = Search(first.raw, np.full(len(prior_m), size), first.known, first.alarm, doubt)
    if search.best() is not None:
        return None
    said = f"positions of all points off by about {size * 1e3:.2g} mm (standard deviation per axis)"
    p = min((found.p_value for found in [*findings, first.flexible()]), default=1.0)
    return Finding("position", list(first.live), p, None, size, text=said)
