"""The header of dof.csv: the names of its columns for the degrees of freedom that were chosen.

A column is an entry of ``motion.ROW_COLUMNS``.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from legacy.stapeskit.records.motion import ROW_COLUMNS
from legacy.stapeskit.spatial import DOF_NAMES, DOF_UNITS

_PER_REFERENCE = "_per_ref"


@dataclass(frozen=True)
class MotionColumns:
    """The names of the columns for some degrees of freedom.

    Attributes
    ----------
    per_reference : bool
        Whether q is per unit of a reference motion.
    """

    dof: tuple[str, ...]
    per_reference: bool

    def _column_names(self, part: str) -> list[str]:
        end = _PER_REFERENCE if self.per_reference else ""
        return [f"{name}_{part}_{DOF_UNITS[name]}{end}" for name in self.dof]

    @property
    def real(self) -> list[str]:
        """Real parts of q."""
        return self._column_names("re")

    @property
    def imaginary(self) -> list[str]:
        """Imaginary parts of q."""
        return self._column_names("im")

    @property
    def deviations(self) -> list[str]:
        """Standard deviations of both parts."""
        return self._column_names("sd")

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
