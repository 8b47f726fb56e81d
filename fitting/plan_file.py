"""The file plan.toml: read into a Plan, every fault in one sentence."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.damping import LAWS, DampingLaw
from fitting.errors import FittingError
from fitting.inertia import check_mass
from fitting.mass_file import read_mass
from fitting.model import passive
from fitting.paper import PAPER_DAMPING_CORRECTED, PAPER_DOF, PAPER_MASS, PAPER_STIFFNESS
from fitting.plan import Plan
from kinematics.errors import StapeskitError, raise_all, sentence
from kinematics.spatial import parse_dof

Array = NDArray[np.float64]
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
        raise FittingError(
            sentence("--plan", "an existing TOML file", path, next_step="dof2kd --help shows an example")
        )
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as fault:
        raise FittingError(sentence("--plan", "valid TOML", fault, path.name)) from fault
    for key in table:
        if key not in KEYS:
            near = difflib.get_close_matches(key, KEYS, 1)
            hint = f"Did you mean {near[0]}" if near else f"Known keys are {', '.join(KEYS)}"
            raise FittingError(sentence("a key of the plan", "a known one", key, path.name, hint))
    return _plan(table, path)


def _plan(table: Mapping[str, Any], path: Path) -> tuple[Plan, Path | None]:
    where = path.name
    dof = _names(table, "dof", PAPER_DOF, where)
    directions = _names(table, "directions", ("y",), where)
    outside = [name for name in directions if name not in dof]
    if outside:
        raise FittingError(
            sentence("directions", f"out of the plan's dof, {', '.join(dof)}", ", ".join(outside), where)
        )
    mass, mass_file = _mass(table, dof, path)
    stiffness = _expected(table, "stiffness", dof, np.array(PAPER_STIFFNESS), where)
    damping = _expected(table, "damping", dof, np.array(PAPER_DAMPING_CORRECTED), where)
    low, high = _band(table, where)
    law = table.get("damping_law", "viscous")
    faults = []
    if law not in LAWS[:2]:
        faults.append(sentence("damping_law", "viscous or hysteretic", law, where))
    lines = table.get("lines", 200)
    if not isinstance(lines, int) or isinstance(lines, bool) or not 2 <= lines <= 100_000:
        faults.append(sentence("lines", "a whole number from 2 to 100000", lines, where))
    if "noise_m_s" in table and "noise_relative" in table:
        faults.append(sentence("the noise", "given as noise_m_s or as noise_relative", "both", where))
    for key, zero in (
        ("noise_m_s", False),
        ("noise_relative", False),
        ("base_velocity_m_s", False),
        ("rocking", True),
    ):
        value = table.get(key, 1.0)
        number = isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value)
        if not number or value < 0.0 or (value == 0.0 and not zero):
            wanted = "a number, zero or positive" if zero else "a positive number"
            faults.append(sentence(key, wanted, value, where))
    raise_all(FittingError, faults)
    default = Plan()
    noise = table.get("noise_m_s")
    plan = Plan(
        dof,
        mass,
        stiffness,
        damping,
        _points(table, "structure_points_mm", default.structure_mm, where),
        _points(table, "base_points_mm", default.base_mm, where),
        None if noise is None else float(noise),
        float(table.get("noise_relative", default.noise_relative)),
        float(table.get("base_velocity_m_s", default.base_velocity_m_s)),
        float(table.get("rocking", default.rocking)),
        low,
        high,
        lines,
        directions,
        DampingLaw(law),
    )
    _check_layout(plan, where)
    return plan, mass_file


def _names(table: Mapping[str, Any], key: str, default: tuple[str, ...], where: str) -> tuple[str, ...]:
    raw = table.get(key, list(default))
    if isinstance(raw, str):
        raw = raw.split(",")
    if not isinstance(raw, list) or not raw or not all(isinstance(name, str) for name in raw):
        raise FittingError(sentence(key, 'names of degrees of freedom, e.g. ["y", "alpha"]', raw, where))
    try:
        found = parse_dof(",".join(raw))
    except StapeskitError as fault:
        raise FittingError(f"{key} ({where}): {fault}") from fault
    if key == "dof" and list(found) != [name.strip().lower() for name in raw]:
        step = (
            f"Write dof = [{', '.join(f'{chr(34)}{name}{chr(34)}' for name in found)}] and order matrices so"
        )
        wanted = "in the order x, y, z, alpha, beta, gamma"
        raise FittingError(sentence("dof", wanted, ", ".join(raw), where, step))
    return found if key == "dof" else tuple(name.strip() for name in raw)


def _mass(table: Mapping[str, Any], dof: tuple[str, ...], path: Path) -> tuple[Any, Path | None]:
    raw = table.get("mass")
    if isinstance(raw, str):
        file = path.parent / raw
        return read_mass(file, dof)[0], file
    if raw is None:
        if dof != PAPER_DOF:
            raise FittingError(
                sentence(
                    "mass",
                    f"given when dof is not {', '.join(PAPER_DOF)}",
                    "nothing",
                    path.name,
                    'Write mass = "mass.json" or a matrix',
                )
            )
        return np.array(PAPER_MASS), None
    matrix = _matrix(raw, "mass", len(dof), path.name)
    check_mass(matrix, path.name)
    return matrix, None


def _matrix(raw: Any, key: str, n: int, where: str) -> Array:
    try:
        matrix = np.array(raw, dtype=float)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (n, n) or not np.all(np.isfinite(matrix)):
        raise FittingError(sentence(key, f"a {n} x {n} matrix in SI, in the order of dof", raw, where))
    return matrix


def _expected(table: Mapping[str, Any], key: str, dof: tuple[str, ...], default: Array, where: str) -> Array:
    raw = table.get(key)
    if raw is None and dof != PAPER_DOF:
        raise FittingError(sentence(key, f"given when dof is not {', '.join(PAPER_DOF)}", "nothing", where))
    matrix = default if raw is None else _matrix(raw, key, len(dof), where)
    root = np.sqrt(np.abs(np.diag(matrix)))
    symmetric = np.all(np.abs(matrix - matrix.T) <= 1e-6 * np.outer(root, root) + 1e-300)
    if not symmetric or not passive(matrix) or np.any(root == 0.0):
        raise FittingError(sentence(key, "symmetric and positive (semi)definite", raw, where))
    return matrix


def _band(table: Mapping[str, Any], where: str) -> tuple[float, float]:
    raw = table.get("band_hz", [400.0, 5000.0])
    good = isinstance(raw, list) and len(raw) == 2 and all(isinstance(one, int | float) for one in raw)
    if not good or not 0.0 < raw[0] < raw[1] < np.inf:
        raise FittingError(sentence("band_hz", "two frequencies in Hz, low before high", raw, where))
    return float(raw[0]), float(raw[1])


def _points(table: Mapping[str, Any], key: str, default: Array, where: str) -> Array:
    if key not in table:
        return default
    try:
        points = np.array(table[key], dtype=float)
    except (TypeError, ValueError):
        points = np.empty(0)
    if points.ndim != 2 or points.shape[1] != 3 or not np.all(np.isfinite(points)):
        raise FittingError(
            sentence(key, "a list of points [x, y, z] in mm, footplate axes", table[key], where)
        )
    return points


def _check_layout(plan: Plan, where: str) -> None:
    """Refuse points that cannot tell the degrees of freedom apart."""
    from fitting.experiment import Layout

    for key, points in (("structure_points_mm", plan.structure_mm), ("base_points_mm", plan.base_mm)):
        if not Layout(points).determines(plan.dof):
            raise FittingError(
                sentence(
                    key,
                    f"enough points, well apart, for {', '.join(plan.dof)}",
                    f"{len(points)} that leave a motion unseen",
                    where,
                    "Add points off the line through the others",
                )
            )
