"""Two faulty channels that hide each other: pairs that explain a misfit which no single channel does."""

from __future__ import annotations

import numpy as np

from kinematics.faults.search import Search

# Channels up to which all pairs are compared, pairs that are tried, the share of the misfit that a pair must
# explain, and of information below which it cannot be seen.
_MOST_PAIRED, _TRIED, _EXPLAINED, _UNSEEN = 600, 3, 0.9, 1e-6


def masking_pairs(first: Search) -> list[tuple[int, int]]:
    """Return the pairs of channels that explain most when left out, the best first.

    Notes
    -----
    Leaving out channels S takes the energy e_S^H (P_SS)^-1 e_S, P the projector on the residuals.
    """
    state, live = first.given, np.array(first.live)
    if len(live) > _MOST_PAIRED or len(first.x):
        return []
    e, span = state.own_e[:, live], state.own_span[:, live]
    norm = np.eye(len(live)) if state.norm is None else state.norm[np.ix_(live, live)]
    p = np.real(norm - span @ span.conj().swapaxes(1, 2))
    energy = np.real(e @ e.conj().swapaxes(1, 2))
    own = np.diagonal(p, axis1=1, axis2=2)
    seen = np.diagonal(energy, axis1=1, axis2=2)
    outer = own[:, :, None] * own[:, None, :]
    det = outer - p**2
    taken = own[:, :, None] * seen[:, None, :] + seen[:, :, None] * own[:, None, :] - 2.0 * p * energy
    gains = np.sum(np.where(det > _UNSEEN * outer, taken / np.where(det > 0.0, det, 1.0), 0.0), axis=0)
    names = np.array([first.data.points[c] for c in live])
    gains = np.where(names[:, None] == names, 0.0, np.triu(gains, 1))
    order = np.argsort(-gains, axis=None)[:_TRIED]
    least = _EXPLAINED * first.excess()
    chosen = [np.unravel_index(k, gains.shape) for k in order]
    return [(int(live[i]), int(live[j])) for i, j in chosen if gains[i, j] > least]
