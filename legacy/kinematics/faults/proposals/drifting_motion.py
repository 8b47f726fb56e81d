"""A motion that changed while the points were recorded one after the other, as a sample dries."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.faults.estimated_weights import equalise_noise
from legacy.kinematics.faults.noise_size import channel_noise
from legacy.kinematics.faults.nuisance import Nuisance
from legacy.kinematics.faults.packed_readings import Packed, whitened
from legacy.kinematics.faults.proposals.misfitting_body import Cause, MisfittingBody, Remedy
from legacy.kinematics.faults.score_information import State
from legacy.kinematics.faults.score_tests import lasers_of, of_one_size
from legacy.stapeskit.arrays import Array

# Powers of the order of the file that are tried, and residual directions that the last leaves at least.
_POWERS, _LEAST_FREE = (1, 2), 3.0
# Other orders of the points that the order of the file must surpass, all of them: by chance one of a hundred
# does.
_ORDERS = 99
# Share of the misfit beyond noise that may be left, and standard deviations of noise that are granted. A body
# that bends leaves a third and more, on average, where most of the residual directions are taken.
_LEFT, _SURELY = 0.05, 3.0
# Points that are left out together in trial: as many as the largest exchange that is sought, three names in a
# cycle; and among how many of those whose faults alone explain most. Computation: 560 sets.
_TOGETHER, _SUSPECTS = 3, 16
# Share of the mean motion by which it may change: beyond, it would turn round on the way. A stiffness that
# rises by 20 % changes it by 0.3 to 1.0 in 40 simulated bodies; exchanged names pass for a drift of 2.8.
_LARGEST = 2.0
# Share of the variance of the order that the places of the points explain beyond chance, from which on a
# body that bends would change in that order as well: half, by judgement. benchmarks/drifting_motion.py checks
# these numbers on bodies that they were not chosen on: 1 of 440 that bend is said to drift.
_ALONG_PLACES = 0.5


def drifting_motion(suspect: MisfittingBody) -> Iterator[Cause]:
    """Yield a rigid motion that changes from point to point in the order of the file.

    Notes
    -----
    At every point the body moves as a rigid body, by a motion that is a polynomial of the number of the
    point: where a stiffness falls or rises, resonances shift, and no factor of a point explains that. It
    must explain nearly all of the misfit, more than faults at a few places could, and the order of the file
    more than each of many other orders (a permutation test: Fisher 1935, The design of experiments).
    """
    data = suspect.packed(suspect.plain, suspect.known)
    if not suspect.known:
        data = equalise_noise(data, Nuisance.of(data, suspect.position_sd_m))
    names = list(data.by_point)
    place = {name: number for number, name in enumerate(names)}
    # A point without readings weighs nothing.
    number = np.array([place.get(point, 0) for point in data.points])
    order = 2.0 * number / max(len(names) - 1, 1) - 1.0
    state = State.of(data)
    for power in _POWERS:
        rest = _with_drift(state, order, power)
        if rest is None:
            return
        if (
            _explains(state, rest, suspect.known)
            and rest.energy < _least_without(state, power)
            and _surpasses(state, rest, number, power)
        ):
            share = _share(data, order, power)
            if share > _LARGEST:
                return
            alike = _explained(data.assumed.arms_m, order, [own[0] for own in data.by_point.values()])
            remedy = Remedy(list(data.live), suspect.body, share, alike > _ALONG_PLACES, judged=True)
            yield remedy, {"first": names[0], "last": names[-1], "share": 100.0 * share}
            return


def _with_drift(state: State, order: Array, power: int) -> State | None:
    """Return the fit with drift next to the motion; None where too few directions are left."""
    span, data = state.span, state.data
    for k in range(1, power + 1):
        rows = whitened(order[:, None] ** k * state.own, data.whiten)
        rows = rows - span @ (span.conj().swapaxes(1, 2) @ rows)
        vectors, sizes, _ = np.linalg.svd(rows, full_matrices=False)
        if np.min(sizes) < 1e-9 * np.max(sizes):
            return None
        span = np.concatenate([span, vectors], axis=2)
    own = span[:, :, state.span.shape[2] :]
    with_drift = replace(state, span=span, e=state.e - own @ (own.conj().swapaxes(1, 2) @ state.e))
    return with_drift if float(np.mean(with_drift.free())) >= _LEAST_FREE else None


def _explains(state: State, rest: State, known: bool) -> bool:
    """Return whether a fit with drift leaves little of the misfit beyond noise."""
    level = 1.0 if known else channel_noise(rest).level
    before, after = (level * float(np.sum(fit.free())) * fit.both.shape[2] for fit in (state, rest))
    chance = _SURELY * float(np.sqrt(level * after))
    misfit, left = (float(np.sum(np.abs(fit.both) ** 2)) for fit in (state, rest))
    return left - after - chance < _LEFT * (misfit - before)


def _least_without(state: State, power: int) -> float:
    """Return the least residual energy without a channel, a laser, or up to three points.

    A fault of these channels, whatever its kind, leaves no less. Points are left out together as long as they
    have no more channels than a drift has parameters at each line.
    """
    data = state.data
    points = [tuple(own) for own in data.by_point.values()]
    alone = [*points, *((channel,) for channel in data.live), *map(tuple, lasers_of(data))]
    alone = [own for own in dict.fromkeys(alone) if 2 * len(own) < len(data.live)]
    falls = dict[tuple[int, ...], float]()
    for same in of_one_size(alone):
        falls |= zip(map(tuple, same.tolist()), state.left_out(same).tolist(), strict=True)
    worst = sorted((own for own in points if own in falls), key=lambda own: -falls[own])[:_SUSPECTS]
    most = power * state.own.shape[2]
    sets = [
        sum(some, ())
        for count in range(2, _TOGETHER + 1)
        for some in combinations(worst, count)
        if sum(map(len, some)) <= most
    ]
    together = [np.max(state.left_out(same)) for same in of_one_size(sets)]
    return state.energy - float(max([*falls.values(), *together], default=0.0))


def _surpasses(state: State, rest: State, number: NDArray[np.int_], power: int) -> bool:
    """Return whether the order of the file leaves less than each of many other orders of the points."""
    rng = np.random.default_rng(0)
    count = int(number.max()) + 1
    tried, least = set[tuple[int, ...]](), rest.energy
    for _ in range(_ORDERS):
        turn = rng.permutation(count)
        one = tuple(turn.tolist())
        if one in tried or one in (tuple(range(count)), tuple(range(count))[::-1]):
            continue
        tried.add(one)
        other = _with_drift(state, 2.0 * turn[number] / (count - 1) - 1.0, power)
        if other is not None and other.energy <= least:
            return False
    return len(tried) >= _ORDERS // 2


def _explained(arms_m: Array, order: Array, first: list[int]) -> float:
    """Return the share of the variance of the order that places explain, adjusted for their number."""
    t = order[first]
    columns = np.column_stack([np.ones(len(t)), arms_m[first]])
    left = t - columns @ np.linalg.lstsq(columns, t, rcond=1e-6)[0]
    free = len(t) - np.linalg.matrix_rank(columns, tol=1e-6 * np.linalg.norm(columns))
    return 1.0 if free < 1 else float(1.0 - np.mean(left**2) / np.mean(t**2) * (len(t) - 1) / free)


def _share(data: Packed, order: Array, power: int) -> float:
    """Return the change from the first point to the last, as a share of the motion (rms of all channels)."""
    own = State.of(data).own
    columns = np.concatenate([order[:, None] ** k * own for k in range(power + 1)], axis=2)
    coefficient = np.linalg.pinv(columns, rcond=1e-9) @ data.y
    size = own.shape[2]
    mean, change = own @ coefficient[:, :size], 2.0 * own @ coefficient[:, size : 2 * size]
    return float(np.sqrt(np.sum(np.abs(change) ** 2) / np.sum(np.abs(mean) ** 2)))
