"""The schema of ``kd.json``, stiffness and damping with everything about them; further keys are allowed.

`read_kd_json` checks a file against it, `kd_record` a content just computed; `schema` is the JSON Schema.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError, raise_all
from stapeskit.records.json_files import read_json
from stapeskit.spatial import DOF_NAMES

MADE_BY = "Make the file with dof2kd"

Number = float | None
"""Null where a number is not finite."""
Row = list[Number]
Matrix = list[Row]
Dof = Literal["x", "y", "z", "alpha", "beta", "gamma"]


class _Block(BaseModel):
    model_config = ConfigDict(extra="allow", frozen=True, strict=True)


class Warned(_Block):
    """A warning or a reason."""

    code: Annotated[str, Field(pattern="^[a-z0-9_]+$")]
    text: str


class Verdict(_Block):
    """What the result may be used for, the weightiest reason first."""

    level: Literal["believe", "check", "do not use"]
    reasons: list[Warned] = []


class Passive(_Block):
    """Whether stiffness and damping are positive semidefinite."""

    stiffness: bool
    damping: bool


class NoiseOnly(_Block):
    """Standard deviations by channel noise alone, SI."""

    stiffness: Matrix
    damping: Matrix


class Mode(_Block):
    """One conjugate pair of poles."""

    frequency_hz: Annotated[float, Field(gt=0.0, description="damped, |Im(lambda)| / 2 pi")]
    undamped_frequency_hz: Annotated[float, Field(gt=0.0, description="|lambda| / 2 pi")]
    damping_ratio: float
    shape_re: Row
    shape_im: Row
    normalisation: str


class PrincipalAxes(_Block):
    """Principal axes of the ligament, about the footplate centre."""

    origin_x_mm: float
    origin_z_mm: float
    angle_deg: Annotated[float, Field(description="right-handed about +y, from footplate x")]
    stiffness_si: Annotated[Row, Field(min_length=3, max_length=3)]


class Fit(_Block):
    """How well the model fits."""

    chi2: Number
    n_dof: int
    chi2_per_dof: Number
    iterations: int
    active_constraints: list[Any]


class KDRecord(_Block):
    """What a ``kd.json`` says, SI: K11 is the entry of the first degree of freedom in ``dof``, and so on."""

    schema_: Annotated[Literal["stapeskit.kd/1"], Field(alias="schema")]
    dof: Annotated[list[Dof], Field(min_length=1)]
    model: dict[str, Any]
    estimator: str
    stiffness_si: Matrix
    stiffness_sd_si: Annotated[Matrix, Field(description="of all sources")]
    damping_si: Matrix
    damping_sd_si: Annotated[Matrix, Field(description="of all sources")]
    noise_only_sd_si: NoiseOnly
    parameters: list[str]
    covariance_si: Matrix
    verdict: Verdict | None = None
    budget: Annotated[dict[str, dict[str, Any]], Field(description="standard deviations by source and entry")]
    stable: bool
    max_real_eigenvalue_1_s: Number
    passive: Passive
    modes: list[Mode]
    overdamped_roots_1_s: Row
    principal_axes: PrincipalAxes | None
    fit: Fit
    identifiability: dict[str, Any]
    warnings: list[Warned]
    provenance: dict[str, Any]

    def array(self, name: str) -> Array:
        """Return a matrix by its key as an array, NaN for null."""
        return np.array(getattr(self, name), dtype=float)


def read_kd_json(path: Path) -> KDRecord:
    """Read and check a ``kd.json``.

    Raises
    ------
    StapeskitError
        The file is missing, no JSON, or not as the schema has it; every fault is listed.
    """
    path = Path(path)
    return kd_record(read_json(path, "the result of a fit", MADE_BY), path.name)


def kd_record(content: Mapping[str, Any], name: str = "kd.json") -> KDRecord:
    """Check the content of a ``kd.json``, read from a file or just computed; errors as in `read_kd_json`."""
    try:
        record = KDRecord.model_validate(dict(content))
    except ValidationError as error:
        faults = []
        for entry in error.errors():
            missing = entry["type"] == "missing"
            expected = "given" if missing else entry["msg"].removeprefix("Input should be ")
            got = "none" if missing else str(entry["input"])[:60]
            faults.append(Fault(".".join(map(str, entry["loc"])), expected, got, name, MADE_BY))
        raise StapeskitError(*faults) from None
    raise_all(_shape_faults(record, name))
    return record


def _shape_faults(record: KDRecord, name: str) -> list[Fault]:
    """List matrices of another size than their degrees of freedom or parameters."""
    sizes = dict.fromkeys(("stiffness_si", "stiffness_sd_si", "damping_si", "damping_sd_si"), len(record.dof))
    sizes["covariance_si"] = len(record.parameters)
    faults = []
    for key, size in sizes.items():
        rows: Matrix = getattr(record, key)
        if {len(rows), *map(len, rows)} != {size}:
            faults.append(Fault(key, f"{size} x {size}", f"{len(rows)} rows", name, MADE_BY))
    if [letter for letter in DOF_NAMES if letter in record.dof] != record.dof:
        faults.append(Fault("dof", f"in the order {', '.join(DOF_NAMES)}", record.dof, name, MADE_BY))
    return faults


def schema() -> dict[str, Any]:
    """Return the JSON Schema of ``kd.json``."""
    return KDRecord.model_json_schema(by_alias=True)
