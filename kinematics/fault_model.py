"""Faults of single channels as changes of their observation rows, and the refit with such a change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinematics.beams import BeamSet
from kinematics.spatial import dof_indices, point_rows

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Rows = Callable[[Array], ComplexArray]
_STEP = 1e-5
_ROUNDS = 4


@dataclass(frozen=True)
class LineData:
    """One body in one run at the lines used for the diagnosis.

    Attributes
    ----------
    beams : BeamSet
        For all degrees of freedom that the beams observe.
    arms_m, directions : ndarray, (channel, 3)
    points : tuple of str, (channel,)
    y : ndarray, (channel, freq), complex
        Displacement along the beams, m; zero where missing.
    s : ndarray, (channel, freq)
        1 / (sd sqrt 2), so that s times noise has unit complex variance; zero where not used.
    tau : ndarray, (freq,)
        Place of each line in the measurement, -1 to 1.
    """

    beams: BeamSet
    arms_m: Array
    directions: Array
    points: tuple[str, ...]
    y: ComplexArray
    s: Array
    tau: Array

    def row(self, arms_m: Array, directions: Array) -> Array:
        """Return rows (n, m) in the orthonormal basis for other positions or directions."""
        places = dof_indices(self.beams.dof)
        return np.asarray(point_rows(arms_m, directions)[:, places] @ self.beams.to_dof)

    def moved(self, arms_m: Array | None = None, directions: Array | None = None) -> LineData:
        """Return the data with other positions (m) or directions, and the rows that belong to them."""
        arms = self.arms_m if arms_m is None else arms_m
        beams = self.directions if directions is None else directions
        basis = replace(self.beams, basis=self.row(arms, beams))
        return replace(self, beams=basis, arms_m=arms, directions=beams)

    def without(self, channels: Array | list[int]) -> LineData:
        """Return the data with some channels left out."""
        s = self.s.copy()
        s[channels] = 0.0
        return replace(self, s=s)


@dataclass(frozen=True)
class State:
    """A fit at all lines: coefficients z (m, freq), whitened residual e (channel, freq), leverage h."""

    z: ComplexArray
    inverse: ComplexArray
    e: ComplexArray
    h: Array
    rows: ComplexArray

    def energy(self) -> Array:
        """Return the leverage-corrected mean residual energy of each channel, (channel,); 1 for noise."""
        live = np.abs(self.e) > 0.0
        with np.errstate(invalid="ignore", divide="ignore"):
            corrected = np.where(live & (self.h < 0.999), np.abs(self.e) ** 2 / (1.0 - self.h), 0.0)
            return np.asarray(np.sum(corrected, axis=1) / np.maximum(np.sum(corrected > 0.0, axis=1), 1))


def solve(data: LineData, rows: ComplexArray | None = None) -> State:
    """Fit all lines with rows (channel, m) or (freq, channel, m) in the orthonormal basis."""
    used = data.beams.basis.astype(complex) if rows is None else rows
    weights = data.s**2
    size = used.shape[-1]
    if used.ndim == 2:
        pairs = (used.conj()[:, :, None] * used[:, None, :]).reshape(len(used), -1)
        gram = (weights.T @ pairs).reshape(-1, size, size)
        right = (weights * data.y).T @ used.conj()
    else:
        weighted = used.conj() * weights.T[:, :, None]
        gram = weighted.transpose(0, 2, 1) @ used
        right = np.einsum("fcm,cf->fm", weighted, data.y)
    scale = np.maximum(np.trace(gram, axis1=1, axis2=2).real, 1e-300) / size
    inverse = np.linalg.inv(gram / scale[:, None, None] + 1e-12 * np.eye(size)) / scale[:, None, None]
    z = np.einsum("fab,fb->fa", inverse, right)
    if used.ndim == 2:
        e = data.s * (data.y - used @ z.T)
        h = np.real(np.einsum("ca,fab,cb->cf", used, inverse, used.conj(), optimize=True)) * weights
    else:
        e = data.s * (data.y - np.einsum("fcm,fm->cf", used, z))
        h = np.real(np.einsum("fca,fab,fcb->cf", used, inverse, used.conj(), optimize=True)) * weights
    return State(z, inverse, e, h, used)


@dataclass(frozen=True)
class Fault:
    """One possible fault.

    Attributes
    ----------
    kind : str
        ``gain``, ``drift``, ``direction``, ``position``, ``label_swap``, ``noise``, ``axes``.
    channels : list of int
        The channels it changes.
    rows : callable
        Parameters (k,) to rows of those channels, (n, m) or (freq, n, m).
    size : int
        Number of real parameters.
    """

    kind: str
    channels: list[int]
    rows: Rows
    size: int


@dataclass(frozen=True)
class FaultFit:
    """A fitted fault: parameters with covariance, and the fall of the sum of |whitened residual|^2."""

    fault: Fault
    parameters: Array
    covariance: Array
    drop: float


def fit_fault(data: LineData, state: State, fault: Fault) -> FaultFit:
    """Fit a fault by Gauss-Newton, started from a fit without its channels.

    Notes
    -----
    The motion is refitted with every change of the rows, so the fall of the residual energy is that of the
    maximum of the likelihood, and the derivatives are projected off what the motion can explain.
    """
    before = float(np.sum(np.abs(state.e) ** 2))
    parameters, covariance = np.zeros(fault.size), np.zeros((fault.size, fault.size))
    if fault.size:
        apart = solve(data.without(fault.channels)) if len(fault.channels) < len(data.points) / 2 else state
        step, covariance = _step(data, apart, fault, parameters, projected=False)
        parameters = step
    now = solve(data, _changed(state.rows, fault, parameters))
    for _ in range(_ROUNDS if fault.size else 0):
        step, covariance = _step(data, now, fault, parameters, projected=True)
        parameters = parameters + step
        now = solve(data, _changed(state.rows, fault, parameters))
        if np.all(np.abs(step) <= 1e-2 * np.sqrt(np.maximum(np.diag(covariance), 0.0))):
            break
    after = float(np.sum(np.abs(now.e) ** 2))
    return FaultFit(fault, parameters, covariance, before - after)


def score_statistic(data: LineData, state: State, fault: Fault) -> float:
    """Return the score test of a fault, chi-squared with ``fault.size`` degrees of freedom without it."""
    step, covariance = _step(data, state, fault, np.zeros(fault.size), projected=True)
    return float(step @ np.linalg.pinv(covariance, rcond=1e-9, hermitian=True) @ step)


def _changed(base: ComplexArray, fault: Fault, parameters: Array) -> ComplexArray:
    new = fault.rows(parameters)
    if new.ndim == 3 and base.ndim == 2:
        base = np.repeat(base[None], len(new), axis=0)
    changed = base.copy()
    changed[..., fault.channels, :] = new
    return changed


def _step(
    data: LineData, state: State, fault: Fault, parameters: Array, projected: bool
) -> tuple[Array, Array]:
    """Return a Gauss-Newton step (k,) and the covariance of the parameters."""
    here = fault.rows(parameters)
    s = data.s[fault.channels]
    slopes, seen = [], []
    for place in range(fault.size):
        small = np.zeros(fault.size)
        small[place] = _STEP * min(1.0, max(1e-3, data.beams.lever_m) if fault.kind == "position" else 1.0)
        derivative = (fault.rows(parameters + small) - fault.rows(parameters - small)) / (2.0 * small[place])
        slopes.append(s * _times(derivative, state.z))
        if projected:
            seen.append(_gathered(here, slopes[-1] * s))
    e = state.e[fault.channels] if projected else s * (data.y[fault.channels] - _times(here, state.z))
    columns = np.stack(slopes)
    score = np.real(np.einsum("kcf,cf->k", columns.conj(), e))
    information = np.real(np.einsum("kcf,lcf->kl", columns.conj(), columns))
    if projected:
        shared = np.stack(seen)
        information -= np.real(
            np.einsum("kfa,fab,lfb->kl", shared.conj(), state.inverse, shared, optimize=True)
        )
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    inverse = np.linalg.pinv(information * np.outer(scale, scale), rcond=1e-8, hermitian=True)
    inverse = inverse * np.outer(scale, scale)
    return inverse @ score, 0.5 * inverse


def _times(rows: ComplexArray, z: ComplexArray) -> ComplexArray:
    if rows.ndim == 2:
        return np.asarray(rows @ z.T)
    return np.asarray(np.einsum("fcm,fm->cf", rows, z))


def _gathered(rows: ComplexArray, values: ComplexArray) -> ComplexArray:
    """Return the products (freq, m) of rows^H with values (n, freq)."""
    if rows.ndim == 2:
        return np.asarray(values.T @ rows.conj())
    return np.asarray(np.einsum("fcm,cf->fm", rows.conj(), values))
