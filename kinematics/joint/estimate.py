"""One estimator of any set of parameters of channels, free or known beforehand, the motion projected out.

Shapes: c channels, G groups, n columns, r motions that the beams see, p parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kinematics.joint import tangents
from kinematics.joint.pack import Packed
from kinematics.joint.tangents import Geometry, Parameters
from stapeskit.arrays import Array, ComplexArray

_ROUNDING = 1e-14  # relative rounding that is left of information where the motion explains a parameter
_SMALL = 1e-9  # singular values of the beams, over the largest, that count as zero
_LEAST_OWN = 1e-6  # share of a channel's noise that stays in its residual, below which nothing is known of it
_ROUNDS = 12  # of Gauss and Newton; most end after three
_SETTLED = 1e-2  # fall of chi2 that ends the rounds: a tenth of a standard deviation
_STEPS = (1.0, 0.5, 0.25, 0.06)


class State:
    """The motion fitted under a geometry, and the tangents of every channel there.

    Attributes
    ----------
    q : ndarray, (G or 1, c, r)
        Orthonormal columns that span the weighted rows.
    e : ndarray, (G, c, n), complex
        Residuals over noise, sqrt 2 per part; their phase is that of the factor.
    energy : float
        Sum of |residual / sd|^2.
    """

    def __init__(self, packed: Packed, geometry: Geometry | None = None) -> None:
        self.packed = packed
        self.geometry = geometry or packed.geometry
        size = np.abs(self.geometry.factor)
        phase = np.where(size > 0.0, self.geometry.factor.conj() / np.where(size > 0.0, size, 1.0), 1.0)
        weight = packed.w * size
        if np.array_equal(weight, np.broadcast_to(weight[:1], weight.shape)):
            weight = weight[:1]
        self.weight = weight
        self.rows = self.geometry.rows() / packed.scale
        a = weight[:, :, None] * (self.rows @ packed.visible)
        q, r = np.linalg.qr(a)
        diagonal = np.abs(np.diagonal(r, axis1=1, axis2=2))
        self._turn: Array | None = None
        if diagonal.min() > _SMALL * diagonal.max():
            self._r = r
        else:
            u, s, vt = np.linalg.svd(a, full_matrices=False)
            keep = s > _SMALL * s[:, :1]
            q = u * keep[:, None, :]
            self._turn = vt.swapaxes(1, 2) * np.where(keep, 1.0 / np.where(keep, s, 1.0), 0.0)[:, None, :]
        self.q = q
        self.y = packed.y if np.all(phase == 1.0) else packed.y * phase[:, :, None]
        self._phase = phase
        self.seen = q.swapaxes(1, 2) @ self.y
        self.e = self.y - q @ self.seen
        self.energy = 2.0 * float(np.sum(self.e.real**2) + np.sum(self.e.imag**2))

    @cached_property
    def leverage(self) -> Array:
        """Diagonal of the hat matrix, (G, c)."""
        h = np.sum(self.q**2, axis=2)
        return np.asarray(np.broadcast_to(h, self.packed.w.shape))

    @property
    def freedom(self) -> int:
        """Degrees of freedom of ``energy``."""
        used = np.count_nonzero(self.packed.w, axis=1)
        rank = np.rint(self.leverage.sum(axis=1)).astype(int)
        return int(2 * np.sum((used - rank) * self.packed.columns))

    @cached_property
    def motion(self) -> ComplexArray:
        """The motion in the visible coordinates, (G, r, n)."""
        if self._turn is not None:
            return np.asarray(self._turn @ self.seen)
        return np.asarray(
            np.linalg.solve(np.broadcast_to(self._r, (len(self.seen), *self._r.shape[1:])), self.seen)
        )

    @cached_property
    def rest(self) -> ComplexArray:
        """Residuals of the columns without motion, (G, c, k)."""
        packed = self.packed
        rest = packed.rest if np.all(self._phase == 1.0) else packed.rest * self._phase[:, :, None]
        return np.asarray(rest - self.q @ (self.q.swapaxes(1, 2) @ rest))

    @cached_property
    def noise_energy(self) -> tuple[Array, Array]:
        """Energy of ``rest`` and its degrees of freedom, of every group and channel, (G, c) each."""
        energy = 2.0 * np.sum(np.abs(self.rest) ** 2, axis=2)
        free = 2.0 * (self.packed.w > 0.0) * (1.0 - self.leverage) * self.packed.rest_columns[:, None]
        return energy, free

    @cached_property
    def own_noise(self) -> tuple[Array, Array]:
        """For each channel (c,): the energy that the motion does not explain, and its degrees of freedom.

        In lines of their own, what is proportional to the motion at all lines is subtracted from residuals.
        """
        if self.packed.turned:
            energy, freedom = self.noise_energy
            return energy.sum(axis=0), freedom.sum(axis=0)
        motion, weight = self.motion[:, :, 0], self.packed.w
        energy, freedom = np.zeros(weight.shape[1]), np.zeros(weight.shape[1])
        for channel in self.packed.live:
            used = np.flatnonzero(weight[:, channel] > 0.0)
            own = float(np.mean(1.0 - self.leverage[used, channel]))
            if len(used) > 2 * motion.shape[1] and own > _LEAST_OWN:
                course = np.linalg.qr(motion[used] * weight[used, channel, None])[0]
                rest = self.e[used, channel, 0]
                rest = rest - course @ (course.conj().T @ rest)
                energy[channel] = 2.0 * float(np.sum(np.abs(rest) ** 2)) / own
                freedom[channel] = 2.0 * (len(used) - course.shape[1])
        return energy, freedom

    @cached_property
    def channel_energy(self) -> tuple[Array, Array]:
        """Energy of all columns over its expectation, and the number of real values, of every channel, (c,).

        Residuals of a channel of leverage h have the variance 1 - h; where it is 1 they say nothing.
        """
        packed = self.packed
        own = np.where(1.0 - self.leverage > _LEAST_OWN, 1.0 - self.leverage, np.inf)
        energy = 2.0 * np.sum(np.abs(self.e) ** 2, axis=2) + self.noise_energy[0]
        columns = (packed.columns + packed.rest_columns)[:, None]
        count = 2.0 * (packed.w > 0.0) * np.isfinite(own) * columns
        return np.sum(energy / own, axis=0), np.sum(count, axis=0)

    @cached_property
    def t(self) -> ComplexArray:
        """Tangents of what every channel reads, (13, c, G, n)."""
        packed, geometry, z = self.packed, self.geometry, self.motion
        lift = packed.visible
        weight = self.weight[:, :, None]
        plain = (self.rows @ lift) @ z
        read = weight * plain
        gained = read
        if geometry.slope is not None:
            gained = (packed.w * self._phase * geometry.slope)[:, :, None] * plain
        shape = (tangents.COUNT, read.shape[1], *read.shape[::2])
        t = np.empty(shape, dtype=complex)
        tau, omega = packed.tau[:, None, None], packed.omega[:, None, None]
        simple = {tangents.GAIN: gained, tangents.PHASE: 1j * gained, tangents.DELAY: -1j * omega * read}
        simple |= {tangents.GAIN_DRIFT: tau * gained, tangents.PHASE_DRIFT: 1j * tau * gained}
        for kind, values in simple.items():
            t[kind] = values.swapaxes(0, 1)
        for kind in range(tangents.BEAM_U, tangents.COUNT):
            changed = (geometry.row_tangents(kind) / packed.scale) @ lift
            t[kind] = (weight * (changed @ z)).swapaxes(0, 1)
        return t

    @cached_property
    def flat(self) -> Array:
        """Tangents as real numbers, (c, 13, 2 G n)."""
        t = np.ascontiguousarray(self.t.transpose(1, 0, 2, 3))
        return t.reshape(len(t), tangents.COUNT, -1).view(float)

    @cached_property
    def b(self) -> Array:
        """Products of tangents and residuals, (c, 13)."""
        e = np.ascontiguousarray(self.e.swapaxes(0, 1))
        return np.asarray((self.flat @ e.reshape(len(e), -1).view(float)[:, :, None])[:, :, 0])

    @cached_property
    def m(self) -> Array:
        """Products of tangents of a channel, (c, 13, 13)."""
        return np.asarray(self.flat @ self.flat.swapaxes(1, 2))

    def projected(self, channels: Sequence[int]) -> Array:
        """Return the products of the tangents of channels with the motion, (k, 13, D), real."""
        own = list(channels)
        q = np.broadcast_to(self.q, (len(self.e), *self.q.shape[1:]))[:, own].transpose(1, 0, 2)
        product = q[:, None, :, :, None] * self.t[:, own].swapaxes(0, 1)[:, :, :, None, :]
        return np.ascontiguousarray(product).reshape(len(own), tangents.COUNT, -1).view(float)

    def projection(self, parameters: Parameters) -> Array:
        """Return the products of parameters (p,) with the motion, (p, D), real."""
        groups, columns = len(self.e), self.e.shape[2]
        rank = self.q.shape[2]
        out = np.empty((len(parameters), groups, rank, columns), dtype=complex)
        q = np.broadcast_to(self.q, (groups, *self.q.shape[1:]))
        for j, (mask, kind) in enumerate(zip(parameters.mask, parameters.tangent, strict=True)):
            own = np.flatnonzero(mask)
            out[j] = q[:, own].swapaxes(1, 2) @ (mask[own, None, None] * self.t[kind, own]).swapaxes(0, 1)
        return out.reshape(len(parameters), -1).view(float)

    def leave_out(self, channels: Sequence[int]) -> float:
        """Return the fall of the energy when channels are left out; infinite when motion is lost."""
        own = list(channels)
        q = self.q[:, own]
        value, vector = np.linalg.eigh(np.eye(len(own)) - q @ q.swapaxes(1, 2))
        along = np.abs(vector.swapaxes(1, 2) @ self.e[:, own]) ** 2
        inverse = np.where(value > 1e-6, 1.0 / np.maximum(value, 1e-6), 0.0)
        return 2.0 * float(np.sum(inverse[:, :, None] * along))


def system(state: State, parameters: Parameters) -> tuple[Array, Array, Array]:
    """Return score (p,), information (p, p) and projections (p, D) of parameters, the motion free."""
    k = parameters.tangent
    score = np.einsum("jc,cj->j", parameters.mask, state.b[:, k])
    projection = state.projection(parameters)
    own, some = parameters.by_channel
    both = some[:, :, None] & some[:, None, :]
    channel = np.arange(len(own))[:, None, None]
    blocks = state.m[channel, k[own][:, :, None], k[own][:, None, :]]
    information = np.zeros((len(k), len(k)))
    first, second = (np.broadcast_to(index, both.shape) for index in (own[:, :, None], own[:, None, :]))
    np.add.at(information, (first[both], second[both]), blocks[both])
    rounding = _ROUNDING * np.diag(np.diag(information))
    return 2.0 * score, 2.0 * (information - projection @ projection.T + rounding), projection


@dataclass(frozen=True)
class Estimate:
    """Parameters that fit best.

    Attributes
    ----------
    values : ndarray, (p,)
    covariance : ndarray, (p, p)
        With what was known of them beforehand, for noise as assumed.
    chi2 : float
        Sum of squares of residuals and of values over their prior sd.
    state : State
        The motion under these values.
    """

    values: Array
    covariance: Array
    chi2: float
    state: State


def joint(
    packed: Packed,
    parameters: Parameters,
    start: Array | None = None,
    geometry: Geometry | None = None,
) -> Estimate:
    """Estimate parameters together with the motion by Gauss and Newton, from ``start`` (p,) or 0 on.

    They change ``geometry``, by default that of ``packed``.

    Notes
    -----
    The motion is projected out (variable projection, Golub and Pereyra 1973, doi:10.1137/0710036): with Q the
    span of the rows, tangents t and residuals e, the score is 2 Re t^H e and the information
    2 Re t^H (1 - Q Q^H) t, to which known parameters add the inverse of their variance.
    """
    base = geometry or packed.geometry
    x = np.zeros(len(parameters)) if start is None else np.array(start, dtype=float)
    prior = parameters.prior

    def at(values: Array) -> tuple[State, float]:
        moved = base.moved(parameters, values, packed.tau, packed.omega) if len(parameters) else base
        state = State(packed, moved)
        return state, state.energy + float(prior @ values**2)

    state, chi2 = at(x)
    covariance = np.zeros((0, 0))
    for _ in range(_ROUNDS if len(parameters) else 0):
        score, information, _ = system(state, parameters)
        covariance = inverse(information + np.diag(prior))
        step = covariance @ (score - prior * x)
        if not np.all(np.isfinite(step)):  # weights too far apart for floating point
            break
        for part in _STEPS:
            next_state, next_chi2 = at(x + part * step)
            if next_chi2 <= chi2:
                break
        else:
            break
        fall = chi2 - next_chi2
        x, state, chi2 = x + part * step, next_state, next_chi2
        if fall < _SETTLED:
            break
    return Estimate(x, covariance, chi2, state)


def inverse(matrix: Array) -> Array:
    """Return the inverse of a symmetric matrix in scaled variables; pseudo-inverse where it has none."""
    diagonal = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scale = np.outer(diagonal, diagonal)
    scaled = matrix / scale
    try:
        inverted = np.linalg.inv(scaled + 1e-15 * np.eye(len(scaled)))
    except np.linalg.LinAlgError:  # exactly singular: two parameters that do the same
        inverted = np.full_like(scaled, np.inf)
    if not np.all(np.abs(inverted) < 1e9):
        inverted = np.linalg.pinv(scaled, rcond=1e-9, hermitian=True)
    return np.asarray(inverted / scale)
