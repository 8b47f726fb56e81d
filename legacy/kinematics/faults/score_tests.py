"""Score tests of every kind of the catalogue at every place at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.faults.catalogue import KINDS
from legacy.kinematics.faults.nuisance import Marginal
from legacy.kinematics.faults.packed_readings import LEAST_SEGMENTS, Packed
from legacy.kinematics.faults.score_information import AXES, State
from legacy.kinematics.fit.laser_groups import laser_channels
from legacy.stapeskit.arrays import Array

# Share of the largest information below which parameters are not seen: rounding.
_NO_INFORMATION = 1e-9
# Leverage above which the residual of a channel shows nothing: a fiftieth of a fault is left, and over the
# noise that is left with it a seventh.
UNSEEN = 0.98


@dataclass(frozen=True)
class Tested:
    """The score tests of one kind at B places: statistics (B,), chi-squared with ``freedom`` (B,)."""

    kind: str
    owner: str
    groups: NDArray[np.intp]
    statistic: Array
    freedom: NDArray[np.intp]

    @property
    def sets(self) -> list[tuple[int, ...]]:
        """The channels of each place."""
        return [tuple(own) for own in self.groups.tolist()]


def lasers_of(data: Packed) -> list[list[int]]:
    """Return the channels of beams that are nearly parallel at several points, when there are others.

    A single beam off the others by a few degrees stays with them: that its laser is at fault everywhere else
    is no explanation.
    """
    groups = laser_channels(data.assumed.directions, data.live)
    many = [own for own in groups if len({data.points[c] for c in own}) > 2]
    return many if len(groups) > 1 and len(many) <= 8 else []


def places_of(state: State) -> dict[str, Sequence[Sequence[int]]]:
    """Return the sets of channels at which faults are looked for, by their owner."""
    data, used = state.data, state.data.weight > 0.0
    kept = np.sum(np.where(used, 1.0 - state.leverage, 0.0), axis=0)
    seen = kept > (1.0 - UNSEEN) * np.sum(used, axis=0)
    whole = len(data.live) == np.count_nonzero(data.source.share)
    return {
        "channel": [[channel] for channel in data.live if seen[channel]],
        "point": [own for own in data.by_point.values() if len(data.live) - len(own) >= data.size],
        "laser": lasers_of(data),
        "body": [data.live] if whole else [],
    }


def score_tests(near: Marginal, owners: dict[str, Sequence[Sequence[int]]]) -> list[Tested]:
    """Test every kind of fault at every place of each owner, near the most probable nuisance parameters."""
    tests = []
    varying = len(near.state.data.tau) >= LEAST_SEGMENTS
    for owner, places in owners.items():
        for same in of_one_size(places) if owner != "laser" else _each(places):
            size = same.shape[1]
            kinds = [
                name
                for name, kind in KINDS.items()
                if owner in kind.owners
                and (varying or not kind.varies)
                and (owner != "point" or size > 1 or "channel" not in kind.owners)
            ]
            if not kinds or not len(same):
                continue
            which = sorted({k for name in kinds for k in KINDS[name].tangents})
            score, information = scores_at(near, same, which)
            for name in kinds:
                at = [which.index(k) for k in KINDS[name].tangents]
                statistic, freedom = _statistic(score[:, at], information[:, at][:, :, at])
                tests.append(Tested(name, owner, same, statistic, freedom))
    return tests


def _each(places: Sequence[Sequence[int]]) -> list[NDArray[np.intp]]:
    """Return each place as an array (1, n)."""
    return [np.array([own], dtype=np.intp) for own in places]


def of_one_size(places: Sequence[Sequence[int]]) -> list[NDArray[np.intp]]:
    """Return places with as many channels in one array (B, n) each."""
    sizes = sorted({len(own) for own in places})
    return [np.array([own for own in places if len(own) == size], dtype=np.intp) for size in sizes]


def scores_at(near: Marginal, groups: NDArray[np.intp], which: Sequence[int]) -> tuple[Array, Array]:
    """Return scores (B, p) and information (B, p, p) of tangents ``which`` at B sets of channels (B, n)."""
    state, scores, informations = near.state, [], []
    members = groups.shape[1]
    beam = None
    if members > 1 and AXES[0] not in which:
        mean = np.sum(state.model.directions[groups[0]], axis=0)
        beam = state.model.directions[groups[0, 0]] if len(groups) == 1 else None
        beam = beam if np.linalg.norm(mean) > 0.9 * members else None
    for part in state.chunks(groups, len(which), len(near.nuisance.sd)):
        t = state.tangents(part.ravel(), which, beam)
        t = t.reshape(*t.shape[:2], len(part), members, t.shape[-1])
        sums = state.sums(part, t)
        scores.append(sums.score)
        informations.append(near.remaining(part, t, sums))
    return np.concatenate(scores), np.concatenate(informations)


def _statistic(score: Array, information: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return 2 b^T N^-1 b and the rank of N, for scores b (B, p) and information N (B, p, p)."""
    size = np.sqrt(np.maximum(np.einsum("bkk->bk", information), 0.0))
    unit = np.where(size > 1e-145, 1.0 / np.maximum(size, 1e-145), 0.0)
    values, vectors = np.linalg.eigh(information * unit[:, :, None] * unit[:, None, :])
    along = (vectors.swapaxes(1, 2) @ (score * unit)[:, :, None])[:, :, 0]
    seen = values > _NO_INFORMATION * np.maximum(values[:, -1:], 1e-300)
    seen &= values > 1e-12
    statistic = 2.0 * np.sum(np.where(seen, along**2 / np.where(seen, values, 1.0), 0.0), axis=1)
    return statistic, np.sum(seen, axis=1)
