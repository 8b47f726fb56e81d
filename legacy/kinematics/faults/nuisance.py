"""Parameters with normal priors next to the motion: errors of positions and of lasers with a stated sd."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import prod
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.faults.laser_scatter import OF_LASERS, LaserScatter
from legacy.kinematics.faults.packed_readings import Packed, real_parts
from legacy.kinematics.faults.score_information import (
    DELAY,
    IMAGINARY,
    REAL,
    SHIFTS,
    Model,
    State,
    Sums,
    model_of,
)
from legacy.stapeskit.arrays import Array, ComplexArray

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# An exchanged sign or a wrong range is no error of a few percent: beyond so many sd nothing is corrected.
MOST_SDS = 6.0
# Rows of groups of lines that differ by less, relative to the largest, are the same.
_ALIKE = 1e-9


@dataclass(frozen=True)
class Nuisance:
    """Parameters of many places at once, with normal priors.

    Attributes
    ----------
    owner : ndarray, (k, channel), int
        The parameter by which each channel changes along each of ``which``; -1 for none.
    sd : ndarray, (V,)
        Prior standard deviations.
    which : tuple of int, (k,)
        Tangents, see ``State.tangents``. Factors have their logarithms as parameters.
    mean : ndarray, (V,)
        Prior means; none by default.
    """

    owner: NDArray[np.intp]
    sd: Array
    which: tuple[int, ...] = SHIFTS
    mean: Array = field(default_factory=lambda: np.zeros(()))

    @classmethod
    def of(cls, data: Packed, position_sd_m: Array, lasers: LaserScatter | None = None) -> Nuisance:
        """Collect the coordinates of the points in use, and the errors of the lasers.

        Parameters
        ----------
        data : Packed
        position_sd_m : ndarray, (channel,)
            Zero where not stated.
        lasers : LaserScatter, optional
        """
        count = len(data.points)
        places = [own for own in data.by_point.values() if position_sd_m[own[0]] > 0.0]
        nuisance = cls.at(places, count, np.array([position_sd_m[own[0]] for own in places]))
        if lasers is None:
            return nuisance
        beams = lasers.live_channels(data.live)
        lag_sd = 2.0 * np.pi * data.source.middle_hz * lasers.delay_sd
        positions = len(nuisance.sd)
        for tangent, sd in zip(OF_LASERS, (lasers.gain_sd, lasers.phase_sd, lag_sd), strict=True):
            if sd > 0.0:
                nuisance = nuisance.beside(cls.at(beams, count, np.full(len(beams), sd), (tangent,)))
        mean = np.zeros(len(nuisance.sd))
        if len(data.assumed.laser_errors):
            mean[positions:] = -data.assumed.laser_errors
        return replace(nuisance, mean=mean)

    @classmethod
    def at(
        cls,
        places: Sequence[Sequence[int] | NDArray[np.intp]],
        channels: int,
        sd: Array,
        which: tuple[int, ...] = SHIFTS,
    ) -> Nuisance:
        """Make the parameters ``which`` of some places, each with its sd (place,)."""
        owner = np.full((len(which), channels), -1)
        for number, own in enumerate(places):
            owner[:, list(own)] = (len(which) * number + np.arange(len(which)))[:, None]
        return cls(owner, np.repeat(sd, len(which)), which)

    def beside(self, other: Nuisance) -> Nuisance:
        """Return these parameters and those of others; none without a size is kept."""
        if not len(self.sd):
            return other
        owner = np.where(other.owner >= 0, other.owner + len(self.sd), -1)
        sd = np.concatenate([self.sd, other.sd])
        return Nuisance(np.concatenate([self.owner, owner]), sd, (*self.which, *other.which))

    @property
    def varies(self) -> bool:
        """Whether a change differs from line to line."""
        return DELAY in self.which

    def penalty(self, x: Array) -> float:
        """Return half of the sum of ((x - mean) / sd)^2."""
        return 0.5 * float(np.sum(((x - self.mean) / self.sd) ** 2))

    def applied(self, model: Model, x: Array, ratio: Array) -> Model:
        """Return a model with errors ``x`` (V,) of coordinates, m, and of lasers.

        ``ratio`` (group,) is the relative frequency, see ``Packed``.
        """
        # An owner of -1 is the last element, no error.
        error = dict(zip(self.which, np.append(x, 0.0)[self.owner], strict=True))
        if SHIFTS[0] in error:
            moved = np.stack([error[k] for k in SHIFTS], axis=1)
            model = model._replace(arms_m=model.arms_m + moved)
        of_log = {REAL: 1.0, IMAGINARY: 1j, DELAY: -1j * ratio[:, None]}
        held = [slope * error[k] for k, slope in of_log.items() if k in error]
        if not held:
            return model
        factor = np.exp(np.broadcast_to(sum(held), (len(ratio), len(model.arms_m))))
        return model._replace(factor=factor if model.factor is None else model.factor * factor)


@dataclass(frozen=True)
class Marginal:
    """A fit next to nuisance parameters, and the information on these.

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
        model = nuisance.applied(base or model_of(data), x, data.ratio)
        return cls(State.of(data, model), nuisance, x)

    @cached_property
    def value(self) -> float:
        """The objective: residual energy and half the squares of the parameters over their sd."""
        return self.state.energy + self.nuisance.penalty(self.x)

    @property
    def strain(self) -> float:
        """The largest of the parameters over their sd."""
        nuisance = self.nuisance
        return float(np.max(np.abs((self.x - nuisance.mean) / nuisance.sd), initial=0.0))

    def laser_errors(self, lasers: LaserScatter) -> dict[int, Array]:
        """Return the errors (laser,) by their tangent, in units of their sd, with those that are undone."""
        kinds = [k for k in OF_LASERS if k in self.nuisance.which]
        relative = ((self.x - self.nuisance.mean) / self.nuisance.sd)[-len(kinds) * lasers.count :]
        return dict(zip(kinds, relative.reshape(len(kinds), -1), strict=True))

    def without_laser_errors(self, lasers: LaserScatter) -> Packed:
        """Return the data freed of the errors of lasers."""
        relative = self.laser_errors(lasers)
        sd = self.nuisance.sd[-len(relative) * lasers.count :].reshape(len(relative), -1)
        errors = {k: error * own for (k, error), own in zip(relative.items(), sd, strict=True)}
        return lasers.undone(self.state.data, errors)

    @cached_property
    def turn(self) -> ComplexArray | None:
        """Orthonormal columns (group column, k) that hold all motion; None where groups differ in their rows.

        Where all groups have the same rows, all tangents are rows times motion, and their products those of
        these few columns.
        """
        if self.nuisance.varies:
            return None
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
        return np.flatnonzero(np.any(self.nuisance.owner >= 0, axis=0))

    @cached_property
    def owner(self) -> NDArray[np.intp]:
        """Parameters (h, k) of the tangents; -1 for none."""
        return self.nuisance.owner[:, self.held].T

    @cached_property
    def place(self) -> NDArray[np.intp]:
        """Place (channel,) of each channel among ``held``; -1 for none."""
        place = np.full(self.nuisance.owner.shape[1], -1)
        place[self.held] = np.arange(len(self.held))
        return place

    @cached_property
    def tangents(self) -> ComplexArray:
        """Tangents (h, k, group, column) of these channels."""
        return self.in_columns(self.state.tangents(self.held, self.nuisance.which)).transpose(2, 0, 1, 3)

    @cached_property
    def coupled(self) -> list[tuple[NDArray[np.intp], Array]]:
        """Channels (channel,) with which each has noise in common, and the products of changes of both.

        First each channel itself.
        """
        channels = np.arange(self.nuisance.owner.shape[1])
        norm = self.state.norm
        if norm is None:
            return [(channels, np.ones(len(channels)))]
        most = int(np.max(np.sum(norm != 0.0, axis=1)))
        with_most = np.argsort(-(np.abs(norm) + np.diag(np.full(len(norm), np.inf))), axis=1, kind="stable")
        return [(other, norm[channels, other]) for other in with_most[:, :most].T]

    @cached_property
    def gathering(self) -> csr_array:
        """Matrix (V, h k) that sums over the tangents of each parameter."""
        from scipy.sparse import csr_array

        owner = self.owner.ravel()
        of_one = np.flatnonzero(owner >= 0)
        entries = np.ones(len(of_one)), (owner[of_one], of_one)
        return csr_array(entries, shape=(len(self.nuisance.sd), len(owner)))

    def gathered(self, value: Array) -> Array:
        """Sum values (h, k, ...) of the tangents for each parameter, (V, ...)."""
        sums = self.gathering @ value.reshape(self.owner.size, -1)
        return np.asarray(sums).reshape(len(self.nuisance.sd), *value.shape[2:])

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
        return np.asarray(self.score - 0.5 * (self.x - self.nuisance.mean) / sd**2) if len(sd) else sd

    @cached_property
    def information(self) -> Array:
        """Information (V, V), without the priors."""
        flat, count = _flat(self.tangents), len(self.nuisance.sd)
        # An owner of -1 is the last row or column, which is left.
        whole = np.zeros((count + 1, count + 1))
        for partner, weight in self.coupled:
            other = self.place[partner[self.held]]
            some = np.flatnonzero(other >= 0)
            own = np.real(flat[some].conj() @ flat[other[some]].swapaxes(1, 2))
            at = self.owner[some][:, :, None], self.owner[other[some]][:, None, :]
            np.add.at(whole, at, weight[self.held[some], None, None] * own)
        return np.asarray(whole[:-1, :-1] - self.taken @ self.taken.T)

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
        shared = np.zeros((sets, count, len(self.nuisance.sd) + 1))
        shared[..., :-1] = -seen @ self.taken.T
        flat = _flat(self.tangents)
        members = self.in_columns(tangents.transpose(0, 2, 1, 3, 4)).transpose(3, 1, 0, 2, 4)
        for member, channels in zip(members, groups.T, strict=True):
            one = _flat(member).conj()
            for partner, weight in self.coupled:
                place = self.place[partner[channels]]
                some = np.flatnonzero(place >= 0)
                own = np.real(one[some] @ flat[place[some]].swapaxes(1, 2))
                at = some[:, None, None], np.arange(count)[:, None], self.owner[place[some]][:, None]
                shared[at] += weight[channels[some], None, None] * own
        return shared[..., :-1]

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
