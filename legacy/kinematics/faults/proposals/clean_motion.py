"""The motion of a body without the channels that spoil it, to compare with what any other rows hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.faults.packed_readings import Assumed, Packed, Source, packed
from legacy.kinematics.faults.score_information import State
from legacy.kinematics.fit.beams import BeamSet
from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.spatial import dof_indices

Lines = NDArray[np.intp]
# Up to so many lines are all looked at; of more, about as many in groups of neighbours, for shifts by REACH.
_WHOLE = 300
_BLOCKS, REACH = 43, 3
# A point is left out when that takes this share of the misfit, and so many times what noise would.
_FALL, _TIMES = 0.3, 4.0
# One of its channels alone, when that takes nearly all of it, or what the others hold is little above noise.
_ALONE, _QUIET = 0.97, 1.4
# The weakest direction of motion must keep this share of the strongest's lever.
_HELD = 1e-3
# Points that are left out at most, and the best candidates that are tried for each.
_MOST, _TRIED = 8, 5


@dataclass(frozen=True)
class CleanMotion:
    """One body in one run.

    Attributes
    ----------
    number : int
        Of the body.
    lines : ndarray, (n,), int
        The lines that were looked at.
    freq_hz, rate : ndarray, (n,)
        Of these lines, and its power that brings displacements to the size of what was read.
    step_hz : float
        Between lines, median.
    value, variance : ndarray, (channel, n)
        Readings, m, and variance of a complex reading, m^2; zero and infinite where missing.
    q : ndarray, (n, 6), complex
        Motion without the suspects; zero where the beams do not observe it.
    covariance : ndarray, (n, 6, 6)
        Complex covariance E[dq dq^H].
    suspects : tuple of tuple of int
        Channels of a point, or single ones, without which the others agree much better.
    level : float
        Residual energy of the others over that of the stated noise.
    """

    run: int
    number: int
    body: BodyChannels
    lines: Lines
    freq_hz: Array
    rate: Array
    step_hz: float
    value: ComplexArray
    variance: Array
    q: ComplexArray
    covariance: Array
    suspects: tuple[tuple[int, ...], ...]
    level: float


def chosen_lines(good: NDArray[np.bool_]) -> Lines:
    """Return the determined lines, of all (freq,), or, of many, evenly spread groups of neighbours."""
    lines = np.flatnonzero(good)
    if len(lines) <= _WHOLE:
        return lines
    starts = np.linspace(REACH, len(lines) - 1 - REACH, _BLOCKS).round().astype(int)
    return np.asarray(lines[np.unique(starts[:, None] + np.arange(-REACH, REACH + 1))])


def fit_clean_motion(
    key: tuple[int, int], fit: LineFit, placed: Measurement, beams: BeamSet, sd: Array, lines: Lines
) -> CleanMotion:
    """Leave out one point after the other as long as that explains much of what is left.

    Of a run and body, ``key``, with the beams for all degrees of freedom that are observed, and at some lines
    (n,) with their standard deviations (channel, n), m.
    """
    body, freq_hz = placed.bodies[key[1]], placed.freq_hz
    value = fit.value[:, lines]
    sd = np.where(np.isfinite(value) & np.isfinite(sd), sd, np.inf)
    count, even = len(value), np.ones(len(lines))
    source = Source(beams, body.points, fit.value, lines, np.ones(count), even, sd, 0.0 * even, even)
    data = packed(source, Assumed(body.positions_mm * 1e-3, body.directions, np.ones(count)))
    groups: dict[str, list[int]] = {}
    for channel, name in enumerate(body.points):
        groups.setdefault(name, []).append(channel)
    suspects: list[tuple[int, ...]] = []
    strongest = np.asarray(np.linalg.eigvalsh(_gram(data))[:, -1], dtype=float)
    for _ in range(min(max(1, len(groups) // 3), _MOST)):
        own = _next_suspect(data, groups, strongest)
        if own is None:
            break
        del groups[body.points[own[0]]]
        suspects.append(tuple(own))
        data = data.under(data.assumed.without(own))
    inverse = np.asarray(np.linalg.pinv(_gram(data), rcond=1e-14, hermitian=True), dtype=float)
    state = State.of(data)
    places = dof_indices(beams.dof)
    q = np.zeros((len(lines), 6), dtype=complex)
    q[:, places] = state.z[:, :, 0] @ beams.to_dof.T
    covariance = np.zeros((len(lines), 6, 6))
    covariance[np.ix_(range(len(lines)), places, places)] = beams.to_dof @ inverse @ beams.to_dof.T
    level = state.energy / max(float(np.sum(state.free())), 1.0)
    value = np.where(np.isfinite(sd), value, 0.0)
    step_hz = float(np.median(np.diff(freq_hz))) if len(freq_hz) > 1 else np.nan
    freq_hz = freq_hz[lines]
    return CleanMotion(
        *key,
        body,
        lines,
        freq_hz,
        freq_hz**placed.order,
        step_hz,
        value,
        2.0 * sd**2,
        q,
        covariance,
        tuple(suspects),
        level,
    )


def _next_suspect(data: Packed, groups: dict[str, list[int]], strongest: Array) -> list[int] | None:
    """Return the channels of a point, or one of them, without which the others agree much better."""
    state = State.of(data)
    before = state.energy
    if not float(np.sum(state.free())) > 0.5:
        return None
    falls = dict[str, float]()
    for size in {len(own) for own in groups.values()}:
        same = {name: own for name, own in groups.items() if len(own) == size}
        falls |= zip(same, state.left_out(np.array(list(same.values()))).tolist(), strict=True)
    for name in sorted(falls, key=lambda name: -falls[name])[:_TRIED]:
        own, fall = groups[name], falls[name]
        rest = data.under(data.assumed.without(own))
        weakest = np.linalg.eigvalsh(_gram(rest))[:, 0]
        if np.median(weakest / strongest) > _HELD**2:
            break
    else:
        return None
    noise = max((before - fall) / max(float(np.sum(State.of(rest).free())), 1.0), 1e-300)
    lines = len(data.y)
    if fall < _FALL * before or fall < _TIMES * noise * len(own) * lines:
        return None
    for channel in own if len(own) > 1 else ():
        alone = float(state.left_out(np.array([[channel]]))[0])
        if alone > _ALONE * fall or fall - alone < _QUIET * noise * (len(own) - 1) * lines:
            return [channel]
    return own


def _gram(data: Packed) -> Array:
    """Return the normal matrices (line, m, m) of every line."""
    rows = data.weight[:, :, None] * data.rows(data.assumed.arms_m, data.assumed.directions)
    return np.asarray(rows.swapaxes(1, 2) @ rows)


__all__ = ["REACH", "CleanMotion", "Lines", "chosen_lines", "fit_clean_motion"]
