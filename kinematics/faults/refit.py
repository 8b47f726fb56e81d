"""The fit at some size of a fault and some shifts of the points, and the step to better ones."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.fault_kinds import Fault
from kinematics.faults.packed.compact import Compact
from stapeskit.spatial import dof_indices

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
SMALL = 1e-5
_UNSEEN = 1e-22


@dataclass(frozen=True)
class Places:
    """Positions as they are known: points with a stated error, by their channels.

    Attributes
    ----------
    owners : list of list of int
    sd_m : ndarray, (point,)
    """

    owners: list[list[int]] = field(default_factory=list)
    sd_m: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, data: Compact, sd_m: Array) -> Places:
        """Collect the points in use that have a positive prior standard deviation (channel,), m."""
        groups: dict[str, list[int]] = {}
        for channel in data.live:
            if sd_m[channel] > 0.0:
                groups.setdefault(data.points[channel], []).append(channel)
        owners = list(groups.values())
        return cls(owners, np.array([sd_m[channels[0]] for channels in owners]))

    def moved(self, data: Compact, shift: Array) -> Compact:
        """Return the data with every point shifted; shift (point, 3), m."""
        if not self.owners:
            return data
        arms, (channels, owner) = data.arms_m.copy(), self.members
        arms[channels] += shift[owner]
        return data.moved(arms_m=arms)

    @cached_property
    def members(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """All channels, point by point, and the number of the point of each."""
        sizes = [len(own) for own in self.owners]
        channels = np.array([c for own in self.owners for c in own], dtype=np.intp)
        return channels, np.repeat(np.arange(len(sizes)), sizes)

    def summed(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the sums (point, ...) of values (n, ...) of all channels, point by point."""
        size = len(self.owners[0])
        if all(len(own) == size for own in self.owners):
            return np.asarray(values.reshape(-1, size, *values.shape[1:]).sum(axis=1))
        starts = np.flatnonzero(np.diff(self.members[1], prepend=-1))
        return np.asarray(np.add.reduceat(values, starts, axis=0))

    def penalty(self, shift: Array) -> float:
        """Return half the sum of (shift / sd)^2."""
        return 0.5 * float(np.sum((shift / self.sd_m[:, None]) ** 2)) if self.owners else 0.0


def own_part(data: Compact, white: NDArray[Any]) -> NDArray[Any]:
    """Return values whose products with changes of channels' rows are those of whitened ones (channel, n)."""
    return white if data.mixing is None else np.asarray(data.mixing.whiten.T @ white)


def solved_for(upper: Array, seen: ComplexArray) -> ComplexArray:
    """Solve triangular systems (..., m, m); directions that are not determined stay zero."""
    diagonal = np.abs(np.diagonal(upper, axis1=-2, axis2=-1))
    if np.all(np.min(diagonal, axis=-1) > 1e-9 * np.max(diagonal, axis=-1)):
        return np.asarray(np.linalg.solve(upper, seen))
    return np.asarray(np.linalg.pinv(upper, rcond=1e-9) @ seen)


def change_of_rows(data: Compact, fault: Fault, theta: Array) -> list[ComplexArray | Array]:
    """Return the derivatives of the fault's rows by each parameter."""
    made = []
    for place in range(fault.size):
        small = np.zeros(fault.size)
        small[place] = SMALL * fault.scale[place]
        made.append(
            (fault.rows(data, theta + small) - fault.rows(data, theta - small)) / (2.0 * small[place])
        )
    return made


def times(rows: ComplexArray | Array, z: ComplexArray) -> ComplexArray:
    """Return rows (n, m), or (line, n, m), times the motion (m, line): (n, line)."""
    if rows.ndim == 2:
        return np.asarray(rows @ z)
    return np.asarray(np.einsum("fcm,mf->cf", rows, z))


@dataclass(frozen=True)
class Others:
    """All channels that a fault leaves as they are, in as few rows as there are degrees of freedom.

    Attributes
    ----------
    rows : ndarray, (m, m)
    held : ndarray, (m, line), complex
    left : float
        Energy of what these rows do not hold.
    """

    rows: Array
    held: ComplexArray
    left: float

    @classmethod
    def of(cls, data: Compact, channels: list[int]) -> Others:
        """Gather them; only for noise that no channels have in common."""
        kept = np.array([c for c in data.live if c not in set(channels)], dtype=np.intp)
        a = data.a[kept][:, None]
        held = a * data.y[kept]
        span, rows = np.linalg.qr(a * data.beams.basis[kept])
        seen = span.T @ held
        return cls(rows, seen, float(np.sum(np.abs(held - span @ seen) ** 2)))


class Refit:
    """The fit at some parameters and shifts: objective, and the Gauss-Newton step from there."""

    def __init__(
        self,
        data: Compact,
        places: Places,
        fault: Fault | None,
        theta: Array,
        shift: Array,
        others: Others | None = None,
    ) -> None:
        self.places, self.fault, self.theta, self.shift = places, fault, theta, shift
        self.data = places.moved(data, shift)
        mixing = self.data.mixing
        self.norm = None if mixing is None else mixing.norm
        self.channels = fault.channels if fault is not None else []
        self.own = self.data.a[self.channels][:, None]
        self.at = self.channels
        if others is None:
            base = self.data.a[:, None] * self.data.beams.basis
            held = self.data.white(self.data.y)
        else:
            count = len(others.rows)
            self.at = list(range(count, count + len(self.channels)))
            base = np.vstack([others.rows, np.zeros((len(self.channels), others.rows.shape[1]))])
            held = np.vstack([others.held, self.own * self.data.y[self.channels]])
        rows = fault.rows(self.data, theta) if fault is not None else np.zeros((0, base.shape[1]))
        self.varies = rows.ndim == 3
        if self.varies:
            all_rows = np.repeat(base[None].astype(complex), len(rows), axis=0)
            all_rows[:, self.at] = self.own * rows
            span, upper = np.linalg.qr(all_rows if mixing is None else mixing.whiten @ all_rows)
            seen = np.einsum("fcm,cf->fm", span.conj(), held)
            self.z = solved_for(upper, seen[..., None])[..., 0].T
            self.e = held - np.einsum("fcm,fm->cf", span, seen)
        else:
            changed = base.astype(rows.dtype)
            changed[self.at] = self.own * rows
            span, upper = np.linalg.qr(changed if mixing is None else mixing.whiten @ changed)
            seen = span.conj().T @ held
            self.z = solved_for(upper, seen)
            self.e = held - span @ seen
        self.own_span, self.own_e = own_part(self.data, span), own_part(self.data, self.e)
        self.rows = changed if not self.varies else all_rows
        self.objective = float(np.sum(np.abs(self.e) ** 2)) + places.penalty(shift)
        self.objective += 0.0 if others is None else others.left

    def step(self) -> tuple[Array, Array]:
        """Return the Gauss-Newton step of parameters and shifts, and the covariance of the parameters.

        Notes
        -----
        The information of the shifts is blocks of the points less a product of low rank, what the motion can
        take; the parameters are solved for by the Schur complement.
        """
        size, count = len(self.theta), len(self.places.owners)
        score, information = np.zeros(size), np.zeros((size, size))
        seen = np.zeros((size, self.z.size), dtype=complex)
        slopes = np.zeros((0, len(self.channels), self.z.shape[1]), dtype=complex)
        if self.fault is not None and size:
            found = change_of_rows(self.data, self.fault, self.theta)
            slopes = np.stack([self.own * times(slope, self.z) for slope in found])
            score = np.real(np.einsum("knl,nl->k", slopes.conj(), self.own_e[self.at]))
            mixed = slopes if self.norm is None else self.norm[np.ix_(self.channels, self.channels)] @ slopes
            information = np.real(np.einsum("knl,jnl->kj", slopes.conj(), mixed))
            seen = self._seen(self.at, slopes.transpose(1, 0, 2)).sum(axis=0)
            information = information - np.real(seen.conj() @ seen.T)
        if not count:
            inverse = inverse_of(information)
            return inverse @ score, inverse
        shifts = self._shifts(slopes, seen)
        freely = shifts.solved(np.column_stack([shifts.score, shifts.crossed.T]))
        own = np.diag(information).copy()
        inverse = inverse_of(information - shifts.crossed @ freely[:, 1:], own)
        theta = inverse @ (score - shifts.crossed @ freely[:, 0])
        return np.concatenate([theta, freely[:, 0] - freely[:, 1:] @ theta]), inverse

    def _shifts(self, slopes: ComplexArray, seen: ComplexArray) -> Shifts:
        """Return score and information of all shifts, and their information in common with parameters."""
        owners = self.places.owners
        owner = self.places.members[1]
        channels = self.places.members[0].tolist()
        moved = self._shifted(channels)
        mixed = moved
        if self.norm is not None:
            flat = self.norm[np.ix_(channels, channels)] @ moved.reshape(len(channels), -1)
            mixed = flat.reshape(moved.shape)
        weight = 0.5 / np.repeat(self.places.sd_m, 3) ** 2
        score = np.real(moved.conj() @ self.own_e[channels][:, :, None])[..., 0]
        score = self.places.summed(score).ravel() - weight * self.shift.ravel()
        blocks = np.real(moved.conj() @ mixed.transpose(0, 2, 1))
        blocks = self.places.summed(blocks)
        blocks[:, np.arange(3), np.arange(3)] += weight.reshape(-1, 3)
        taken = self.places.summed(self._seen(channels, moved)).reshape(3 * len(owners), -1)
        crossed = -np.real(seen.conj() @ taken.T)
        if len(slopes):
            place = {channel: k for k, channel in enumerate(channels)}
            some = [k for k, channel in enumerate(self.channels) if channel in place]
            there = [place[self.channels[k]] for k in some]
            common = np.real(slopes[:, some].conj().transpose(1, 0, 2) @ mixed[there].transpose(0, 2, 1))
            whole = np.zeros((len(owners), len(slopes), 3))
            np.add.at(whole, owner[there], common)
            crossed = crossed + whole.transpose(1, 0, 2).reshape(len(slopes), -1)
        return Shifts(score, blocks, np.hstack([taken.real, taken.imag]), crossed)

    def _shifted(self, channels: list[int]) -> ComplexArray:
        """Return what shifts of the points of channels along the three axes change, (n, 3, line)."""
        turned = np.cross(np.eye(3)[None], self.data.directions[channels][:, None])
        change = np.concatenate([np.zeros_like(turned), turned], axis=2)
        rows = change[..., dof_indices(self.data.beams.dof)] @ self.data.beams.to_dof
        made = self.data.a[channels][:, None, None] * (rows @ self.z)
        if self.fault is not None and self.fault.kind in ("gain", "phase", "delay", "drift"):
            for place, channel in enumerate(channels):
                if channel in self.channels:
                    made[place] = made[place] * self._factor(channel)
        return np.asarray(made)

    def _factor(self, channel: int) -> ComplexArray | complex:
        """Return the factor that the fault puts on a channel."""
        row = self.data.a[channel] * self.data.beams.basis[channel]
        peak = int(np.argmax(np.abs(row)))
        return np.asarray(self.rows[..., channel, peak] / row[peak])

    def _seen(self, channels: list[int], values: ComplexArray) -> ComplexArray:
        """Return the part (n, k, m * line) of changes (n, k, line) that the motion can take."""
        if self.varies:
            found = np.einsum("lnm,nkl->nkml", self.own_span[:, channels].conj(), values, optimize=True)
        else:
            found = self.own_span[channels].conj()[:, None, :, None] * values[:, :, None]
        return np.asarray(found.reshape(*values.shape[:2], -1))


@dataclass(frozen=True)
class Shifts:
    """Score (3 point,) and information of the shifts: ``blocks`` (point, 3, 3) less ``low`` low^T."""

    score: Array
    blocks: Array
    low: Array
    crossed: Array

    def solved(self, right: Array) -> Array:
        """Return the information's inverse times ``right`` (3 point, n) (Woodbury 1950)."""
        count, rank = self.low.shape
        if rank > count // 2:
            whole = -self.low @ self.low.T
            for number, block in enumerate(self.blocks):
                part = slice(3 * number, 3 * number + 3)
                whole[part, part] += block
            return np.asarray(np.linalg.solve(whole, right))
        inner = np.linalg.inv(self.blocks)
        low, given = self._times(inner, self.low), self._times(inner, right)
        capacity = np.eye(rank) - self.low.T @ low
        return np.asarray(given + low @ np.linalg.solve(capacity, self.low.T @ given))

    def _times(self, inner: NDArray[Any], right: Array) -> Array:
        return np.asarray((inner @ right.reshape(len(inner), 3, -1)).reshape(right.shape))


def inverse_of(information: Array, own: Array | None = None) -> Array:
    """Return the pseudo-inverse of an information matrix, scaled to a unit diagonal first.

    Directions with less than 1e-9 of their ``own`` information, that without others beside them, are left.
    """
    diagonal = np.diag(information)
    seen = diagonal > _UNSEEN * np.max(diagonal, initial=0.0)
    if own is not None:
        seen &= diagonal > 1e-9 * own
    scale = np.where(seen, 1.0 / np.sqrt(np.where(seen, diagonal, 1.0)), 0.0)
    even = information * np.outer(scale, scale)
    found = np.linalg.pinv(even, rcond=1e-9, hermitian=True)
    return np.asarray(found * np.outer(scale, scale))
