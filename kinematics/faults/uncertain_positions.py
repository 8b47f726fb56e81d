"""Parameters with normal priors next to the motion, as the errors of positions with a stated sd."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import prod

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.packed_readings import Packed, real_parts
from kinematics.faults.score_information import SHIFTS, Model, State, Sums, model_of
from stapeskit.arrays import Array, ComplexArray

# Rows of groups of lines that differ by less, relative to the largest, are the same.
_ALIKE = 1e-9


@dataclass(frozen=True)
class Nuisance:
    """Parameters of many places at once, with normal priors: by default errors of the points' coordinates.

    Attributes
    ----------
    owner : ndarray, (k, channel), int
        The parameter by which each channel changes along each of ``which``; -1 for none.
    sd : ndarray, (V,)
        Prior standard deviations.
    which : tuple of int, (k,)
        Tangents, see ``State.tangents``.
    """

    owner: NDArray[np.intp]
    sd: Array
    which: tuple[int, ...] = SHIFTS

    @classmethod
    def of(cls, data: Packed, position_sd_m: Array) -> Nuisance:
        """Collect the coordinates of the points in use.

        Parameters
        ----------
        data : Packed
        position_sd_m : ndarray, (channel,)
            Zero where not stated.
        """
        places = [own for own in data.by_point.values() if position_sd_m[own[0]] > 0.0]
        return cls.at(places, len(data.points), np.array([position_sd_m[own[0]] for own in places]))

    @classmethod
    def at(
        cls, places: Sequence[Sequence[int]], channels: int, sd: Array, which: tuple[int, ...] = SHIFTS
    ) -> Nuisance:
        """Make the parameters ``which`` of some places, each with its sd (place,)."""
        owner = np.full((len(which), channels), -1)
        for number, own in enumerate(places):
            owner[:, list(own)] = (len(which) * number + np.arange(len(which)))[:, None]
        return cls(owner, np.repeat(sd, len(which)), which)

    def penalty(self, x: Array) -> float:
        """Return half of the sum of (x / sd)^2."""
        return 0.5 * float(np.sum((x / self.sd) ** 2))

    def applied(self, model: Model, x: Array) -> Model:
        """Return a model with the errors ``x`` (V,) of coordinates, m."""
        # An owner of -1 is the last element, no error.
        return model._replace(arms_m=model.arms_m + np.append(x, 0.0)[self.owner].T)


@dataclass(frozen=True)
class Marginal:
    """A fit next to nuisance parameters, and the information on these.

    Where the noise within points is correlated, all channels of a point have the same parameters.

    Attributes
    ----------
    state : State
    nuisance : Nuisance
    x : ndarray, (V,)
        The parameters at the state; none by default.
    """

    state: State
    nuisance: Nuisance
    x: Array = field(default_factory=lambda: np.zeros(()))

    @classmethod
    def at(cls, data: Packed, nuisance: Nuisance, x: Array, base: Model | None = None) -> Marginal:
        """Fit the motion for nuisance parameters ``x`` (V,), in addition to a model."""
        return cls(State.of(data, nuisance.applied(base or model_of(data), x)), nuisance, x)

    @cached_property
    def value(self) -> float:
        """The objective: residual energy and half the squares of the parameters over their sd."""
        return self.state.energy + self.nuisance.penalty(self.x)

    @cached_property
    def turn(self) -> ComplexArray | None:
        """Orthonormal columns (group column, k) that hold all motion; None where groups differ in their rows.

        Where all groups have the same rows, all tangents are rows times motion, and their products those of
        these few columns.
        """
        own = self.state.own
        alike = np.max(np.abs(own - own[0])) <= _ALIKE * np.max(np.abs(own))
        if len(own) == 1 or not self.held.size or not alike:
            return None
        return np.linalg.qr(_side_by_side(self.state.z)[0].conj().T)[0]

    def in_columns(self, value: ComplexArray) -> ComplexArray:
        """Return values (..., group, n, column) in these columns, as of one group."""
        return value if self.turn is None else _side_by_side(value) @ self.turn

    @cached_property
    def held(self) -> NDArray[np.intp]:
        """Channels (h,) that have parameters."""
        return np.flatnonzero(self.nuisance.owner[0] >= 0)

    @cached_property
    def owner(self) -> NDArray[np.intp]:
        """Parameters (h, k) of the tangents."""
        return self.nuisance.owner[:, self.held].T

    @cached_property
    def tangents(self) -> ComplexArray:
        """Tangents (h, k, group, column) of these channels."""
        return self.in_columns(self.state.tangents(self.held, self.nuisance.which)).transpose(2, 0, 1, 3)

    @cached_property
    def products(self) -> ComplexArray:
        """What products with changes of the channels' rows are made of, (h, k, D)."""
        flat = _flat(self.tangents)
        norm = self.state.norm
        if norm is None:
            return flat
        return np.einsum("hi,ikd->hkd", norm[np.ix_(self.held, self.held)], flat, optimize=True)

    def gathered(self, value: Array) -> Array:
        """Sum values (h, k, ...) of the tangents for each parameter, (V, ...)."""
        first = self.owner[:, 0]
        if np.any(np.diff(first) < 0):  # channels of a point are mostly next to each other already
            order = np.argsort(first, kind="stable")
            value, first = value[order], first[order]
        sums = np.add.reduceat(value, np.flatnonzero(np.diff(first, prepend=-1)), axis=0)
        return sums.reshape(len(self.nuisance.sd), *value.shape[2:])

    @cached_property
    def taken(self) -> Array:
        """Projections (V, D) of the tangents on the motion."""
        span = self.state.own_span[: self.tangents.shape[2], self.held].conj()
        seen = np.einsum("ghm,hkgc->hkgmc", span, self.tangents, order="C")
        return self.gathered(real_parts(_flat(seen)))

    @cached_property
    def score(self) -> Array:
        """Score (V,) of the residual, without the priors."""
        e = self.in_columns(self.state.own_e)[:, self.held]
        return self.gathered(np.real(np.einsum("hkgc,ghc->hk", self.tangents.conj(), e)))

    @property
    def pull(self) -> Array:
        """Score (V,) with the priors: minus half the slope of the objective."""
        sd = self.nuisance.sd
        return np.asarray(self.score - 0.5 * self.x / sd**2) if len(sd) else sd

    @cached_property
    def information(self) -> Array:
        """Information (V, V), without the priors."""
        flat = _flat(self.tangents)
        own = np.real(flat.conj() @ self.products.swapaxes(1, 2))
        blocks = self.gathered(own).reshape(-1, *own.shape[1:])
        information, place = np.asarray(-self.taken @ self.taken.T), np.arange(len(blocks))
        information.reshape(2 * blocks.shape[:2])[place, :, place] += blocks
        return information

    @cached_property
    def root(self) -> Array:
        """Lower triangular root (V, V) of the information with the priors."""
        scale = np.outer(self.nuisance.sd, self.nuisance.sd)
        relative, prior = self.information * scale, 0.5 * np.eye(len(scale))
        try:
            root = np.linalg.cholesky(relative + prior)
        except np.linalg.LinAlgError:
            # Rounding, where the beams hardly determine the motion.
            values, vectors = np.linalg.eigh(relative)
            root = np.linalg.cholesky((vectors * np.maximum(values, 0.0)) @ vectors.T + prior)
        return root / self.nuisance.sd[:, None]

    def solved(self, value: Array) -> Array:
        """Solve the information with the priors for values (V,) or (V, k)."""
        from scipy.linalg import cho_solve

        if not len(self.nuisance.sd):
            return value
        return np.asarray(cho_solve((self.root, True), value, check_finite=False))

    def common(self, groups: NDArray[np.intp], tangents: ComplexArray, taken: ComplexArray) -> Array:
        """Return the information (B, p, V) that tangents of sets of channels share with the nuisance.

        ``groups``, ``tangents`` and ``taken`` as of ``State.sums``.
        """
        sets, count = taken.shape[:2]
        if not len(self.nuisance.sd):
            return np.zeros((sets, count, 0))
        seen = real_parts(_flat(self.in_columns(taken)))
        shared = np.asarray(-seen @ self.taken.T)
        place = np.full(self.nuisance.owner.shape[1], -1)
        place[self.held] = np.arange(len(self.held))
        members = self.in_columns(tangents.transpose(0, 2, 1, 3, 4)).transpose(3, 1, 0, 2, 4)
        for member, channels in zip(members, place[groups].T, strict=True):
            some = np.flatnonzero(channels >= 0)
            one = _flat(member[some]).conj()
            own = np.real(one @ self.products[channels[some]].swapaxes(1, 2))
            at = some[:, None, None], np.arange(count)[:, None], self.owner[channels[some]][:, None]
            shared[at] += own
        return shared

    def remaining(self, groups: NDArray[np.intp], tangents: ComplexArray, sums: Sums) -> Array:
        """Return the information (B, p, p) on tangents next to the nuisance."""
        from scipy.linalg import solve_triangular

        if not len(self.nuisance.sd):
            return sums.information
        shared = self.common(groups, tangents, sums.taken)
        flat = shared.reshape(-1, shared.shape[2]).T
        half = solve_triangular(self.root, flat, lower=True, check_finite=False).T.reshape(shared.shape)
        return np.asarray(sums.information - half @ half.swapaxes(1, 2))


def _flat(value: ComplexArray) -> ComplexArray:
    """Return values (h, k, ...) as (h, k, n)."""
    return value.reshape(*value.shape[:2], prod(value.shape[2:]))


def _side_by_side(value: ComplexArray) -> ComplexArray:
    """Return values (..., group, n, column) as those of one group (..., 1, n, group column)."""
    *outer, groups, n, columns = value.shape
    return value.swapaxes(-3, -2).reshape(*outer, 1, n, groups * columns)


def estimate_nuisance(data: Packed, nuisance: Nuisance, rounds: int = 6) -> Marginal:
    """Return the fit with the most probable nuisance parameters, by Gauss and Newton's method."""
    near = Marginal.at(data, nuisance, np.zeros(len(nuisance.sd)))
    for _ in range(rounds if len(nuisance.sd) else 0):
        step = near.solved(near.pull)
        for part in (1.0, 0.5, 0.25):
            trial = Marginal.at(data, nuisance, near.x + part * step)
            if trial.value <= near.value:
                break
        else:
            break
        fall, near = near.value - trial.value, trial
        if fall < 1e-3:
            break
    return near


def information_of(
    state: State, places: Sequence[Sequence[int]], which: tuple[int, ...]
) -> tuple[Array, Array]:
    """Return score (n k,) and information (n k, n k) of the tangents ``which`` (k) at n places."""
    near = Marginal(state, Nuisance.at(places, len(state.data.points), np.ones(len(places)), which))
    return near.score, near.information


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
