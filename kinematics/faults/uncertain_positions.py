"""Errors of the points' positions with a stated standard deviation, estimated with the motion."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.packed_readings import Packed
from kinematics.faults.score_information import SHIFTS, Model, State, Sums, model_of
from stapeskit.arrays import Array, ComplexArray

# Rows of groups of lines that differ by less, relative to the largest, are the same.
_ALIKE = 1e-9


@dataclass(frozen=True)
class Nuisance:
    """Coordinates of points with normal priors.

    Attributes
    ----------
    owner : ndarray, (3, channel), int
        The parameter that is the error of each channel's x, y, z; -1 for none.
    sd : ndarray, (V,)
        Prior standard deviations, m.
    """

    owner: NDArray[np.intp] = field(default_factory=lambda: np.full((3, 0), -1))
    sd: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, data: Packed, position_sd_m: Array) -> Nuisance:
        """Collect the coordinates of the points in use.

        Parameters
        ----------
        data : Packed
        position_sd_m : ndarray, (channel,)
            Zero where not stated.
        """
        owner = np.full((3, len(data.points)), -1)
        sd: list[float] = []
        place: dict[str, int] = {}
        for channel in data.live:
            if position_sd_m[channel] > 0.0:
                name = data.points[channel]
                if name not in place:
                    place[name] = len(sd)
                    sd += [float(position_sd_m[channel])] * 3
                owner[:, channel] = place[name] + np.arange(3)
        return cls(owner, np.array(sd))

    @cached_property
    def gather(self) -> Any:
        """Sparse matrix (V, channel * 3) that sums the tangents of all channels for each parameter."""
        from scipy.sparse import csr_array

        owner = self.owner.T.ravel()
        held = np.flatnonzero(owner >= 0)
        return csr_array((np.ones(len(held)), (owner[held], held)), shape=(len(self.sd), len(owner)))

    def penalty(self, x: Array) -> float:
        """Return half of the sum of (x / sd)^2."""
        return 0.5 * float(np.sum((x / self.sd) ** 2)) if len(self.sd) else 0.0

    def applied(self, model: Model, x: Array) -> Model:
        """Return a model with the errors ``x`` (V,), m."""
        if not len(self.sd):
            return model
        # An owner of -1 is the last element, no error.
        return model._replace(arms_m=model.arms_m + np.append(x, 0.0)[self.owner].T)


@dataclass(frozen=True)
class Marginal:
    """The information on the nuisance parameters at a state."""

    state: State
    nuisance: Nuisance

    @cached_property
    def turn(self) -> ComplexArray | None:
        """Orthonormal columns (group column, k) that hold all motion; None where groups differ in their rows.

        Where all groups have the same rows, all tangents are rows times motion, and their products those of
        these few columns.
        """
        own = self.state.own
        if len(own) == 1:
            return None
        if np.max(np.abs(own - own[0])) > _ALIKE * np.max(np.abs(own)):
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
    def tangents(self) -> ComplexArray:
        """Tangents (3, group, channel, column) of all channels."""
        channels = np.arange(len(self.state.data.points))
        return self.merged.tangents(channels, SHIFTS)

    @cached_property
    def near(self) -> tuple[NDArray[np.intp], Array]:
        """Channels (channel, k) whose noise each has in common, itself first, and the products with them."""
        count, norm = len(self.state.data.points), self.state.norm
        if norm is None:
            return np.arange(count)[:, None], np.ones((count, 1))
        held = norm != 0.0
        most = int(np.max(np.sum(held, axis=1)))
        order = np.argsort(~held, axis=1, kind="stable")[:, :most]
        return order, np.take_along_axis(norm, order, axis=1)

    @cached_property
    def owner(self) -> NDArray[np.intp]:
        """Parameters (channel, 3) of the tangents; the number of parameters for none."""
        owner = self.nuisance.owner.T
        return np.where(owner >= 0, owner, len(self.nuisance.sd))

    @cached_property
    def taken(self) -> Array:
        """Projections (V, D) of the tangents on the motion."""
        span = self.merged.own_span.conj().transpose(1, 0, 2)[:, None, :, :, None]
        seen = span * self.tangents.transpose(2, 0, 1, 3)[:, :, :, None]
        flat = seen.reshape(self.owner.size, -1)
        return np.asarray(self.nuisance.gather @ np.concatenate([flat.real, flat.imag], axis=1))

    @cached_property
    def score(self) -> Array:
        """Score (V,) of the residual, without the priors."""
        own = np.real(np.sum(self.tangents.conj() * self.merged.own_e[None], axis=(1, 3))).T
        return np.asarray(self.nuisance.gather @ own.ravel())

    @cached_property
    def information(self) -> Array:
        """Information (V, V), without the priors."""
        count = len(self.nuisance.sd)
        flat = self.tangents.transpose(2, 0, 1, 3).reshape(*self.owner.shape, -1)
        information = np.asarray(self.taken @ self.taken.T)
        np.negative(information, out=information)
        for others, norm in zip(*(part.T for part in self.near), strict=True):
            own = np.real(flat.conj() @ flat[others].swapaxes(1, 2)) * norm[:, None, None]
            row, column = np.broadcast_arrays(self.owner[:, :, None], self.owner[others][:, None, :])
            held = (row < count) & (column < count)
            np.add.at(information, (row[held], column[held]), own[held])
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

    @cached_property
    def inverse(self) -> Array:
        """Inverse (V, V) of the information with the priors."""
        return self.solved(np.eye(len(self.root)))

    def halved(self, value: Array) -> Array:
        """Solve the root for values (V, k): their products are those of the values with the inverse."""
        from scipy.linalg import solve_triangular

        return np.asarray(solve_triangular(self.root, value, lower=True, check_finite=False))

    def solved(self, value: Array) -> Array:
        """Solve the information with the priors for values (V,) or (V, k)."""
        from scipy.linalg import cho_solve

        return np.asarray(cho_solve((self.root, True), value, check_finite=False))

    def common(self, groups: NDArray[np.intp], tangents: ComplexArray, taken: Array) -> Array:
        """Return the information (B, p, V) that tangents (p, group, B, n, column) share with the nuisance."""
        sets, count = taken.shape[:2]
        number = len(self.nuisance.sd)
        if self.turn is not None:
            tangents, taken = self._in_columns(tangents, taken, self.turn)
        sums = np.zeros(sets * count * (number + 1))
        at = np.arange(sets * count).reshape(sets, count, 1) * (number + 1)
        neighbours, norms = self.near
        for member in range(groups.shape[1]):
            one = tangents[:, :, :, member].transpose(2, 0, 1, 3).reshape(sets, count, -1).conj()
            for others, norm in zip(neighbours[groups[:, member]].T, norms[groups[:, member]].T, strict=True):
                two = self.tangents[:, :, others].transpose(2, 0, 1, 3).reshape(sets, len(self.tangents), -1)
                own = np.real(one @ two.swapaxes(1, 2)) * norm[:, None, None]
                index = at + self.owner[others][:, None, :]
                sums += np.bincount(index.ravel(), own.ravel(), len(sums))
        return sums.reshape(sets, count, number + 1)[:, :, :number] - taken @ self.taken.T

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
        """Return the information on tangents next to the nuisance."""
        shared = self.common(groups, tangents, sums.taken)
        sets, count, number = shared.shape
        half = self.halved(shared.reshape(-1, number).T).T.reshape(sets, count, number)
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
