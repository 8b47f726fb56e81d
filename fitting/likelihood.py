"""One likelihood of everything that a fit of K and D leaves open.

Per line the equations are B(theta) y = 0, y the motion of both bodies with the covariance C. Minimised is 2
sum e^H (B C B^H)^-1 e + priors with e = B y: errors in all variables. Only `Likelihood.act`, B times a
motion, is written down; derivatives are differences of it (for K, D and shared errors, in which B is linear,
its own terms), taken at the fitted motion yhat = y - C B^H (B C B^H)^-1 e, where J^T r is the exact
gradient (Pintelon and Schoukens 2012, System Identification, ch. 9).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from fitting.data import Data
from fitting.entries import basis, split
from fitting.laws import LAWS
from fitting.unknowns import Parts, Unknown
from stapeskit.arrays import Array, ComplexArray

PLAIN, LOAD, PLANE, INPLANE = "plain", "load", "plane", "inplane"
"""Motion outside the model: left out; a known load; with the plane of the ligament; and its own equations."""

_STEP = 1e-5  # of central differences: B is linear or quadratic in most unknowns, all of order one
_AT_ONCE = 2  # columns of noise whose derivatives are held at once
_CHANCE = 4.0  # standard deviations by which chi2 is smaller where data hold less noise than stated
_LEAST_INFORMATION = 0.05  # kept of directions that are nearly all noise of the regressor


@dataclass(frozen=True)
class Prior:
    """A normal distribution of parameters: mean (p,) and covariance (p, p)."""

    mean: Array
    covariance: Array

    @property
    def root(self) -> Array:
        """R with R^T R the inverse covariance."""
        size = np.sqrt(np.diag(self.covariance))
        values, vectors = np.linalg.eigh(self.covariance / np.outer(size, size))
        values = np.maximum(values, 1e-12 * values[-1])
        return np.asarray((vectors / np.sqrt(values)).T / size)


@dataclass(frozen=True)
class Model:
    """What is fitted."""

    law: str = "viscous"  # damping law
    motion: str = PLAIN  # one of PLAIN, LOAD, PLANE, INPLANE
    coupling: Prior | None = None  # of Y (9,), scaled, rows times columns; with PLANE and INPLANE
    unknowns: tuple[Unknown, ...] = ()  # further ones; the companions of each follow it
    entries: Prior | None = None  # of the entries of K and D, scaled
    # places of parameters, values and sd to which they are held
    held: tuple[tuple[int, float, float], ...] = ()
    law_value: float | None = None  # scaled unknown of the law where it is fixed

    @property
    def extras(self) -> tuple[Unknown, ...]:
        """The further unknowns with their companions."""
        return tuple(part for unknown in self.unknowns for part in (unknown, *unknown.companions))


class Likelihood:
    """Residuals and derivatives of one model on one data set.

    Parameters are ordered K and D (of the rows), the law's, Y, further unknowns, shared errors. ``noise`` is
    its variance over that stated, ``weights`` (lines,) are on the precision of each line.
    """

    def __init__(self, data: Data, model: Model, noise: float = 1.0, weights: Array | None = None):
        self.data, self.model, self.noise, self.weights = data, model, noise, weights
        rows, columns = data.rows, data.columns
        if model.motion == INPLANE:
            rows, columns = columns, rows
        self.n, m = len(rows), len(data.measured)
        self.row_units, self.column_units = np.eye(m)[rows], np.eye(m)[columns]
        kind = LAWS[model.law]
        counts = {
            "entries": self.n * (self.n + 1),
            "law": int(kind.usual_sd > 0.0),
            "coupling": len(rows) * len(columns) if model.coupling is not None else 0,
            "extra": len(model.extras),
            "shared": len(data.sources),
        }
        ends = np.cumsum([0, *counts.values()])
        spans = zip(counts, ends[:-1], ends[1:], strict=True)
        self.at = {name: slice(int(first), int(last)) for name, first, last in spans}
        self.count = int(ends[-1])
        self._set_priors(kind.usual, kind.usual_sd)
        self._cost = np.inf
        self._known: tuple[Array, tuple[ComplexArray, ...]] | None = None

    def _set_priors(self, usual: float, usual_sd: float) -> None:
        """Set mean and root of the prior: rows of the root are those of a least-squares problem."""
        model, at = self.model, self.at
        self.mean = np.zeros(self.count)
        blocks = [np.zeros((0, at["entries"].stop))]
        if model.entries is not None:
            self.mean[at["entries"]], blocks = model.entries.mean, [model.entries.root]
        if usual_sd:
            self.mean[at["law"]] = usual if model.law_value is None else model.law_value
            blocks.append(np.array([[1.0 / usual_sd if model.law_value is None else 1e6]]))
        if model.coupling is not None:
            self.mean[at["coupling"]] = model.coupling.mean
            blocks.append(model.coupling.root)
        blocks.append(np.diag([1.0 / unknown.sd for unknown in model.extras]))
        blocks.append(np.eye(len(self.data.sources)))
        self.root = block_diag(*blocks)
        self.offset = self.root @ self.mean
        for place, value, sd in model.held:
            row = np.eye(self.count)[place] / sd
            self.root, self.offset = np.vstack([self.root, row]), np.append(self.offset, value / sd)

    def parts(self, theta: Array) -> Parts:
        """Return the parts of the equations at theta."""
        data, ones = self.data, np.ones(self.data.count)
        changes = np.tensordot(theta[self.at["shared"]], data.mass_changes, 1)
        loss = LAWS[self.model.law].factor(data.omega, *theta[self.at["law"]])
        still = np.zeros((self.n, self.n))
        parts = Parts(loss, data.mass + changes, still, ones, ones.astype(complex), ones.astype(complex))
        for value, unknown in zip(theta[self.at["extra"]], self.model.extras, strict=True):
            unknown.change(value, parts, data)
        return parts

    def shapes(self, theta: Array) -> tuple[Array, Array]:
        """Return what deflects the suspension (n, m) and what loads its rows (n, m).

        With Z_rc = Y Z_cc the motion of the columns is eliminated: Z' (q_s - q_b)_r = w2 (M_r - Y M_c) q_s
        with Z' = Z_rr - Y Z_cc Y^T; in the plane, Z_cc (q_c + Y^T q_r) = w2 M_c q.
        """
        if self.model.coupling is None:
            return self.row_units, self.row_units
        coupling = theta[self.at["coupling"]]
        if self.model.motion == INPLANE:
            turned = coupling.reshape(len(self.column_units), self.n)
            return self.row_units + turned.T @ self.column_units, self.row_units
        turned = coupling.reshape(self.n, len(self.column_units))
        return self.row_units, self.row_units - turned @ self.column_units

    def act(self, theta: Array, motion: ComplexArray, parts: Parts | None = None) -> ComplexArray:
        """Return B(theta) times motions (lines or 1, 2 m, c): the whole physics, (lines, n, c)."""
        data, parts = self.data, self.parts(theta) if parts is None else parts
        structure, base = self._moved(theta, motion, parts)
        deflecting, loading = self.shapes(theta)
        load = loading @ self._seen_mass(parts.mass)
        elastic = self._dynamic(theta, parts) @ (deflecting @ (structure - base))
        return np.asarray(elastic - (data.omega**2)[:, None, None] * (load @ structure))

    def _moved(self, theta: Array, motion: ComplexArray, parts: Parts) -> tuple[ComplexArray, ComplexArray]:
        """Return the motion of structure and base (lines, m, c) with the shared errors and factors."""
        turn, m = self.data.turns(theta[self.at["shared"]]), len(self.data.measured)
        structure = parts.structure[:, None, None] * (turn[:, 0] @ motion[:, :m])
        return structure, parts.base[:, None, None] * (turn[:, 1] @ motion[:, m:])

    def _dynamic(self, theta: Array, parts: Parts) -> ComplexArray:
        """Return the dynamic stiffness (lines, n, n)."""
        stiffness, damping = split(theta[self.at["entries"]], self.n)
        dynamic = parts.factor[:, None, None] * (stiffness + parts.loss[:, None, None] * damping)
        return np.asarray(dynamic - (self.data.omega**2)[:, None, None] * parts.added)

    def _seen_mass(self, mass: Array) -> Array:
        """Return the mass matrix; without a load that of the rows alone."""
        if self.model.motion != PLAIN:
            return mass
        own = self.row_units.T @ self.row_units
        return np.asarray(own @ mass @ own)

    def response(self, theta: Array) -> tuple[ComplexArray, ComplexArray]:
        """Return the motion (lines, n) of the rows that solves the equations, and its slopes by K and D.

        It is simulated for the measured base motion and the load of other measured motion (paper, Eq. 8);
        slopes are (lines, n, p).
        """
        rows, y = self.data.rows, self.data.y.copy()
        operator = self.act(theta, np.eye(y.shape[1], dtype=complex)[None])
        system = operator[:, :, rows]
        y[:, rows] -= np.linalg.solve(system, operator @ y[:, :, None])[:, :, 0]
        pull = self.entry_slopes(theta, y[:, :, None])[..., 0].transpose(1, 2, 0)
        return y[:, rows], np.asarray(-np.linalg.solve(system, pull))

    def look(self, theta: Array) -> tuple[ComplexArray, ...]:
        """Return white residuals (lines, n), what whitens, C B^H W^H, fitted motion; the last is kept."""
        if self._known is not None and np.array_equal(self._known[0], theta):
            return self._known[1]
        data = self.data
        operator = self.act(theta, np.eye(data.y.shape[1], dtype=complex)[None])
        gain = self.noise * data.covariance @ operator.conj().swapaxes(1, 2)
        if self.weights is not None:
            gain = gain / self.weights[:, None, None]
        whitening = np.linalg.inv(np.linalg.cholesky(operator @ gain))
        white = (whitening @ (operator @ data.y[:, :, None]))[:, :, 0]
        back = gain @ whitening.conj().swapaxes(1, 2)
        fitted = data.y - (back @ white[:, :, None])[:, :, 0]
        looked: tuple[ComplexArray, ...] = tuple(map(np.asarray, (white, whitening, back, fitted)))
        self._known = (theta.copy(), looked)
        return looked

    def residuals(self, theta: Array) -> Array:
        """Return the rows of the least-squares problem: their squares sum to chi2 with priors."""
        return np.concatenate([_real_rows(self.look(theta)[0]), self.root @ theta - self.offset])

    def entry_slopes(self, theta: Array, motion: ComplexArray) -> ComplexArray:
        """Return dB/d(K, D) times motions (lines, 2 m, c), (p, lines, n, c)."""
        parts = self.parts(theta)
        structure, base = self._moved(theta, motion, parts)
        deflection = self.shapes(theta)[0] @ (structure - base)
        elastic = (parts.factor[:, None, None] * basis(self.n)[:, None]) @ deflection
        return np.concatenate([elastic, parts.loss[:, None, None] * elastic])

    def slopes(self, theta: Array, motion: ComplexArray) -> ComplexArray:
        """Return dB/dtheta times motions (lines, 2 m, c), (p, lines, n, c)."""
        parts = self.parts(theta)
        columns, here = [self.entry_slopes(theta, motion)], self.act(theta, motion, parts)
        for place in range(self.at["law"].start, self.at["shared"].start):
            unit = np.eye(self.count)[place]
            if self.at["coupling"].start <= place < self.at["coupling"].stop:  # B is affine in Y
                slope = self.act(theta + unit, motion, parts) - here
            else:
                ends = [self.act(theta + step * unit, motion) for step in (_STEP, -_STEP)]
                slope = (ends[0] - ends[1]) / (2.0 * _STEP)
            columns.append(slope[None])
        if self.data.sources:
            columns.append(self._shared_slopes(theta, motion))
        return np.concatenate(columns)

    def _shared_slopes(self, theta: Array, motion: ComplexArray) -> ComplexArray:
        """Return the columns of the shared errors, in which B is linear: they move motion and mass."""
        data, m, width = self.data, len(self.data.measured), motion.shape[2]
        parts = self.parts(theta)
        structure, _ = self._moved(theta, motion, parts)
        deflecting, loading = self.shapes(theta)
        square = (data.omega**2)[:, None, None]
        elastic = self._dynamic(theta, parts) @ deflecting
        bare = (elastic - square * (loading @ self._seen_mass(parts.mass)), -elastic)
        columns = np.zeros((len(data.sources), data.count, self.n, width), dtype=complex)
        for maps in data.maps:
            lines = data.lines_of(maps.run)
            power = data.powers(maps.power)[lines, None, None]
            for body, factor in ((0, parts.structure), (1, parts.base)):
                used = np.flatnonzero(np.any(maps.values[body], axis=(0, 1)))
                flat = motion[lines, body * m : (body + 1) * m].transpose(1, 0, 2).reshape(m, -1)
                turned = maps.values[body][..., used].transpose(0, 2, 1).reshape(-1, m) @ flat
                turned = turned.reshape(m, len(used), len(lines), width).transpose(2, 0, 1, 3)
                acting = bare[body][lines] * (factor[lines, None, None] * power)
                moved = (acting @ turned.reshape(len(lines), m, -1)).reshape(len(lines), self.n, -1, width)
                columns[np.ix_(maps.errors[used], lines)] += moved.transpose(2, 0, 1, 3)
        heavy = np.flatnonzero(np.any(data.mass_changes, axis=(1, 2)))
        changes = np.array([loading @ self._seen_mass(data.mass_changes[error]) for error in heavy])
        if len(heavy):
            columns[heavy] -= square * (changes[:, None] @ structure)
        return columns

    def white(self, theta: Array, columns: ComplexArray) -> Array:
        """Return columns of the equations (k, lines, n, 1) as rows of the least-squares problem, (r, k)."""
        return _real_rows((self.look(theta)[1] @ columns)[..., 0]).T

    def outside(self, theta: Array, unknowns: Sequence[Unknown]) -> tuple[Array, Array]:
        """Return the columns (r, u) of unknowns that are not in the model, and what it cannot absorb of them.

        They are those of dB/dvalue at zero and at the fitted motion.
        """
        fitted, parts, columns = self.look(theta)[3][:, :, None], self.parts(theta), []
        for unknown in unknowns:
            ends = []
            for step in (_STEP, -_STEP):
                changed = replace(parts)
                unknown.change(step, changed, self.data)
                ends.append(self.act(theta, fitted, changed))
            columns.append((ends[0] - ends[1]) / (2.0 * _STEP))
        white = self.white(theta, np.array(columns))
        new = np.concatenate([white, np.zeros((len(self.root), len(unknowns)))])
        basis = np.linalg.qr(self.jacobian(theta))[0]
        return new, new - basis @ (basis.T @ new)

    def jacobian(self, theta: Array) -> Array:
        """Return the derivative of the rows by theta; J^T r is the exact gradient."""
        fitted = self.look(theta)[3][:, :, None]
        return np.concatenate([self.white(theta, self.slopes(theta, fitted)), self.root])

    def reduced(self, theta: Array) -> tuple[Array, Array]:
        """Return the QR form of the least-squares problem: residuals (p + 1,) and Jacobian (p + 1, p).

        Value, gradient and Gauss-Newton matrix are those of the whole problem; what follows takes no time.
        """
        whole = np.column_stack([self.jacobian(theta), self.residuals(theta)])
        triangle: Array = np.asarray(np.linalg.qr(whole, mode="r"))
        return triangle[:, -1], triangle[:, :-1]

    def information(self, theta: Array) -> Array:
        """Return J^T J, priors included."""
        jacobian = self.jacobian(theta)
        return np.asarray(jacobian.T @ jacobian)

    def covariance(self, theta: Array, level: float = 1.0) -> tuple[Array, Array]:
        """Return the covariance of theta and the inverse of what it is known by.

        What the noise of the fitted motion adds to J^T J is spread, but no information (Pintelon and
        Schoukens 2012, section 9.11); of directions that are nearly all noise a twentieth of the information
        is kept. Data with less noise than stated, to none in a plan, have added a share ``level`` of it; what
        they lack is spread as well.
        """
        _, whitening, back, _ = self.look(theta)
        hessian = self.information(theta)
        added = np.zeros_like(hessian)
        noise = self.noise * self.data.covariance
        if self.weights is not None:
            noise = noise / self.weights[:, None, None]
        values, vectors = np.linalg.eigh(noise - back @ back.conj().swapaxes(1, 2))
        root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        for first in range(0, root.shape[2], _AT_ONCE):
            part = whitening @ self.slopes(theta, root[:, :, first : first + _AT_ONCE])
            spread = part.reshape(self.count, -1)
            added += 2.0 * (spread.conj() @ spread.T).real
        level = min(level, 1.0)
        size = np.sqrt(np.diag(hessian))
        values, vectors = np.linalg.eigh(hessian / np.outer(size, size))
        values = np.maximum(values, 1e-14 * values[-1])
        half = (vectors / np.sqrt(values)) @ vectors.T / size[None, :]
        shares, turned = np.linalg.eigh(np.eye(len(size)) - level * half @ added @ half.T)
        inverse = half.T @ (turned / np.maximum(shares, _LEAST_INFORMATION)) @ turned.T @ half
        by_chance = _CHANCE * np.sqrt(1.0 / (self.n * self.count))  # of chi2 over 2 n lines
        lacking = 1.0 - level if 1.0 - level > by_chance else 0.0
        return inverse @ (hessian + lacking * added) @ inverse, inverse


def _real_rows(white: ComplexArray) -> Array:
    """Return white residuals (..., lines, n) as real rows (..., 2 lines n) of unit variance."""
    flat = np.sqrt(2.0) * white.reshape(*white.shape[:-2], -1)
    return np.concatenate([flat.real, flat.imag], axis=-1)
