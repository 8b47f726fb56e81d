"""Read and write ``mass.json``: ten inertial parameters with their covariance, and the frames of a scan."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stapeskit.faults import StapeskitError, raise_all
from stapeskit.records.json_files import as_json, read_json
from stapeskit.records.mass_checks import MADE_BY, REDUCED, MassReader
from stapeskit.records.mass_record import MassRecord, statements
from stapeskit.spatial import DOF_NAMES

SCHEMA = "stapeskit.mass/1"


def mass_json(
    record: MassRecord,
    provenance: Mapping[str, Any] | None = None,
    further: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the content of ``mass.json``.

    Parameters
    ----------
    record : MassRecord
        Its ``raw`` is not used.
    provenance : mapping
        Block of `stapeskit.provenance.record`.
    further : mapping
        What does not follow from the record, joined key by key: ``uncertainty``, ``found``,
        ``{"frames": {"side": ...}}``. It cannot replace what follows.

    Raises
    ------
    StapeskitError
        The content is not one that `mass_record` accepts.
    """
    frames: dict[str, Any] = {"pose_covariance": {"scan_from_plate": None}}
    poses = [("footplate", record.scan_from_footplate, record.footplate_covariance)]
    if record.scan_from_plate is not None:
        covariance = np.zeros((6, 6)) if record.plate_covariance is None else record.plate_covariance
        poses.append(("plate", record.scan_from_plate, covariance))
    for name, transform, covariance in poses:
        convention = f"displacement of the {name} frame in its own axes, m and rad"
        frames[f"scan_from_{name}"] = transform.matrix
        block = {"names": DOF_NAMES, "convention": convention, "matrix_si": covariance}
        frames["pose_covariance"][f"scan_from_{name}"] = block
    mass = record.mass_matrix
    defining = {
        "schema": SCHEMA,
        "density_kg_m3": record.density_kg_m3,
        "volume_m3": record.volume_m3,
        "frames": {"scan_from_plate": None, "plate_from_footplate": None, **frames},
        "inertial_parameters": {
            "values_si": mass.parameters,
            "covariance_si": mass.covariance,
            "contributions_si": mass.contributions,
        },
        "mass_matrix_plate_axes": None,
        "warnings": [notice.as_json() for notice in record.notices],
        "provenance": dict(provenance or {}),
    }
    follows: dict[str, Any] = {}
    for path, stated in statements(record, REDUCED).items():
        parent, _, key = path.rpartition(".")
        inner: dict[str, Any] = follows.setdefault(parent, {}) if parent else follows
        inner[key] = stated.value
    content: dict[str, Any] = as_json(_joined(further or {}, _joined(defining, follows)))
    order = dict.fromkeys([*follows, *defining, *content])
    content = {key: content[key] for key in ("schema", *order)}
    mass_record(content)
    return content


def _joined(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Join two nested mappings; where both have a value, the second counts."""
    joined = dict(first)
    for key, value in second.items():
        both = isinstance(value, Mapping) and isinstance(joined.get(key), Mapping)
        joined[key] = _joined(joined[key], value) if both else value
    return joined


def read_mass_json(path: Path) -> MassRecord:
    """Read and check a ``mass.json``.

    Raises
    ------
    StapeskitError
        The file is missing, is no JSON, has another schema, lacks a key, contradicts itself, or holds a
        matrix that no rigid body can have. Every fault found is listed.
    """
    path = Path(path)
    return mass_record(read_json(path, "the mass file", MADE_BY), path.name)


def mass_record(raw: Mapping[str, Any], name: str = "mass.json") -> MassRecord:
    """Check the content of a ``mass.json``, read from a file or just computed.

    Parameters
    ----------
    name : str
        What it is called in messages.

    Raises
    ------
    StapeskitError
        As in `read_mass_json`.
    """
    if raw.get("schema") != SCHEMA:
        raise StapeskitError.of("schema", f'"{SCHEMA}"', raw.get("schema"), name, MADE_BY)
    reader = MassReader(raw, name)
    record = reader.record()
    if record is not None:
        reader.compare(statements(record, reader.reduced_dof()))
    raise_all(reader.faults)
    if record is None:
        raise StapeskitError.of("a mass.json", "complete", "a part of it", name, MADE_BY)
    return record
