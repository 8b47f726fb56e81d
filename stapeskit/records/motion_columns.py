"""The columns of dof.csv: q, its standard deviations, and one number per row for each entry of a table.

A new column is one entry of `ROW_COLUMNS`. Where its values are not computed from other fields, it also needs
a field of that name in `RigidMotion`, which both dof.csv and dof.h5 then keep.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stapeskit.records.motion import RigidMotion
from stapeskit.spatial import DOF_NAMES, DOF_UNITS

Array = NDArray[np.float64]
# Above it a double is no exact count.
LARGEST_COUNT = 1e15
_PER_REFERENCE = "_per_ref"


@dataclass(frozen=True)
class RowColumn:
    """A column of dof.csv with one number per row.

    Attributes
    ----------
    name : str
    values : callable
        Take a RigidMotion and return the numbers, (run, body, freq).
    stored : bool
        Whether the numbers are a field of RigidMotion; if not, a reader skips the column.
    whole : bool
        Whether the numbers are counts.
    missing : float
        Value of an empty cell.
    """

    name: str
    values: Callable[[RigidMotion], NDArray[Any]]
    stored: bool = False
    whole: bool = False
    missing: float = float("nan")

    @property
    def form(self) -> str:
        """How a number is written: all digits of a count, 9 digits otherwise."""
        return "%d" if self.whole else "%.9g"

    @property
    def expected(self) -> str:
        """What a cell must hold, for messages."""
        return "a count" if self.whole else f"from 0 to {LARGEST_COUNT:g}"

    def is_wrong(self, values: Array) -> NDArray[np.bool_]:
        """Return which cells (rows,) hold an impossible number; empty ones do not."""
        wrong = (values < 0.0) | (values > LARGEST_COUNT)
        return wrong | (np.isfinite(values) & (values != np.round(values))) if self.whole else wrong

    def filled(self, values: Array) -> NDArray[Any]:
        """Return cells (rows,) with the value of missing ones."""
        full = np.where(np.isnan(values), self.missing, values)
        return full.astype(int) if self.whole else full


ROW_COLUMNS = (
    RowColumn("chi2", attrgetter("chi2"), stored=True),
    RowColumn("n_dof", attrgetter("n_dof"), stored=True, whole=True, missing=0.0),
)
STORED = tuple(column for column in ROW_COLUMNS if column.stored)


@dataclass(frozen=True)
class MotionColumns:
    """The names of the columns for some degrees of freedom.

    Attributes
    ----------
    dof : tuple of str
    per_reference : bool
        Whether q is per unit of a reference motion.
    """

    dof: tuple[str, ...]
    per_reference: bool

    def _of(self, part: str) -> list[str]:
        end = _PER_REFERENCE if self.per_reference else ""
        return [f"{name}_{part}_{DOF_UNITS[name]}{end}" for name in self.dof]

    @property
    def real(self) -> list[str]:
        """Real parts of q."""
        return self._of("re")

    @property
    def imaginary(self) -> list[str]:
        """Imaginary parts of q."""
        return self._of("im")

    @property
    def deviations(self) -> list[str]:
        """Standard deviations of both parts."""
        return self._of("sd")

    @property
    def needed(self) -> list[str]:
        """What every dof.csv has."""
        parts = [name for pair in zip(self.real, self.imaginary, strict=True) for name in pair]
        return ["body", "freq_hz", *parts, *self.deviations]

    @property
    def all(self) -> list[str]:
        """What points2dof writes, in its order."""
        return ["run", *self.needed, *(column.name for column in ROW_COLUMNS)]


def columns_of(header: Collection[str]) -> MotionColumns:
    """Return the columns that a file with some names of columns must have."""
    dof = tuple(name for name in DOF_NAMES if any(column.startswith(f"{name}_re_") for column in header))
    return MotionColumns(dof, any(column.endswith(_PER_REFERENCE) for column in header))
