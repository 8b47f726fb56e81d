"""Before a measurement: the standard deviations to expect, and what would make them smaller.

The planned experiment is simulated in six degrees of freedom without noise and fitted by the engine that will
fit the real one; what that fit states is what the plan promises.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fitting.dof2kd import MassSource, fit_of, mass_source
from fitting.layout import BASE_POINTS_MM, STAPES_POINTS_MM, Layout, frame_maps
from fitting.options import KDOptions
from fitting.plane import INPLANE_DOF, PISTON_DOF
from fitting.result import KDFit
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, raise_all
from stapeskit.option_types import Count, DofList, Kind, Positive, Range, Words, number_where
from stapeskit.options import Opt, Options, read_toml
from stapeskit.records.json_files import as_json
from stapeskit.records.motion import RigidMotion, SharedErrors
from stapeskit.report.quantities import diagonal_unit, plus_minus
from stapeskit.spatial import DOF_NAMES, matrix_from_parameters, parameters_from_matrix

_HEIGHT_MM, _INPLANE_RATIO = 0.15, 2.2  # of the ligament that is planned for: calibrated.toml, usual values
_PHASE_HZ = 5000.0  # frequency over which the phase of rocking turns by about a radian
_ROCKING_RADIUS_M = 1e-3

PAPER_STIFFNESS = ((1722.0, 0.414, -0.48), (0.414, 1.37e-3, -6.41e-5), (-0.48, -6.41e-5, 3.79e-3))
PAPER_DAMPING = (
    (2.289e-2, 6.142e-6, -3.679e-6),
    (6.142e-6, 3.015e-8, -6.756e-12),
    (-3.679e-6, -6.756e-12, 5.646e-8),
)
"""K and D of the study of CURAC 2019 (p. 98), D with its exponents corrected; y, alpha, gamma, SI."""

_STAPES = (3.2e-6, 1.43e-10, 4.16e-9, 4.349e-10, 9.77e-12, 2.2e-12, 1.07e-11, -3.0e-13, 8.0e-14, -3.0e-14)
# Ten inertial parameters of a human stapes whose centre of mass is 1.3 mm above the footplate.


def _rows(value: Any) -> Array:
    table = np.array(value, dtype=float)
    if table.ndim != 2 or not np.all(np.isfinite(table)):
        raise ValueError
    return table


def _mass(value: Any) -> Any:
    return Path(value) if isinstance(value, str | Path) else _rows(value)


_IN_ROWS = "Write rows in brackets, [[1, 2], [3, 4]]"
Matrix = Annotated[Any, Kind(_rows, "a matrix in SI: y, alpha, gamma", "MATRIX", _IN_ROWS)]
Points = Annotated[Any, Kind(_rows, "points [x, y, z] in mm, footplate axes", "POINTS", _IN_ROWS)]
Mass = Annotated[Any, Kind(_mass, "a mass.json, or a 6 x 6 matrix in SI", "MASS", _IN_ROWS)]
Sd = Annotated[float, Kind(number_where(lambda value: value >= 0.0), "a number, 0 or positive", "NUMBER")]


class Plan(Options):
    """A measurement that has not been made: the keys of plan.toml."""

    table: ClassVar[str] = "plan"

    dof: Annotated[DofList, Opt("degrees of freedom of the fit")] = PISTON_DOF
    directions: Annotated[Words, Opt("driven by the shaker, one run each")] = ("y",)
    band_hz: Annotated[Range, Opt("first and last line")] = (400.0, 5000.0)
    lines: Annotated[Count, Opt("of one run")] = 200
    noise_m_s: Annotated[Positive | None, Opt("sd of Re and Im of a reading; or noise_relative")] = None
    noise_relative: Annotated[Positive, Opt("noise of a reading over the velocity of its body")] = 0.05
    base_velocity_m_s: Annotated[Positive, Opt("along the driven direction")] = 6e-4
    rocking: Annotated[Sd, Opt("of the base in the other directions, rotations at 1 mm")] = 0.05
    mass: Annotated[Mass | None, Opt("mass.json or matrix", example="mass.json")] = None
    stiffness: Annotated[Matrix, Opt("expected K")] = PAPER_STIFFNESS
    damping: Annotated[Matrix, Opt("expected D, viscous")] = PAPER_DAMPING
    structure_points_mm: Annotated[Points, Opt("points on the stapes")] = STAPES_POINTS_MM
    base_points_mm: Annotated[Points, Opt("points on the bone")] = BASE_POINTS_MM
    position_sd_mm: Annotated[Sd, Opt("of each coordinate of a point")] = 0.03
    registration_sd_mm: Annotated[Sd, Opt("of the footplate centre in the vibrometer")] = 0.02
    registration_sd_deg: Annotated[Sd, Opt("of the footplate axes in it")] = 0.1
    gain_sd_percent: Annotated[Sd, Opt("of each laser")] = 1.0
    phase_sd_deg: Annotated[Sd, Opt("of each laser")] = 0.5
    delay_sd_us: Annotated[Sd, Opt("of each laser")] = 1.0
    mass_sd_percent: Annotated[Sd, Opt("of the density; unused beside a mass.json")] = 3.0

    @property
    def layouts(self) -> tuple[Layout, Layout]:
        """Points of structure and base."""
        return Layout(np.array(self.structure_points_mm)), Layout(np.array(self.base_points_mm))


@dataclass(frozen=True)
class StatedMass:
    """A mass matrix with the uncertainty that a plan states."""

    parameters: Array
    contributions: Mapping[str, Array]
    about: str = "footplate_centre"
    axes: str = "footplate"


@dataclass(frozen=True)
class Way:
    """A way to measure, and what its fit would state.

    Attributes
    ----------
    name : str
        What differs from the plan; ``as planned`` for the plan itself.
    """

    name: str
    fit: KDFit

    @property
    def relative(self) -> Array:
        """Expected sd of every entry over sqrt(Xii Xjj)."""
        from fitting.entries import sizes

        return np.sqrt(np.diag(self.fit.covariance)) / sizes(self.fit.stiffness, self.fit.damping)

    @property
    def weak(self) -> tuple[str, ...]:
        """Entries with an expected sd over 10 %."""
        return tuple(
            name for name, value in zip(self.fit.parameters, self.relative, strict=True) if value > 0.1
        )


def read_plan(path: Path) -> tuple[Plan, MassSource]:
    """Read a plan.toml.

    Raises
    ------
    StapeskitError
        A key is unknown, a value is at fault, or the points do not determine the motion.
    """
    values = read_toml(path)
    keys = {entry.key: entry.key for entry in Plan.entries()}
    plan = Plan.read(values, path.name, keys, path.parent)
    raise_all(_faults(plan, path.name))
    if isinstance(plan.mass, Path):
        return plan, mass_source(path.parent / plan.mass, KDOptions())
    return plan, stated_mass(plan)


def _faults(plan: Plan, where: str) -> list[Fault]:
    """Return what cannot be planned: directions, points and matrices that are none."""
    faults = []
    wrong = [name for name in plan.directions if name not in DOF_NAMES]
    if wrong or not plan.directions:
        got = ", ".join(wrong) or "none"
        faults.append(Fault("directions", f"names out of {', '.join(DOF_NAMES)}", got, where))
    for key, points in (
        ("structure_points_mm", plan.structure_points_mm),
        ("base_points_mm", plan.base_points_mm),
    ):
        if np.shape(points)[1] != 3 or not Layout(np.array(points)).determines:
            step = "Give at least three points that are not on one line"
            faults.append(Fault(key, "points that determine six degrees of freedom", "others", where, step))
    for key, size, matrix in (
        ("mass", 6, plan.mass),
        ("stiffness", 3, plan.stiffness),
        ("damping", 3, plan.damping),
    ):
        if matrix is None or isinstance(matrix, Path):
            continue
        table = np.array(matrix)
        good = table.shape == (size, size) and np.allclose(table, table.T, rtol=1e-6, atol=0.0)
        if not good or not _is_positive(table):
            wanted = f"a symmetric, positive definite {size} x {size} matrix in SI"
            faults.append(
                Fault(key, wanted, " x ".join(map(str, table.shape)), where, "Correct it, or leave it out")
            )
    return faults


def _is_positive(matrix: Array) -> bool:
    """Return whether a matrix whose entries have different units is positive definite."""
    diagonal = np.diag(matrix)
    if np.any(diagonal <= 0.0):
        return False
    return bool(np.linalg.eigvalsh(matrix / np.sqrt(np.outer(diagonal, diagonal)))[0] > 1e-9)


def stated_mass(plan: Plan) -> MassSource:
    """Return the mass of a plan with the stated error of its density."""
    parameters = np.array(_STAPES) if plan.mass is None else parameters_from_matrix(np.asarray(plan.mass))
    density = {"density": (0.01 * plan.mass_sd_percent) ** 2 * np.outer(parameters, parameters)}
    return MassSource(StatedMass(parameters, density if plan.mass_sd_percent else {}))


def six_dof_matrices(plan: Plan) -> tuple[Array, Array]:
    """Return K and D (6, 6) about the footplate centre of a ligament with the planned piston block.

    Its plane is at the usual height and as stiff in it as usual: Z_rc = Y Z_cc.
    """
    rows = [DOF_NAMES.index(name) for name in PISTON_DOF]
    columns = [DOF_NAMES.index(name) for name in INPLANE_DOF]
    coupling = np.zeros((3, 3))
    coupling[1, 1], coupling[2, 0] = 1e-3 * _HEIGHT_MM, -1e-3 * _HEIGHT_MM
    found = []
    for block in (np.array(plan.stiffness, dtype=float), np.array(plan.damping, dtype=float)):
        inside = np.diag([_INPLANE_RATIO, _INPLANE_RATIO, _INPLANE_RATIO * 1e-6]) * block[0, 0]
        whole = np.zeros((6, 6))
        whole[np.ix_(rows, rows)], whole[np.ix_(columns, columns)] = block, inside
        whole[np.ix_(rows, columns)] = coupling @ inside
        whole[np.ix_(columns, rows)] = (coupling @ inside).T
        found.append(whole)
    return found[0], found[1]


def planned_motion(plan: Plan, mass: Array, rng: np.random.Generator | None = None) -> RigidMotion:
    """Return the motion of a plan with covariance and shared errors; with ``rng`` all of them are drawn."""
    from fitting.model import simulate

    freq = np.linspace(*plan.band_hz, plan.lines)
    omega, runs = 2.0 * np.pi * freq, len(plan.directions)
    stiffness, damping = six_dof_matrices(plan)
    q = np.empty((runs, 2, plan.lines, 6), dtype=complex)
    covariance = np.empty((runs, 2, plan.lines, 6, 6), dtype=complex)
    names, sds, maps, powers = _errors(plan)
    drawn = np.zeros(len(names)) if rng is None else np.array(sds) * rng.standard_normal(len(names))
    for run, direction in enumerate(plan.directions):
        q[run, 1] = _base_motion(plan, freq, direction)
        q[run, 0] = simulate(mass, stiffness, damping, freq, q[run, 1])
        for body, layout in enumerate(plan.layouts):
            level = _noise(plan, layout, q[run, body], omega)
            inverse = layout.inverse
            covariance[run, body] = np.square(level)[:, None, None] * (inverse @ inverse.T)
            turn = np.eye(6) + np.einsum("k,kl,kij->lij", drawn, _growth(powers, omega), maps[:, body])
            q[run, body] = (turn @ q[run, body][..., None])[..., 0]
            if rng is not None:
                draws = rng.standard_normal((2, plan.lines, inverse.shape[1])) * np.sqrt(0.5)
                q[run, body] += level[:, None] * ((draws[0] + 1j * draws[1]) @ inverse.T)
    derivatives = np.einsum("kl,kbij,rblj->krbli", _growth(powers, omega), maps, q)
    shared = SharedErrors(tuple(names), np.diag(np.square(sds)), derivatives, maps, np.array(powers))
    none = np.full((runs, 2, plan.lines), np.nan)
    labels = tuple(f"run {run + 1}, driven along {name}" for run, name in enumerate(plan.directions))
    return RigidMotion(labels, ("stapes", "base"), DOF_NAMES, freq, q, covariance, none, none, shared=shared)


def _noise(plan: Plan, layout: Layout, q: ComplexArray, omega: Array) -> Array:
    """Return the root of E|noise|^2 of a reading, m."""
    if plan.noise_m_s is not None:
        return np.asarray(np.sqrt(2.0) * plan.noise_m_s / omega)
    velocity = (q * omega[:, None]) @ layout.rows.T
    return np.asarray(plan.noise_relative * np.sqrt(np.mean(np.abs(velocity) ** 2)) / omega)


def _growth(powers: list[int], omega: Array) -> ComplexArray:
    return np.asarray((1j * omega)[None] ** np.array(powers)[:, None])


def _errors(plan: Plan) -> tuple[list[str], list[float], ComplexArray, list[int]]:
    """Return names, sd, maps (p, body, 6, 6) and powers of i w of what all lines share."""
    names, sds, maps, powers = list[str](), list[float](), list[ComplexArray](), list[int]()

    def add(name: str, sd: float, both: NDArray[Any], power: int = 0) -> None:
        if sd > 0.0:
            names.append(name)
            sds.append(sd)
            maps.append(both.astype(complex))
            powers.append(power)

    for axis, change in zip(DOF_NAMES, frame_maps(), strict=True):
        sd = 1e-3 * plan.registration_sd_mm if axis in "xyz" else float(np.radians(plan.registration_sd_deg))
        add(f"registration.{axis}", sd, np.stack([change, change]))
    for body, layout in enumerate(plan.layouts):
        for number, change in enumerate(layout.position_maps()):
            both = np.zeros((2, 6, 6))
            both[body] = change
            add(f"position.{body}_{number // 3}_{'xyz'[number % 3]}", 1e-3 * plan.position_sd_mm, both)
    lasers = np.stack([layout.laser_maps() for layout in plan.layouts], axis=1)
    for axis, both in zip("xyz", lasers, strict=True):
        add(f"laser_gain.{axis}", 0.01 * plan.gain_sd_percent, both)
        add(f"laser_phase.{axis}", float(np.radians(plan.phase_sd_deg)), 1j * both)
        add(f"laser_delay.{axis}", 1e-6 * plan.delay_sd_us, -both, 1)
    return names, sds, np.array(maps).reshape(-1, 2, 6, 6), powers


def _base_motion(plan: Plan, freq: Array, direction: str) -> ComplexArray:
    """Return the base motion (lines, 6): constant velocity along the driven direction, some in the others."""
    motion = np.empty((len(freq), 6), dtype=complex)
    for place, name in enumerate(DOF_NAMES):
        share: Any = (
            1.0 if name == direction else plan.rocking * np.exp(1j * (1.0 + place) * freq / _PHASE_HZ)
        )
        arm = _ROCKING_RADIUS_M if place > 2 else 1.0
        motion[:, place] = plan.base_velocity_m_s / (2.0 * np.pi * freq) * share / arm
    return motion


def expect(plan: Plan, mass: MassSource | None = None) -> tuple[Way, ...]:
    """Return what the plan, and the plan with one change each, would state: the plan first.

    Raises
    ------
    StapeskitError
        Mass, stiffness and degrees of freedom do not fit together, or the lines are too few.
    """
    source = mass or stated_mass(plan)
    options = KDOptions.of(dof=plan.dof, unknowns="none")
    ways = []
    for name, changed in _ways(plan, mass):
        own = (
            source
            if mass is not None and changed.mass_sd_percent == plan.mass_sd_percent
            else stated_mass(changed)
        )
        matrix = matrix_from_parameters(own.mass.parameters)  # type: ignore[union-attr]
        ways.append(Way(name, fit_of(planned_motion(changed, matrix), own, options, {})))
    return tuple(ways)


def _ways(plan: Plan, mass: MassSource | None) -> list[tuple[str, Plan]]:
    """Return the plan and its improvements, one change each."""
    low, high = plan.band_hz
    lines = round((2.0 * high - low) / (high - low) * max(plan.lines - 1, 1)) + 1
    quiet = (
        {"noise_m_s": plan.noise_m_s / 2.0}
        if plan.noise_m_s
        else {"noise_relative": plan.noise_relative / 2.0}
    )
    halved = {
        "points known twice as well": ("position_sd_mm",),
        "registration twice as good": ("registration_sd_mm", "registration_sd_deg"),
        "lasers calibrated twice as well": ("gain_sd_percent", "phase_sd_deg", "delay_sd_us"),
        "density known twice as well": () if mass is not None and mass.record else ("mass_sd_percent",),
    }
    changes: dict[str, dict[str, Any]] = {"as planned": {}}
    more = next((name for name in ("x", "z", "alpha", "gamma", "y") if name not in plan.directions), None)
    if more:
        changes[f"one more run, driven along {more}"] = {"directions": (*plan.directions, more)}
    changes[f"band up to {2.0 * high:g} Hz"] = {"band_hz": (low, 2.0 * high), "lines": lines}
    changes["half the noise (4 times the averages)"] = quiet
    for words, keys in halved.items():
        halves = {key: getattr(plan, key) / 2.0 for key in keys if getattr(plan, key)}
        if halves:
            changes[words] = halves
    return [(name, replace(plan, **change)) for name, change in changes.items()]


def plan_json(plan: Plan, ways: tuple[Way, ...], provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return an expectation as JSON-able data, SI."""
    fit = ways[0].fit
    stiffness_sd, damping_sd = fit.standard_deviation
    noise, derived = fit.noise_standard_deviation, fit.derived
    content = {
        "schema": "stapeskit.plan/1",
        "dof": list(plan.dof),
        "about": "footplate_centre",
        "axes": "footplate",
        "runs": list(plan.directions),
        "band_hz": list(plan.band_hz),
        "lines": plan.lines,
        "stiffness_si": fit.stiffness,
        "expected_stiffness_sd_si": stiffness_sd,
        "damping_si": fit.damping,
        "expected_damping_sd_si": damping_sd,
        "noise_only_sd_si": {"stiffness": noise[0], "damping": noise[1]},
        "budget": {
            source: dict(zip(fit.parameters, np.sqrt(np.maximum(np.diag(part), 0.0)).tolist(), strict=True))
            for source, part in fit.budget.items()
        },
        "modes": [
            {
                "frequency_hz": mode.frequency_hz,
                "expected_frequency_sd_hz": derived.frequency_sd_hz[place],
                "damping_ratio": mode.damping_ratio,
                "expected_damping_ratio_sd": derived.ratio_sd[place],
            }
            for place, mode in enumerate(fit.modes.pairs)
        ],
        "relative_to": "sqrt(Xii Xjj) for entry (i, j) of X = K or D",
        "options": [
            {
                "name": way.name,
                "entries_over_10_percent": list(way.weak),
                "relative_sd": dict(zip(fit.parameters, way.relative.tolist(), strict=True)),
            }
            for way in ways
        ],
        "warnings": [],
        "provenance": dict(provenance),
    }
    plain: dict[str, Any] = as_json(content)
    return plain


def plan_rows(ways: tuple[Way, ...]) -> list[tuple[str, str]]:
    """Return the rows of the command's table."""
    fit, rows = ways[0].fit, list[tuple[str, str]]()
    for letter, values, sds in zip("KD", (fit.stiffness, fit.damping), fit.standard_deviation, strict=True):
        for place, name in enumerate(fit.dof):
            unit = diagonal_unit(letter, name, fit.law.time_power)
            rows.append(
                (f"{letter}({name})", unit.with_sd(float(values[place, place]), float(sds[place, place])))
            )
    for number, (mode, sd) in enumerate(zip(fit.modes.pairs, fit.derived.frequency_sd_hz, strict=True), 1):
        rows.append((f"mode {number}", f"{plus_minus(mode.frequency_hz, float(sd))} Hz, damped"))
    for way in ways:
        worst = int(np.argmax(way.relative))
        text = f"worst entry {fit.parameters[worst]} {100.0 * way.relative[worst]:.2g} %"
        rows.append((way.name, f"{text}; {len(way.weak)} of {len(fit.parameters)} entries over 10 %"))
    return rows
