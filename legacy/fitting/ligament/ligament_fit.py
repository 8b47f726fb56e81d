"""The fitted ligament in SI: K and D about its own plane and about the footplate centre, with covariance."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from legacy.fitting.estimators.base import Estimate
from legacy.fitting.estimators.problem import Problem
from legacy.fitting.ligament.equations import Equations
from legacy.fitting.ligament.inplane_stiffness import (
    COLUMNS,
    ROWS,
    InplaneStiffness,
    coupling_root,
    inplane_stiffness,
    inverse_of,
)
from legacy.fitting.ligament.joint_covariance import joint_covariance
from legacy.fitting.ligament.joint_fit import JointFit
from legacy.fitting.ligament.joint_lines import JointLines
from legacy.fitting.ligament.plane_transfer import curvature_of_transfer, slopes_of_transfer
from legacy.fitting.model.damping import DampingLaw
from legacy.fitting.model.parameter_vector import join, pairs, split
from legacy.fitting.model.principal_axes import PRINCIPAL_DOF
from legacy.fitting.uncertainty.covariance import NOISE, SharedEffect
from legacy.stapeskit.arrays import Array, ComplexArray

INPLANE_STIFFNESS = "inplane_stiffness"
PLANE = "ligament_plane"
_N = len(PRINCIPAL_DOF)


@dataclass(frozen=True)
class LigamentFit:
    """The joint fit of K, D, the plane of the ligament and the shared errors.

    Attributes
    ----------
    estimate : Estimate
        Scaled K' and D' about the plane of the ligament.
    stiffness, damping : ndarray, (3, 3)
        About the footplate centre, SI.
    plane_stiffness, plane_damping : ndarray, (3, 3)
        K', D' about the plane of the ligament, SI.
    plane_covariance : ndarray, (12, 12)
        Of K' and D', all sources, SI.
    coupling : ndarray, (3, 3)
        Y, rows y, alpha, gamma, columns x, z, beta; m, m, 1 and so on, SI.
    coupling_covariance : ndarray, (9, 9)
    sources : dict of str to ndarray, (12, 12)
        Covariance of K and D about the footplate centre by source.
    effects : tuple of SharedEffect
        The shared errors as the data leave them, for derived quantities.
    chi2 : float
        Of equations, shared errors and priors together.
    widened : float
        Factor on the channel noise because chi2 exceeds its degrees of freedom.
    law_sd : ndarray, (unknowns,)
        Of the unknowns of the law, SI.
    normalised : ndarray, (lines, 3), complex
        Residuals over their noise; real and imaginary parts have unit variance.
    lines, equations, joint
        What was solved.
    to_centre, to_plane : ndarray, (12, p)
        Derivatives of K and D about the footplate centre, and of K' and D', SI, by the scaled unknowns.
    terms : dict of str to (float, float)
        Further unknowns that are part of the model, e.g. a fluid: value and sd, SI.
    """

    law: DampingLaw
    estimate: Estimate
    stiffness: Array
    damping: Array
    plane_stiffness: Array
    plane_damping: Array
    plane_covariance: Array
    coupling: Array
    coupling_covariance: Array
    inplane: InplaneStiffness
    sources: dict[str, Array]
    effects: tuple[SharedEffect, ...]
    chi2: float
    n_dof: int
    widened: float
    law_sd: Array
    normalised: ComplexArray
    lines: JointLines = field(repr=False)
    equations: Equations = field(repr=False)
    joint: JointFit = field(repr=False)
    to_centre: Array = field(repr=False)
    to_plane: Array = field(repr=False)
    terms: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def fluid(self) -> Array | None:
        """Mass of fluid on the deflection that is part of the model, (3, 3), SI; None without."""
        _, equations = self.equations.applied(self.lines, self.joint.parameters)
        root = self.lines.root_mass[ROWS]
        return None if equations.fluid is None else np.asarray(equations.fluid * np.outer(root, root))

    @property
    def applied(self) -> JointLines:
        """The lines with the further unknowns in them."""
        return self.equations.applied(self.lines, self.joint.parameters)[0]

    def with_model_error(self, off: Array) -> LigamentFit:
        """Return the fit with columns E (12, k) of K' and D': a wrong model puts them off by E E^T; SI."""
        return replace(self, plane_covariance=self.plane_covariance + off @ off.T)

    def change_about_centre(self, change: Array) -> Array:
        """Return the change (12,) of K and D about the footplate centre, SI, for one (p,) of the unknowns.

        Notes
        -----
        That of Y K_cc Y^T is taken whole, since a cause may move the height by as much as it is.
        """
        moved = change[self.equations.coupling].reshape(_N, _N) * coupling_units(self.lines)
        square = join(*(moved @ part @ moved.T for part in (self.inplane.stiffness, self.inplane.damping)))
        return np.asarray(self.to_centre @ change + square)

    @property
    def p_value(self) -> float:
        """Probability of such a chi2, or a larger one, when model, noise and shared errors are as stated."""
        from scipy.special import chdtrc

        return float(chdtrc(self.n_dof, self.chi2))

    @property
    def heights_m(self) -> tuple[float, float]:
        """Height of the plane above the footplate centre as rocking about x and about z see it, m."""
        return float(self.coupling[1, 1]), float(-self.coupling[2, 0])

    @property
    def height(self) -> tuple[float, float]:
        """Weighted mean of the two heights and its sd, m."""
        places = [_entry(1, 1), _entry(2, 0)]
        signs = np.array([1.0, -1.0])
        covariance = self.coupling_covariance[np.ix_(places, places)] * np.outer(signs, signs)
        weights = np.linalg.solve(covariance, np.ones(2))
        values = np.array(self.heights_m)
        return float(weights @ values / weights.sum()), float(1.0 / np.sqrt(weights.sum()))

    @property
    def heights_sd_m(self) -> tuple[float, float]:
        """Their standard deviations, m."""
        sd = np.sqrt(np.diag(self.coupling_covariance))
        return float(sd[_entry(1, 1)]), float(sd[_entry(2, 0)])

    @property
    def tilt_rad(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Tilt of the plane about x and about z, each with its sd; rad.

        Notes
        -----
        A ring turned by a small angle t about z has K_yx = t (K_xx - K_yy), hence Y[y, x] = t (1 - K_yy /
        K_xx); about x: Y[y, z] = -t (1 - K_yy / K_zz).
        """
        sd = np.sqrt(np.diag(self.coupling_covariance))
        piston = self.plane_stiffness[0, 0]
        angles = []
        for column, sign in ((1, -1.0), (0, 1.0)):
            share = 1.0 - piston / self.inplane.stiffness[column, column]
            share = sign * share if abs(share) > 0.1 else np.nan
            angles.append((float(self.coupling[0, column] / share), float(sd[column] / abs(share))))
        return angles[0], angles[1]


def ligament_in_si(
    problem: Problem,
    lines: JointLines,
    equations: Equations,
    fit: JointFit,
    active: tuple[str, ...] = (),
) -> LigamentFit:
    """Return the minimum in SI about both points, with the covariance by source and active constraints."""
    known, spread = joint_covariance(lines, equations, fit)
    p, entries = equations.unknowns, equations.entries
    inverse = inverse_of(known)
    covariance = inverse @ spread @ inverse
    own = inverse_of(known[:p, :p])
    widened = max(1.0, fit.level)
    noise = widened * own @ spread[:p, :p] @ own
    response = -own @ known[:p, p:]
    shared = covariance[p:, p:]
    law = equations.law_at(fit.parameters).scaled(1.0 / problem.scale.omega)
    units, unit = problem.with_law(law).units, coupling_units(lines)
    plane = split(fit.parameters[:entries] * units, _N)
    coupling = fit.parameters[equations.coupling].reshape(_N, _N) * unit
    to_plane = _to_plane(problem, equations, fit.parameters, units, law)
    spread_root = coupling_root(widened * covariance[equations.coupling, equations.coupling])
    applied = equations.applied(lines, fit.parameters)[0]
    corrected = applied.corrected(fit.parameters[p:])
    inplane = inplane_stiffness(
        problem.with_law(law), applied, corrected, coupling / unit, spread_root, plane
    )
    total = noise + response @ shared @ response.T
    place = equations.coupling
    coupling_covariance = total[place, place] * np.outer(unit.ravel(), unit.ravel())
    slope, by_inplane = slopes_of_transfer(coupling, coupling_covariance, inplane)
    to_centre = to_plane.copy()
    to_centre[:, equations.coupling] += slope * unit.ravel()
    sources = {NOISE: to_centre @ noise @ to_centre.T}
    moved = to_centre @ response
    for source in dict.fromkeys(lines.sources):
        places = [place for place, name in enumerate(lines.sources) if name == source]
        half = moved[:, places] @ shared[places] @ moved.T
        sources[source] = 0.5 * (half + half.T)
    sources[INPLANE_STIFFNESS] = by_inplane @ inplane.covariance @ by_inplane.T
    sources[PLANE] = curvature_of_transfer(coupling_covariance, inplane)
    effects = [SharedEffect("shared", lines.sources, shared, moved, applied.mass_slopes[:, ROWS][:, :, ROWS])]
    still = np.zeros((2 * len(pairs(_N)), _N, _N))
    effects.append(SharedEffect(INPLANE_STIFFNESS, (), inplane.covariance, by_inplane, still))
    effects.append(SharedEffect(PLANE, (), sources[PLANE], np.eye(len(still)), still))
    added = [coupling @ part @ coupling.T for part in (inplane.stiffness, inplane.damping)]
    open_in_law = np.diag(total)[entries : place.start]
    return LigamentFit(
        law,
        Estimate(fit.parameters[:entries], 0.5 * fit.chi2, fit.iterations, fit.converged, active),
        plane[0] + added[0],
        plane[1] + added[1],
        plane[0],
        plane[1],
        to_plane @ total @ to_plane.T,
        coupling,
        coupling_covariance,
        inplane,
        sources,
        tuple(effects) if lines.errors else tuple(effects[1:]),
        fit.chi2,
        fit.n_dof,
        widened,
        np.sqrt(open_in_law) * law.units(problem.scale.omega),
        fit.at.residual * np.sqrt(2.0),
        lines,
        equations,
        fit,
        to_centre,
        to_plane,
        {
            term.name: (float(fit.parameters[at] * term.unit), float(np.sqrt(total[at, at]) * term.unit))
            for at, term in enumerate(equations.terms, equations.term.start)
        },
    )


def _to_plane(
    problem: Problem, equations: Equations, parameters: Array, units: Array, law: DampingLaw
) -> Array:
    """Return the derivative of K' and D' in SI by the scaled parameters, (12, p)."""
    entries = equations.entries
    slope = np.zeros((entries, equations.unknowns))
    slope[:, :entries] = np.diag(units)
    if law.estimated and law.law.time_power is None:
        half = entries // 2
        damping = parameters[half:entries] * units[half:]
        slope[half:, entries] = -np.log(problem.scale.omega) * damping
    return slope


def coupling_units(lines: JointLines) -> Array:
    """Return SI over scaled of Y, (3, 3)."""
    return np.asarray(lines.root_mass[ROWS][:, None] / lines.root_mass[COLUMNS][None, :])


def _entry(row: int, column: int) -> int:
    return row * _N + column
