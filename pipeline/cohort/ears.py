"""Finished studies as the rows and columns of cohort.csv."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any

import numpy as np

from stapeskit.arrays import Array
from stapeskit.faults import Fault, raise_all
from stapeskit.report.quantities import MASS, ShownUnit, matrix_units, si_unit
from stapeskit.warnings import from_json, once

SHARED_SOURCES = ("density", "calibration", "voxel_size", "mass")
"""Sources of errors of the mass that ears can share."""
# Under a mirror image in the x-y plane (a left ear against a right one, with x anterior and y lateral in
# both), entries that couple an odd with an even of these degrees of freedom change their sign.
_ODD = ("z", "alpha", "beta")
SCHEMAS = {"mass.json": "stapeskit.mass/1", "kd.json": "stapeskit.kd/1"}


@dataclass(frozen=True)
class Ear:
    """One finished study."""

    name: str
    folder: str
    side: str  # empty when the study does not name it
    mass: Mapping[str, Any]  # content of mass.json
    kd: Mapping[str, Any]  # content of kd.json
    # what the study states of the ear: subject, age, sex, group and further covariates
    about: Mapping[str, Any] = field(default_factory=dict)

    @property
    def verdict(self) -> str:
        """The level of the verdict of kd.json; empty in files that state none."""
        return str((self.kd.get("verdict") or {}).get("level", ""))

    @property
    def warnings(self) -> int:
        """How many different warnings there are; those of the scan are in both files and count once."""
        return len(once(from_json([*self.mass.get("warnings", ()), *self.kd.get("warnings", ())])))

    @property
    def damping_exponent(self) -> float:
        """Power of time in the unit of D."""
        return float((self.kd.get("model") or {}).get("damping_exponent", 1.0))


def read_ear(folder: Path, name: str, about: Mapping[str, Any] | None = None) -> Ear:
    """Read the results of one study, called ``name``, from its output folder.

    Raises
    ------
    OSError, KeyError, ValueError
        A file is missing or is not what ct2mass or dof2kd writes.
    """
    found = {}
    for file, schema in SCHEMAS.items():
        content = json.loads((Path(folder) / file).read_text(encoding="utf-8"))
        if not isinstance(content, dict) or content.get("schema") != schema:
            raise ValueError(f"{file} is not of the schema {schema}")
        found[file] = content
    side = found["mass.json"]["frames"].get("side") or ""
    return Ear(name, Path(folder).name, side, found["mass.json"], found["kd.json"], about or {})


def read_ears(sources: Iterable[tuple[Path, str, Mapping[str, Any]]]) -> list[Ear]:
    """Read studies by folder, name and what is known of the ear.

    Raises
    ------
    StapeskitError
        Folders that hold no finished study, all in one error.
    """
    ears, faults = list[Ear](), list[Fault]()
    for folder, called, about in sources:
        try:
            ears.append(read_ear(folder, called, about))
        except (OSError, LookupError, ValueError, TypeError, AttributeError) as error:
            name = getattr(error, "filename", None)
            got = str(error) if name is None else f"no {Path(name).name}"
            expected = "a folder with mass.json and kd.json of a finished study"
            faults.append(Fault(str(folder), expected, got, "", "Run scan2kd on its study first"))
    raise_all(faults)
    return ears


def unique_names(ears: Sequence[Ear]) -> list[str]:
    """Return a unique name for each ear: with its folder where studies share a name."""
    times = Counter(ear.name for ear in ears)
    return [ear.name if times[ear.name] == 1 else f"{ear.name} ({ear.folder})" for ear in ears]


def common_damping_exponent(ears: Sequence[Ear]) -> float | None:
    """Return the power of time in the unit of D; None where ears differ, whose D cannot be compared."""
    exponents = {ear.damping_exponent for ear in ears}
    return exponents.pop() if len(exponents) == 1 else None


def source_id(ear: Ear, source: str) -> str:
    """Name a source of errors so that ears which share the error have one name for it."""
    provenance = ear.mass.get("provenance") or {}
    line = ((provenance.get("inputs") or {}).get("calibration") or {}).get("hash")
    if source == "density" and ear.mass.get("mass_known_by", "density") == "density":
        return f"density {float(ear.mass.get('density_kg_m3') or np.nan):.6g}"
    if source == "calibration" and line:
        return f"calibration {line}"
    if source == "voxel_size":
        stated = (provenance.get("parameters") or {}).get("voxel_size_sd_percent", "")
        return f"voxel size of scanner {ear.about.get('scanner', '')} {stated}".strip()
    return f"{source} of {ear.folder}"


@dataclass(frozen=True)
class Quantity:
    """One number of every ear."""

    name: str
    unit: str  # SI
    shown: ShownUnit  # in which people see it
    values: Array  # (ears,): SI; NaN where an ear has none
    sd: Array  # (ears,)
    own_sd: Array  # (ears,): without errors that all ears share

    @property
    def title(self) -> str:
        """Its name for people: K(y, alpha), mode 1 frequency."""
        letter, *dof = self.name.split("_")
        if letter in ("K", "D"):
            return f"{letter}({', '.join(dict.fromkeys(dof))})"
        return self.name.replace("_", " ").replace("mode", "mode ")

    @property
    def title_with_unit(self) -> str:
        """The same with its unit, where it has one."""
        return f"{self.title} ({self.shown.symbol})" if self.shown.symbol else self.title


_Number = tuple[float | None, float | None, float]
"""Value, standard deviation, and the variance by errors that all ears share."""
_NONE: _Number = (None, None, 0.0)


def quantities(ears: Sequence[Ear]) -> list[Quantity]:
    """Return mass, K, D and modes of all ears; right ears as their mirror images on the left."""
    common = [source for source in SHARED_SOURCES if len({source_id(ear, source) for ear in ears}) == 1]
    numbers = [_numbers(ear, common) for ear in ears]
    exponent = common_damping_exponent(ears)
    largest = sorted(numbers, key=len, reverse=True)
    return [
        _quantity(name, exponent, [of.get(name, _NONE) for of in numbers])
        for name in dict.fromkeys(name for of in largest for name in of)
    ]


def _numbers(ear: Ear, common: Sequence[str]) -> dict[str, _Number]:
    """Return the numbers of one ear by name."""
    kd, parts = ear.kd, ear.mass["inertial_parameters"].get("contributions_si") or {}
    shared = float(sum(parts[source][0][0] for source in common if source in parts))
    found: dict[str, _Number] = {
        "mass": (ear.mass["mass_kg"], ear.mass["mass_matrix"]["standard_deviation_si"][0][0], shared)
    }
    budget = [(kd.get("budget") or {}).get(f"mass.{source}", {}) for source in common]
    for letter, key in (("K", "stiffness"), ("D", "damping")):
        value, sd = (kd.get(f"{key}{ending}") for ending in ("_si", "_sd_si"))
        for (i, first), (j, second) in combinations_with_replacement(enumerate(kd["dof"]), 2):
            turned = ear.side == "right" and (first in _ODD) != (second in _ODD)
            shared = float(sum((of.get(f"{letter}{i + 1}{j + 1}") or 0.0) ** 2 for of in budget))
            entry = value and (-value[i][j] if turned else value[i][j])
            found[f"{letter}_{first}_{second}"] = (entry, sd and sd[i][j], shared)
    for number, mode in enumerate(kd.get("modes") or [], 1):
        found[f"mode{number}_frequency"] = (mode.get("frequency_hz"), mode.get("frequency_sd_hz"), 0.0)
        found[f"mode{number}_damping_ratio"] = (mode.get("damping_ratio"), mode.get("damping_ratio_sd"), 0.0)
    return found


def _quantity(name: str, exponent: float | None, numbers: Sequence[_Number]) -> Quantity:
    letter, *dof = name.split("_")
    if letter in ("K", "D"):
        unit, shown = si_unit(letter, dof[0], dof[1], exponent), matrix_units(letter, dof, exponent)[0][1]
    else:
        unit = {"mass": "kg", "frequency": "Hz"}.get(name.split("_")[-1], "")
        shown = MASS if name == "mass" else ShownUnit(unit, 1.0)
    value, sd, shared = np.array(numbers, dtype=float).T
    variance = sd**2 - shared
    # what rounding leaves of a difference is no error of an ear
    own = np.sqrt(np.where(variance < 1e-9 * sd**2, 0.0, variance))
    return Quantity(name, unit, shown, value, sd, own)


def ear_table(ears: Sequence[Ear], failed: Mapping[str, str] | None = None) -> Any:
    """Return a pandas table of cohort.csv, SI: an ear a row, each quantity with its sd, the verdict, and
    what the study states of the ear.

    Parameters
    ----------
    failed : mapping of str to str, optional
        Studies that failed, by name, and why: rows at the end with nothing but the column error.
    """
    import pandas as pd

    columns: dict[str, Any] = {
        "study": [ear.name for ear in ears],
        "folder": [ear.folder for ear in ears],
        "side": [ear.side for ear in ears],
        "verdict": [ear.verdict for ear in ears],
        "estimator": [ear.kd["estimator"] for ear in ears],
        "damping_exponent": [ear.damping_exponent for ear in ears],
        "warnings": [ear.warnings for ear in ears],
    }
    for quantity in quantities(ears) if ears else []:
        end = f"_{quantity.unit}".replace("/", "_per_").replace(" ", "_").lower() if quantity.unit else ""
        columns[f"{quantity.name}{end}"] = quantity.values
        columns[f"{quantity.name}_sd{end}"] = quantity.sd
    for name in dict.fromkeys(name for ear in ears for name in ear.about if name != "side"):
        column = f"stated_{name}" if name in columns else name
        columns[column] = [ear.about.get(name) for ear in ears]
    table = pd.DataFrame(columns).assign(error="")
    if not failed:
        return table
    names = list(failed)
    errors = [" ".join(text.split()) for text in failed.values()]
    empty = pd.DataFrame({"study": names, "folder": names, "error": errors})
    return pd.concat([table.astype({"warnings": "Int64"}), empty], ignore_index=True)
