"""The rigid fit of packed data, and its refit with a fault beside the motion and the positions."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.compact import Compact
from kinematics.faults.fault_kinds import Fault
from kinematics.spatial import dof_indices

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
_ROUNDS = 6
_SMALL = 1e-5
_UNSEEN = 1e-22
_MANY = 60


@dataclass(frozen=True)
class State:
    """A fit of all packed lines.

    Attributes
    ----------
    data : Compact
    span : ndarray, (channel, m)
        Orthonormal columns of the whitened rows.
    z : ndarray, (m, line), complex
        Motion in the basis of ``data.beams``.
    e : ndarray, (channel, line), complex
        Whitened residual.
    """

    data: Compact
    span: Array
    z: ComplexArray
    e: ComplexArray

    @property
    def h(self) -> Array:
        """Leverage of each channel, (channel,)."""
        return np.asarray(np.sum(self.plain(self.span) ** 2, axis=1))

    def plain(self, white: NDArray[Any]) -> NDArray[Any]:
        """Return whitened values (channel, n) as those of the channels themselves, over their noise."""
        return white if self.data.mixing is None else self.data.mixing.back @ white

    def project(self) -> Array:
        """Return what turns the noise of the channels, over its size, into ``plain`` residuals."""
        left = np.eye(len(self.span)) - self.span @ self.span.T
        mixing = self.data.mixing
        return np.asarray(left if mixing is None else mixing.back @ left @ mixing.whiten)

    @cached_property
    def own_span(self) -> Array:
        """Columns whose products with changes of the channels' rows are those of ``span``, (channel, m)."""
        return _own(self.data, self.span)

    @cached_property
    def own_e(self) -> ComplexArray:
        """Residual whose products with changes of the channels' rows are those of ``e``, (channel, line)."""
        return _own(self.data, self.e)

    @property
    def norm(self) -> Array | None:
        """Products of changes of two channels' rows, (channel, channel); None for the unit matrix."""
        return None if self.data.mixing is None else self.data.mixing.norm

    def rest(self) -> ComplexArray:
        """Return the whitened residuals of the lines without motion, (channel, sample)."""
        held = self.data.white(self.data.rest)
        return np.asarray(held - self.span @ (self.span.T @ held))

    def score(self, weight: Array | None = None) -> ComplexArray:
        """Return G = e z^H, (channel, m), each line with a weight."""
        z = self.z if weight is None else self.z * weight
        return np.asarray(self.own_e @ z.conj().T)

    def motion(self, weight: Array | None = None) -> Array:
        """Return T = Re(z z^H), (m, m), each line with a weight."""
        z = self.z if weight is None else self.z * weight
        return np.asarray((z @ self.z.conj().T).real)


def _own(data: Compact, white: NDArray[Any]) -> NDArray[Any]:
    return white if data.mixing is None else np.asarray(data.mixing.whiten.T @ white)


def solve(data: Compact) -> State:
    """Fit all packed lines."""
    span, upper = np.linalg.qr(data.white(data.beams.basis))
    held = data.white(data.y)
    seen = span.T @ held
    z = _solved(upper, seen)
    return State(data, span, z, held - span @ seen)


def _solved(upper: Array, seen: ComplexArray) -> ComplexArray:
    """Solve triangular systems (..., m, m); directions that are not determined stay zero."""
    diagonal = np.abs(np.diagonal(upper, axis1=-2, axis2=-1))
    if np.all(np.min(diagonal, axis=-1) > 1e-9 * np.max(diagonal, axis=-1)):
        return np.asarray(np.linalg.solve(upper, seen))
    return np.asarray(np.linalg.pinv(upper, rcond=1e-9) @ seen)


def static(data: Compact) -> Compact:
    """Return the data with all segments packed into one: enough for faults that are the same everywhere."""
    state = solve(data)
    vectors = np.linalg.svd(state.z, full_matrices=False)[2]
    y = data.y @ vectors.conj().T
    nothing = np.zeros(y.shape[1])
    return replace(data, y=y, part=nothing.astype(np.int64), tau=nothing, freq_hz=nothing)


@dataclass(frozen=True)
class FaultFit:
    """A fitted fault: parameters with covariance, and the fall of the sum of |whitened residual|^2."""

    fault: Fault
    parameters: Array
    covariance: Array
    drop: float


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
        arms = data.arms_m.copy()
        for channels, step in zip(self.owners, shift, strict=True):
            arms[channels] += step
        return data.moved(arms_m=arms)

    def penalty(self, shift: Array) -> float:
        """Return half the sum of (shift / sd)^2."""
        return 0.5 * float(np.sum((shift / self.sd_m[:, None]) ** 2)) if self.owners else 0.0


def fit_fault(
    data: Compact, places: Places, fault: Fault | None, before: float = 0.0
) -> tuple[FaultFit, Array]:
    """Fit a fault with the motion and the positions beside it, by Gauss-Newton.

    Parameters
    ----------
    data : Compact
    places : Places
    fault : Fault, optional
        None: only the positions.
    before : float
        Objective without the fault.

    Returns
    -------
    FaultFit
        ``drop`` is ``before`` less the objective: the energy of the residual and half (shift / sd)^2.
    ndarray, (point, 3)
        Shifts of the points, m.

    Notes
    -----
    The motion is refitted with every change of the rows, so the fall of the residual energy is that of the
    maximum of the likelihood, and the derivatives are projected off what the motion can explain. A step
    that does not improve is halved.
    """
    size = fault.size if fault is not None else 0
    shift = np.zeros((len(places.owners), 3))
    starts = [np.zeros(size)] if fault is None or not size else _starts(data, fault)
    now = min((_Refit(data, places, fault, theta, shift) for theta in starts), key=lambda fit: fit.objective)
    inverse = np.zeros((size, size))
    for _ in range(_ROUNDS if size + shift.size else 0):
        step, inverse = now.step()
        trial = _Refit(data, places, fault, now.theta + step[:size], now.shift + step[size:].reshape(-1, 3))
        for _ in range(6):
            if trial.objective <= now.objective * (1.0 + 1e-12):
                break
            step = 0.5 * step
            trial = _Refit(
                data, places, fault, now.theta + step[:size], now.shift + step[size:].reshape(-1, 3)
            )
        fall, now = now.objective - trial.objective, trial
        if fall < 1e-3:
            break
    made = fault if fault is not None else Fault("", [], 0, _no_rows, _same, np.zeros(0))
    fit = FaultFit(made, now.theta, 0.5 * inverse[:size, :size], before - now.objective)
    return fit, now.shift


def objective(data: Compact, places: Places, fit: FaultFit, shift: Array) -> float:
    """Return the energy of the residual with a fitted fault, and half (shift / sd)^2."""
    return _Refit(data, places, fit.fault, fit.parameters, shift).objective


def _no_rows(data: Compact, _p: Array) -> Array:
    return np.zeros((0, data.beams.basis.shape[1]))


def _same(data: Compact, _p: Array) -> Compact:
    return data


def _starts(data: Compact, fault: Fault) -> list[Array]:
    """Return parameters to start from: no fault, the opposite sign, what the other channels say."""
    starts = [np.zeros(fault.size)]
    if fault.kind in ("gain", "phase", "drift"):
        starts.append(np.concatenate([[-2.0], np.zeros(fault.size - 1)]))
    if len(fault.channels) < len(data.live) / 2:
        starts.append(_apart(data, fault))
    return starts


def _apart(data: Compact, fault: Fault) -> Array:
    """Return first parameters: the fault's channels against the motion that all others show."""
    others = data.without(fault.channels)
    state = solve(others)
    if np.min(
        np.abs(np.linalg.svd(others.a[:, None] * others.beams.basis, compute_uv=False))
    ) < 1e-6 * np.max(data.a):
        return np.zeros(fault.size)
    a = data.a[fault.channels][:, None]
    here = fault.rows(data, np.zeros(fault.size))
    e = a * (data.y[fault.channels] - _times(here, state.z))
    slopes = np.stack([a * _times(d, state.z) for d in _slopes(data, fault, np.zeros(fault.size))])
    score = np.real(np.einsum("kcf,cf->k", slopes.conj(), e))
    information = np.real(np.einsum("kcf,lcf->kl", slopes.conj(), slopes))
    return np.asarray(_inverse(information) @ score)


def _slopes(data: Compact, fault: Fault, theta: Array) -> list[ComplexArray | Array]:
    """Return the derivatives of the fault's rows by each parameter."""
    made = []
    for place in range(fault.size):
        small = np.zeros(fault.size)
        small[place] = _SMALL * fault.scale[place]
        made.append(
            (fault.rows(data, theta + small) - fault.rows(data, theta - small)) / (2.0 * small[place])
        )
    return made


def _times(rows: ComplexArray | Array, z: ComplexArray) -> ComplexArray:
    if rows.ndim == 2:
        return np.asarray(rows @ z)
    return np.asarray(np.einsum("fcm,mf->cf", rows, z))


class _Refit:
    """The fit at some parameters and shifts: objective, and the Gauss-Newton step from there."""

    def __init__(
        self, data: Compact, places: Places, fault: Fault | None, theta: Array, shift: Array
    ) -> None:
        self.places, self.fault, self.theta, self.shift = places, fault, theta, shift
        self.data = places.moved(data, shift)
        base = self.data.a[:, None] * self.data.beams.basis
        held = self.data.white(self.data.y)
        mixing = self.data.mixing
        self.norm = None if mixing is None else mixing.norm
        self.channels = fault.channels if fault is not None else []
        self.own = self.data.a[self.channels][:, None]
        rows = fault.rows(self.data, theta) if fault is not None else np.zeros((0, base.shape[1]))
        self.varies = rows.ndim == 3
        if self.varies:
            all_rows = np.repeat(base[None].astype(complex), len(rows), axis=0)
            all_rows[:, self.channels] = self.own * rows
            span, upper = np.linalg.qr(all_rows if mixing is None else mixing.whiten @ all_rows)
            seen = np.einsum("fcm,cf->fm", span.conj(), held)
            self.z = _solved(upper, seen[..., None])[..., 0].T
            self.e = held - np.einsum("fcm,fm->cf", span, seen)
        else:
            changed = base.astype(rows.dtype)
            changed[self.channels] = self.own * rows
            span, upper = np.linalg.qr(changed if mixing is None else mixing.whiten @ changed)
            seen = span.conj().T @ held
            self.z = _solved(upper, seen)
            self.e = held - span @ seen
        self.own_span, self.own_e = _own(self.data, span), _own(self.data, self.e)
        self.rows = changed if not self.varies else all_rows
        self.objective = float(np.sum(np.abs(self.e) ** 2)) + places.penalty(shift)

    def step(self) -> tuple[Array, Array]:
        """Return the Gauss-Newton step of parameters and shifts, and the inverse information."""
        size, count = len(self.theta), len(self.places.owners)
        total = size + 3 * count
        information = np.zeros((total, total))
        score, seen = np.zeros(total), np.zeros((total, self.z.size), dtype=complex)
        slopes = np.zeros((0, len(self.channels), self.z.shape[1]), dtype=complex)
        if self.fault is not None and size:
            found = _slopes(self.data, self.fault, self.theta)
            slopes = np.stack([self.own * _times(slope, self.z) for slope in found])
            score[:size] = np.real(np.einsum("knl,nl->k", slopes.conj(), self.own_e[self.channels]))
            mixed = self._normed(self.channels, self.channels, slopes)
            information[:size, :size] = np.real(np.einsum("knl,jnl->kj", slopes.conj(), mixed))
            seen[:size] = self._seen(self.channels, slopes)
        for number, channels in enumerate(self.places.owners):
            part = slice(size + 3 * number, size + 3 * number + 3)
            moved = self._shifted(channels)
            score[part] = np.real(np.einsum("knl,nl->k", moved.conj(), self.own_e[channels]))
            mixed = self._normed(channels, channels, moved)
            information[part, part] = np.real(np.einsum("knl,jnl->kj", moved.conj(), mixed))
            seen[part] = self._seen(channels, moved)
            both = [c for c in channels if c in self.channels] if size else []
            if both:
                ours = slopes[:, [self.channels.index(c) for c in both]]
                theirs = self._normed(both, channels, moved)
                information[:size, part] = np.real(np.einsum("knl,jnl->kj", ours.conj(), theirs))
                information[part, :size] = information[:size, part].T
        information -= np.real(seen.conj() @ seen.T)
        if count:
            weight = 0.5 / np.repeat(self.places.sd_m, 3) ** 2
            information[np.arange(size, total), np.arange(size, total)] += weight
            score[size:] -= weight * self.shift.ravel()
        inverse = _inverse(information)
        return inverse @ score, inverse

    def _normed(self, wanted: list[int], channels: list[int], values: ComplexArray) -> ComplexArray:
        """Return changes (k, n, line) of some channels as seen by changes of others, (k, wanted, line)."""
        if self.norm is None:
            if wanted == channels:
                return values
            return np.asarray(values[:, [channels.index(c) for c in wanted]])
        return np.asarray(self.norm[np.ix_(wanted, channels)] @ values)

    def _shifted(self, channels: list[int]) -> ComplexArray:
        """Return what shifts of a point along the three axes change, (3, n, line)."""
        turned = np.cross(np.eye(3)[:, None], self.data.directions[channels][None])
        change = np.concatenate([np.zeros_like(turned), turned], axis=2)
        rows = change[..., dof_indices(self.data.beams.dof)] @ self.data.beams.to_dof
        made = self.data.a[channels][:, None] * (rows @ self.z)
        if self.fault is not None and self.fault.kind in ("gain", "phase", "delay", "drift"):
            for place, channel in enumerate(channels):
                if channel in self.channels:
                    made[:, place] = made[:, place] * self._factor(channel)
        return np.asarray(made)

    def _factor(self, channel: int) -> ComplexArray | complex:
        """Return the factor that the fault puts on a channel."""
        row = self.data.a[channel] * self.data.beams.basis[channel]
        peak = int(np.argmax(np.abs(row)))
        return np.asarray(self.rows[..., channel, peak] / row[peak])

    def _seen(self, channels: list[int], values: ComplexArray) -> ComplexArray:
        """Return the part (k, m * line) of changes (k, n, line) that the motion can take."""
        if self.varies:
            found = np.einsum("lnm,knl->kml", self.own_span[:, channels].conj(), values, optimize=True)
        else:
            found = self.own_span[channels].conj().T @ values
        return np.asarray(found.reshape(len(values), -1))


def _inverse(information: Array) -> Array:
    """Return the pseudo-inverse of an information matrix, scaled to a unit diagonal first."""
    diagonal = np.diag(information)
    seen = diagonal > _UNSEEN * np.max(diagonal, initial=0.0)
    scale = np.where(seen, 1.0 / np.sqrt(np.where(seen, diagonal, 1.0)), 0.0)
    even = information * np.outer(scale, scale)
    if len(even) > _MANY:
        found = np.linalg.inv(even + np.diag(np.where(seen, 1e-10, 1.0)))
    else:
        found = np.linalg.pinv(even, rcond=1e-9, hermitian=True)
    return np.asarray(found * np.outer(scale, scale))
