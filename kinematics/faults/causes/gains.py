"""Gains that differ from channel to channel, or from point to point, all a little."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.causes.suspect import Explanation, Suspect
from kinematics.faults.fault_model import State, solve
from kinematics.faults.packed.compact import Compact, compact
from stapeskit.vocabulary import named

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
_LEAST_OWNERS = 4
# Residual directions per degree of freedom below which gains and a body that bends look alike.
_REDUNDANT = 2.0
# The range of relative errors that is searched.
_SMALLEST, _LARGEST = 1e-4, 0.5
# Log likelihood that scatter must gain, and smallest scatter of interest.
_GAIN, _WORTH = 10.0, 1e-3
# Rank correlation with the order of the file from which on the points drift.
_IN_ORDER = 0.8
_ROUNDS = 3


@dataclass(frozen=True)
class Scatter:
    """Relative errors (owner,) of groups of channels, complex, with their common sd and log likelihood."""

    error: ComplexArray
    sd: float
    gain: float


def gains(suspect: Suspect) -> Iterator[Explanation]:
    """Yield gains scattered over channels, and complex factors scattered over points, the likelier first."""
    data = compact(suspect.plain, suspect.body, suspect.freq_hz, False, suspect.placed.line_spread)
    live, size = data.live, data.beams.basis.shape[1]
    if len(live) - size < _REDUNDANT * size:
        return
    points: dict[str, list[int]] = {}
    for channel in live:
        points.setdefault(data.points[channel], []).append(channel)
    channels = [[channel] for channel in live]
    tried = [(channels, False)]
    if len(points) < len(live):
        tried += [(list(points.values()), True)]
    found = [(owners, turned, _scatter(data, owners, turned)) for owners, turned in tried]
    for owners, _turned, scatter in sorted(found, key=lambda entry: -entry[2].gain):
        if len(owners) >= _LEAST_OWNERS and scatter.gain > _GAIN and scatter.sd > _WORTH:
            yield _explanation(suspect, data, owners, scatter)


def _explanation(suspect: Suspect, data: Compact, owners: list[list[int]], scatter: Scatter) -> Explanation:
    value = suspect.value.copy()
    for own, error in zip(owners, scatter.error, strict=True):
        value[own] = value[own] / (1.0 + error)
    channels = [channel for own in owners for channel in own]
    sd = 100.0 * scatter.sd
    most = owners[int(np.argmax(np.abs(scatter.error)))][0]
    factor = abs(1.0 + scatter.error[int(np.argmax(np.abs(scatter.error)))])
    per_point = any(len(own) > 1 for own in owners)
    if per_point and abs(_rank_correlation(np.abs(1.0 + scatter.error))) > _IN_ORDER:
        first, last = abs(1.0 + scatter.error[0]), abs(1.0 + scatter.error[-1])
        text = (
            f"the readings change from point to point in the order of the file, by a factor of "
            f"{last / first:.3g} from point {data.points[owners[0][0]]} to {data.points[owners[-1][0]]}"
        )
        step = (
            "The motion changed while the points were recorded one after the other (drying, drift of the "
            "source): measure the first point again at the end, or give a reference recorded with each point"
        )
        code, verdict = "drift_between_points", "drift"
    else:
        what = "points" if per_point else "channels"
        name = f"point {data.points[most]}" if per_point else f"channel {suspect.body.channel_name(most)}"
        text = (
            f"the gains of the {what} scatter by about {sd:.2g} % (standard deviation), most at {name} "
            f"(factor {factor:.4g})"
        )
        step = (
            f"Calibrate the channels, or state the scatter and fit it with {named('calibrate')} "
            f"{named('gain_sd')} {sd:.2g}"
        )
        code, verdict = "gains_scattered", "gain"
    return Explanation(code, verdict, channels, text, step, scatter.sd, suspect.with_value(value))


def _scatter(data: Compact, owners: list[list[int]], turned: bool) -> Scatter:
    """Return the likeliest relative errors of groups of channels, independent and of one common size.

    Notes
    -----
    Marginal likelihood of independent normal errors next to the motion, linear in the errors (Harville 1977,
    doi:10.1080/01621459.1977.10480998): along the eigenvectors of the information N with score g, the gain
    over none at a variance v is g_i^2 / (N_i + 1 / 2 v) - log(1 + 2 v N_i) / 2; the errors are the means
    (N + 1 / 2 v)^-1 g. Repeated with the errors undone, as the motion is found anew.
    """
    error, sd, gain = np.zeros(len(owners), dtype=complex), 0.0, 0.0
    current = data
    for turn in range(_ROUNDS):
        state = solve(current)
        score, information = _information(state, owners, turned)
        level = _level(state)
        score, information = score / level, information / level
        values, vectors = np.linalg.eigh(information)
        along, values = vectors.T @ score, np.maximum(values, 0.0)
        if turn == 0:
            sizes = np.geomspace(_SMALLEST, _LARGEST, 80)
            twice = 2.0 * sizes[:, None] ** 2
            likely = np.sum(
                along**2 * twice / (1.0 + twice * values) - 0.5 * np.log1p(twice * values), axis=1
            )
            best = int(np.argmax(likely))
            sd, gain = float(sizes[best]), float(likely[best])
        step = vectors @ (along / (values + 0.5 / sd**2))
        step = step[: len(owners)] + (1j * step[len(owners) :] if turned else 0.0)
        error = (1.0 + error) * (1.0 + step) - 1.0
        current = data
        for own, one in zip(owners, error, strict=True):
            current = current.scaled(own, np.full(current.y.shape[1], 1.0 + one))
    return Scatter(error, sd, gain)


def _level(state: State) -> float:
    """Return the variance of the noise by the lines without motion, or else by the quieter residuals."""
    free = max(len(state.data.live) - state.span.shape[1], 1)
    rest = state.rest()
    if rest.shape[1] >= 8:
        return float(np.sum(np.abs(rest) ** 2)) / free / rest.shape[1]
    values = np.sort(np.abs(state.e[state.data.live]).ravel() ** 2)
    return float(np.median(values)) / np.log(2.0) * len(state.data.live) / free


def _information(state: State, owners: list[list[int]], turned: bool) -> tuple[Array, Array]:
    """Return score and information of relative errors, real parts first, then imaginary ones."""
    data = state.data
    moved = data.a[:, None] * (data.beams.basis @ state.z)
    columns = np.zeros((len(owners), *state.e.shape), dtype=complex)
    for number, own in enumerate(owners):
        columns[number][own] = moved[own]
    if turned:
        columns = np.concatenate([columns, 1j * columns])
    columns = columns - state.span @ (state.span.T @ columns)
    flat = columns.reshape(len(columns), -1)
    return np.real(flat.conj() @ state.e.ravel()), np.real(flat.conj() @ flat.T)


def _rank_correlation(value: Array) -> float:
    """Return the rank correlation of values with their order."""
    rank = np.argsort(np.argsort(value))
    return float(np.corrcoef(rank, np.arange(len(value)))[0, 1]) if np.ptp(value) > 0.0 else 0.0
