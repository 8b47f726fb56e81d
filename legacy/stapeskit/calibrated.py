"""Read the numbers that were calibrated on simulated specimens from a room's ``calibrated.toml``."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from legacy.stapeskit.provenance import content_hash


@dataclass(frozen=True)
class Population:
    """Specimens on which numbers were fitted or checked.

    Attributes
    ----------
    description : str
        Shapes, sizes, noise and blur, as far as they are recorded.
    script : str
        The program that makes the specimens, or ``not recorded``.
    date : str
        When the numbers were determined, ISO 8601.
    """

    description: str
    script: str
    date: str


@dataclass(frozen=True)
class CalibratedNumber:
    """A number that was chosen because it performed well on a population of specimens.

    Attributes
    ----------
    meaning : str
        What the number decides or states, with its unit.
    fitted_on, checked_on : str
        Names of populations. The check must use other specimens than the fit; ``none`` if there was none.
    """

    value: Any
    meaning: str
    fitted_on: str
    checked_on: str


class CalibratedNumbers:
    """The calibrated numbers of one room, by name: ``numbers("psf.reach_widths")``.

    Parameters
    ----------
    path : Path
        A TOML file: tables ``[population.NAME]`` with the fields of `Population`, and tables
        ``[SUBJECT.NAME]`` with the fields of `CalibratedNumber`. ``fitted_on`` and ``checked_on`` default
        to those of ``[default]``.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with path.open("rb") as stream:
            document = tomllib.load(stream)
        default = document.pop("default")
        self.populations: Mapping[str, Population] = {
            name: Population(**entry) for name, entry in document.pop("population").items()
        }
        self.entries: Mapping[str, CalibratedNumber] = {
            f"{subject}.{name}": CalibratedNumber(**{**default, **entry, "value": _freeze(entry["value"])})
            for subject, table in document.items()
            for name, entry in table.items()
        }

    def __call__(self, name: str) -> Any:
        """Return the value of a number; lists come as tuples.

        Raises
        ------
        KeyError
            The file has no such number.
        """
        return self.entries[name].value

    def version(self) -> dict[str, str]:
        """Return ``room/file: content hash``, for the versions in the provenance of a result."""
        return {f"{self._path.parent.name}/{self._path.name}": content_hash(self._path)}


def _freeze(value: Any) -> Any:
    return tuple(_freeze(entry) for entry in value) if isinstance(value, list) else value
