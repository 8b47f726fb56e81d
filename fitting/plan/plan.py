"""Before a measurement: the standard deviations to expect of every entry, and what would make them smaller.

The planned experiment is simulated without noise and fitted; the covariance that its noise would have then
gives what the fit of the real one can reach (Cramer-Rao bound), the mass matrix's uncertainty included.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.examples.experiment import BASE_POINTS_MM, STAPES_POINTS_MM, Layout
from fitting.examples.paper import PAPER_DAMPING_CORRECTED, PAPER_DOF, PAPER_MASS, PAPER_STIFFNESS
from fitting.kd import fit_kd
from fitting.kd_fit import KDFit
from fitting.model.damping import VISCOUS, DampingLaw
from fitting.model.model import simulate
from fitting.options import KDOptions
from stapeskit.page.numbers import plus_minus
from stapeskit.records.mass_record import MassMatrix
from stapeskit.records.motion import RigidMotion
from stapeskit.spatial import DOF_NAMES, DOF_UNITS
from stapeskit.warnings import Notice

Array = NDArray[np.float64]
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
EXPECTED_CODES = ("weak_identifiability", "unstable", "not_passive", "mass_uncertainty_not_given")


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
    low_hz, high_hz : float
    lines : int
        Of one run.
    directions : tuple of str
        Direction that the shaker drives, one a run.
    law : DampingLaw
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


@dataclass(frozen=True)
class Option:
    """A way to measure, with what it would give.

    Attributes
    ----------
    name : str
        What differs from the plan; ``as planned`` for the plan itself.
    fit : KDFit
        Of the experiment without noise: its covariance is the expected one.
    """

    name: str
    fit: KDFit

    @property
    def weak_entries(self) -> tuple[str, ...]:
        """Entries with an expected noise-only sd over 10 % of sqrt(Xii Xjj)."""
        known = self.fit.identifiability
        return tuple(name for name, value in zip(known.names, known.relative, strict=True) if value > 0.1)

    @property
    def relative(self) -> Array:
        """Expected sd of every entry, channel noise alone, relative to sqrt(Xii Xjj), (p,)."""
        return self.fit.identifiability.relative


@dataclass(frozen=True)
class Expectation:
    """What a plan promises, and what changes of it would.

    Attributes
    ----------
    plan : Plan
    options : tuple of Option
        The plan first.
    notices : tuple of Notice
    """

    plan: Plan
    options: tuple[Option, ...]
    notices: tuple[Notice, ...]

    @property
    def planned(self) -> KDFit:
        """The plan as it is."""
        return self.options[0].fit


def expect(plan: Plan) -> Expectation:
    """Return the expected uncertainty of a plan and of its improvements.

    Raises
    ------
    FittingError
        Mass, stiffness and degrees of freedom do not fit together, or the lines are too few.
    """
    options = tuple(Option(name, _fit(way)) for name, way in _ways(plan))
    notices = [notice for notice in options[0].fit.notices if notice.code in EXPECTED_CODES]
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
    return ways


def _fit(plan: Plan) -> KDFit:
    options = KDOptions(dof=plan.dof, damping=plan.law.name, bands=0, profile=False)
    return fit_kd(planned_motion(plan), plan.mass, options)


def planned_motion(plan: Plan) -> RigidMotion:
    """Return the motion of a plan without noise, its covariance stated."""
    freq = np.linspace(plan.low_hz, plan.high_hz, plan.lines)
    omega = 2.0 * np.pi * freq
    runs, n = len(plan.directions), len(plan.dof)
    q = np.empty((runs, 2, plan.lines, n), dtype=complex)
    covariance = np.empty((runs, 2, plan.lines, n, n), dtype=complex)
    mass = _matrix(plan)
    for run, direction in enumerate(plan.directions):
        q[run, 1] = _base(plan, freq, direction)
        q[run, 0] = simulate(mass, plan.stiffness, plan.damping, freq, q[run, 1], law=plan.law)
        for body, points in enumerate((plan.structure_mm, plan.base_mm)):
            layout = Layout(points)
            if plan.noise_m_s is not None:
                level = np.sqrt(2.0) * plan.noise_m_s / omega
            else:
                level = plan.noise_relative * layout.signal(plan.dof, q[run, body] * omega[:, None]) / omega
            covariance[run, body] = layout.covariance(plan.dof, level)
    none = np.full((runs, 2, plan.lines), np.nan)
    names = tuple(f"run {run + 1}, driven along {name}" for run, name in enumerate(plan.directions))
    return RigidMotion(names, ("stapes", "base"), plan.dof, freq, q, covariance, none, none)


def _base(plan: Plan, freq: Array, direction: str) -> NDArray[np.complex128]:
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
    from fitting.model.inertia import inertia_of

    return inertia_of(plan.mass, plan.dof).rows(plan.dof, ())


def plan_json(expectation: Expectation, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return an expectation as JSON-able data, SI."""
    plan, fit = expectation.plan, expectation.planned
    stiffness, damping = fit.standard_deviation
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
        "modes": [
            {
                "frequency_hz": mode.frequency_hz,
                "expected_frequency_sd_hz": float(fit.derived.frequency_sd_hz[place]),
                "damping_ratio": mode.damping_ratio,
                "expected_damping_ratio_sd": float(fit.derived.damping_ratio_sd[place]),
            }
            for place, mode in enumerate(fit.modes.pairs)
        ],
        "relative_to": "sqrt(Xii Xjj) for entry (i, j) of X = K or D; channel noise alone",
        "options": [
            {
                "name": option.name,
                "condition_number_column_scaled": float(option.fit.identifiability.condition),
                "worst_combination": option.fit.identifiability.describe(0),
                "worst_combination_relative_sd": float(option.fit.identifiability.worst),
                "entries_over_10_percent": list(option.weak_entries),
                "relative_sd": dict(zip(fit.parameters, option.relative.tolist(), strict=True)),
            }
            for option in expectation.options
        ],
        "warnings": [notice.as_json() for notice in expectation.notices],
        "provenance": dict(provenance),
    }


def summary_rows(expectation: Expectation) -> list[tuple[str, str]]:
    """Return the rows of the command's table."""
    fit = expectation.planned
    rows = []
    stiffness_sd, damping_sd = fit.standard_deviation
    for letter, values, sds in (("K", fit.stiffness, stiffness_sd), ("D", fit.damping, damping_sd)):
        parts = [
            f"{name} {plus_minus(values[place, place], sds[place, place])}"
            for place, name in enumerate(fit.dof)
        ]
        rows.append((f"{letter} diagonal, expected (SI)", ", ".join(parts)))
    parts = [
        plus_minus(mode.frequency_hz, sd)
        for mode, sd in zip(fit.modes.pairs, fit.derived.frequency_sd_hz, strict=True)
    ]
    rows.append(("modes, damped (Hz)", ", ".join(parts)))
    for option in expectation.options:
        known = option.fit.identifiability
        weak = f"{len(option.weak_entries)} of {len(known.names)} entries over 10 %"
        largest = int(np.argmax(known.relative))
        rows.append(
            (
                option.name,
                f"worst combination {known.percent(0)}, worst entry {known.names[largest]} "
                f"{100.0 * known.relative[largest]:.2g} %, {weak}",
            )
        )
    return rows
