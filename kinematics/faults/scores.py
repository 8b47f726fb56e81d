"""Score tests of every kind of fault at every place, the motion and the expected errors free.

Shapes: c channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kinematics.faults.fault_kinds import KINDS, Place
from kinematics.joint.estimate import State, system
from kinematics.joint.tangents import Parameters
from stapeskit.arrays import Array

_BLOCK = 64  # places at a time: large products of matrices, some MB
_ROUNDING = 1e-12  # of correlations: exact data determine some errors 1e12 times better than others


@dataclass(frozen=True)
class Test:
    """A test of one kind at one place: its statistic is chi2 of ``freedom`` without such a fault."""

    place: Place
    kind: str
    statistic: float
    freedom: int


@dataclass(frozen=True)
class Noise:
    """How well the size of the noise is known.

    Attributes
    ----------
    level : float
        Variance of the noise over the assumed one.
    freedom : float
        Degrees of freedom of the level; infinite when it is stated.
    """

    level: float = 1.0
    freedom: float = np.inf

    def log_tail(
        self, statistic: Array | float, freedom: Array | float, known: Array | float | None = None
    ) -> Array:
        """Return log P(statistic or more) of a sum of squares over noise of this level.

        The tail is that of chi2, or of F where the level has degrees of freedom, ``known`` for channels whose
        own noise was estimated; beyond the range of doubles it is continued by its leading terms.
        """
        from scipy.special import chdtrc, fdtrc, gammaln

        statistic = np.maximum(np.asarray(statistic) / self.level, 1e-300)
        freedom = np.maximum(np.asarray(freedom), 1e-9)
        if known is not None or np.isfinite(self.freedom):
            known = self.freedom if known is None else known
            tail = fdtrc(freedom, known, statistic / freedom)
            far = -0.5 * known * np.log1p(statistic / known)
        else:
            tail = chdtrc(freedom, statistic)
            half = 0.5 * statistic
            far = -half + (0.5 * freedom - 1.0) * np.log(half) - gammaln(0.5 * freedom)
        return np.where(tail > 1e-290, np.log(np.maximum(tail, 1e-300)), np.minimum(far, -660.0))


def informations(
    state: State, expected: Parameters, places: Sequence[Place]
) -> tuple[list[list[str]], Array, Array]:
    """Return the kinds of every place, and score (P, 13) and information (P, 13, 13) of all tangents there.

    Notes
    -----
    The parts of the information along the motion and along the expected errors (with their priors) are
    subtracted (Schur complement).
    """
    channels = sorted({channel for place in places for channel in place.channels})
    where = {channel: row for row, channel in enumerate(channels)}
    projected = state.projected(channels)
    if len(expected):
        _, inner, known = system(state, expected)
        whole = inner + np.diag(expected.prior)
        size = np.sqrt(np.diag(whole))
        scaled = whole / np.outer(size, size) + _ROUNDING * np.eye(len(size))
        root = np.linalg.inv(np.linalg.cholesky(scaled)) / size
        moved = known.T @ root.T
        cross = state.m[channels][:, :, expected.tangent] * expected.mask[:, channels].T[:, None, :]
    score = np.array([2.0 * state.b[list(place.channels)].sum(axis=0) for place in places])
    information = np.array([2.0 * state.m[list(place.channels)].sum(axis=0) for place in places])
    for first in range(0, len(places), _BLOCK):
        rows = [[where[channel] for channel in place.channels] for place in places[first : first + _BLOCK]]
        p = np.stack([projected[own].sum(axis=0) for own in rows])
        information[first : first + _BLOCK] -= 2.0 * p @ p.swapaxes(1, 2)
        if len(expected):
            half = p @ -moved
            for one, own in zip(half, rows, strict=True):
                along = cross[own].sum(axis=0)
                few = np.flatnonzero(along.any(axis=0))  # errors of these channels
                one += along[:, few] @ root.T[few]
            information[first : first + _BLOCK] -= 4.0 * half @ half.swapaxes(1, 2)
    directions = state.geometry.directions
    parallel = bool(np.all(np.abs(directions @ directions[0]) > 0.999))
    return [place.kinds(len(state.packed.tau), parallel) for place in places], score, information


def score_tests(state: State, expected: Parameters, places: Sequence[Place]) -> list[Test]:
    """Test every kind at every place by Rao's score test: b^T N^-1 b of the score b and the information N."""
    if not places:
        return []
    kinds, score, information = informations(state, expected, places)
    tests: list[list[Test]] = [[] for _ in places]
    for kind, entry in KINDS.items():
        own, k = [row for row, some in enumerate(kinds) if kind in some], list(entry.tangents)
        n, b = information[np.ix_(own, k, k)], score[np.ix_(own, k)]
        size = np.diagonal(n, axis1=1, axis2=2)
        scale = np.sqrt(np.where(size > 0.0, size, np.inf))  # none where rounding left no information
        value, vector = np.linalg.eigh(n / (scale[:, :, None] * scale[:, None, :]))
        good = value > 1e-8 * np.maximum(value[:, -1:], 1e-300)
        along = np.einsum("pij,pi->pj", vector, b / scale)
        statistic = np.sum(np.where(good, along**2 / np.where(good, value, 1.0), 0.0), axis=1)
        for row, found, freedom in zip(own, statistic.tolist(), good.sum(axis=1).tolist(), strict=True):
            tests[row] += [Test(places[row], kind, found, freedom)] if freedom else []
    return [test for some in tests for test in some]


def pattern_gain(state: State, level: float) -> float:
    """Return how much log likelihood one bending shape gains: a pattern over channels, free at each line.

    Notes
    -----
    The shape costs half the logarithm of the number of values for each of its
    coefficients (Schwarz 1978, doi:10.1214/aos/1176344136).
    """
    columns = int(state.packed.columns.sum())
    coefficients = len(state.packed.live) - state.q.shape[2] + 2 * columns
    e = state.e.swapaxes(0, 1).reshape(state.e.shape[1], -1)
    strongest = 2.0 * float(np.linalg.norm(e, 2)) ** 2 / level - 2.0 * columns
    return 0.5 * strongest - 0.5 * coefficients * float(np.log(state.packed.values))
