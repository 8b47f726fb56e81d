"""Several ears side by side: one row each, and whether they differ by more than their uncertainty."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array
from legacy.stapeskit.json_toml import read_json
from legacy.stapeskit.page.quantities import MASS, matrix_units, si_unit
from legacy.stapeskit.tables.text_cells import as_text_cell

SHARED_SOURCES = ("density", "calibration", "voxel_size", "mass")
"""Sources of the mass's errors that ears can share."""
# Under a mirror image in the x-y plane (a left ear against a right one, with x anterior and y lateral in
# both), entries that couple an odd with an even of these degrees of freedom change their sign.
_ODD = ("z", "alpha", "beta")


@dataclass(frozen=True)
class Ear:
    """One finished study.

    Attributes
    ----------
    name, folder, side : str
        Side is empty when the study does not name it.
    mass, kd : mapping
        Content of mass.json and kd.json.
    about : mapping
        What the study says of the ear: subject, age, sex, group and further covariates.
    """

    name: str
    folder: str
    side: str
    mass: Mapping[str, Any]
    kd: Mapping[str, Any]
    about: Mapping[str, Any] = field(default_factory=dict)

    @property
    def warnings(self) -> int:
        """How many different warnings there are."""
        codes = (*self.mass.get("warnings", ()), *self.kd.get("warnings", ()))
        return len({(notice["code"], notice["text"]) for notice in codes})


@dataclass(frozen=True)
class Quantity:
    """One number of every ear.

    Attributes
    ----------
    values, deviations : ndarray, (ears,)
        NaN where an ear has none.
    turns : bool
        Whether a right ear has the other sign than its mirror image on the left.
    own : ndarray, (ears,), optional
        Standard deviations without errors that all ears share; ``deviations`` when left out.
    """

    name: str
    unit: str
    values: Array
    deviations: Array
    turns: bool = False
    own: Array | None = None

    @property
    def mean(self) -> float:
        """Plain mean over the ears."""
        return float(np.mean(self.values[np.isfinite(self.values)]))

    @property
    def spread(self) -> float:
        """Standard deviation between the ears (n - 1); NaN for one ear."""
        good = self.values[np.isfinite(self.values)]
        return float(np.std(good, ddof=1)) if len(good) > 1 else float("nan")

    def shown(self, exponent: float | None) -> Quantity:
        """Return the quantity in the unit of pages; ``exponent`` is the power of time in the unit of D."""
        letter, *dof = self.name.split("_")
        if letter not in ("mass", "K", "D"):
            return self
        unit = MASS if letter == "mass" else matrix_units(letter, dof, exponent)[0][1]
        own = None if self.own is None else unit.of(self.own)
        return replace(
            self, unit=unit.symbol, values=unit.of(self.values), deviations=unit.of(self.deviations), own=own
        )

    def mirrored(self, right: NDArray[np.bool_]) -> Quantity:
        """Return the quantity with right ears as their mirror images on the left; ``right`` is (ears,)."""
        return replace(self, values=np.where(right & self.turns, -self.values, self.values))

    def homogeneity(self) -> tuple[float, int, float]:
        """Return Cochran's Q of "all ears are alike", its degrees of freedom and its p-value.

        Notes
        -----
        Q = sum w (x - xw)^2 with w = 1/sd^2 and xw the weighted mean (Cochran 1954, doi:10.2307/3001666),
        from the errors of each ear alone: an error that all ears share makes them differ in nothing.
        """
        from scipy.special import chdtrc

        sd = self.deviations if self.own is None else self.own
        good = np.isfinite(self.values) & np.isfinite(sd) & (sd > 0.0)
        count = int(np.sum(good)) - 1
        if count < 1:
            return float("nan"), 0, float("nan")
        weight = sd[good] ** -2.0
        middle = np.sum(weight * self.values[good]) / np.sum(weight)
        q = float(np.sum(weight * (self.values[good] - middle) ** 2))
        return q, count, float(chdtrc(count, q))


def read_ear(folder: Path, name: str) -> Ear:
    """Read the results of one study, called ``name``, from its output folder.

    Raises
    ------
    OSError
    KeyError, ValueError
        A file is not what ct2mass or dof2kd writes.
    """
    mass, kd = (read_json(Path(folder) / file) for file in ("mass.json", "kd.json"))
    for content, schema in ((mass, "stapeskit.mass/1"), (kd, "stapeskit.kd/1")):
        if content.get("schema") != schema:
            raise ValueError(f"schema {content.get('schema')} and not {schema}")
    return Ear(name, Path(folder).name, mass["frames"].get("side") or "", mass, kd)


def quantities(ears: Sequence[Ear]) -> list[Quantity]:
    """Return mass, K, D and modes of all ears."""
    common = tuple(source for source in SHARED_SOURCES if len({source_id(ear, source) for ear in ears}) == 1)
    exponent = damping_exponent(ears)
    sds = [ear.mass["mass_matrix"]["standard_deviation_si"][0][0] for ear in ears]
    variances = [_mass_shared(ear.mass, common) for ear in ears]
    rows = [_quantity("mass", "kg", [ear.mass["mass_kg"] for ear in ears], sds, variances)]
    dof = max((tuple(ear.kd["dof"]) for ear in ears), key=len)
    for letter, key in (("K", "stiffness"), ("D", "damping")):
        for first, second in combinations_with_replacement(dof, 2):
            values, sds = (
                [_entry(ear.kd, f"{key}{end}", first, second) for ear in ears] for end in ("_si", "_sd_si")
            )
            variances = [_entry_shared(ear, common, letter, first, second) for ear in ears]
            unit = si_unit(letter, first, second, exponent)
            turns = (first in _ODD) != (second in _ODD)
            rows.append(_quantity(f"{letter}_{first}_{second}", unit, values, sds, variances, turns))
    for mode in range(max(len(ear.kd["modes"]) for ear in ears)):
        for name, unit, keys in (
            ("frequency", "Hz", ("frequency_hz", "frequency_sd_hz")),
            ("damping_ratio", "", ("damping_ratio", "damping_ratio_sd")),
        ):
            values, sds = ([_mode(ear.kd, mode, key) for ear in ears] for key in keys)
            rows.append(_quantity(f"mode{mode + 1}_{name}", unit, values, sds))
    return rows


def source_id(ear: Ear, source: str) -> str:
    """Name a source of errors so that ears which share the error have one name for it."""
    provenance = ear.mass.get("provenance") or {}
    line = ((provenance.get("inputs") or {}).get("calibration") or {}).get("hash")
    if source == "density" and ear.mass.get("mass_known_by") == "density":
        return f"density {ear.mass.get('density_kg_m3'):.6g}"
    if source == "calibration" and line:
        return f"calibration {line}"
    if source == "voxel_size":
        stated = (provenance.get("parameters") or {}).get("voxel_size_sd_percent", "")
        return f"voxel size of scanner {ear.about.get('scanner', '')} {stated}".strip()
    return f"{source} of {ear.folder}"


def _mass_shared(mass: Mapping[str, Any], common: Sequence[str]) -> float:
    """Return the variance of the mass by common sources."""
    parts = mass["inertial_parameters"].get("contributions_si") or {}
    return float(sum(parts[source][0][0] for source in common if source in parts))


def _entry_shared(ear: Ear, common: Sequence[str], letter: str, first: str, second: str) -> float:
    """Return the variance of an entry of K or D by common sources."""
    dof, budget = list(ear.kd["dof"]), ear.kd.get("budget") or {}
    if first not in dof or second not in dof:
        return 0.0
    name = f"{letter}{dof.index(first) + 1}{dof.index(second) + 1}"
    return float(sum((budget.get(f"mass.{source}", {}).get(name) or 0.0) ** 2 for source in common))


def _quantity(
    name: str,
    unit: str,
    values: Sequence[float | None],
    deviations: Sequence[float | None],
    shared: Sequence[float] | None = None,
    turns: bool = False,
) -> Quantity:
    """Return a quantity of all ears; ``shared`` is the variance by errors that they have in common."""
    value, sd = (np.array(numbers, dtype=float) for numbers in (values, deviations))
    own = None
    if shared is not None:
        variance = sd**2 - np.array(shared)
        # What rounding leaves of a difference is no error of an ear.
        own = np.sqrt(np.where(variance < 1e-9 * sd**2, 0.0, variance))
    return Quantity(name, unit, value, sd, turns, own)


def _entry(kd: Mapping[str, Any], key: str, first: str, second: str) -> float | None:
    dof = list(kd["dof"])
    if first not in dof or second not in dof:
        return None
    value: float | None = kd[key][dof.index(first)][dof.index(second)]
    return value


def _mode(kd: Mapping[str, Any], mode: int, key: str) -> float | None:
    return kd["modes"][mode].get(key) if mode < len(kd["modes"]) else None


def damping_exponent(ears: Sequence[Ear]) -> float | None:
    """Return the power of time in the unit of D; None where ears differ, whose D cannot be compared."""
    exponents = {_exponent(ear) for ear in ears}
    return exponents.pop() if len(exponents) == 1 else None


def _exponent(ear: Ear) -> float:
    return float(ear.kd.get("model", {}).get("damping_exponent", 1.0))


def labels(ears: Sequence[Ear]) -> list[str]:
    """Return a unique name for each ear: with its folder where studies share a name."""
    times = Counter(ear.name for ear in ears)
    return [ear.name if times[ear.name] == 1 else f"{ear.name} ({ear.folder})" for ear in ears]


def ear_table(ears: Sequence[Ear]) -> Any:
    """Return a pandas table, one row per ear: name, side, warnings, each quantity with its sd; SI units."""
    import pandas as pd

    columns: dict[str, Any] = {
        "study": [as_text_cell(ear.name) for ear in ears],
        "folder": [as_text_cell(ear.folder) for ear in ears],
        "side": [as_text_cell(ear.side) for ear in ears],
        "estimator": [ear.kd["estimator"] for ear in ears],
        "damping_exponent": [_exponent(ear) for ear in ears],
        "warnings": [ear.warnings for ear in ears],
    }
    for quantity in quantities(ears):
        end = _column_unit(quantity.unit)
        columns[f"{quantity.name}{end}"] = quantity.values
        columns[f"{quantity.name}_sd{end}"] = quantity.deviations
    return pd.DataFrame(columns)


def write_cohort_csv(path: Path, ears: Sequence[Ear], faults: Mapping[str, str] | None = None) -> None:
    """Write `ear_table` and a column error.

    Parameters
    ----------
    faults : mapping of str to str, optional
        Studies that failed, by folder, and why: rows at the end with nothing but the column error.
    """
    import pandas as pd

    failed = {} if faults is None else faults
    table = ear_table(ears).assign(error="")
    if failed:
        errors = [as_text_cell(" ".join(text.split())) for text in failed.values()]
        names = [as_text_cell(name) for name in failed]
        empty = pd.DataFrame({"study": names, "folder": names, "error": errors})
        table = pd.concat([table.astype({"warnings": "Int64"}), empty])
    table.to_csv(path, index=False, lineterminator="\n")


def _column_unit(unit: str) -> str:
    """Return the ending of a column: ``_n_per_m`` for N/m."""
    return f"_{unit}".replace("/", "_per_").replace(" ", "_").lower() if unit else ""
