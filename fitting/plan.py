"""Before a measurement: the standard deviations to expect, and what would make them smaller.

The planned experiment is simulated in six degrees of freedom without noise and fitted by the engine that will
fit the real one; what that fit states is what the plan promises.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np

from fitting.dof2kd import fit_of
from fitting.mass import Inertia, inertia_of
from fitting.options import KDOptions
from fitting.plane import PISTON_DOF
from fitting.planned_motion import BASE_POINTS_MM, STAPES_POINTS_MM, Layout, cone_beams, planned_motion
from fitting.report.kd_json import RELATIVE
from fitting.result import KDFit
from stapeskit.arrays import Array
from stapeskit.option_types import Count, DofList, Kind, Positive, Range, number, path
from stapeskit.options import Opt, Options, read_toml
from stapeskit.records.mass_matrix import MassMatrix
from stapeskit.spatial import DOF_NAMES

PAPER_STIFFNESS = ((1722.0, 0.414, -0.48), (0.414, 1.37e-3, -6.41e-5), (-0.48, -6.41e-5, 3.79e-3))
PAPER_DAMPING = (
    (2.289e-2, 6.142e-6, -3.679e-6),
    (6.142e-6, 3.015e-8, -6.756e-12),
    (-3.679e-6, -6.756e-12, 5.646e-8),
)
"""K and D of the study of CURAC 2019 (p. 98), D with its exponents corrected; y, alpha, gamma, SI."""

_STAPES = (3.2e-6, 1.43e-10, 4.16e-9, 4.349e-10, 9.77e-12, 2.2e-12, 1.07e-11, -3.0e-13, 8.0e-14, -3.0e-14)
# Ten inertial parameters of a human stapes whose centre of mass is 1.3 mm above the footplate.
_WEAK = 0.1  # relative sd of an entry that a plan leaves weak


def _rows(good: Callable[[Array], bool], wanted: str, name: str) -> Kind:
    """Return the kind of a table of numbers that must be good."""

    def read(value: Any) -> Array:
        table = np.array(value, dtype=float)
        if table.ndim != 2 or not np.all(np.isfinite(table)) or not good(table):
            raise ValueError
        return table

    return Kind(read, wanted, name, "Write rows in brackets, [[1, 2], [3, 4]]")


def _is_stiffness(matrix: Array) -> bool:
    """Return whether a matrix whose entries have different units is symmetric and positive definite."""
    diagonal = np.diag(matrix)
    if matrix.shape != (3, 3) or np.any(diagonal <= 0.0):
        return False
    scaled = matrix / np.sqrt(np.outer(diagonal, diagonal))
    return np.allclose(scaled, scaled.T, atol=1e-6) and bool(np.linalg.eigvalsh(scaled)[0] > 1e-9)


_MATRIX = "a symmetric, positive definite 3 x 3 matrix in SI: y, alpha, gamma"
_POINTS = "three or more points [x, y, z] in mm, footplate axes, not on one line"
Matrix = Annotated[Any, _rows(_is_stiffness, _MATRIX, "MATRIX")]
Points = Annotated[Any, _rows(lambda table: Layout(table).determines, _POINTS, "POINTS")]
Mass = Annotated[
    Path, Kind(path, "the name of a mass.json, or of an M.csv of all degrees of freedom", "FILE")
]
Sd = Annotated[float, Kind(number, "a number, 0 or positive", "NUMBER", where=lambda found: found >= 0.0)]
Cone = Annotated[
    float, Kind(number, "degrees between 1 and 60", "DEG", where=lambda found: 1.0 <= found <= 60.0)
]


class Plan(Options):
    """A measurement that has not been made: the keys of plan.toml."""

    table: ClassVar[str] = "plan"

    dof: Annotated[DofList, Opt("degrees of freedom of the fit")] = PISTON_DOF
    directions: Annotated[DofList, Opt("driven by the shaker, one run each")] = ("y",)
    band_hz: Annotated[Range, Opt("first and last line")] = (400.0, 5000.0)
    lines: Annotated[Count, Opt("of one run")] = 200
    noise_m_s: Annotated[Positive, Opt("sd of Re and Im of a reading")] = 2e-5
    base_velocity_m_s: Annotated[Positive, Opt("along the driven direction")] = 6e-4
    rocking: Annotated[Sd, Opt("of the base in the other directions, rotations at 1 mm")] = 0.05
    mass: Annotated[Mass | None, Opt("mass.json or M.csv", example="mass.json")] = None
    stiffness: Annotated[Matrix, Opt("expected K")] = PAPER_STIFFNESS
    damping: Annotated[Matrix, Opt("expected D, viscous")] = PAPER_DAMPING
    structure_points_mm: Annotated[Points, Opt("points on the stapes")] = STAPES_POINTS_MM
    base_points_mm: Annotated[Points, Opt("points on the bone")] = BASE_POINTS_MM
    cone_deg: Annotated[Cone, Opt("between each laser beam and the y axis")] = 20.0
    position_sd_mm: Annotated[Sd, Opt("of each coordinate of a point")] = 0.03
    registration_sd_mm: Annotated[Sd, Opt("of the footplate centre in the vibrometer")] = 0.02
    registration_sd_deg: Annotated[Sd, Opt("of the footplate axes in it")] = 0.1
    gain_sd_percent: Annotated[Sd, Opt("of each laser")] = 1.0
    phase_sd_deg: Annotated[Sd, Opt("of each laser")] = 0.5
    delay_sd_us: Annotated[Sd, Opt("of each laser")] = 1.0
    mass_sd_percent: Annotated[Sd, Opt("of the density; unused with a mass.json")] = 3.0

    @property
    def layouts(self) -> tuple[Layout, Layout]:
        """Points of structure and base."""
        beams = cone_beams(self.cone_deg)
        structure, base = np.array(self.structure_points_mm), np.array(self.base_points_mm)
        return Layout(structure, beams), Layout(base, beams)


def read_plan(path: Path) -> tuple[Plan, Inertia | None]:
    """Read a plan.toml, and the mass that it names.

    Raises
    ------
    StapeskitError
        A key is unknown, a value is at fault, or the points do not determine the motion.
    """
    keys = {entry.key: entry.key for entry in Plan.entries()}
    plan = Plan.read(read_toml(path), path.name, keys, path.parent)
    if plan.mass is None:
        return plan, None
    return plan, inertia_of(path.parent / plan.mass, DOF_NAMES)


def stated_mass(plan: Plan) -> Inertia:
    """Return the mass of a human stapes with the stated error of its density."""
    parameters = np.array(_STAPES)
    density = {"density": (0.01 * plan.mass_sd_percent) ** 2 * np.outer(parameters, parameters)}
    mass = MassMatrix(parameters, contributions=density if plan.mass_sd_percent else {})
    return inertia_of(mass, DOF_NAMES)


def expect(plan: Plan, mass: Inertia | None = None) -> dict[str, KDFit]:
    """Return what the plan, and the plan with one change each, would state: ``as planned`` first.

    The mass is that of a file, or that which the plan states.

    Raises
    ------
    StapeskitError
        Mass, stiffness and degrees of freedom do not fit together, or the lines are too few.
    """
    options = KDOptions.of(dof=plan.dof, unknowns="none")
    fits = {}
    for name, changed in _ways(plan, mass).items():
        inertia = mass or stated_mass(changed)
        fits[name] = fit_of(planned_motion(changed, inertia.matrix), inertia, options, {})
    return fits


def _ways(plan: Plan, mass: Inertia | None) -> dict[str, Plan]:
    """Return the plan and its improvements, one change each."""
    low, high = plan.band_hz
    lines = round((2.0 * high - low) / (high - low) * max(plan.lines - 1, 1)) + 1
    ways = {"as planned": plan}
    more = next((name for name in ("x", "z", "alpha", "gamma", "y") if name not in plan.directions), None)
    if more:
        ways[f"one more run, driven along {more}"] = replace(plan, directions=(*plan.directions, more))
    ways[f"band up to {2.0 * high:g} Hz"] = replace(plan, band_hz=(low, 2.0 * high), lines=lines)
    for words, keys in (
        ("half the noise (4 times the averages)", ("noise_m_s",)),
        ("points known twice as well", ("position_sd_mm",)),
        ("registration twice as good", ("registration_sd_mm", "registration_sd_deg")),
        ("lasers calibrated twice as well", ("gain_sd_percent", "phase_sd_deg", "delay_sd_us")),
        ("density known twice as well", () if mass else ("mass_sd_percent",)),
    ):
        if any(getattr(plan, key) for key in keys):
            ways[words] = replace(plan, **{key: getattr(plan, key) / 2.0 for key in keys})
    return ways


def weak_entries(fit: KDFit) -> tuple[str, ...]:
    """Return the entries with an expected sd over 10 % of sqrt(Xii Xjj)."""
    named = zip(fit.parameters, fit.relative_sd, strict=True)
    return tuple(name for name, value in named if value > _WEAK)


def plan_json(plan: Plan, fits: Mapping[str, KDFit], provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return an expectation as JSON-able data, SI: what the fit would state under the names of kd.json."""
    fitted = next(iter(fits.values())).content()
    same = ("dof", "about", "axes", "stiffness_si", "damping_si", "noise_only_sd_si", "budget")
    expected = ("stiffness_sd_si", "damping_sd_si")
    of_modes = ("frequency_hz", "frequency_sd_hz", "damping_ratio", "damping_ratio_sd")
    return {
        "schema": "stapeskit.plan/1",
        "runs": list(plan.directions),
        "band_hz": list(plan.band_hz),
        "lines": plan.lines,
        **{key: fitted[key] for key in same},
        **{f"expected_{key}": fitted[key] for key in expected},
        "modes": [
            {f"expected_{key}" if "sd" in key else key: mode[key] for key in of_modes}
            for mode in fitted["modes"]
        ],
        "relative_to": RELATIVE,
        "options": [
            {
                "name": name,
                "entries_over_10_percent": list(weak_entries(fit)),
                "relative_sd": dict(zip(fit.parameters, fit.relative_sd.tolist(), strict=True)),
            }
            for name, fit in fits.items()
        ],
        "warnings": [],
        "provenance": dict(provenance),
    }


def plan_rows(fits: Mapping[str, KDFit]) -> list[tuple[str, str]]:
    """Return the rows of the command: K, D, modes, what limits them, and what each change would bring."""
    planned = next(iter(fits.values()))
    rows = [row for row in planned.summary() if row[0].startswith(("K(", "D(", "mode "))]
    for name, fit in fits.items():
        worst = int(np.argmax(fit.relative_sd))
        shares = {source: part[worst, worst] for source, part in fit.budget.items()}
        source = max(shares, key=shares.__getitem__)
        text = f"worst entry {fit.parameters[worst]} {100.0 * fit.relative_sd[worst]:.2g} %"
        over = f"{len(weak_entries(fit))} of {len(fit.parameters)} entries over 10 %"
        rows.append((name, f"{text}, most of it by {source.replace('_', ' ')}; {over}"))
    return rows
