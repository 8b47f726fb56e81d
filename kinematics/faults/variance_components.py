"""Errors of one common size at all places: positions that are all somewhat off, gains that all differ."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kinematics.faults.score_information import State
from stapeskit.arrays import Array


def information_of(
    state: State, places: Sequence[Sequence[int]], which: Sequence[int]
) -> tuple[Array, Array]:
    """Return score (n k,) and information (n k, n k) of the tangents ``which`` (k) at n places."""
    e, span = state.own_e, state.own_span.conj()
    scores, taken = [], []
    information = np.zeros((len(places) * len(which),) * 2)
    for number, own in enumerate(places):
        channels = np.array(own, dtype=np.intp)
        t = state.tangents(channels, which)
        flat = t.reshape(len(which), -1)
        scores.append(np.real(flat.conj() @ e[:, channels].ravel()))
        block = slice(number * len(which), (number + 1) * len(which))
        other = state.products(channels, t).reshape(len(which), -1)
        information[block, block] = np.real(flat.conj() @ other.T)
        seen = (span[:, channels].swapaxes(1, 2)[None] @ t).reshape(len(which), -1)
        taken.append(np.concatenate([seen.real, seen.imag], axis=1))
    low = np.concatenate(taken)
    return np.concatenate(scores), information - low @ low.T


def likeliest_size(score: Array, information: Array, sizes: Array) -> tuple[float, float]:
    """Return the likeliest standard deviation of parameters, out of sizes, and its log likelihood gain.

    Notes
    -----
    Marginal likelihood of independent normal errors next to the motion, linear in the errors (Harville 1977,
    doi:10.1080/01621459.1977.10480998): along the eigenvectors of the information N with score g, the gain
    over none at a variance v is g_i^2 / (N_i + 1 / 2 v) - log(1 + 2 v N_i) / 2.
    """
    values, vectors = np.linalg.eigh(information)
    along, values = vectors.T @ score, np.maximum(values, 0.0)
    twice = 2.0 * sizes[:, None] ** 2
    gains = np.sum(along**2 * twice / (1.0 + twice * values) - 0.5 * np.log1p(twice * values), axis=1)
    best = int(np.argmax(gains))
    return float(sizes[best]), float(gains[best])
