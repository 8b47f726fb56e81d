"""The keys of plan.toml, each declared once: its reader, the help and the example follow."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from legacy.fitting.errors import FittingError
from legacy.fitting.model.laws import LAWS, law_of
from legacy.fitting.plan.planned_errors import PlannedErrors
from legacy.stapeskit.option_declaration import Option, option
from legacy.stapeskit.option_docs import example_of
from legacy.stapeskit.option_kinds import DOF, NAMES, RANGE, Kind, choice, number, whole
from legacy.stapeskit.option_values import read_path, require, toml
from legacy.stapeskit.options import OptionTable, declared

Rows = tuple[tuple[float, ...], ...]
_POSITIVE = number("a positive number", lambda value: value > 0.0)
# Letters a line of the example, and in front of its comments.
_WIDTH, _BEFORE = 80, 33


def _rows(value: Any) -> Rows:
    """Read a table of finite numbers."""
    try:
        table = np.array(value, dtype=float)
    except OverflowError as fault:
        raise ValueError from fault
    require(table.ndim == 2 and bool(np.all(np.isfinite(table))))
    return tuple(map(tuple, table.tolist()))


def _points(value: Any) -> Rows:
    rows = _rows(value)
    require(all(len(row) == 3 for row in rows))
    return rows


def _mass(value: Any) -> Path | Rows:
    return read_path(value) if isinstance(value, str | Path) else _rows(value)


_DIRECTIONS = replace(NAMES, read=lambda value: tuple(name.lower() for name in NAMES.read(value)))
_IN_ROWS = "Write rows in brackets, [[1, 2], [3, 4]]"
_MATRIX = Kind("a matrix in SI, in the order of dof", "MATRIX", _rows, advise=lambda _: _IN_ROWS)
_MASS = Kind("a mass.json, or a matrix in SI, in the order of dof", "MASS", _mass, advise=lambda _: _IN_ROWS)
_POINTS = Kind(
    "a list of points [x, y, z] in mm, footplate axes", "POINTS", _points, advise=lambda _: _IN_ROWS
)


@dataclass(frozen=True)
class PlanKeys(OptionTable):
    """What is measured and expected; a key that is not given has the value of `fitting.plan.plan.Plan`."""

    title = "plan"
    error = FittingError

    dof: tuple[str, ...] | None = option(DOF, "", example=["y", "alpha", "gamma"], recommended=True)
    directions: tuple[str, ...] | None = option(
        _DIRECTIONS, "driven by the shaker, one run each", example=["y"], recommended=True
    )
    band_hz: tuple[float, float] | None = option(RANGE, "", example=[400, 5000], recommended=True)
    lines: int | None = option(
        whole("a whole number from 2 to 100000", lambda value: 2 <= value <= 100_000),
        "of one run",
        example=200,
        recommended=True,
    )
    noise_m_s: float | None = option(
        _POSITIVE, "sd of Re and Im; or: noise_relative = 0.05", example=2e-6, recommended=True
    )
    noise_relative: float | None = option(_POSITIVE, "", example=0.05)
    base_velocity_m_s: float | None = option(
        _POSITIVE, "along the driven direction", example=6e-4, recommended=True
    )
    rocking: float | None = option(
        number("a number, zero or positive", lambda value: value >= 0.0),
        "of the base in the others, at 1 mm",
        example=0.05,
        recommended=True,
    )
    damping_law: str | None = option(
        choice(*(name for name in LAWS if law_of(name).search is None)), "", example="viscous"
    )
    mass: Path | Rows | None = option(
        _MASS, "or a matrix, SI, order of dof (the paper's)", example="mass.json"
    )
    stiffness: Rows | None = option(
        _MATRIX,
        "",
        example=[[1722, 0.414, -0.48], [0.414, 1.37e-3, -6.41e-5], [-0.48, -6.41e-5, 3.79e-3]],
    )
    damping: Rows | None = option(
        _MATRIX,
        "",
        example=[
            [22.89e-3, 6.142e-6, -3.679e-6], [6.142e-6, 3.015e-8, -6.756e-12],
            [-3.679e-6, -6.756e-12, 5.646e-8],
        ],
    )  # fmt: skip
    structure_points_mm: Rows | None = option(
        _POINTS, "", example=[[1.2, 0.15, 0], [-1.2, 0.15, 0], [0.5, 0.15, 0.5], [0.1, 3.2, 0.2]]
    )
    base_points_mm: Rows | None = option(
        _POINTS, "", example=[[2.5, 0.3, 0], [-2.5, 0.3, 0], [0, 0.3, 2], [0, 0.3, -2]]
    )


KEYS: dict[str, Option] = {
    entry.key: entry for table in (PlanKeys, PlannedErrors) for entry in declared(table)
}


def _plan_example() -> str:
    usual = [entry for entry in KEYS.values() if entry.recommended or entry.default is not None]
    others = [entry for entry in KEYS.values() if entry not in usual and entry.key != "noise_relative"]
    return "".join(f"{line}\n" for entry in (*usual, *others) for line in _example(entry, entry in usual))


def _example(entry: Option, usual: bool) -> list[str]:
    mark = "" if usual else "# "
    text = wrap(f"{entry.key} = {toml(example_of(entry))}", _WIDTH - 6, break_on_hyphens=False)
    first, *more = [mark + line for line in text]
    return [f"{first:<{_BEFORE - 1}} # {entry.help}" if entry.help else first, *more]


PLAN_EXAMPLE = _plan_example()
"""A plan that runs as it stands, for the help; further keys are comments."""
