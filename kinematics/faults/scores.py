"""Score tests of every kind of fault at every place, the motion and the expected errors free.

Shapes: c channels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from kinematics.faults.kinds import KINDS, Place
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
) -> Iterator[tuple[Place, list[str], Array, Array]]:
    """Yield every place with its kinds, and score (13,) and information (13, 13) of all tangents there.

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
    directions = state.geometry.directions
    parallel = bool(np.all(np.abs(directions @ directions[0]) > 0.999))
    for first in range(0, len(places), _BLOCK):
        some = places[first : first + _BLOCK]
        rows = [[where[channel] for channel in place.channels] for place in some]
        p = np.stack([projected[own].sum(axis=0) for own in rows])
        n = 2.0 * np.stack([state.m[list(place.channels)].sum(axis=0) for place in some])
        n -= 2.0 * p @ p.swapaxes(1, 2)
        if len(expected):
            half = p @ -moved
            for one, own in zip(half, rows, strict=True):
                along = cross[own].sum(axis=0)
                few = np.flatnonzero(along.any(axis=0))  # errors of these channels
                one += along[:, few] @ root.T[few]
            n -= 4.0 * half @ half.swapaxes(1, 2)
        for place, information in zip(some, n, strict=True):
            score = 2.0 * state.b[list(place.channels)].sum(axis=0)
            yield place, place.kinds(len(state.packed.tau), parallel), score, information


def score_tests(state: State, expected: Parameters, places: Sequence[Place]) -> list[Test]:
    """Test every kind at every place by Rao's score test: b^T N^-1 b of the score b and the information N."""
    tests = []
    for place, kinds, b, n in informations(state, expected, places):
        for kind in kinds:
            k = list(KINDS[kind].tangents)
            size = np.diag(n)[k]
            scale = np.sqrt(np.where(size > 0.0, size, np.inf))  # none where rounding left no information
            value, vector = np.linalg.eigh(n[np.ix_(k, k)] / np.outer(scale, scale))
            good = value > 1e-8 * max(value[-1], 1e-300)
            along = vector.T @ (b[k] / scale)
            if good.any():
                statistic = float(np.sum(along[good] ** 2 / value[good]))
                tests.append(Test(place, kind, statistic, int(good.sum())))
    return tests


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
