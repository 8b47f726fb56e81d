"""Score tests of every kind of fault at every place, the motion and the expected errors free.

Shapes: c channels, s places, p expected errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.kinds import KINDS, SHARE, Place
from kinematics.joint.estimate import State, system
from kinematics.joint.tangents import Parameters
from stapeskit.arrays import Array

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

    def log_tail(self, statistic: Array | float, freedom: Array | float) -> Array:
        """Return log P(statistic or more) of a sum of squares over noise of this level."""
        return log_tail(np.asarray(statistic) / self.level, np.asarray(freedom), self.freedom)


def log_tail(statistic: Array, freedom: Array, level_freedom: float = np.inf) -> Array:
    """Return the logarithm of the upper tail of chi2, or of F with a level of so many degrees of freedom.

    Beyond the range of doubles it is continued by its leading terms.
    """
    from scipy.special import chdtrc, fdtrc, gammaln

    statistic = np.maximum(statistic, 1e-300)
    freedom = np.maximum(freedom, 1e-9)
    if np.isfinite(level_freedom):
        tail = fdtrc(freedom, level_freedom, statistic / freedom)
        far = -0.5 * level_freedom * np.log1p(statistic / level_freedom)
    else:
        tail = chdtrc(freedom, statistic)
        half = 0.5 * statistic
        far = -half + (0.5 * freedom - 1.0) * np.log(half) - gammaln(0.5 * freedom)
    with np.errstate(divide="ignore"):
        return np.where(tail > 1e-290, np.log(np.maximum(tail, 1e-300)), np.minimum(far, -660.0))


@dataclass(frozen=True)
class Owned:
    """Places of one owner, with the score (s, 13) and information (s, 13, 13) of all tangents there."""

    places: list[Place]
    score: Array
    information: Array

    def with_kind(self, kind: str, state: State) -> list[int]:
        """Return the places that can have a kind."""
        directions = state.geometry.directions
        parallel = bool(np.all(np.abs(directions @ directions[0]) > 0.999))
        groups = len(state.packed.tau)
        return [k for k, place in enumerate(self.places) if kind in place.kinds(groups, parallel)]


def informations(state: State, expected: Parameters, places: Sequence[Place]) -> list[Owned]:
    """Return score and information of all tangents at every place, by owner.

    Notes
    -----
    The parts of the information along the motion and along the expected errors (with their priors) are
    subtracted (Schur complement).
    """
    channels = sorted({channel for place in places for channel in place.channels})
    where = {channel: row for row, channel in enumerate(channels)}
    projected = state.projected(channels)
    root, known, cross = None, np.zeros((0, 0)), np.zeros((0, 0, 0))
    if len(expected):
        _, information, known = system(state, expected)
        whole = information + np.diag(expected.prior)
        size = np.sqrt(np.diag(whole))
        scaled = whole / np.outer(size, size) + _ROUNDING * np.eye(len(size))
        root = np.linalg.inv(np.linalg.cholesky(scaled)) / size
        mask = expected.mask[:, channels].T
        cross = state.m[channels][:, :, expected.tangent] * mask[:, None, :]
    found = []
    for owner in SHARE:
        own = [place for place in places if place.owner == owner]
        if not own:
            continue
        rows = [[where[channel] for channel in place.channels] for place in own]
        p = np.stack([projected[row].sum(axis=0) for row in rows])
        b = 2.0 * np.stack([state.b[list(place.channels)].sum(axis=0) for place in own])
        n = np.stack([state.m[list(place.channels)].sum(axis=0) for place in own])
        n = 2.0 * (n - p @ p.swapaxes(1, 2))
        if root is not None:
            along = np.stack([cross[row].sum(axis=0) for row in rows]) - p @ known.T
            half = 2.0 * along @ root.T
            n -= half @ half.swapaxes(1, 2)
        found.append(Owned(own, b, n))
    return found


def score_tests(state: State, expected: Parameters, places: Sequence[Place]) -> list[Test]:
    """Test every kind at every place by Rao's score test: b^T N^-1 b of the score b and the information N."""
    tests: list[Test] = []
    for owned in informations(state, expected, places):
        for kind in KINDS:
            chosen = owned.with_kind(kind, state)
            if not chosen:
                continue
            parts = owned.score[chosen], owned.information[chosen]
            statistic, freedom = _statistics(*parts, KINDS[kind].tangents)
            tests += [
                Test(owned.places[k], kind, float(value), int(free))
                for k, value, free in zip(chosen, statistic, freedom, strict=True)
                if free > 0
            ]
    return tests


def _statistics(b: Array, n: Array, tangents: tuple[int, ...]) -> tuple[Array, NDArray[np.intp]]:
    """Return b^T N^-1 b of some tangents and its degrees of freedom, (s,) each."""
    k = np.array(tangents)
    part, score = n[:, k[:, None], k], b[:, k]
    size = np.diagonal(part, axis1=1, axis2=2)
    scale = np.sqrt(np.where(size > 0, size, np.inf))  # none where rounding has left no information
    value, vector = np.linalg.eigh(part / scale[:, :, None] / scale[:, None, :])
    good = value > 1e-8 * np.maximum(value[:, -1:], 1e-300)
    along = (vector.swapaxes(1, 2) @ (score / scale)[:, :, None])[:, :, 0]
    statistic = np.sum(np.where(good, along**2 / np.where(good, value, 1.0), 0.0), axis=1)
    return statistic, good.sum(axis=1)


def pattern_gain(state: State, noise: Noise) -> float:
    """Return the log likelihood gained by one pattern over channels with a course of its own.

    Notes
    -----
    A shape of bending is such a pattern. It costs half the logarithm of the number of values for each of its
    coefficients (Schwarz 1978, doi:10.1214/aos/1176344136).
    """
    columns = int(state.packed.columns.sum())
    coefficients = len(state.packed.live) - state.q.shape[2] + 2 * columns
    e = state.e.swapaxes(0, 1).reshape(state.e.shape[1], -1)
    strongest = 2.0 * float(np.linalg.norm(e, 2)) ** 2 / noise.level - 2.0 * columns
    return 0.5 * strongest - 0.5 * coefficients * float(np.log(state.packed.values))


def structure(state: State, level: float) -> float:
    """Return the logarithm of the probability that noise alone has the strongest pattern over channels.

    Notes
    -----
    The largest eigenvalue of n columns of noise with m free channels follows the law of Tracy and Widom
    (Johnstone 2001, doi:10.1214/aos/1009210544); its tail here is the leading term of that law for complex
    values, exp(-4/3 x^1.5).
    """
    live = state.packed.live
    parts = [state.e.swapaxes(0, 1).reshape(state.e.shape[1], -1)]
    if state.packed.turned:
        parts.append(state.rest.swapaxes(0, 1).reshape(state.e.shape[1], -1))
    e = np.concatenate(parts, axis=1)[live]
    e = e[:, np.any(e != 0.0, axis=0)]
    free = len(live) - state.q.shape[2]
    n = e.shape[1]
    if free < 2 or n < 8:
        return 0.0
    gram = e @ e.conj().T if n > len(live) else e.conj().T @ e
    top = float(np.linalg.eigvalsh(gram)[-1]) / n / level
    edge = (1.0 + np.sqrt(free / n)) ** 2
    width = (np.sqrt(n) + np.sqrt(free)) * (n**-0.5 + free**-0.5) ** (1.0 / 3.0) / n
    x = (top - edge) / width
    return float(-4.0 / 3.0 * x**1.5) if x > 0.0 else 0.0
