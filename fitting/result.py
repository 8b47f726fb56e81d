"""The result of a fit: K and D with uncertainty, budget, modes, axes; it prints, draws and writes itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fitting import entries
from fitting.budget import budget_of, known_exactly
from fitting.derived import Derived, derived_of
from fitting.evidence import Alternative
from fitting.kd import Solution
from fitting.laws import Law
from fitting.model import Modes, modes, passive
from fitting.options import KDOptions
from fitting.plane import (
    PISTON_DOF,
    InPlane,
    Posterior,
    coupling_scale,
    heights,
    in_plane,
    posterior,
)
from fitting.solve import Fit, bend, entry_scale
from stapeskit.arrays import Array
from stapeskit.results import Result
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from fitting.montecarlo import Scatter
    from fitting.unknowns import Unknown
    from fitting.verdict import Verdict

_DRAWS = 2000
_CLUSTERS = 5  # parts of the lines whose residuals are taken as alike where no cause explains a misfit
_SMALLEST_WEIGHT = 1e-3  # of an alternative that changes the intervals


@dataclass(frozen=True, repr=False)
class KDFit(Result):
    """Stiffness and damping with everything that is known about them, SI.

    Attributes
    ----------
    options : KDOptions
    solution : Solution
        What was fitted, scaled.
    notices : tuple of Notice
        Every warning.
    provenance : mapping
    outline_mm : ndarray, (points, 2), or None
        x and z of the footplate's outline in footplate axes.
    side : str
        ``left``, ``right`` or empty: names z.
    files : tuple of Path
        Every file that was read; `write` never replaces one.
    scatter : Scatter or None
        Refits of simulated repetitions.
    confirmed : tuple of str
        Codes of warnings that the user has checked.
    """

    options: KDOptions
    solution: Solution
    notices: tuple[Notice, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)
    outline_mm: Array | None = None
    side: str = ""
    files: tuple[Path, ...] = ()
    scatter: Scatter | None = None
    confirmed: tuple[str, ...] = ()

    @property
    def found(self) -> Fit:
        """The minimum of the likelihood."""
        return self.solution.found

    @property
    def dof(self) -> tuple[str, ...]:
        """Degrees of freedom of the model."""
        return self.options.dof

    @property
    def law(self) -> Law:
        """The damping law."""
        return self.found.law

    @cached_property
    def mass(self) -> Array:
        """Mass matrix (n, n)."""
        return self.solution.inertia.block(self.dof)

    @cached_property
    def draws(self) -> Posterior:
        """K and D about the footplate centre as draws of their joint distribution."""
        many = len(self.dof) > len(PISTON_DOF) and self.solution.textbook is None
        bent = bend(self.found) if many and self.found.data.sources else None
        return posterior(self.found, self.solution.plane, _DRAWS, bent=bent)

    @property
    def stiffness(self) -> Array:
        """K (n, n) about the footplate centre."""
        return entries.split(self.draws.estimate, len(self.dof))[0]

    @property
    def damping(self) -> Array:
        """D (n, n)."""
        return entries.split(self.draws.estimate, len(self.dof))[1]

    @property
    def parameters(self) -> tuple[str, ...]:
        """K11, K12, ..., Dnn."""
        return entries.names(len(self.dof))

    @property
    def values(self) -> Array:
        """Entries of K and D in that order."""
        return self.draws.estimate

    @property
    def unknowns(self) -> list[tuple[Unknown, float, float]]:
        """Further estimated unknowns, each with its value and sd in its unit."""
        at, found = self.found.at["extra"], self.found
        sds = np.sqrt(np.diag(found.covariance)[at]).tolist()
        return list(zip(found.likelihood.model.extras, found.theta[at].tolist(), sds, strict=True))

    @cached_property
    def _to_centre(self) -> Array:
        """Derivative (p, t) by theta of K and D about the footplate centre, from the draws."""
        off = self.draws.draws - self.draws.estimate
        return np.asarray(np.linalg.lstsq(self.draws.spread, off, rcond=1e-12)[0].T)

    @cached_property
    def model_error(self) -> Array:
        """Columns E (p, k): by E E^T what the model may lack puts K and D off, averaged over alternatives."""
        columns = [self._to_centre @ self.solution.weak]
        search = self.solution.search
        for weight, other in zip(search.weights, search.alternatives, strict=True):
            if weight > _SMALLEST_WEIGHT:
                columns.append(np.sqrt(weight) * self.effect(other))
        best = search.best
        book = self.solution.textbook is not None
        if not book and not (self.found if best is None else best.found).explained:
            columns.append(self._unexplained())
        return np.concatenate(columns, axis=1)

    def effect(self, other: Alternative) -> Array:
        """Return how K and D would change if an alternative held, as columns (p, k)."""
        tried = other.found
        if tried.covariance.size == 0:  # only Y's is needed of it
            inverse: Array = np.asarray(np.linalg.inv(tried.likelihood.information(tried.theta)))
            tried = replace(tried, covariance=inverse, inverse=inverse)
        plane = in_plane(tried) if tried.likelihood.model.coupling is not None else None
        there = posterior(tried, plane, 4).estimate
        if other.unknown is None:  # D damps as g D of this law, g the ratio of what both lose
            omega = 2.0 * np.pi * tried.data.freq_hz
            ratio = tried.law.factor(omega).imag / self.law.factor(omega).imag
            lossy = np.repeat([0.0, 1.0], len(there) // 2)
            moved = there * np.where(lossy, np.mean(ratio), 1.0) - self.values
            return np.stack([moved, float(np.std(ratio)) * lossy * there], axis=1)
        effect = there - self.values
        columns = [effect, other.sd / max(abs(other.value), 1e-300) * effect]
        if other.unknown.weights is not None:  # K and D change over the lines: 1.96 sd hold their range
            shape = 0.01 * other.value * other.unknown.weights(tried.data)
            columns.append(float(np.std(shape)) * there)
        return np.stack(columns, axis=1)

    def _unexplained(self) -> Array:
        """Return columns of the error where nothing explains the misfit: sandwich over parts of the lines.

        Residuals of neighbouring lines are alike in a misfit; how much the scores of parts of the band differ
        is how far the estimate moves when another part is measured (Liang and Zeger 1986,
        doi:10.1093/biomet/73.1.13).
        """
        found, likelihood = self.found, self.found.likelihood
        rows = 2 * likelihood.n * found.data.count
        jacobian, residual = likelihood.jacobian(found.theta)[:rows], likelihood.residuals(found.theta)[:rows]
        scores = (jacobian * residual[:, None]).reshape(2, found.data.count, likelihood.n, -1).sum(axis=0)
        parts = np.array_split(scores, _CLUSTERS)
        sums = np.concatenate([part.sum(axis=0) for part in parts])
        moved = np.sqrt(len(sums) / (len(sums) - 1.0)) * found.inverse @ sums.T
        return np.asarray(self._to_centre @ moved)

    @cached_property
    def covariance(self) -> Array:
        """Covariance (p, p) of K and D from all sources."""
        off = self.draws.draws - self.draws.estimate
        spread = off.T @ off / len(off) + self.model_error @ self.model_error.T
        if self.solution.textbook is not None:
            bias = self.solution.textbook.bias * entry_scale(self.found)
            spread = spread + np.outer(bias, bias)
        return np.asarray(spread)

    @cached_property
    def noise_covariance(self) -> Array:
        """The same from channel noise alone: what is left where every shared error is known."""
        return self.about_centre(known_exactly(self.found, np.arange(self.found.at["shared"].start)))

    def about_centre(self, covariance: Array) -> Array:
        """Return the covariance of K and D (p, p) for one of theta, or of its first unknowns."""
        size = len(covariance)
        return np.asarray(self._to_centre[:, :size] @ covariance @ self._to_centre[:, :size].T)

    @cached_property
    def budget(self) -> dict[str, Array]:
        """Covariance (p, p) by source."""
        return budget_of(self)

    @property
    def coupling(self) -> Array:
        """Y (3, 3), rows y, alpha, gamma, columns x, z, beta; zeros where the plane is not estimated."""
        at = self.found.at["coupling"]
        if at.stop == at.start:
            return np.zeros((3, 3))
        return np.asarray(self.found.theta[at].reshape(3, 3) * coupling_scale(self.found.data))

    @property
    def coupling_covariance(self) -> Array:
        """Covariance (9, 9) of Y."""
        at, scale = self.found.at["coupling"], coupling_scale(self.found.data).ravel()
        return np.asarray(self.found.covariance[at, at] * np.outer(scale, scale))

    @property
    def height(self) -> tuple[float, float] | None:
        """Height of the plane of the ligament above the footplate centre and its sd, m."""
        return None if self.solution.plane is None else heights(self.coupling, self.coupling_covariance)

    @property
    def plane(self) -> InPlane | None:
        """Stiffness and damping in the plane of the ligament."""
        return self.solution.plane

    @property
    def standard_deviation(self) -> tuple[Array, Array]:
        """Standard deviations of K and of D from all sources."""
        return entries.split(np.sqrt(np.diag(self.covariance)), len(self.dof))

    @property
    def noise_standard_deviation(self) -> tuple[Array, Array]:
        """The same from channel noise alone."""
        return entries.split(np.sqrt(np.maximum(np.diag(self.noise_covariance), 0.0)), len(self.dof))

    @property
    def intervals(self) -> Array:
        """95 % intervals of the parameters, (p, 2)."""
        reach = 1.959964 * np.sqrt(np.diag(self.covariance))
        return np.column_stack([self.values - reach, self.values + reach])

    @cached_property
    def modes(self) -> Modes:
        """Eigenvalues and shapes."""
        return modes(self.mass, self.stiffness, self.damping, self.law)

    @property
    def passive(self) -> tuple[bool, bool]:
        """Whether K and D are positive semidefinite."""
        return passive(self.stiffness), passive(self.damping)

    @cached_property
    def bound(self) -> Array:
        """Smallest sd of an unbiased estimator of this model, (p,): Cramer-Rao, with every prior."""
        information = np.linalg.inv(self.found.inverse)
        if self.solution.textbook is None:
            information = self.found.likelihood.information(self.found.theta) / max(1.0, self.found.level)
        size = np.sqrt(np.maximum(np.diag(information), 1e-300))
        inverse = np.linalg.pinv(information / np.outer(size, size), rcond=1e-13) / np.outer(size, size)
        return np.sqrt(np.maximum(np.diag(self.about_centre(inverse)), 0.0))

    @cached_property
    def combinations(self) -> list[tuple[float, dict[str, float]]]:
        """Combinations of entries by their relative standard deviation, worst first, with their parts."""
        relative = entries.sizes(self.stiffness, self.damping)
        values, vectors = np.linalg.eigh(self.covariance / np.outer(relative, relative))
        found = []
        for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
            order = np.argsort(-np.abs(vector))[:3]
            parts = {self.parameters[at]: float(vector[at]) for at in order if abs(vector[at]) > 0.3}
            found.append((float(np.sqrt(max(value, 0.0))), parts))
        return found

    @cached_property
    def derived(self) -> Derived:
        """Modes and principal axes with their standard deviations."""
        return derived_of(self)

    @cached_property
    def verdict(self) -> Verdict:
        """Believe, check or do not use, with the reasons."""
        from fitting.checks import verdict_of

        return verdict_of(self)

    @property
    def title(self) -> str:
        """What this is."""
        return f"Stiffness and damping for {', '.join(self.dof)}"

    def summary(self) -> Sequence[tuple[str, str]]:
        """Return verdict, K, D, modes and fit with their uncertainty."""
        from fitting.report.summary import summary_rows

        return summary_rows(self)

    def content(self) -> dict[str, Any]:
        """Return the content of kd.json."""
        from fitting.report.kd_json import kd_json

        return kd_json(self)

    def to_frame(self) -> DataFrame:
        """Return one row a parameter: value, standard deviations and 95 % interval, SI."""
        from fitting.exports import entry_table

        return entry_table(self)

    def plot(self) -> Figure:
        """Draw measured and simulated responses of the first run."""
        from fitting.report.figures import response_figure

        return response_figure(self)

    def write_into(
        self, folder: Path, *, name: str = "kd.json", export: Sequence[str] = (), report: bool = True
    ) -> tuple[str, ...]:
        """Write kd.json, kd.mat, kd.csv, exports and, unless left out, kd.html into an empty folder."""
        from fitting.exports import write_into

        return write_into(self, folder, name, export, report)

    def write(
        self, folder: Path | str, *, force: bool = False, name: str = "kd.json", export: Sequence[str] = ()
    ) -> tuple[Path, ...]:
        """Write kd.json, kd.html, kd.mat, kd.csv and exports by name (`fitting.exports.EXPORTS`)."""
        from fitting.exports import file_names
        from stapeskit.outputs import Outputs

        outputs = Outputs("dof2kd", Path(folder), file_names(name, export), self.files, force)
        with outputs.staged() as stage:
            names = self.write_into(stage, name=name, export=export)
        return tuple(Path(folder) / one for one in names)
