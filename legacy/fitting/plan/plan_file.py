"""The file plan.toml: read into a Plan, every fault in one sentence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from legacy.fitting.errors import FittingError
from legacy.fitting.examples.paper import PAPER_DOF
from legacy.fitting.model.damping import DampingLaw
from legacy.fitting.model.inertia import check_mass
from legacy.fitting.model.mass_file import read_mass
from legacy.fitting.model.model import passive
from legacy.fitting.model.point_layout import Layout
from legacy.fitting.plan.plan import Plan
from legacy.fitting.plan.plan_options import KEYS
from legacy.fitting.plan.planned_errors import PlannedErrors
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, collect_faults, raise_all
from legacy.stapeskit.json_toml import parse_toml
from legacy.stapeskit.option_names import suggestion
from legacy.stapeskit.option_values import toml
from legacy.stapeskit.spatial import DOF_NAMES


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


def _plan(table: Mapping[str, Any], path: Path) -> tuple[Plan, Path | None]:
    where, faults = path.name, list[Fault]()
    for key in (key for key in table if key not in KEYS):
        step = suggestion(key, KEYS) or f"Known keys are {', '.join(KEYS)}"
        faults.append(Fault("a key of the plan", "a known one", key, where, step))
    read = {key: KEYS[key].read(value, faults, key, where) for key, value in table.items() if key in KEYS}
    values = {key: value for key, value in read.items() if value is not None}
    unread = "dof" in table and "dof" not in values
    dof: tuple[str, ...] = values.get("dof", DOF_NAMES if unread else PAPER_DOF)
    faults += _contradictions(values, dof, where)
    chosen, mass_file = ({}, None) if unread else _body(values, dof, path, faults)
    raise_all(FittingError, faults)
    errors = {error.name: values[error.name] for error in fields(PlannedErrors) if error.name in values}
    names = ("lines", "noise_m_s", "noise_relative", "base_velocity_m_s", "rocking", "directions")
    chosen |= {name: values[name] for name in names if name in values}
    if "band_hz" in values:
        chosen["low_hz"], chosen["high_hz"] = values["band_hz"]
    if "damping_law" in values:
        chosen["law"] = DampingLaw(values["damping_law"])
    return Plan(**chosen, dof=tuple(dof), errors=PlannedErrors(**errors)), mass_file


def _contradictions(values: Mapping[str, Any], dof: tuple[str, ...], where: str) -> list[Fault]:
    """Return the faults of values that do not go together."""
    faults = []
    if getattr(dof, "reordered", False):
        step = f"Write dof = {toml(tuple(dof))} and order the matrices so"
        faults.append(Fault("dof", f"in the order {', '.join(DOF_NAMES)}", "another order", where, step))
    directions = values.get("directions", ("y",))
    if not directions or len(set(directions)) != len(directions) or not set(directions) <= set(dof):
        wanted = f"different names out of the plan's dof, {', '.join(dof)}"
        step = 'Write for example directions = ["y"], one for each run'
        faults.append(Fault("directions", wanted, ", ".join(directions) or "none", where, step))
    if min(values.get("band_hz", (1.0,))) <= 0.0:
        wanted, got = "two frequencies above 0 Hz, the lower first", list(values["band_hz"])
        faults.append(Fault("band_hz", wanted, got, where, "Write for example band_hz = [400, 5000]"))
    if "noise_m_s" in values and "noise_relative" in values:
        faults.append(Fault("the noise", "given as noise_m_s or as noise_relative", "both", where))
    mass = values.get("mass")
    if "mass_sd_percent" in values and isinstance(mass, Path) and mass.suffix.lower() == ".json":
        wanted = "left out when a mass.json is given, which has its own"
        faults.append(Fault("mass_sd_percent", wanted, values["mass_sd_percent"], where))
    return faults


def _body(
    values: Mapping[str, Any], dof: tuple[str, ...], path: Path, faults: list[Fault]
) -> tuple[dict[str, Any], Path | None]:
    """Return mass, expected K and D and points that are given, and the mass file; gather their faults."""
    chosen: dict[str, Any] = {}
    mass = values.get("mass")
    mass_file = path.parent / mass if isinstance(mass, Path) else None
    with collect_faults(faults):
        if mass_file is not None:
            chosen["mass"] = read_mass(mass_file, dof)[0]
        elif (matrix := _matrix(values, "mass", dof, path.name)) is not None:
            check_mass(matrix, path.name)
            chosen["mass"] = matrix
    for key in ("stiffness", "damping"):
        with collect_faults(faults):
            matrix = _matrix(values, key, dof, path.name)
            if matrix is not None:
                _check_passive(key, matrix, path.name)
                chosen[key] = matrix
    for key, field in (("structure_points_mm", "structure_mm"), ("base_points_mm", "base_mm")):
        points = np.array(values[key]) if key in values else getattr(Plan(), field)
        if not Layout(points).determines(dof):
            wanted = f"enough points, well apart, for {', '.join(dof)}"
            got = f"{len(points)} that leave a motion unseen"
            faults.append(Fault(key, wanted, got, path.name, "Add points off the line through the others"))
        chosen[field] = points
    return chosen, mass_file


def _matrix(values: Mapping[str, Any], key: str, dof: tuple[str, ...], where: str) -> Array | None:
    """Return the matrix of a key; None where that of the paper counts.

    Raises
    ------
    FittingError
        It is of another size, or missing where the degrees of freedom are not those of the paper.
    """
    n = len(dof)
    if key not in values:
        if dof == PAPER_DOF:
            return None
        step = f"Write {key} = [[...], ...], {n} x {n} in SI"
        raise FittingError.of(key, f"given when dof is not {', '.join(PAPER_DOF)}", "nothing", where, step)
    matrix = np.array(values[key])
    if matrix.shape != (n, n):
        got = f"{len(matrix)} x {matrix.shape[1]}"
        raise FittingError.of(key, f"a {n} x {n} matrix in SI, in the order of dof", got, where)
    return matrix


def _check_passive(key: str, matrix: Array, where: str) -> None:
    root = np.sqrt(np.abs(np.diag(matrix)))
    symmetric = np.all(np.abs(matrix - matrix.T) <= 1e-6 * np.outer(root, root) + 1e-300)
    if not symmetric or not passive(matrix) or np.any(root == 0.0):
        raise FittingError.of(key, "symmetric and positive (semi)definite", matrix.tolist(), where)
