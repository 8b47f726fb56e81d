"""All matrices of a cohort in one HDF5 file, with their covariances."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from legacy.pipeline.cohort.cohort_laws import CohortLaws
from legacy.stapeskit.records.hdf5_writing import write_h5

SCHEMA = "stapeskit.cohort_matrices/1"
_NOTE = (
    "Arrays (ear, ...), SI, about the footplate centre in footplate axes. logarithms: ln of the quantities "
    "of laws, their own covariances, and the effect of one standard deviation of each error that ears share."
)


def write(folder: Path, cohort: CohortLaws, content: Mapping[str, Any]) -> None:
    """Write cohort.h5."""
    import h5py

    ears = cohort.ears
    with write_h5(folder / "cohort.h5") as file:
        file.attrs["schema"], file.attrs["note"] = SCHEMA, _NOTE
        file["cohort_json"] = json.dumps(content)
        texts = h5py.string_dtype()
        file.create_dataset("ear/name", data=[ear.name for ear in ears], dtype=texts)
        file.create_dataset("ear/folder", data=[ear.folder for ear in ears], dtype=texts)
        file.create_dataset("ear/side", data=[ear.side for ear in ears], dtype=texts)
        file.create_dataset("ear/about", data=[json.dumps(dict(ear.about)) for ear in ears], dtype=texts)
        inertia = [ear.mass["inertial_parameters"] for ear in ears]
        _stack(file, "inertia/parameters", [parameters["values_si"] for parameters in inertia])
        _stack(file, "inertia/covariance", [parameters.get("covariance_si") for parameters in inertia])
        if len({tuple(ear.kd["dof"]) for ear in ears}) == 1:
            file.create_dataset("kd/dof", data=list(ears[0].kd["dof"]), dtype=texts)
            file.create_dataset("kd/parameters", data=list(ears[0].kd["parameters"]), dtype=texts)
            for name, key in (("stiffness", "stiffness_si"), ("damping", "damping_si")):
                _stack(file, f"kd/{name}", [ear.kd[key] for ear in ears])
            _stack(file, "kd/covariance", [ear.kd.get("covariance_si") for ear in ears])
        table = cohort.table
        if table is not None:
            names = [*table.predictors, *table.responses]
            file.create_dataset("logarithms/quantity", data=names, dtype=texts)
            file.create_dataset("logarithms/shared_error", data=list(table.sources), dtype=texts)
            for name in ("values", "own", "shared", "subject"):
                file[f"logarithms/{name}"] = getattr(table, name)


def _stack(file: Any, name: str, values: list[Any]) -> None:
    """Write arrays of equal shape as one; an ear without one gets NaN; left out where no ear has it."""
    arrays = [None if value is None else np.asarray(value, dtype=float) for value in values]
    known = [array for array in arrays if array is not None]
    if known and len({array.shape for array in known}) == 1:
        file[name] = np.array(
            [np.full(known[0].shape, np.nan) if array is None else array for array in arrays]
        )
