"""Two channels at fault that hide each other: alone, each is blamed on its neighbours."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.adequate import account_for_it, corrected
from kinematics.faults.findings import Finding, can_lose
from kinematics.faults.packed.compact import Compact
from kinematics.faults.search import Search

Array = NDArray[np.float64]
# Channels up to which all pairs are compared (the memory goes with the square), and pairs that are tried.
_MOST, _TRIED = 600, 3
# The share of the misfit that a pair must explain, and of information below which a pair cannot be told.
_EXPLAINED, _UNSEEN = 0.9, 1e-6


def masked_pair(
    first: Search, data: Compact, searched: Callable[[Compact], Search]
) -> tuple[list[Finding], Search] | None:
    """Return the faults of two channels without which nothing is left to be found, and the search without.

    Parameters
    ----------
    first : Search
        Before anything was left out.
    data : Compact
    searched : callable
        Data to their search.

    Returns
    -------
    (list of Finding, Search) or None
        None where no two channels at different points explain what was found, or where their faults, undone
        by their estimates, leave more than noise. Faults that drift are left: two of them have enough
        parameters to pass for a body that bends.
    """
    for one, two in _pairs(first):
        if not can_lose(data, [one, two]):
            continue
        last = searched(data.without([one, two]).repacked())
        if last.best() is not None:
            continue
        findings = [searched(data.without([other]).repacked()).best() for other in (two, one)]
        told = [finding for finding in findings if finding is not None and finding.fit is not None]
        if any(found.kind == "drift" for found in told):
            continue
        if [found.channels for found in told] != [[one], [two]]:
            continue
        if account_for_it(first, searched(corrected(data, told)), told):
            return told, last
    return None


def _pairs(first: Search) -> list[tuple[int, int]]:
    """Return the pairs of channels that explain most when left out, the best first.

    Notes
    -----
    Leaving out channels S takes the energy e_S^H (P_SS)^-1 e_S, P the projector on the residuals.
    """
    state, live = first.state, np.array(first.live)
    if len(live) > _MOST or first.places.owners:
        return []
    e, span = state.own_e[live], state.own_span[live]
    norm = np.eye(len(live)) if state.norm is None else state.norm[np.ix_(live, live)]
    p, energy = norm - span @ span.T, np.real(e @ e.conj().T)
    own, seen = np.diag(p), np.diag(energy)
    det = np.outer(own, own) - p**2
    taken = np.outer(own, seen) + np.outer(seen, own) - 2.0 * p * energy
    place = np.where(det > _UNSEEN * np.outer(own, own), taken / np.where(det > 0.0, det, 1.0), 0.0)
    names = np.array([first.data.points[c] for c in live])
    place = np.where(names[:, None] == names, 0.0, np.triu(place, 1))
    order = np.argsort(-place, axis=None)[:_TRIED]
    least = _EXPLAINED * first.excess()
    chosen = [np.unravel_index(k, place.shape) for k in order]
    return [(int(live[i]), int(live[j])) for i, j in chosen if place[i, j] > least]
