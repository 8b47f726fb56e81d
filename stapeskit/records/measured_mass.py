"""A mass record with the surfaces of its scan, from the folder of a mass.json or straight from ct2mass."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array
from stapeskit.records.mass import read_mass_json
from stapeskit.records.mass_record import MassRecord

Mesh = tuple[Array, NDArray[np.int64]]
"""Vertices (n, 3) in scan coordinates, mm, and faces (m, 3)."""


@dataclass(frozen=True)
class MeasuredMass:
    """Mass, frames and surfaces of a stapes.

    Attributes
    ----------
    record : MassRecord
    file : Path or None
        The mass.json; surfaces are in its folder. None: everything is in memory.
    meshes : mapping of str to Mesh
        ``stapes`` and ``plate``, when they are in memory.
    source : mapping
        What the provenance of a result says about a mass in memory: an entry of its ``inputs``.
    """

    record: MassRecord
    file: Path | None = None
    meshes: Mapping[str, Mesh] = field(default_factory=dict, repr=False)
    source: Mapping[str, Any] = field(default_factory=dict, repr=False)

    @property
    def provenance_input(self) -> Path | Mapping[str, Any] | None:
        """What an input of `stapeskit.provenance.record` is: the file, or the source of a mass in memory."""
        return self.file or self.source or None


@runtime_checkable
class HasMass(Protocol):
    """A result that holds a mass record, as that of ct2mass."""

    def measured_mass(self) -> MeasuredMass:
        """Return mass, frames and surfaces."""


MassInput = str | os.PathLike[str] | MeasuredMass | MassRecord | HasMass
"""What gives a mass: the path of a mass.json, a record, or a result that holds one."""


def measured_mass(source: MassInput) -> MeasuredMass:
    """Return the mass that a path, a record or a result gives.

    Raises
    ------
    StapeskitError
        The file is not what ct2mass writes; see `read_mass_json`.
    """
    if isinstance(source, MeasuredMass):
        return source
    if isinstance(source, MassRecord):
        return MeasuredMass(source)
    if isinstance(source, HasMass):
        return source.measured_mass()
    return MeasuredMass(read_mass_json(Path(source)), Path(source))
