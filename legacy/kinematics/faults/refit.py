"""The fit of one fault next to the motion and the nuisance parameters, and its evidence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import exp, lgamma, log, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.faults.catalogue import OF_MANY, Fault
from legacy.kinematics.faults.findings import STEP, Finding
from legacy.kinematics.faults.nuisance import Marginal, estimate_nuisance
from legacy.kinematics.faults.packed_readings import Packed, packed
from legacy.kinematics.faults.score_information import Model, State, energies, model_of, weighted_rows
from legacy.stapeskit.arrays import Array, ComplexArray

# Limit of steps of Gauss and Newton for a fault and the nuisance parameters. Computation; measured on 50
# simulated scenes (each fault of benchmarks/fault_scenes.py, clean ones, ones with outliers; a third of them
# next to errors of positions): half of 3850 fits take up to two steps, 3 % all twelve. No verdict of 25 of
# the scenes changes with a limit of 6 or 24.
_ROUNDS = 12
# Share of a change of the readings, squared, below which what the motion leaves of it is not seen.
_UNSEEN = 1e-9


@dataclass(frozen=True)
class _Trial:
    theta: Array
    near: Marginal

    @property
    def value(self) -> float:
        return self.near.value


class Refit:
    """Fits of faults to data with nuisance parameters, from a fit ``near`` without fault.

    ``merged`` are its data with all lines as one, for what is the same at all lines.
    """

    def __init__(self, near: Marginal, merged: Packed) -> None:
        self.near, self.data, self.merged = near, near.state.data, merged
        self.flat = self.data if near.nuisance.varies else merged
        self.start = np.broadcast_to(near.x, near.nuisance.sd.shape)
        self.lever = self.data.source.beams.lever_m

    @cached_property
    def fine(self) -> Marginal:
        """The fit without fault of the data that judge faults of many channels.

        A large fault of many channels hides motion from the fit, so that it is not gathered with it.
        """
        data = packed(self.data.source, self.data.assumed, fine=True)
        return Marginal.at(data, self.near.nuisance, self.start)

    def _try(self, data: Packed, fault: Fault, theta: Array, x: Array) -> _Trial:
        base = fault.applied(model_of(data), theta, data)
        return _Trial(theta, Marginal.at(data, self.near.nuisance, x, base))

    def sights(self, faults: Sequence[Fault]) -> Array:
        """Return the least objective (n,) with each of some exchanges, the nuisance as it is or zero."""
        starts = [self.start, np.zeros_like(self.start)] if len(self.start) else [self.start]
        data, nuisance, found = self.merged, self.near.nuisance, []
        for x in starts:
            base = nuisance.applied(model_of(data), x, data.ratio)
            places = [fault.geometry(base.arms_m, base.directions, np.zeros(0)) for fault in faults]
            arms, beams = (
                np.array(part).reshape(-1, *base.arms_m.shape) for part in zip(*places, strict=True)
            )
            found.append(energies(data, base, arms, beams) + nuisance.penalty(x))
        return np.min(found, axis=0)

    def most(self, channels: Sequence[int]) -> float:
        """Return by how much the objective falls without some channels: no fault of theirs takes more."""
        if self.data.whiten is not None:
            return np.inf
        return self.near.value - estimate_nuisance(self.data.blanked(channels), self.near.nuisance).value

    def fit(self, fault: Fault) -> Finding:
        """Fit a fault by Gauss and Newton's method; a step that does not improve is shortened."""
        many = fault.owner in OF_MANY
        null = self.fine if many and self.data.source.sd is None else self.near
        judge = null.state.data
        data = judge if fault.entry.varies else self.flat
        trials = (self._try(data, fault, theta, x) for theta, x in self._starts(data, fault))
        now, inverse = self._improve(data, fault, min(trials, key=lambda trial: trial.value))
        if data is not judge:
            now = self._try(judge, fault, now.theta, now.near.x)
            if many or not judge.rest.size:
                # What is gathered without it holds a large fault only in part.
                now, inverse = self._improve(judge, fault, now)
        return Finding(
            fault.kind,
            list(fault.channels),
            fault=fault,
            parameters=now.theta,
            covariance=0.5 * inverse,
            drop=null.value - now.value,
            strain=now.near.strain,
            source=self.data.source,
        )

    def refined(self, fit: Finding) -> Finding:
        """Return a fit of a fault that changes from line to line, by single lines instead of segments."""
        fault = fit.fault
        if fault is None or not fault.entry.varies or self.data.source.sd is not None:
            return fit
        data = self.fine.state.data
        start = self._try(data, fault, fit.parameters, self.start)
        now, inverse = self._improve(data, fault, start)
        return replace(fit, parameters=now.theta, covariance=0.5 * inverse)

    def _improve(self, data: Packed, fault: Fault, now: _Trial) -> tuple[_Trial, Array]:
        """Take steps until they help no more; return the inverse of the information on the fault too."""
        inverse = np.zeros((0, 0))
        for _ in range(_ROUNDS if fault.size + len(self.start) else 0):
            step, inverse = self._step(data, fault, now)
            for part in (1.0, 0.5, 0.25, 0.06):
                theta, x = now.theta + part * step[: fault.size], now.near.x + part * step[fault.size :]
                trial = self._try(data, fault, theta, x)
                if trial.value <= now.value:
                    break
            else:
                break
            fall, now = now.value - trial.value, trial
            if fall < 1e-3:
                break
        return now, inverse

    def _starts(self, data: Packed, fault: Fault) -> list[tuple[Array, Array]]:
        """Return first parameters: no fault, the opposite sign, what the other channels show."""
        size = fault.size
        thetas = [np.zeros(size)]
        if fault.entry.flips:
            thetas.append(-2.0 * np.eye(size)[0])
        if size and 2 * len(fault.channels) < len(data.live):
            others = State.of(data.blanked(fault.channels))
            if others.determined:
                # What the fault's channels lack of the motion of the others, to first order.
                t = self._tangents(data, fault, thetas[0], model_of(data), others.z).reshape(size, -1)
                own = weighted_rows(data, model_of(data), fault.channels)
                error = data.y[:, fault.channels] - own @ others.z
                normal = np.linalg.pinv(np.real(t.conj() @ t.T), rcond=1e-8, hermitian=True)
                thetas.append(normal @ np.real(t.conj() @ error.ravel()))
        # Next to a large fault the nuisance parameters of the fit without it are far off.
        starts = [(theta, np.zeros_like(self.start)) for theta in thetas]
        return [*starts, (thetas[0], self.start)] if len(self.start) else starts

    def _tangents(
        self, data: Packed, fault: Fault, theta: Array, base: Model, z: NDArray[Any]
    ) -> ComplexArray:
        """Return derivatives (p, group, n, column) of the readings of the fault's channels."""
        channels, factor = np.array(fault.channels), fault.entry.factor
        steps = np.diag(STEP * fault.scale(self.lever))

        def change(at: Callable[[Array], NDArray[Any]]) -> NDArray[Any]:
            here = at(theta)
            moved = [(at(theta + step) - here) / np.sum(step) for step in steps]
            return np.reshape(moved, (len(steps), *here.shape))

        if factor is not None:
            size = len(data.tau)
            slopes = change(lambda p: np.broadcast_to(factor(p, data.tau, data.ratio), (size,)))
            return np.asarray(slopes[..., None, None] * (weighted_rows(data, base, channels) @ z))
        return change(lambda p: weighted_rows(data, fault.applied(base, p, data), channels)) @ z

    def _step(self, data: Packed, fault: Fault, now: _Trial) -> tuple[Array, Array]:
        """Return the step of all parameters, and the inverse of the information on those of the fault.

        The nuisance parameters are eliminated (Schur complement).
        """
        near = replace(now.near)  # what is computed of it is not held with the trial
        pull = near.pull
        free = near.solved(pull)
        if not fault.size:
            return free, np.zeros((0, 0))
        groups = np.array([fault.channels])
        base = near.nuisance.applied(model_of(data), near.x, data.ratio)
        t = self._tangents(data, fault, now.theta, base, near.state.z)[:, :, None]
        sums = near.state.sums(groups, t)
        shared = near.common(groups, t, sums.taken)[0]
        held = near.solved(shared.T)
        whole = np.diag(sums.information[0]) + np.sum(np.abs(sums.taken[0]) ** 2, axis=(1, 2, 3))
        # A parameter that does not show at its usual size is none that rounding should show.
        unit = 1.0 / np.sqrt(np.maximum(whole, fault.scale(self.lever) ** -2.0))
        inverse = _inverse(sums.information[0] - shared @ held, unit)
        step = inverse @ (sums.score[0] - pull @ held)
        return np.concatenate([step, free - held @ step]), inverse


def _inverse(information: Array, unit: Array) -> Array:
    """Invert the information on a fault; what the data do not show of it is left at zero.

    ``unit`` (p,) scales the parameters to equal changes of the readings. Of a change that is motion as well,
    the motion leaves rounding, of either sign.
    """
    values, vectors = np.linalg.eigh(information * np.outer(unit, unit))
    seen = values > _UNSEEN
    half = vectors[:, seen] * values[seen] ** -0.5
    return np.asarray((half @ half.T) * np.outer(unit, unit))


def log_evidence(fit: Finding, level: float, lever_m: float) -> float:
    """Return the logarithm of the Bayes factor of a fault against none.

    Parameters
    ----------
    fit : Finding
        Of a fault, before its covariance is multiplied with the level.
    level : float
        Noise variance over the stated one.
    lever_m : float
        Unit of lengths.

    Notes
    -----
    Laplace's approximation (MacKay 2003, Information theory, inference and learning algorithms, ch. 27-28)
    with a multivariate Cauchy prior of the parameters in units of their common size; a factor has half its
    prior around -1. Information that the prior holds is added, so that a fault of which the data show nothing
    has a factor of 1, however many parameters it has.
    """
    fault, size, gain = fit.fault, len(fit.parameters), fit.drop / level - log(fit.places)
    if fault is None or not size:
        return gain
    scale = fault.scale(lever_m)
    information = np.linalg.pinv(fit.covariance * level, rcond=1e-12, hermitian=True)
    values = np.linalg.eigvalsh(information * np.outer(scale, scale))
    norm = lgamma(0.5 * (1 + size)) - lgamma(0.5) - 0.5 * size * log(pi)
    unseen = 2.0 * pi * exp(2.0 * norm / size)
    width = 0.5 * size * log(2.0 * pi) - 0.5 * float(np.sum(np.log(np.maximum(values, 0.0) + unseen)))
    p = fit.parameters / scale
    distance = float(p @ p)
    if fault.entry.flips:
        turned = p.copy()
        turned[0] += 2.0 / scale[0]
        distance = min(distance, float(turned @ turned))
        norm -= log(2.0)
    return gain + norm - 0.5 * (1 + size) * log(1.0 + distance) + width
