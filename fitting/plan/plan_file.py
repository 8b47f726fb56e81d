"""The file plan.toml: read into a Plan, every fault in one sentence."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from fitting.errors import FittingError
from fitting.examples.paper import PAPER_DAMPING_CORRECTED, PAPER_DOF, PAPER_MASS, PAPER_STIFFNESS
from fitting.model.damping import VISCOUS, DampingLaw
from fitting.model.inertia import check_mass
from fitting.model.laws import LAWS, law_of
from fitting.model.mass_file import read_mass
from fitting.model.model import passive
from fitting.plan.plan import Plan
from fitting.plan.planned_errors import PlannedErrors
from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError, raise_all
from stapeskit.json_toml import is_finite_number, parse_toml
from stapeskit.spatial import DOF_NAMES

_ERROR_KEYS = tuple(error.name for error in fields(PlannedErrors))
KEYS = (
    "dof",
    "mass",
    "stiffness",
    "damping",
    "damping_law",
    "structure_points_mm",
    "base_points_mm",
    "noise_m_s",
    "noise_relative",
    "base_velocity_m_s",
    "rocking",
    "band_hz",
    "lines",
    "directions",
    *_ERROR_KEYS,
)


def read_plan(path: Path) -> tuple[Plan, Path | None]:
    """Read a plan; every key has a default.

    Returns
    -------
    plan : Plan
    mass_file : Path or None
        The mass file that it names.

    Raises
    ------
    FittingError
        The file is missing or no TOML, a key is unknown, or a value is not what its key needs.
    """
    path = Path(path)
    if not path.is_file():
        raise FittingError.of(
            "{plan}", "an existing TOML file", path, next_step="dof2kd --help shows an example"
        )
    try:
        table = parse_toml(path.read_text(encoding="utf-8"))
    except ValueError as fault:
        raise FittingError.of("{plan}", "valid TOML", fault, path.name) from fault
    return _plan(table, path)


class _Faults:
    """Gathers the faults of the parts of a file."""

    def __init__(self) -> None:
        self.found: list[Fault] = []

    def of(self, read: Callable[..., Any], *given: Any) -> Any:
        """Return what a part reads, or None and keep its faults."""
        try:
            return read(*given)
        except StapeskitError as fault:
            self.found += fault.faults
            return None


def _plan(table: Mapping[str, Any], path: Path) -> tuple[Plan, Path | None]:
    where, faults = path.name, _Faults()
    faults.found += _key_faults(table, where)
    dof = faults.of(_dof, table, where)
    directions = faults.of(_directions, table, dof, where)
    mass: Any = None
    stiffness: Any = None
    damping: Any = None
    if dof is not None:
        mass = faults.of(_mass, table, dof, path)
        stiffness = faults.of(_expected, table, "stiffness", dof, np.array(PAPER_STIFFNESS), where)
        damping = faults.of(_expected, table, "damping", dof, np.array(PAPER_DAMPING_CORRECTED), where)
    band = faults.of(_band, table, where)
    faults.found += _value_faults(table, where)
    default = Plan()
    structure = faults.of(_points, table, "structure_points_mm", default.structure_mm, where)
    base = faults.of(_points, table, "base_points_mm", default.base_mm, where)
    for key, points in (("structure_points_mm", structure), ("base_points_mm", base)):
        if points is not None and dof is not None:
            faults.of(_check_layout, key, points, dof, where)
    raise_all(FittingError, faults.found)
    noise = table.get("noise_m_s")
    plan = Plan(
        dof,
        mass[0],
        stiffness,
        damping,
        structure,
        base,
        None if noise is None else float(noise),
        float(table.get("noise_relative", default.noise_relative)),
        float(table.get("base_velocity_m_s", default.base_velocity_m_s)),
        float(table.get("rocking", default.rocking)),
        band[0],
        band[1],
        table.get("lines", 200),
        directions,
        DampingLaw(table.get("damping_law", VISCOUS.name)),
        PlannedErrors(**{key: float(table[key]) for key in _ERROR_KEYS if key in table}),
    )
    return plan, mass[1]


def _key_faults(table: Mapping[str, Any], where: str) -> list[Fault]:
    """Return a fault for every unknown key."""
    faults = []
    for key in table:
        if key not in KEYS:
            near = difflib.get_close_matches(key, KEYS, 1)
            hint = f"Did you mean {near[0]}" if near else f"Known keys are {', '.join(KEYS)}"
            faults.append(Fault("a key of the plan", "a known one", key, where, hint))
    return faults


def _value_faults(table: Mapping[str, Any], where: str) -> list[Fault]:
    """Return a fault for every value of a wrong type or size."""
    faults = []
    law = table.get("damping_law", VISCOUS.name)
    known = [name for name in LAWS if law_of(name).search is None]
    if law not in known:
        faults.append(Fault("damping_law", " or ".join(known), law, where))
    lines = table.get("lines", 200)
    if not isinstance(lines, int) or isinstance(lines, bool) or not 2 <= lines <= 100_000:
        faults.append(Fault("lines", "a whole number from 2 to 100000", lines, where))
    if "noise_m_s" in table and "noise_relative" in table:
        faults.append(Fault("the noise", "given as noise_m_s or as noise_relative", "both", where))
    if "mass_sd_percent" in table and str(table.get("mass", "")).lower().endswith(".json"):
        wanted = "left out when a mass.json is given, which has its own"
        faults.append(Fault("mass_sd_percent", wanted, table["mass_sd_percent"], where))
    for key in ("noise_m_s", "noise_relative", "base_velocity_m_s", "rocking", *_ERROR_KEYS):
        value, zero = table.get(key, 1.0), key == "rocking" or key in _ERROR_KEYS
        number = is_finite_number(value)
        if not number or value < 0.0 or (value == 0.0 and not zero):
            wanted = "a number, zero or positive" if zero else "a positive number"
            faults.append(Fault(key, wanted, value, where))
    return faults


def _list(table: Mapping[str, Any], key: str, default: tuple[str, ...], where: str) -> list[str]:
    """Return a list of names, or one comma list."""
    raw = table.get(key, list(default))
    if isinstance(raw, str):
        raw = raw.split(",")
    if not isinstance(raw, list) or not raw or not all(isinstance(name, str) for name in raw):
        raise FittingError.of(key, 'names of degrees of freedom, e.g. ["y", "alpha"]', raw, where)
    return [name.strip().lower() for name in raw]


def _dof(table: Mapping[str, Any], where: str) -> tuple[str, ...]:
    raw = _list(table, "dof", PAPER_DOF, where)
    known = tuple(name for name in DOF_NAMES if name in raw)
    if list(known) != raw:
        hint = ", ".join(f'"{name}"' for name in known or PAPER_DOF)
        wanted = f"different names in the order {', '.join(DOF_NAMES)}"
        step = f"Write dof = [{hint}] and order the matrices so"
        raise FittingError.of("dof", wanted, ", ".join(raw), where, step)
    return known


def _directions(table: Mapping[str, Any], dof: tuple[str, ...] | None, where: str) -> tuple[str, ...]:
    names = _list(table, "directions", ("y",), where)
    allowed = DOF_NAMES if dof is None else dof
    if len(set(names)) != len(names) or not set(names) <= set(allowed):
        wanted = f"different names out of the plan's dof, {', '.join(allowed)}"
        step = 'Write for example directions = ["y"], one for each run'
        raise FittingError.of("directions", wanted, ", ".join(names), where, step)
    return tuple(names)


def _mass(table: Mapping[str, Any], dof: tuple[str, ...], path: Path) -> tuple[Any, Path | None]:
    raw = table.get("mass")
    if isinstance(raw, str):
        file = path.parent / raw
        return read_mass(file, dof)[0], file
    if raw is None:
        if dof != PAPER_DOF:
            raise FittingError.of(
                "mass",
                f"given when dof is not {', '.join(PAPER_DOF)}",
                "nothing",
                path.name,
                'Write mass = "mass.json" or a matrix',
            )
        return np.array(PAPER_MASS), None
    matrix = _matrix(raw, "mass", len(dof), path.name)
    check_mass(matrix, path.name)
    return matrix, None


def _matrix(raw: Any, key: str, n: int, where: str) -> Array:
    try:
        matrix = np.array(raw, dtype=float)
    except (TypeError, ValueError, OverflowError):
        matrix = np.empty(0)
    if matrix.shape != (n, n) or not np.all(np.isfinite(matrix)):
        raise FittingError.of(key, f"a {n} x {n} matrix in SI, in the order of dof", raw, where)
    return matrix


def _expected(table: Mapping[str, Any], key: str, dof: tuple[str, ...], default: Array, where: str) -> Array:
    raw = table.get(key)
    if raw is None and dof != PAPER_DOF:
        wanted = f"given when dof is not {', '.join(PAPER_DOF)}"
        step = f"Write {key} = [[...], ...], {len(dof)} x {len(dof)} in SI"
        raise FittingError.of(key, wanted, "nothing", where, step)
    matrix = default if raw is None else _matrix(raw, key, len(dof), where)
    root = np.sqrt(np.abs(np.diag(matrix)))
    symmetric = np.all(np.abs(matrix - matrix.T) <= 1e-6 * np.outer(root, root) + 1e-300)
    if not symmetric or not passive(matrix) or np.any(root == 0.0):
        raise FittingError.of(key, "symmetric and positive (semi)definite", raw, where)
    return matrix


def _band(table: Mapping[str, Any], where: str) -> tuple[float, float]:
    raw = table.get("band_hz", [400.0, 5000.0])
    good = isinstance(raw, list) and len(raw) == 2 and all(map(is_finite_number, raw))
    if not good or not 0.0 < raw[0] < raw[1]:
        raise FittingError.of("band_hz", "two frequencies in Hz, low before high", raw, where)
    return float(raw[0]), float(raw[1])


def _points(table: Mapping[str, Any], key: str, default: Array, where: str) -> Array:
    if key not in table:
        return default
    try:
        points = np.array(table[key], dtype=float)
    except (TypeError, ValueError, OverflowError):
        points = np.empty(0)
    if points.ndim != 2 or points.shape[1] != 3 or not np.all(np.isfinite(points)):
        raise FittingError.of(key, "a list of points [x, y, z] in mm, footplate axes", table[key], where)
    return points


def _check_layout(key: str, points: Array, dof: tuple[str, ...], where: str) -> None:
    """Refuse points that cannot tell the degrees of freedom apart."""
    from fitting.examples.experiment import Layout

    if not Layout(points).determines(dof):
        raise FittingError.of(
            key,
            f"enough points, well apart, for {', '.join(dof)}",
            f"{len(points)} that leave a motion unseen",
            where,
            "Add points off the line through the others",
        )
