"""Three points whose names were exchanged in a cycle."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from kinematics.faults.causes.misfit_causes import Explanation, MisfittingBody
from kinematics.fit.neglected_motion import extended_beams

# Up to so many points all cycles are compared (2 280 of them), and what the best may leave of the misfit.
_MOST_POINTS, _LEFT = 20, 0.5


def cycles(suspect: MisfittingBody) -> Iterator[Explanation]:
    """Yield the three points that move as one body when each takes the readings of the next.

    Notes
    -----
    Readings V leave tr(P V V^H), P the projection onto what no rigid motion makes; other names only change
    the order of the rows of V.
    """
    body = suspect.body
    value = suspect.value[:, np.all(np.isfinite(suspect.value), axis=0)]
    own: dict[str, list[int]] = {}
    for channel, point in enumerate(body.points):
        own.setdefault(point, []).append(channel)
    if not 3 <= len(own) <= _MOST_POINTS or value.shape[1] < 2:
        return
    rows = np.linalg.qr(extended_beams(body, suspect.beams.dof).basis)[0]
    outside = np.eye(len(rows)) - rows @ rows.T
    power = np.real(value @ value.conj().T)
    whole = float(np.sum(outside * power))
    least, likeliest, order = _LEFT * whole, ("", "", ""), np.arange(len(rows))
    for three in combinations(own, 3):
        beams = [body.directions[own[point]] for point in three]
        if any(one.shape != beams[0].shape or not np.allclose(one, beams[0]) for one in beams):
            continue
        for cycle in (three, three[::-1]):
            taken = np.arange(len(rows))
            for point, following in zip(cycle, (*cycle[1:], cycle[0]), strict=True):
                taken[own[point]] = own[following]
            left = float(np.sum(outside * power[np.ix_(taken, taken)]))
            if left < least:
                least, likeliest, order = left, cycle, taken
    if not likeliest[0]:
        return
    channels = sorted(channel for point in likeliest for channel in own[point])
    first, second, third = likeliest
    text = (
        f"the names of three points look exchanged: the rows of {second} belong to {first}, those of {third} "
        f"to {second} and those of {first} to {third}"
    )
    words = (text, "Correct the column point, or the positions of the three")
    put_right = suspect.with_value(suspect.value[order])
    yield Explanation.of("channel_label_swap", "label_swap", channels, words, 0.0, put_right)
