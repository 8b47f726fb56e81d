"""Before a measurement: the standard deviations to expect of every entry, and what would make them smaller.

The planned experiment is simulated without noise and fitted. Its covariance is then what the fit of the real
one can reach: that of the noise is the Cramer-Rao bound; errors that the lines share (points, registration,
lasers, mass) are taken through the fit and not estimated by it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.fitting.examples.paper import PAPER_DAMPING_CORRECTED, PAPER_DOF, PAPER_MASS, PAPER_STIFFNESS
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.kd_fit import KDFit
from legacy.fitting.model.damping import VISCOUS, DampingLaw
from legacy.fitting.model.model import simulate
from legacy.fitting.model.parameter_vector import join, split
from legacy.fitting.model.point_layout import BASE_POINTS_MM, STAPES_POINTS_MM, Layout
from legacy.fitting.options import KDOptions
from legacy.fitting.plan.planned_errors import PlannedErrors, shared_errors
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.page.numbers import plus_minus
from legacy.stapeskit.page.quantities import diagonal_unit
from legacy.stapeskit.records.mass_record import MassMatrix
from legacy.stapeskit.records.motion import RigidMotion
from legacy.stapeskit.spatial import DOF_NAMES, DOF_UNITS
from legacy.stapeskit.warnings import Notice

# Directions that a shaker may drive in one more run, with words for them.
_DRIVES = {
    "y": "driven along y",
    "x": "driven along x",
    "z": "driven along z",
    "alpha": "rocked about x",
    "gamma": "rocked about z",
}
# Frequency over which the phase of rocking turns by about a radian.
_PHASE_HZ = 5000.0
_ROCKING_RADIUS_M = 1e-3
# Codes that say nothing of a plan: its motion has no noise, and it states the errors of the mass itself.
_NOT_OF_A_PLAN = ("noise_overstated", "mass_uncertainty_not_given")
_OF_MASS = ("mass_sd_percent",)
# Errors that are halved together, with words for it.
_HALVED = {
    "points known twice as well": ("position_sd_mm",),
    "registration twice as good": ("registration_sd_mm", "registration_sd_deg"),
    "lasers calibrated twice as well": ("gain_sd_percent", "phase_sd_deg", "delay_sd_us"),
    "density or mass known twice as well": _OF_MASS,
}
# Name of the error of a mass matrix that has no uncertainty of its own.
STATED_MASS = "mass.density"


@dataclass(frozen=True)
class Plan:
    """A measurement that has not been made.

    Attributes
    ----------
    dof : tuple of str, (n,)
    mass : MassMatrix or ndarray
        About the footplate centre in footplate axes, SI.
    stiffness, damping : ndarray, (n, n)
        Expected, SI.
    structure_mm, base_mm : ndarray, (points, 3)
        Vibrometer points in footplate axes, each seen along three axes, mm.
    noise_m_s : float or None
        Standard deviation of the real (= imaginary) part of a channel's velocity, m/s.
    noise_relative : float
        Root mean square noise of a channel over the root mean square velocity of its body's points; used
        when ``noise_m_s`` is None.
    base_velocity_m_s : float
        Amplitude of the base along the driven direction.
    rocking : float
        Motion of the base in the other directions relative to it, rotations at a radius of 1 mm.
    lines : int
        Of one run.
    directions : tuple of str
        Direction that the shaker drives, one a run.
    errors : PlannedErrors
        Of what the lines share.
    """

    dof: tuple[str, ...] = PAPER_DOF
    mass: MassMatrix | Array = field(default_factory=lambda: np.array(PAPER_MASS))
    stiffness: Array = field(default_factory=lambda: np.array(PAPER_STIFFNESS))
    damping: Array = field(default_factory=lambda: np.array(PAPER_DAMPING_CORRECTED))
    structure_mm: Array = field(default_factory=lambda: STAPES_POINTS_MM.copy())
    base_mm: Array = field(default_factory=lambda: BASE_POINTS_MM.copy())
    noise_m_s: float | None = None
    noise_relative: float = 0.05
    base_velocity_m_s: float = 6e-4
    rocking: float = 0.05
    low_hz: float = 400.0
    high_hz: float = 5000.0
    lines: int = 200
    directions: tuple[str, ...] = ("y",)
    law: DampingLaw = VISCOUS
    errors: PlannedErrors = field(default_factory=PlannedErrors)


@dataclass(frozen=True)
class Option:
    """A way to measure, with what it would give.

    Attributes
    ----------
    name : str
        What differs from the plan; ``as planned`` for the plan itself.
    fit : KDFit
        Of the experiment without noise.
    mass_sd : float
        Relative error of the whole mass matrix that is not in the fit: all of K and D go with it.
    """

    name: str
    fit: KDFit
    mass_sd: float = 0.0

    @property
    def sources(self) -> dict[str, Array]:
        """Covariance of the parameters K11, K12, ..., Dnn by source, SI; they add up to ``covariance``."""
        sources = dict(self.fit.budget.sources)
        if self.mass_sd > 0.0:
            entries = self.mass_sd * join(self.fit.stiffness, self.fit.damping)
            sources[STATED_MASS] = np.outer(entries, entries)
        return sources

    @property
    def covariance(self) -> Array:
        """Expected covariance of the parameters from all sources, (p, p), SI."""
        return sum(self.sources.values(), np.zeros_like(self.fit.covariance))

    @property
    def standard_deviation(self) -> tuple[Array, Array]:
        """Expected standard deviation of K and of D from all sources, (n, n) each, SI."""
        return split(np.sqrt(np.diag(self.covariance)), len(self.fit.dof))

    @property
    def relative_of_all(self) -> Array:
        """Expected sd of every entry from all sources, relative to sqrt(Xii Xjj), (p,)."""
        roots = [np.sqrt(np.diag(part)) for part in (self.fit.stiffness, self.fit.damping)]
        return np.sqrt(np.diag(self.covariance)) / join(*(np.outer(root, root) for root in roots))

    @property
    def weak_entries(self) -> tuple[str, ...]:
        """Entries with an expected sd, from all sources, over 10 % of sqrt(Xii Xjj)."""
        names = self.fit.parameters
        return tuple(name for name, value in zip(names, self.relative_of_all, strict=True) if value > 0.1)

    @property
    def relative(self) -> Array:
        """Expected sd of every entry, channel noise alone, relative to sqrt(Xii Xjj), (p,)."""
        return self.fit.identifiability.relative


@dataclass(frozen=True)
class Expectation:
    """Expected standard deviations of a plan, and of changed plans.

    Attributes
    ----------
    options : tuple of Option
        The plan first.
    """

    plan: Plan
    options: tuple[Option, ...]
    notices: tuple[Notice, ...]

    @property
    def planned(self) -> Option:
        """The plan without improvements."""
        return self.options[0]


def expect(plan: Plan) -> Expectation:
    """Return the expected uncertainty of a plan and of its improvements.

    Raises
    ------
    FittingError
        Mass, stiffness and degrees of freedom do not fit together, or the lines are too few.
    """
    settings = KDOptions(dof=plan.dof, damping=plan.law.name, bands=0, profile=False)
    options = tuple(
        Option(name, fit_kd(planned_motion(way), way.mass, settings), _mass_sd(way))
        for name, way in _ways(plan)
    )
    notices = [notice for notice in options[0].fit.notices if notice.code not in _NOT_OF_A_PLAN]
    return Expectation(plan, options, tuple(notices))


def _ways(plan: Plan) -> list[tuple[str, Plan]]:
    """Return the plan and its improvements, one change each."""
    wider = 2.0 * plan.high_hz
    spacing = (plan.high_hz - plan.low_hz) / max(plan.lines - 1, 1)
    quiet = None if plan.noise_m_s is None else plan.noise_m_s / 2.0
    ways: list[tuple[str, Plan]] = [("as planned", plan)]
    for name, words in _DRIVES.items():
        if name in plan.dof and name not in plan.directions:
            ways.append((f"one more run, {words}", replace(plan, directions=(*plan.directions, name))))
    lines = round((wider - plan.low_hz) / spacing) + 1
    ways += [
        (f"band up to {wider:g} Hz, same spacing", replace(plan, high_hz=wider, lines=lines)),
        ("twice the lines in the same band", replace(plan, lines=2 * plan.lines)),
        (
            "half the noise (4 times the averages)",
            replace(plan, noise_m_s=quiet, noise_relative=plan.noise_relative / 2.0),
        ),
    ]
    for words, names in _HALVED.items():
        halves = {name: getattr(plan.errors, name) / 2.0 for name in names}
        if any(halves.values()) and (names != _OF_MASS or _mass_sd(plan) > 0.0):
            ways.append((words, replace(plan, errors=replace(plan.errors, **halves))))
    return ways


def _mass_sd(plan: Plan) -> float:
    """Return the stated relative error of the mass; zero where the mass brings its own."""
    own = isinstance(plan.mass, MassMatrix) and bool(plan.mass.contributions)
    return 0.0 if own else 1e-2 * plan.errors.mass_sd_percent


def planned_motion(plan: Plan) -> RigidMotion:
    """Return the motion of a plan without noise, its covariance stated."""
    freq = np.linspace(plan.low_hz, plan.high_hz, plan.lines)
    omega = 2.0 * np.pi * freq
    runs, n = len(plan.directions), len(plan.dof)
    q = np.empty((runs, 2, plan.lines, n), dtype=complex)
    covariance = np.empty((runs, 2, plan.lines, n, n), dtype=complex)
    mass = _matrix(plan)
    layouts = (Layout(plan.structure_mm), Layout(plan.base_mm))
    for run, direction in enumerate(plan.directions):
        q[run, 1] = _base_motion(plan, freq, direction)
        q[run, 0] = simulate(mass, plan.stiffness, plan.damping, freq, q[run, 1], law=plan.law)
        for body, layout in enumerate(layouts):
            if plan.noise_m_s is not None:
                level = np.sqrt(2.0) * plan.noise_m_s / omega
            else:
                level = plan.noise_relative * layout.signal(plan.dof, q[run, body] * omega[:, None]) / omega
            inverse = layout.inverse(plan.dof)
            covariance[run, body] = np.square(level)[:, None, None] * (inverse @ inverse.T)
    none = np.full((runs, 2, plan.lines), np.nan)
    names = tuple(f"run {run + 1}, driven along {name}" for run, name in enumerate(plan.directions))
    shared = shared_errors(plan.errors, plan.dof, layouts, freq, q)
    return RigidMotion(names, ("stapes", "base"), plan.dof, freq, q, covariance, none, none, shared=shared)


def _base_motion(plan: Plan, freq: Array, direction: str) -> NDArray[np.complex128]:
    """Return the base motion (lines, n): constant velocity along the driven direction, some in the others."""
    motion = np.empty((len(freq), len(plan.dof)), dtype=complex)
    for place, name in enumerate(plan.dof):
        share: Any = 1.0
        if name != direction:
            share = plan.rocking * np.exp(1j * (1.0 + DOF_NAMES.index(name)) * freq / _PHASE_HZ)
        arm = _ROCKING_RADIUS_M if DOF_UNITS[name] == "rad" else 1.0
        motion[:, place] = plan.base_velocity_m_s / (2.0 * np.pi * freq) * share / arm
    return motion


def _matrix(plan: Plan) -> Array:
    from legacy.fitting.model.inertia import inertia_of

    return inertia_of(plan.mass, plan.dof).rows(plan.dof, ())


def plan_json(expectation: Expectation, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return an expectation as JSON-able data, SI."""
    plan, planned = expectation.plan, expectation.planned
    fit = planned.fit
    stiffness, damping = planned.standard_deviation
    noise = fit.noise_standard_deviation
    return {
        "schema": "stapeskit.plan/1",
        "dof": list(plan.dof),
        "about": "footplate_centre",
        "axes": "footplate",
        "runs": list(plan.directions),
        "band_hz": [plan.low_hz, plan.high_hz],
        "lines": plan.lines,
        "stiffness_si": plan.stiffness.tolist(),
        "expected_stiffness_sd_si": stiffness.tolist(),
        "damping_si": plan.damping.tolist(),
        "expected_damping_sd_si": damping.tolist(),
        "noise_only_sd_si": {"stiffness": noise[0].tolist(), "damping": noise[1].tolist()},
        "errors": asdict(plan.errors) | ({} if planned.mass_sd else {"mass_sd_percent": None}),
        "budget": {
            source: dict(zip(fit.parameters, np.sqrt(np.diag(part)).tolist(), strict=True))
            for source, part in planned.sources.items()
        },
        "modes": [
            {
                "frequency_hz": mode.frequency_hz,
                "expected_frequency_sd_hz": float(fit.derived.frequency_sd_hz[place]),
                "damping_ratio": mode.damping_ratio,
                "expected_damping_ratio_sd": float(fit.derived.damping_ratio_sd[place]),
            }
            for place, mode in enumerate(fit.modes.pairs)
        ],
        "relative_to": "sqrt(Xii Xjj) for entry (i, j) of X = K or D",
        "options": [
            {
                "name": option.name,
                "condition_number_column_scaled": float(option.fit.identifiability.condition),
                "worst_combination": option.fit.identifiability.describe(0),
                "worst_combination_relative_sd": float(option.fit.identifiability.worst),
                "entries_over_10_percent": list(option.weak_entries),
                "relative_sd": dict(zip(fit.parameters, option.relative_of_all.tolist(), strict=True)),
                "relative_sd_noise_only": dict(zip(fit.parameters, option.relative.tolist(), strict=True)),
            }
            for option in expectation.options
        ],
        "warnings": [notice.as_json() for notice in expectation.notices],
        "provenance": dict(provenance),
    }


def summary_rows(expectation: Expectation) -> list[tuple[str, str]]:
    """Return the rows of the command's table."""
    planned = expectation.planned
    fit, names = planned.fit, planned.fit.parameters
    sds = planned.standard_deviation
    rows = []
    for letter, values, deviations in zip("KD", (fit.stiffness, fit.damping), sds, strict=True):
        for place, name in enumerate(fit.dof):
            unit = diagonal_unit(letter, name, fit.law.time_power)
            rows.append((f"{letter}({name})", unit.with_sd(values[place, place], deviations[place, place])))
    for number, (mode, sd) in enumerate(zip(fit.modes.pairs, fit.derived.frequency_sd_hz, strict=True), 1):
        rows.append((f"mode {number}", f"{plus_minus(mode.frequency_hz, sd)} Hz, damped"))
    for option in expectation.options:
        relative, noise = option.relative_of_all, option.relative
        worst = int(np.argmax(relative))
        rows.append(
            (
                option.name,
                f"worst entry {names[worst]} {100.0 * relative[worst]:.2g} %, "
                f"of noise alone {100.0 * noise[worst]:.2g} %; "
                f"{len(option.weak_entries)} of {len(names)} entries over 10 %",
            )
        )
    return rows
