"""The folders of a run, and what was parsed of them: every file is hashed once and parsed once."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from legacy.stapeskit.provenance import Hashes

if TYPE_CHECKING:
    from collections.abc import Mapping

    from legacy.stapeskit.records.measured_mass import MeasuredMass
    from legacy.stapeskit.records.motion import RigidMotion

Value = TypeVar("Value")


@dataclass(frozen=True)
class Workspace:
    """A folder to read from and a folder to write to.

    Attributes
    ----------
    out : Path
        Holds the results of stages that are reused.
    fresh : Path
        Gets the results of stages that run.
    hashes : Hashes
        Content hashes of the files of this run.
    """

    out: Path
    fresh: Path
    hashes: Hashes = field(default_factory=Hashes, repr=False, compare=False)
    _values: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)
    _gone: set[str] = field(default_factory=set, repr=False, compare=False)

    def find(self, name: str) -> Path:
        """Return the present place of an output; there is no file at that of one that is gone."""
        path = self.fresh / name
        return path if path.exists() or name in self._gone else self.out / name

    def drop(self, names: Iterable[str]) -> None:
        """Note outputs of earlier runs that a stage did not write this time: they will be removed."""
        self._gone.update(names)

    def hash_of(self, name: str) -> str:
        """Return the content hash of an output."""
        return self.hashes.of(self.find(name))

    def keep(self, name: str, value: object) -> None:
        """Keep a value that a stage has computed or read, for the stages after it."""
        self._values[name] = value

    def once(self, name: str, read: Callable[[], Value]) -> Value:
        """Return a value that was kept, or read it now and keep it."""
        if name not in self._values:
            self._values[name] = read()
        return cast("Value", self._values[name])

    @property
    def mass(self) -> MeasuredMass:
        """Mass, frames and surfaces of the stapes."""
        from legacy.stapeskit.records.measured_mass import measured_mass

        return self.once("mass", lambda: measured_mass(self.find("mass.json")))

    @property
    def motion(self) -> RigidMotion:
        """The motion of the bodies."""
        from legacy.stapeskit.records.motion_files import read_motion

        return self.once("motion", lambda: read_motion(self.find("dof.h5")))

    @property
    def kd(self) -> Mapping[str, Any]:
        """The content of kd.json."""
        return self.once("kd", lambda: json.loads(self.find("kd.json").read_text(encoding="utf-8")))
