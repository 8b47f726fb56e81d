"""The fit of one fault next to the motion and the nuisance parameters, and its evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import exp, lgamma, log, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.catalogue import KINDS, OF_MANY, Fault
from kinematics.faults.packed_readings import Packed, Source, packed
from kinematics.faults.score_information import Model, State, model_of
from kinematics.faults.uncertain_positions import Marginal, Nuisance, estimate_nuisance
from stapeskit.arrays import Array, ComplexArray

# Limit of steps of Gauss and Newton for a fault and the nuisance parameters. Computation; measured on 50
# simulated scenes (each fault of benchmarks/fault_scenes.py, clean ones, ones with outliers; a third of them
# next to errors of positions): half of 3850 fits take up to two steps, 3 % all twelve. No verdict of 25 of
# the scenes changes with a limit of 6 or 24.
_ROUNDS = 12
# Segments or lines that a change over the lines needs, to be distinguished from level, slope and bend.
_COARSE = 4
# Steps of the numerical derivatives, in units of the prior size.
_STEP = 1e-5
# Share of a change of the readings, squared, below which what the motion leaves of it is not seen.
_UNSEEN = 1e-9


@dataclass(frozen=True)
class FaultFit:
    """A fitted fault.

    Attributes
    ----------
    fault : Fault
    parameters : ndarray, (p,)
    covariance : ndarray, (p, p)
    drop : float
        Fall of the objective: residual energy and half the squares of the nuisance parameters over their sd.
    source : Source, optional
        Of the readings.
    """

    fault: Fault
    parameters: Array
    covariance: Array
    drop: float
    source: Source | None = None

    @property
    def channels(self) -> list[int]:
        """The channels of the fault."""
        return self.fault.channels

    def factor_at(self, freq_hz: Array) -> ComplexArray:
        """Return the factor of the readings, and its relative derivatives, (p + 1, freq).

        Without rows for faults of the geometry.
        """
        factor = KINDS[self.fault.kind].factor if self.fault.kind in KINDS else None
        if factor is None or self.source is None:
            return np.zeros((0, len(freq_hz)), dtype=complex)
        place = np.interp(np.arange(len(freq_hz)), self.source.lines, self.source.tau)
        ratio = freq_hz / self.source.middle_hz
        steps = _STEP * self.fault.scale(1.0)
        value = np.broadcast_to(factor(self.parameters, place, ratio), freq_hz.shape)
        factors = [value]
        for k, step in enumerate(steps):
            more = factor(self.parameters + step * np.eye(len(steps))[k], place, ratio)
            factors.append((more - value) / step / value)
        return np.stack(factors)


@dataclass(frozen=True)
class _Trial:
    theta: Array
    x: Array
    state: State
    value: float


class Refit:
    """Fits of faults to data with nuisance parameters; ``before`` is the objective without fault."""

    def __init__(self, data: Packed, nuisance: Nuisance, start: Array, before: float, flat: Packed) -> None:
        self.data, self.nuisance, self.before = data, nuisance, before
        self.start = start
        self.flat = flat
        self.lever = data.source.beams.lever_m
        self._unmoved: dict[int, Marginal] = {}

    @property
    def coarse(self) -> bool:
        """Whether segments are too few to show a change from line to line that the lines show."""
        return len(self.data.y) < _COARSE <= len(self.data.source.lines)

    @cached_property
    def fine(self) -> tuple[Packed, float]:
        """The data that judge faults of many channels, and their objective without fault.

        A large fault of many channels hides motion from the fit, so that it is not gathered with it, and a
        change from line to line shows more finely than segments do.
        """
        data = packed(self.data.source, self.data.assumed, fine=True)
        null = State.of(data, self.nuisance.applied(model_of(data), self.start))
        return data, null.energy + self.nuisance.penalty(self.start)

    def _try(self, data: Packed, fault: Fault, theta: Array, x: Array) -> _Trial:
        model = self.nuisance.applied(fault.applied(model_of(data), theta, data), x)
        state = State.of(data, model)
        return _Trial(theta, x, state, state.energy + self.nuisance.penalty(x))

    def sight(self, fault: Fault) -> float:
        """Return the least objective with a fault without parameters and the nuisance as it is, or zero."""
        zero = np.zeros(0)
        starts = [self.start, np.zeros_like(self.start)] if len(self.start) else [self.start]
        return min(self._try(self.flat, fault, zero, x).value for x in starts)

    def most(self, channels: Sequence[int]) -> float:
        """Return by how much the objective falls without some channels: no fault of theirs takes more."""
        if self.data.whiten is not None:
            return np.inf
        weight, y = self.data.weight.copy(), self.data.y.copy()
        weight[:, channels], y[:, channels] = 0.0, 0.0
        state, x = estimate_nuisance(replace(self.data, weight=weight, y=y), self.nuisance)
        return self.before - state.energy - self.nuisance.penalty(x)

    def fit(self, fault: Fault) -> FaultFit:
        """Fit a fault by Gauss and Newton's method; a step that does not improve is shortened."""
        judge, before = self.data, self.before
        fine = self.coarse or (fault.owner in OF_MANY and self.data.source.sd is None)
        if fine:
            judge, before = self.fine
        data = judge if fault.varies else self.flat
        now = min(
            (self._try(data, fault, theta, x) for theta, x in self._starts(data, fault)),
            key=lambda trial: trial.value,
        )
        now, inverse = self._improved(data, fault, now)
        if data is not judge:
            now = self._try(judge, fault, now.theta, now.x)
            if fine or fault.owner in OF_MANY:
                # What is packed without it holds a large fault only in part.
                now, inverse = self._improved(judge, fault, now)
        value = now.value
        covariance = 0.5 * inverse[: fault.size, : fault.size]
        return FaultFit(fault, now.theta, covariance, before - value, self.data.source)

    def refined(self, fit: FaultFit) -> FaultFit:
        """Return a fit of a fault that changes from line to line, by single lines instead of segments."""
        if not fit.fault.varies or self.data.source.sd is not None:
            return fit
        data, _ = self.fine
        start = self._try(data, fit.fault, fit.parameters, self.start)
        now, inverse = self._improved(data, fit.fault, start)
        size = fit.fault.size
        return replace(fit, parameters=now.theta, covariance=0.5 * inverse[:size, :size])

    def _improved(self, data: Packed, fault: Fault, now: _Trial) -> tuple[_Trial, Array]:
        """Take steps until they help no more; return the inverse of the information too."""
        inverse = np.zeros((0, 0))
        for _ in range(_ROUNDS if fault.size + len(self.start) else 0):
            step, inverse = self._step(data, fault, now)
            for part in (1.0, 0.5, 0.25, 0.06):
                theta, x = now.theta + part * step[: fault.size], now.x + part * step[fault.size :]
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
        if size and KINDS[fault.kind].flips:
            thetas.append(np.concatenate([[-2.0], np.zeros(size - 1)]))
        if size and 2 * len(fault.channels) < len(data.live):
            alone = self._alone(data, fault)
            if alone is not None:
                thetas.append(alone)
        # Next to a large fault the nuisance parameters of the fit without it are far off.
        starts = [(theta, np.zeros_like(self.start)) for theta in thetas]
        return [*starts, (np.zeros(size), self.start)] if len(self.start) else starts

    def _alone(self, data: Packed, fault: Fault) -> Array | None:
        """Return the parameters of a fault against the motion of all other channels, to first order."""
        left = data.weight.copy()
        left[:, fault.channels] = 0.0
        base = model_of(data)
        own: NDArray[np.float64] = left[:, :, None] * data.rows(base.arms_m, base.directions)
        gram = own.swapaxes(1, 2) @ own
        if np.min(np.linalg.eigvalsh(gram)[:, 0]) < 1e-6 * np.max(np.trace(gram, axis1=1, axis2=2)):
            return None
        kept = left > 0.0
        z = np.linalg.solve(gram, own.swapaxes(1, 2) @ np.where(kept[:, :, None], data.y, 0.0))
        channels = np.array(fault.channels)
        rows = data.weight[:, channels, None] * data.rows(base.arms_m[channels], base.directions[channels])
        error = data.y[:, channels] - rows @ z
        t = self._tangents(data, fault, np.zeros(fault.size), base, z)
        flat = t.reshape(len(t), -1)
        normal = np.real(flat.conj() @ flat.T)
        score = np.real(flat.conj() @ error.ravel())
        return np.asarray(np.linalg.pinv(normal, rcond=1e-8, hermitian=True) @ score)

    def _tangents(
        self, data: Packed, fault: Fault, theta: Array, base: Model, z: NDArray[Any]
    ) -> ComplexArray:
        """Return derivatives (p, group, n, column) of the readings of the fault's channels."""
        channels = np.array(fault.channels)
        scale = fault.scale(self.lever)

        def rows(p: Array) -> NDArray[Any]:
            model = fault.applied(base, p, data)
            weighted = data.weight[:, channels, None] * data.rows(
                model.arms_m[channels], model.directions[channels]
            )
            return weighted if model.factor is None else model.factor[:, channels, None] * weighted

        here = rows(theta)
        tangents = []
        for k in range(len(theta)):
            step = np.zeros(len(theta))
            step[k] = _STEP * scale[k]
            tangents.append(((rows(theta + step) - here) / step[k]) @ z)
        return np.stack(tangents) if tangents else np.zeros((0, *z[:, :1].shape), dtype=complex)

    def _step(self, data: Packed, fault: Fault, now: _Trial) -> tuple[Array, Array]:
        """Return the step of all parameters, and the inverse of the information on those of the fault.

        The nuisance parameters are eliminated first (Schur complement), so that their information is
        factorised once for all faults that start from the same fit.
        """
        size, near = fault.size, self._near(data, fault, now)
        pull = near.score - 0.5 * now.x / self.nuisance.sd**2 if near else now.x
        free = near.solved(pull) if near else now.x
        if not size:
            return free, np.zeros((0, 0))
        groups = np.array([fault.channels])
        base = self.nuisance.applied(model_of(data), now.x)
        t = self._tangents(data, fault, now.theta, base, now.state.z)[:, :, None]
        sums = now.state.sums(groups, t)
        score, information = sums.score[0], sums.information[0]
        whole = np.diag(information) + np.sum(sums.taken[0] ** 2, axis=1)
        unit = 1.0 / np.sqrt(np.maximum(whole, 1e-300))
        if near is None:
            inverse = _inverse(information, unit)
            return inverse @ score, inverse
        shared = near.common(groups, t, sums.taken)[0]
        held = near.solved(shared.T)
        inverse = _inverse(information - shared @ held, unit)
        step = inverse @ (score - pull @ held)
        return np.concatenate([step, free - held @ step]), inverse

    def _near(self, data: Packed, fault: Fault, now: _Trial) -> Marginal | None:
        """Return the information on the nuisance parameters; that of the fit without any error is kept."""
        if not len(self.start):
            return None
        if not fault.size or np.any(now.theta) or np.any(now.x):
            return Marginal(now.state, self.nuisance)
        if id(data) not in self._unmoved:
            self._unmoved[id(data)] = Marginal(State.of(data), self.nuisance)
        return self._unmoved[id(data)]


def _inverse(information: Array, unit: Array) -> Array:
    """Invert the information on a fault; what the data do not show of it is left at zero.

    ``unit`` (p,) scales the parameters to equal changes of the readings. Of a change that is motion as well,
    the motion leaves rounding, of either sign.
    """
    values, vectors = np.linalg.eigh(information * np.outer(unit, unit))
    seen = values > _UNSEEN
    half = vectors[:, seen] * values[seen] ** -0.5
    return np.asarray((half @ half.T) * np.outer(unit, unit))


def log_evidence(fit: FaultFit, level: float, lever_m: float) -> float:
    """Return the logarithm of the Bayes factor of a fault against none.

    Parameters
    ----------
    fit : FaultFit
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
    fault = fit.fault
    gain = fit.drop / level - log(max(fault.places, 1))
    size = fault.size
    if size == 0:
        return gain
    scale = fault.scale(lever_m)
    information = np.linalg.pinv(fit.covariance * level, rcond=1e-12, hermitian=True)
    values = np.linalg.eigvalsh(information * np.outer(scale, scale))
    norm = lgamma(0.5 * (1 + size)) - lgamma(0.5) - 0.5 * size * log(pi)
    unseen = 2.0 * pi * exp(2.0 * norm / size)
    width = 0.5 * size * log(2.0 * pi) - 0.5 * float(np.sum(np.log(np.maximum(values, 0.0) + unseen)))
    p = fit.parameters / scale
    distance = float(p @ p)
    if KINDS[fault.kind].flips:
        turned = p.copy()
        turned[0] += 2.0 / scale[0]
        distance = min(distance, float(turned @ turned))
        norm -= log(2.0)
    return gain + norm - 0.5 * (1 + size) * log(1.0 + distance) + width
