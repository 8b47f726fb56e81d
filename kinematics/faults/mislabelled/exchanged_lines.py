"""Lines whose rows were exchanged, and frequency columns that were shifted or scaled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.mislabelled.exchanged_bodies import ligament_misfit
from kinematics.fit.line_kernels import running_medians
from kinematics.fit.rigid_fit import LineFit
from stapeskit.arrays import Array, ComplexArray
from stapeskit.records.motion import RigidMotion
from stapeskit.records.motion_files import standard_deviation
from stapeskit.warnings import Notice

# How many of the roughest lines are exchanged with each other in trial.
_MOST = 8
# A jump, in units of its expected square, and what an exchange may leave of it.
_ROUGH, _SETTLES = 30.0, 0.05
# The cubic through the four neighbours of a line, at the line (Lagrange).
_BESIDE = np.array([-1.0, 4.0, 0.0, 4.0, -1.0]) / 6.0
# How many times the usual chi2 a line that agrees much worse has at least.
_LOUD = 3.0


def loud_lines(fit: LineFit) -> list[tuple[int, int]]:
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


def exchanged_lines(motion: RigidMotion, structure: str = "stapes", base: str = "base") -> list[Notice]:
    """Warn of two lines of a body that fit into the course of its motion only when they are exchanged.

    Notes
    -----
    Each line is compared with the cubic through its four neighbours, in units of its noise and of what this
    comparison gives at the lines around it. Where lines are far apart chance may make an exchange smooth: it
    is not believed when one ligament explains both bodies better as they are.
    """
    right = motion.q.copy()
    bodies_of: dict[tuple[int, int], list[str]] = {}
    for run, name in enumerate(motion.runs):
        for number, body in enumerate(motion.bodies):
            sd = standard_deviation(motion)[run, number]
            pair = exchanged_pair(motion.q[run, number], sd)
            if pair is not None:
                right[run, number, list(pair)] = motion.q[run, number, list(pair[::-1])]
                where = f" in run {name}" if len(motion.runs) > 1 else ""
                bodies_of.setdefault(pair, []).append(f"{body}{where}")
    if not bodies_of:
        return []
    given = ligament_misfit(motion, structure, base)
    exchanged = ligament_misfit(replace(motion, q=right), structure, base)
    if given is not None and exchanged is not None and exchanged > given:
        return []
    return [
        Notice(
            "label_swap",
            f"the motion of {' and of '.join(bodies)} jumps at {motion.freq_hz[k]:.6g} and "
            f"{motion.freq_hz[m]:.6g} Hz and is smooth when the rows of the two lines are exchanged: check "
            "their freq_hz.",
        )
        for (k, m), bodies in bodies_of.items()
    ]


def exchanged_pair(q: ComplexArray, sd: Array) -> tuple[int, int] | None:
    """Return the two lines of a motion (freq, m) whose exchange makes it smooth; None without such."""
    if len(q) < 16 or not np.all(np.isfinite(q)) or not np.all(np.isfinite(sd)):
        return None
    rough = _roughness(q)
    scale = _scale(rough, sd)
    size = np.mean(rough / scale, axis=1)
    top = np.argsort(-size, kind="stable")[:_MOST]
    top = top[size[top] > _ROUGH]
    if not top.size:
        return None
    ends = [0, 1, len(q) - 2, len(q) - 1]
    top = np.unique([*top.tolist(), *ends])
    best, pair = _SETTLES, None
    for k, m in combinations(top, 2):
        if size[k] < _ROUGH and size[m] < _ROUGH:
            continue
        other = q.copy()
        other[[k, m]] = q[[m, k]]
        near = np.unique(np.clip(np.concatenate([k + np.arange(-2, 3), m + np.arange(-2, 3)]), 0, len(q) - 1))
        after = np.mean(_roughness(other)[near] / scale[near])
        before = np.mean(size[near])
        if before > _ROUGH and after < best * before and after < _ROUGH:
            best, pair = after / before, (int(k), int(m))
    return pair


def _roughness(q: ComplexArray) -> Array:
    """Return |line - cubic of its neighbours|^2, (freq, m); zero at the ends."""
    roughness = np.zeros(q.shape)
    between = sum(_BESIDE[j] * q[j : len(q) - 4 + j] for j in range(5))
    roughness[2:-2] = np.abs(q[2:-2] - between) ** 2
    return roughness


def _scale(rough: Array, sd: Array) -> Array:
    """Return what the comparison is expected to give at each line, (freq, m)."""
    noise = 2.0 * sd**2 * (1.0 + float(np.sum(_BESIDE**2)))
    around = running_medians(rough, 7)
    return np.asarray(np.maximum(noise + 2.0 * around, 1e-300))


def column_offset(freq_hz: Array, measured: Sequence[NDArray[np.bool_]], names: Sequence[str]) -> str:
    """Describe an offset or a factor between the frequencies of two bodies; empty without one.

    Parameters
    ----------
    freq_hz : ndarray, (freq,)
    measured : sequence of ndarray (freq,), bool
        Where each body was measured.
    names : sequence of str
        Of the bodies.
    """
    for one, two in combinations(range(len(names)), 2):
        first, second = freq_hz[measured[one]], freq_hz[measured[two]]
        if len(first) != len(second) or len(first) < 3 or np.array_equal(first, second):
            continue
        shift, ratio = second - first, second / first
        close = 1e-5 * float(np.median(np.diff(first)))
        if np.ptp(shift) < close:
            how = f"plus {np.mean(shift):.6g} Hz"
        elif np.ptp(ratio) < 1e-6 * float(np.mean(ratio)):
            how = f"times {np.mean(ratio):.6g}"
        else:
            continue
        return f" The frequencies of {names[two]} are those of {names[one]} {how} throughout: check freq_hz."
    return ""
