"""Motion of both bodies in all six degrees of freedom, without units, with the errors that all lines share.

A shared error z_k of unit variance moves the motion of a body by a linear map, y -> (1 + z_k T_k) y, and the
mass matrix by dM_k. The maps are found once from the recorded derivatives, so that they can be applied to the
fitted motion: at the noisy motion itself they would make an estimate overconfident.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legacy.fitting.estimators.problem import Problem
from legacy.fitting.model.observation import Observation
from legacy.fitting.uncertainty.covariance import joined_mass_sources, motion_moves_mass
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.spatial import matrix_from_parameters

# Degrees of freedom of a rigid body.
DOFS = 6
# Eigenvalues of a correlation matrix below this are combinations without an error.
_NO_ERROR = 1e-9
# What a map leaves over of a recorded derivative is noise of the readings, unless neighbouring lines agree
# in it: least correlation of neighbours, and least share of the derivative.
_NEIGHBOURS_AGREE, _LEAST_REST = 0.5, 0.02
# A change grows with frequency when that leaves less than this share of the variance: noise of the readings
# leaves all of it, a delay less than a hundredth (benchmarks/quiet_plane.py, 14 to 120 lines).
_EXPLAINED = 0.25
# Share of a change that is rounding: derivatives are recorded as central differences, exact to 1e-9 or so.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class JointLines:
    """Scaled lines of both bodies.

    Attributes
    ----------
    omega : ndarray, (lines,)
        Angular frequency over that of the scale.
    y : ndarray, (lines, 12), complex
        Structure, then base.
    covariance : ndarray, (lines, 12, 12), complex
        Before the factors.
    mass : ndarray, (6, 6)
        Ones on its diagonal.
    root_mass : ndarray, (6,)
        Scaled motion is sqrt(M_ii) q_i over the amplitude.
    maps : ndarray, (2, 6, 6, k), complex
        T_k of structure and base: [body, to, from, error].
    rests : ndarray, (lines, 12, k), complex, or None
        The rest of a recorded derivative that is no linear map of the motion.
    mass_changes : ndarray, (k, 6, 6)
    sources : tuple of str, (k,)
        Name in the budget.
    mass_slopes : ndarray, (k, 6, 6)
        The changes of the mass matrix in SI.
    factors : ndarray, (lines, 12), complex, or None
        What the motion as measured was multiplied by, e.g. for a delay; y has them in it.
    run_starts : tuple of int
        Lines at which another run begins.
    """

    omega: Array
    y: ComplexArray
    covariance: ComplexArray
    mass: Array
    root_mass: Array
    maps: ComplexArray
    rests: ComplexArray | None
    mass_changes: Array
    sources: tuple[str, ...]
    mass_slopes: Array
    factors: ComplexArray | None = None
    run_starts: tuple[int, ...] = ()

    @property
    def count(self) -> int:
        """Number of lines."""
        return len(self.omega)

    @property
    def errors(self) -> int:
        """Number of shared errors k."""
        return len(self.sources)

    @property
    def noise(self) -> ComplexArray:
        """Covariance of y, (lines, 12, 12)."""
        if self.factors is None:
            return self.covariance
        return np.asarray(self.covariance * (self.factors[:, :, None] * self.factors.conj()[:, None, :]))

    def without_errors(self) -> JointLines:
        """Return the lines with the shared errors left out."""
        return replace(
            self,
            maps=self.maps[..., :0],
            rests=None,
            mass_changes=self.mass_changes[:0],
            sources=(),
            mass_slopes=self.mass_slopes[:0],
        )

    def with_nuisances(self, sources: tuple[str, ...]) -> JointLines:
        """Return the lines with further shared errors, which change nothing until a term sets their effect.

        Sources that the lines have already are left as they are.
        """
        new = tuple(name for name in sources if name not in self.sources)
        if not new:
            return self
        still, rests = np.zeros((len(new), DOFS, DOFS)), None
        if self.rests is not None:
            rests = np.concatenate([self.rests, np.zeros((self.count, 2 * DOFS, len(new)))], axis=2)
        return replace(
            self,
            maps=np.concatenate([self.maps, np.zeros((2, DOFS, DOFS, len(new)))], axis=3),
            rests=rests,
            mass_changes=np.concatenate([self.mass_changes, still]),
            sources=(*self.sources, *new),
            mass_slopes=np.concatenate([self.mass_slopes, still]),
        )

    def corrected(self, errors: Array) -> JointLines:
        """Return the lines with shared errors (k,) removed from motion and mass, and none left unknown."""
        turn = np.zeros((2 * DOFS, 2 * DOFS), dtype=complex)
        for body in range(2):
            place = slice(body * DOFS, (body + 1) * DOFS)
            turn[place, place] = np.eye(DOFS) + self.maps[body] @ errors
        y = self.y @ turn.T if self.rests is None else self.y @ turn.T + self.rests @ errors
        mass = self.mass + np.tensordot(errors, self.mass_changes, 1)
        changed = replace(self, y=y, covariance=turn @ self.noise @ turn.conj().T, mass=mass, factors=None)
        return changed.without_errors()

    def multiplied(self, factors: ComplexArray) -> JointLines:
        """Return the lines with the motion multiplied by factors (lines, 12)."""
        before = factors if self.factors is None else self.factors * factors
        return replace(self, y=self.y * factors, factors=before)


def joint_lines(problem: Problem, both: Observation) -> JointLines:
    """Scale the motion of both bodies and gather the shared errors of motion and mass.

    Parameters
    ----------
    problem : Problem
        Scale, law and inertia.
    both : Observation
        All six degrees of freedom of structure and base.
    """
    scale = problem.scale
    root = np.sqrt(np.diag(problem.inertia.matrix))
    unit = np.tile(root, 2) / scale.amplitude
    y = both.q * unit
    covariance = both.covariance * np.outer(unit, unit)
    changes, slopes, sources = _shared_changes(problem, both)
    omega = 2.0 * np.pi * both.freq_hz / scale.omega
    maps, rests = _maps(y, omega, changes * unit)
    scaled = slopes / np.outer(root, root)
    mass = problem.inertia.matrix / np.outer(root, root)
    starts = tuple((np.flatnonzero(np.diff(both.run)) + 1).tolist())
    return JointLines(
        omega, y, covariance, mass, root, maps, rests, scaled, sources, slopes, run_starts=starts
    )


def _shared_changes(problem: Problem, both: Observation) -> tuple[ComplexArray, Array, tuple[str, ...]]:
    """Return changes of q (k, lines, 12) and M (k, 6, 6) by errors of unit variance, with their sources."""
    changes, slopes, sources = [], [], []
    covariance, derivatives = both.shared_covariance, both.shared_derivatives
    joined = problem.with_observation(both)
    if covariance is not None and derivatives is not None:
        along = motion_moves_mass(joined)
        columns, names = _unit_errors(covariance, both.shared_names)
        changes.append(np.tensordot(columns, derivatives, 1))
        slopes += [matrix_from_parameters(change) for change in columns @ along.T]
        sources += names
    if problem.inertia.parameters is not None:
        for source, part in joined_mass_sources(joined).items():
            columns, _ = _unit_errors(part, (source,) * len(part))
            changes.append(np.zeros((len(columns), *both.q.shape), dtype=complex))
            slopes += [matrix_from_parameters(column) for column in columns]
            sources += [f"mass.{source}"] * len(columns)
    if not sources:
        return np.zeros((0, *both.q.shape), dtype=complex), np.zeros((0, DOFS, DOFS)), ()
    return np.concatenate(changes), np.array(slopes), tuple(sources)


def _unit_errors(covariance: Array, names: tuple[str, ...]) -> tuple[Array, list[str]]:
    """Return rows of a root of a covariance, block by block of correlated parameters, with sources."""
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(size > 0.0, size, 1.0)
    correlation = covariance / np.outer(safe, safe)
    related = [np.flatnonzero(row > _NO_ERROR).tolist() for row in np.abs(correlation)]
    remaining = dict.fromkeys(np.flatnonzero(size > 0.0).tolist())
    rows, sources = [np.zeros((0, len(size)))], []
    while remaining:
        block, waiting = [], [next(iter(remaining))]
        while waiting:
            place = waiting.pop()
            if place in remaining:
                del remaining[place]
                block.append(place)
                waiting += related[place]
        block.sort()
        values, vectors = np.linalg.eigh(correlation[np.ix_(block, block)])
        for value, vector in zip(values, vectors.T, strict=True):
            if value > _NO_ERROR:
                column = np.zeros(len(size))
                column[block] = size[block] * vector * np.sqrt(value)
                leading = block[int(np.argmax(np.abs(vector)))]
                rows.append(column[None])
                sources.append(names[leading].partition(".")[0])
    return np.concatenate(rows), sources


def _maps(y: ComplexArray, omega: Array, changes: ComplexArray) -> tuple[ComplexArray, ComplexArray | None]:
    """Return the linear maps that make the changes (k, lines, 12) of y, and the rests of others.

    Notes
    -----
    Most changes are constant maps of the motion, and what is left over is noise of the readings. Others, as
    of a delay, grow with frequency: they are fitted by a constant map and by one times the frequency at once,
    and what the constant one leaves over is their rest. With the constant map alone it would be laid on
    columns of the motion that are nothing but noise.
    """
    count, lines = len(changes), len(y)
    if not count:
        return np.zeros((2, DOFS, DOFS, count), dtype=complex), None
    whole = np.moveaxis(changes, 0, 2)
    constant = _fitted_maps(y, y[:, :, None], whole)
    maps, rests = constant.maps, constant.rests
    alike = np.sum((rests[1:].conj() * rests[:-1]).real, axis=(0, 1))
    size = np.sum(np.abs(whole) ** 2, axis=(0, 1))
    odd = alike > _NEIGHBOURS_AGREE * constant.unexplained
    odd &= constant.unexplained > _LEAST_REST**2 * size
    if lines > 2 * DOFS:
        columns = np.stack([y, y * (omega - np.mean(omega))[:, None]], axis=2)
        growing = _fitted_maps(y, columns, whole)
        freed = (lines - 2 * DOFS) / (lines - DOFS)
        grows = growing.unexplained < _EXPLAINED * freed * constant.unexplained
        grows &= constant.unexplained > _ROUNDING**2 * size
        maps, rests = np.where(grows, growing.maps, maps), np.where(grows, growing.rests, rests)
        odd |= grows
    return maps, np.where(odd, rests, 0.0) if np.any(odd) else None


@dataclass(frozen=True)
class _FittedMaps:
    """Maps (2, 6, 6, k) of the motion, what they leave (lines, 12, k), and what all columns leave (k,)."""

    maps: ComplexArray
    rests: ComplexArray
    unexplained: Array


def _fitted_maps(y: ComplexArray, columns: ComplexArray, changes: ComplexArray) -> _FittedMaps:
    """Fit changes (lines, 12, k) by columns (lines, 12, c) of each body, the first of which are y."""
    count = changes.shape[2]
    maps, rests = np.zeros((2, DOFS, DOFS, count), dtype=complex), changes.copy()
    unexplained = np.zeros(count)
    for body, place in enumerate((slice(0, DOFS), slice(DOFS, 2 * DOFS))):
        flat = columns[:, place].transpose(0, 2, 1).reshape(len(y), -1)
        size = np.sqrt(np.mean(np.abs(flat) ** 2, axis=0))
        size = np.where(size > 0.0, size, 1.0)
        wanted = changes[:, place].reshape(len(y), -1)
        turned = np.linalg.lstsq(flat / size, wanted, rcond=1e-11)[0] / size[:, None]
        left = np.abs(wanted - flat @ turned) ** 2
        unexplained += left.reshape(-1, count).sum(axis=0)
        rests[:, place] -= (y[:, place] @ turned[:DOFS]).reshape(len(y), DOFS, count)
        maps[body] = turned[:DOFS].reshape(DOFS, DOFS, count).transpose(1, 0, 2)
    return _FittedMaps(maps, rests, unexplained)
