"""The rigid fit of packed data, and its refit with a fault beside the motion and the positions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.fault_kinds import Fault
from kinematics.faults.packed.compact import Compact
from kinematics.faults.refit import Others, Places, change_of_rows, inverse_of, own_part, solved_for, times
from kinematics.faults.refit_factor import refit

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
_ROUNDS = 6


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

    @cached_property
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
        return own_part(self.data, self.span)

    @cached_property
    def own_e(self) -> ComplexArray:
        """Residual whose products with changes of the channels' rows are those of ``e``, (channel, line)."""
        return own_part(self.data, self.e)

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


def solve(data: Compact) -> State:
    """Fit all packed lines."""
    span, upper = np.linalg.qr(data.white(data.beams.basis))
    held = data.white(data.y)
    seen = span.T @ held
    z = solved_for(upper, seen)
    return State(data, span, z, held - span @ seen)


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
    others = None
    if fault is not None and not places.owners and data.mixing is None:
        others = Others.of(data, fault.channels) if len(fault.channels) < len(data.live) // 2 else None
        others = others if others is not None and others.rows.shape[0] == others.rows.shape[1] else None
    now = min(
        (refit(data, places, fault, theta, shift, others) for theta in starts), key=lambda fit: fit.objective
    )
    inverse = np.zeros((size, size))
    for _ in range(_ROUNDS if size + shift.size else 0):
        step, inverse = now.step()
        trial = refit(
            data, places, fault, now.theta + step[:size], now.shift + step[size:].reshape(-1, 3), others
        )
        for _ in range(6):
            if trial.objective <= now.objective * (1.0 + 1e-12):
                break
            step = 0.5 * step
            trial = refit(
                data, places, fault, now.theta + step[:size], now.shift + step[size:].reshape(-1, 3), others
            )
        fall, now = now.objective - trial.objective, trial
        if fall < 1e-3:
            break
    made = fault if fault is not None else Fault("", [], 0, _no_rows, _same, np.zeros(0))
    fit = FaultFit(made, now.theta, 0.5 * inverse[:size, :size], before - now.objective)
    return fit, now.shift


def objective(data: Compact, places: Places, fit: FaultFit, shift: Array) -> float:
    """Return the energy of the residual with a fitted fault, and half (shift / sd)^2."""
    return refit(data, places, fit.fault, fit.parameters, shift, None).objective


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
    e = a * (data.y[fault.channels] - times(here, state.z))
    slopes = np.stack([a * times(d, state.z) for d in change_of_rows(data, fault, np.zeros(fault.size))])
    score = np.real(np.einsum("kcf,cf->k", slopes.conj(), e))
    information = np.real(np.einsum("kcf,lcf->kl", slopes.conj(), slopes))
    return np.asarray(inverse_of(information) @ score)
