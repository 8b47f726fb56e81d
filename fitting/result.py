"""The result of a fit: K and D with uncertainty, budget, modes, axes; it prints, draws and writes itself."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fitting import entries
from fitting.bands import BandFactors
from fitting.evidence import Search
from fitting.laws import DampingLaw
from fitting.mass import Inertia
from fitting.model import Modes, modes, passive
from fitting.options import KDOptions
from fitting.plane import PISTON_DOF, InPlane, Posterior, coupling_scale, heights, posterior
from fitting.solve import Fit, bend, entry_scale
from fitting.uncertainty import Derived, budget_of, derived_of, effect_of, known_exactly, unexplained
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
_SMALLEST_WEIGHT = 1e-3  # of an alternative that changes the intervals


@dataclass(frozen=True, repr=False)
class KDFit(Result):
    """Stiffness and damping with everything that is known about them, SI."""

    options: KDOptions
    inertia: Inertia
    found: Fit  # what was fitted, without units
    search: Search = field(default_factory=Search)  # further unknowns that the data call for
    laws: Mapping[str, Fit] = field(default_factory=dict)  # damping laws that were compared
    laws_alike: tuple[str, ...] = ()  # those that the data cannot distinguish from the chosen one
    active: tuple[str, ...] = ()  # what holds the estimate back: constraints, or the limit of K, D >= 0
    plane: InPlane | None = None  # stiffness in the plane of the ligament, where that was estimated
    weak: Array | None = None  # (t, k): columns of the error of weak entries
    bands: BandFactors | None = None  # local stiffness and damping over those of the whole band
    # (p,): what noise of the regressor does to K and D, without units; none for maximum likelihood
    bias: Array | None = None
    notices: tuple[Notice, ...] = ()  # every warning
    provenance: Mapping[str, Any] = field(default_factory=dict)
    scatter: Scatter | None = None  # refits of simulated repetitions
    confirmed: tuple[str, ...] = ()  # codes of warnings that the user has checked

    @property
    def dof(self) -> tuple[str, ...]:
        """Degrees of freedom of the model."""
        return self.options.dof

    @property
    def law(self) -> DampingLaw:
        """The damping law."""
        return self.found.law

    @cached_property
    def mass(self) -> Array:
        """Mass matrix (n, n)."""
        return self.inertia.block(self.dof)

    @cached_property
    def draws(self) -> Posterior:
        """K and D about the footplate centre as draws of their joint distribution."""
        many = len(self.dof) > len(PISTON_DOF) and self.bias is None
        bent = bend(self.found) if many and self.found.data.sources else None
        return posterior(self.found, self.plane, _DRAWS, bent=bent)

    @property
    def stiffness(self) -> Array:
        """K (n, n) about the footplate centre."""
        return entries.split(self.values, len(self.dof))[0]

    @property
    def damping(self) -> Array:
        """D (n, n)."""
        return entries.split(self.values, len(self.dof))[1]

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
        every = zip(found.likelihood.model.extras, found.theta[at].tolist(), sds, strict=True)
        return [(one, value + (one.held or 0.0), sd) for one, value, sd in every]

    @cached_property
    def _to_centre(self) -> Array:
        """Derivative (p, t) by theta of K and D about the footplate centre, from the draws."""
        off = self.draws.draws - self.draws.estimate
        return np.asarray(np.linalg.lstsq(self.draws.spread, off, rcond=1e-12)[0].T)

    def about_centre(self, covariance: Array) -> Array:
        """Return the covariance of K and D (p, p) for one of theta, or of its first unknowns."""
        slopes = self._to_centre[:, : len(covariance)]
        return np.asarray(slopes @ covariance @ slopes.T)

    @cached_property
    def model_error(self) -> Array:
        """Columns E (p, k): by E E^T what the model may lack puts K and D off, averaged over alternatives."""
        columns = [np.zeros((len(self.values), 0))]
        if self.weak is not None:
            columns.append(self._to_centre @ self.weak)
        for weight, other in zip(self.search.weights, self.search.alternatives, strict=True):
            if weight > _SMALLEST_WEIGHT:
                columns.append(np.sqrt(weight) * effect_of(self, other))
        best = self.search.best
        if self.bias is None and not (self.found if best is None else best.found).explained:
            columns.append(self._to_centre @ unexplained(self.found))
        return np.concatenate(columns, axis=1)

    @cached_property
    def covariance(self) -> Array:
        """Covariance (p, p) of K and D from all sources."""
        off = self.draws.draws - self.draws.estimate
        spread = off.T @ off / len(off) + self.model_error @ self.model_error.T
        if self.bias is not None:
            bias = self.bias * entry_scale(self.found)
            spread = spread + np.outer(bias, bias)
        return np.asarray(spread)

    @cached_property
    def noise_covariance(self) -> Array:
        """The same from channel noise alone: what is left where every shared error is known."""
        return self.about_centre(known_exactly(self.found, np.arange(self.found.at["shared"].start)))

    @cached_property
    def budget(self) -> dict[str, Array]:
        """Covariance (p, p) by source."""
        return budget_of(self)

    @property
    def coupling(self) -> Array:
        """Y (3, 3), rows y, alpha, gamma, columns x, z, beta, where the plane is estimated."""
        return self.found.theta[self.found.at["coupling"]].reshape(3, 3) * coupling_scale(self.found.data)

    @property
    def coupling_covariance(self) -> Array:
        """Covariance (9, 9) of Y."""
        at, scale = self.found.at["coupling"], coupling_scale(self.found.data).ravel()
        return np.asarray(self.found.covariance[at, at] * np.outer(scale, scale))

    @property
    def height(self) -> tuple[float, float] | None:
        """Height of the plane of the ligament above the footplate centre and its sd, m."""
        return None if self.plane is None else heights(self.coupling, self.coupling_covariance)

    @property
    def sd(self) -> Array:
        """Standard deviations of the parameters from all sources, (p,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def relative_sd(self) -> Array:
        """Standard deviations over sqrt(Xii Xjj), (p,), with which entries of different units compare."""
        return self.sd / entries.sizes(self.stiffness, self.damping)

    @property
    def noise_sd(self) -> Array:
        """The same from channel noise alone."""
        return np.sqrt(np.maximum(np.diag(self.noise_covariance), 0.0))

    @property
    def standard_deviation(self) -> tuple[Array, Array]:
        """Standard deviations of K and of D from all sources, (n, n)."""
        return entries.split(self.sd, len(self.dof))

    @property
    def intervals(self) -> Array:
        """95 % intervals of the parameters, (p, 2)."""
        return self.values[:, None] + np.outer(self.sd, [-1.959964, 1.959964])

    @cached_property
    def modes(self) -> Modes:
        """Eigenvalues and shapes."""
        return modes(self.mass, self.stiffness, self.damping, self.law)

    @cached_property
    def derived(self) -> Derived:
        """Standard deviations of the modes, and principal axes."""
        return derived_of(self)

    @property
    def passive(self) -> tuple[bool, bool]:
        """Whether K and D are positive semidefinite."""
        return passive(self.stiffness), passive(self.damping)

    @cached_property
    def bound(self) -> Array:
        """Smallest sd of an unbiased estimator of this model, (p,): Cramer-Rao, with every prior."""
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
        """Return one row a parameter: value, standard deviations, 95 % interval and unit, SI."""
        from pandas import DataFrame

        from fitting.exports import entry_columns

        return DataFrame(entry_columns(self))

    def plot(self) -> Figure:
        """Draw measured and simulated responses of the first run."""
        from fitting.report.figures import response_figure

        return response_figure(self)

    def write_into(
        self, folder: Path, *, name: str = "kd.json", export: Sequence[str] = (), report: bool = True
    ) -> tuple[str, ...]:
        """Write kd.json, kd.mat, kd.csv, exports and, unless left out, kd.html into an empty folder."""
        from fitting.exports import EXPORTS, csv_of, entry_columns, file_names, matlab

        names, stem = file_names(name, export), Path(name).stem
        texts = {f"{stem}{ending}": make(self) for one in export for ending, make in EXPORTS[one].items()}
        texts[name] = json.dumps(self.content(), indent=1) + "\n"
        texts[f"{stem}.csv"] = csv_of(entry_columns(self))
        if report:
            from fitting.report.page import kd_page

            kd_page(self).write(folder / f"{stem}.html")
        (folder / f"{stem}.mat").write_bytes(matlab(self))
        for file, text in texts.items():
            (folder / file).write_text(text, encoding="utf-8")
        return tuple(one for one in names if report or not one.endswith(".html"))

    def write(
        self, folder: Path | str, *, force: bool = False, name: str = "kd.json", export: Sequence[str] = ()
    ) -> tuple[Path, ...]:
        """Write kd.json, kd.html, kd.mat, kd.csv and exports by name (`fitting.exports.EXPORTS`)."""
        from fitting.exports import file_names
        from stapeskit.outputs import Outputs

        read = [] if self.inertia.file is None else [self.inertia.file]
        outputs = Outputs("dof2kd", Path(folder), file_names(name, export), read, force)
        with outputs.staged() as stage:
            names = self.write_into(stage, name=name, export=export)
        return tuple(Path(folder) / one for one in names)
