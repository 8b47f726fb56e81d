"""The refit with a factor that runs over the lines: its phase leaves the normal equations as they are.

Lines differ in the size of the factor alone, so that the normal matrices, and the information of all shifts,
come from two small triangles and a few moments of the motion instead of a factorisation of all rows at every
line.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.fault_kinds import Fault
from kinematics.faults.packed.compact import Compact
from kinematics.faults.refit import SMALL, Others, Places, Refit, Shifts, inverse_of
from stapeskit.spatial import dof_indices

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
_DETERMINED = 1e-6
_ROUNDING = 1e-15


def refit(
    data: Compact, places: Places, fault: Fault | None, theta: Array, shift: Array, others: Others | None
) -> Refit | FactorRefit:
    """Return the fit at some parameters (size,) and shifts (point, 3), by the shorter way where there is one.

    ``others`` are the channels without the fault, gathered, or None.
    """
    if fault is not None and fault.factor is not None and others is None and data.mixing is None:
        factor_refit = FactorRefit(data, places, fault, theta, shift)
        if factor_refit.determined:
            return factor_refit
    return Refit(data, places, fault, theta, shift, others)


class FactorRefit:
    """A Refit whose fault is one factor f (line,) common to its channels, of noise that none has in common.

    Notes
    -----
    With rows A of the other channels and B of those at fault the normal matrices are A^T A + |f|^2 B^T B. The
    motion comes from the semi-normal equations with one refinement (Bjorck 1987,
    doi:10.1016/0024-3795(87)90101-7).
    """

    def __init__(self, data: Compact, places: Places, fault: Fault, theta: Array, shift: Array) -> None:
        self.places, self.fault, self.theta, self.shift = places, fault, theta, shift
        self.data = places.moved(data, shift)
        self.base = self.data.a[:, None] * self.data.beams.basis
        self.at = np.zeros(len(self.base), dtype=bool)
        self.at[fault.channels] = True
        self.own = self.base[self.at]
        outside, inside = (np.asarray(np.linalg.qr(self.base[c], mode="r")) for c in (~self.at, self.at))
        self.factor = self._factor(theta)
        self.power = np.abs(self.factor) ** 2
        stack = np.empty((len(self.power), len(outside) + len(inside), self.base.shape[1]))
        stack[:, : len(outside)] = outside
        stack[:, len(outside) :] = np.sqrt(self.power)[:, None, None] * inside
        upper: Array = np.asarray(np.linalg.qr(stack, mode="r"))
        diagonal = np.abs(np.diagonal(upper, axis1=1, axis2=2))
        self.determined = upper.shape[1] == upper.shape[2] and bool(
            np.all(np.min(diagonal, axis=1) > _DETERMINED * np.max(diagonal, axis=1))
        )
        self.objective = np.inf
        if self.determined:
            self.back = np.linalg.inv(upper)
            held = self.data.a[:, None] * self.data.y
            z = self._solved(held)
            self.z = z + self._solved(held - self._rows_times(z))
            self.e = held - self._rows_times(self.z)
            self.objective = float(np.sum(self.e.real**2) + np.sum(self.e.imag**2)) + places.penalty(shift)

    def _factor(self, theta: Array) -> ComplexArray:
        if self.fault.factor is None:
            return np.ones(len(self.data.part), dtype=complex)
        return self.fault.factor(self.data, theta)

    def _rows_times(self, z: ComplexArray) -> ComplexArray:
        """Return the changed rows times the motion (m, line)."""
        made = self.base @ z
        made[self.at] *= self.factor
        return np.asarray(made)

    def _solved(self, held: ComplexArray) -> ComplexArray:
        """Return the motion (m, line) of the normal equations for readings (channel, line)."""
        right = self.base[~self.at].T @ held[~self.at] + self.factor.conj() * (self.own.T @ held[self.at])
        return np.asarray(self._inverse_times(right))

    def _inverse_times(self, right: NDArray[Any]) -> NDArray[Any]:
        """Return the inverse normal matrices times vectors (m, line)."""
        turned = self.back.transpose(0, 2, 1) @ right.T[:, :, None]
        return (self.back @ turned)[:, :, 0].T

    @cached_property
    def _slopes(self) -> ComplexArray:
        """Derivatives (size, line) of the factor by each parameter."""
        made = []
        for place in range(self.fault.size):
            small = np.zeros(self.fault.size)
            small[place] = SMALL * self.fault.scale[place]
            change = self._factor(self.theta + small) - self._factor(self.theta - small)
            made.append(change / (2.0 * small[place]))
        return np.stack(made)

    def step(self) -> tuple[Array, Array]:
        """Return the Gauss-Newton step of parameters and shifts, and the covariance of the parameters."""
        z, slopes = self.z, self._slopes
        moved = self.own @ z
        score = np.real(slopes.conj() @ np.sum(moved.conj() * self.e[self.at], axis=0))
        information = np.real((slopes.conj() * np.sum(np.abs(moved) ** 2, axis=0)) @ slopes.T)
        seen = (self.factor.conj() * slopes)[:, None] * (self.own.T @ moved)
        solved = np.stack([self._inverse_times(one) for one in seen])
        flat, other = seen.reshape(len(slopes), -1), solved.reshape(len(slopes), -1)
        information = information - np.real(flat.conj() @ other.T)
        if not self.places.owners:
            inverse = inverse_of(information)
            return inverse @ score, inverse
        shifts = self._shifts(solved)
        freely = shifts.solved(np.column_stack([shifts.score, shifts.crossed.T]))
        own = np.diag(information).copy()
        inverse = inverse_of(information - shifts.crossed @ freely[:, 1:], own)
        theta = inverse @ (score - shifts.crossed @ freely[:, 0])
        return np.concatenate([theta, freely[:, 0] - freely[:, 1:] @ theta]), inverse

    def _shifts(self, solved: ComplexArray) -> Shifts:
        """Return score and information of all shifts, and their information in common with parameters.

        ``solved`` (size, m, line) is what the motion takes of the parameters' changes.
        """
        z, places = self.z, self.places
        channels = places.members[0]
        at, size = self.at[channels], len(z)
        turned = np.cross(np.eye(3)[None], self.data.directions[channels][:, None])
        change = np.concatenate([np.zeros_like(turned), turned], axis=2)
        rows = change[..., dof_indices(self.data.beams.dof)] @ self.data.beams.to_dof
        rows = self.data.a[channels][:, None, None] * rows
        weight = 0.5 / np.repeat(places.sd_m, 3) ** 2
        e = self.e[channels]
        e[at] *= self.factor.conj()
        score = np.real(rows @ (e @ z.conj().T)[:, :, None])[..., 0]
        score = places.summed(score).ravel() - weight * self.shift.ravel()
        motion = np.empty((len(channels), size, size))
        motion[~at], motion[at] = np.real(z @ z.conj().T), np.real((self.power * z) @ z.conj().T)
        blocks = places.summed(rows @ motion @ rows.transpose(0, 2, 1))
        blocks[:, np.arange(3), np.arange(3)] += weight.reshape(-1, 3)
        patterns = self._patterns(rows, channels)
        common = np.real((self._slopes.conj() * self.factor)[:, None] * z.conj() @ z.T)
        each = np.zeros((len(solved), len(channels), 3))
        here = self.base[channels[at]]
        each[:, at] = (rows[at][None] @ (here @ common)[..., None])[..., 0]
        crossed = np.stack([places.summed(one) for one in each]).reshape(len(solved), -1)
        taken = [np.real((solved.conj() * some) @ z.T).reshape(len(solved), -1) for some in (1.0, self.power)]
        crossed = crossed - np.hstack(taken) @ patterns.T
        return Shifts(score, blocks, patterns @ self._root(), crossed)

    def _patterns(self, rows: Array, channels: NDArray[np.intp]) -> Array:
        """Return products (3 point, 2 m m) of rows with their derivatives (n, 3, m): no fault, then fault."""
        each = self.base[channels][:, None, :, None] * rows[:, :, None, :]
        each = each.reshape(len(channels), 3, -1)
        at = self.at[channels][:, None, None]
        both = np.concatenate([np.where(at, 0.0, each), np.where(at, each, 0.0)], axis=2)
        return np.asarray(self.places.summed(both).reshape(-1, both.shape[2]))

    def _root(self) -> Array:
        """Return a root (2 m m, r) of what the motion takes of the patterns' information."""
        lines, size = self.z.shape[1], self.z.shape[0]
        some = np.stack([np.ones(lines), self.power])
        turned = some[:, None, :, None] * self.back.transpose(1, 0, 2)
        columns = (turned[:, :, None] * self.z[:, :, None]).reshape(2 * size * size, -1)
        if 3 * len(self.places.owners) < len(columns):
            return np.hstack([columns.real, columns.imag])
        values, vectors = np.linalg.eigh(columns.real @ columns.real.T + columns.imag @ columns.imag.T)
        keep = values > _ROUNDING * max(float(values[-1]), 1e-300)
        return np.asarray(vectors[:, keep] * np.sqrt(values[keep]))


__all__ = ["FactorRefit", "refit"]
