"""Parameters with normal priors next to the motion, as the errors of positions with a stated sd."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.packed_readings import Packed
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
    """The information on the nuisance parameters at a state.

    Where the noise within points is correlated, all channels of a point have the same parameters.
    """

    state: State
    nuisance: Nuisance

    @cached_property
    def turn(self) -> ComplexArray | None:
        """Orthonormal columns (group column, k) that hold all motion; None where groups differ in their rows.

        Where all groups have the same rows, all tangents are rows times motion, and their products those of
        these few columns.
        """
        own = self.state.own
        if len(own) == 1 or np.max(np.abs(own - own[0])) > _ALIKE * np.max(np.abs(own)):
            return None
        return np.linalg.qr(_side_by_side(self.state.z)[0].conj().T)[0]

    @cached_property
    def merged(self) -> State:
        """The state in the columns that hold the motion."""
        state, turn = self.state, self.turn
        if turn is None:
            return state
        first = {name: getattr(state, name)[:1] for name in ("own", "span", "upper")}
        data = replace(state.data, weight=state.data.weight[:1], tau=np.zeros(1), ratio=np.ones(1))
        factor = state.model.factor
        model = state.model._replace(factor=None if factor is None else factor[:1])
        z, e = _side_by_side(state.z) @ turn, _side_by_side(state.e) @ turn
        return replace(state, data=data, model=model, z=z, e=e, **first)

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
        """Tangents (h, k, D) of these channels."""
        made = self.merged.tangents(self.held, self.nuisance.which).transpose(2, 0, 1, 3)
        return made.reshape(*self.owner.shape, made.shape[2] * made.shape[3])

    @cached_property
    def products(self) -> ComplexArray:
        """What products with changes of the channels' rows are made of, (h, k, D)."""
        norm = self.state.norm
        if norm is None:
            return self.tangents
        return np.einsum("hi,ikd->hkd", norm[np.ix_(self.held, self.held)], self.tangents, optimize=True)

    def gathered(self, value: Array) -> Array:
        """Sum values (h, k, ...) of the tangents for each parameter, (V, ...)."""
        sums = np.zeros((len(self.nuisance.sd), *value.shape[2:]))
        np.add.at(sums, self.owner, value)
        return sums

    @cached_property
    def taken(self) -> Array:
        """Projections (V, D) of the tangents on the motion."""
        groups, size, columns = self.merged.z.shape
        span = self.merged.own_span[:, self.held].conj().transpose(1, 0, 2)[:, None, :, :, None]
        seen = span * self.tangents.reshape(*self.owner.shape, groups, 1, columns)
        flat = seen.reshape(*self.owner.shape, groups * size * columns)
        return self.gathered(np.concatenate([flat.real, flat.imag], axis=2))

    @cached_property
    def score(self) -> Array:
        """Score (V,) of the residual, without the priors."""
        e = (
            self.merged.own_e[:, self.held]
            .transpose(1, 0, 2)
            .reshape(len(self.held), 1, self.tangents.shape[2])
        )
        return self.gathered(np.real(np.sum(self.tangents.conj() * e, axis=2)))

    @cached_property
    def information(self) -> Array:
        """Information (V, V), without the priors."""
        own = np.real(self.tangents.conj() @ self.products.swapaxes(1, 2))
        information = np.asarray(-self.taken @ self.taken.T)
        np.add.at(information, (self.owner[:, :, None], self.owner[:, None, :]), own)
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

        return np.asarray(cho_solve((self.root, True), value, check_finite=False))

    def common(self, groups: NDArray[np.intp], tangents: ComplexArray, taken: Array) -> Array:
        """Return the information (B, p, V) that tangents (p, group, B, n, column) share with the nuisance."""
        sets, count = taken.shape[:2]
        number = len(self.nuisance.sd)
        if not number:
            return np.zeros((sets, count, 0))
        if self.turn is not None:
            tangents, taken = self._in_columns(tangents, taken, self.turn)
        shared = np.asarray(-taken @ self.taken.T)
        place = np.full(self.nuisance.owner.shape[1], -1)
        place[self.held] = np.arange(len(self.held))
        for member, channels in zip(np.moveaxis(tangents, 3, 0), place[groups].T, strict=True):
            some = np.flatnonzero(channels >= 0)
            one = member.transpose(2, 0, 1, 3).reshape(sets, count, -1)[some].conj()
            own = np.real(one @ self.products[channels[some]].swapaxes(1, 2))
            at = some[:, None, None], np.arange(count)[:, None], self.owner[channels[some]][:, None]
            np.add.at(shared, at, own)
        return shared

    def _in_columns(
        self, tangents: ComplexArray, taken: Array, turn: ComplexArray
    ) -> tuple[ComplexArray, Array]:
        """Return tangents and their projections, as of ``State.sums``, in the columns of ``turn``."""
        own = _side_by_side(tangents.transpose(0, 2, 1, 3, 4)) @ turn
        half = taken.shape[2] // 2
        whole = taken[:, :, :half] + 1j * taken[:, :, half:]
        seen = _side_by_side(whole.reshape(*taken.shape[:2], len(self.state.z), -1, tangents.shape[4]))
        seen = (seen @ turn).reshape(*taken.shape[:2], -1)
        return own.transpose(0, 2, 1, 3, 4), np.concatenate([seen.real, seen.imag], axis=2)

    def remaining(self, groups: NDArray[np.intp], tangents: ComplexArray, sums: Sums) -> Array:
        """Return the information (B, p, p) on tangents next to the nuisance."""
        from scipy.linalg import solve_triangular

        shared = self.common(groups, tangents, sums.taken)
        flat = shared.reshape(-1, shared.shape[2]).T
        half = solve_triangular(self.root, flat, lower=True, check_finite=False).T.reshape(shared.shape)
        return np.asarray(sums.information - half @ half.swapaxes(1, 2))


def _side_by_side(value: ComplexArray) -> ComplexArray:
    """Return values (..., group, n, column) as those of one group (..., 1, n, group column)."""
    swapped = value.swapaxes(-3, -2)
    return swapped.reshape(*swapped.shape[:-2], -1)[..., None, :, :]


def estimate_nuisance(data: Packed, nuisance: Nuisance, rounds: int = 6) -> tuple[State, Array]:
    """Return the fit with the most probable nuisance parameters, and these (V,)."""
    base = model_of(data)
    x = np.zeros(len(nuisance.sd))
    state = State.of(data, base)
    value = state.energy
    for _ in range(rounds if len(x) else 0):
        marginal = Marginal(state, nuisance)
        step = marginal.solved(marginal.score - 0.5 * x / nuisance.sd**2)
        for part in (1.0, 0.5, 0.25):
            trial = State.of(data, nuisance.applied(base, x + part * step))
            left = trial.energy + nuisance.penalty(x + part * step)
            if left <= value:
                break
        else:
            break
        fall, state, value, x = value - left, trial, left, x + part * step
        if fall < 1e-3:
            break
    return state, x


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
