"""Read and write ``mass.json``: ten inertial parameters with their covariance, and the frames of a scan.

What defines the body must be possible, and the rest must follow from it: the writer derives it by
`statements`, and the reader compares.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError, raise_all
from stapeskit.frames import RigidTransform, transform_faults
from stapeskit.records.json_files import as_json, read_json
from stapeskit.records.mass_matrix import MassMatrix
from stapeskit.records.mass_record import FLOOR, SAME, MassRecord, statements
from stapeskit.spatial import DOF_NAMES, central_tensor, inertia_faults, matrix_from_parameters
from stapeskit.warnings import Notice, from_json

SCHEMA = "stapeskit.mass/1"
MADE_BY = "Make the file with ct2mass"

_SAME_MASS = 1e-4  # relative difference of mass and volume times density, which people type
_POSE_SCALE = np.array([1e-3] * 3 + [1.0] * 3)


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
    for path, (value, _) in statements(record).items():
        parent, _, key = path.rpartition(".")
        inner: dict[str, Any] = follows.setdefault(parent, {}) if parent else follows
        inner[key] = value
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
    file = Reader(raw, name)
    footplate, footplate_pose = _pose(file, "footplate")
    plate, plate_pose = _pose(file, "plate")
    notices, mass = _notices(file), _mass_matrix(file)
    density, volume = (file.positive(key) for key in ("density_kg_m3", "volume_m3"))
    if mass is None or footplate is None:
        raise StapeskitError(*file.faults)
    bone_alone = not file.mapping("found").get("added_masses")
    if density is not None and volume is not None and bone_alone:
        product, whole = density * volume, float(mass.parameters[0])
        if abs(product / whole - 1.0) > _SAME_MASS:
            got = f"{product:g} kg against {whole:g} kg"
            file.fault("density_kg_m3 times volume_m3", "the mass of inertial_parameters", got)
    record = MassRecord(
        mass,
        footplate,
        footplate_pose,
        plate,
        None if plate is None else plate_pose,
        density,
        volume,
        notices,
        dict(raw),
    )
    _compare(file, record)
    raise_all(file.faults)
    return record


class Reader:
    """Reads values out of a ``mass.json`` while the faults are collected."""

    def __init__(self, raw: Mapping[str, Any], name: str) -> None:
        self.raw, self.name = raw, name
        self.faults: list[Fault] = []

    def fault(self, thing: str, expected: str, got: object) -> None:
        """Add one fault, its value cut to what a line of a message holds."""
        text = str(got)
        shown = text if len(text) <= 60 else text[:57] + "..."
        self.faults.append(Fault(thing, expected, shown, self.name, MADE_BY))

    def get(self, *path: str) -> Any:
        """Return the value at a path of keys; None where there is none."""
        value: Any = self.raw
        for key in path:
            value = value.get(key) if isinstance(value, Mapping) else None
        return value

    def mapping(self, *path: str) -> Mapping[str, Any]:
        """Return an optional object; empty when it is missing, or no object, which is a fault."""
        value = self.get(*path)
        if value is not None and not isinstance(value, Mapping):
            self.fault(".".join(path), "an object", value)
        return value if isinstance(value, Mapping) else {}

    def numbers(self, *path: str, shape: tuple[int, ...] = (), optional: bool = False) -> Array | None:
        """Return finite numbers of one shape, or None: with a fault noted unless they are optional."""
        value, thing = self.get(*path), ".".join(path)
        if value is None:
            if not optional:
                self.fault(thing, "given", "none")
            return None
        array = _array(value)
        if array is None or array.shape != shape or not np.all(np.isfinite(array)):
            self.fault(thing, f"finite numbers of shape {shape}" if shape else "a finite number", value)
            return None
        return array

    def positive(self, key: str) -> float | None:
        """Return an optional positive number."""
        value = self.numbers(key, optional=True)
        if value is not None and not value > 0.0:
            self.fault(key, "positive", f"{value:g}")
            return None
        return None if value is None else float(value)

    def covariance(self, *path: str, scale: Array) -> Array | None:
        """Return a covariance that is symmetric and positive semidefinite, or None with a fault noted.

        ``scale`` is the natural size of each parameter; what is below its rounding is not judged.
        """
        matrix = self.numbers(*path, shape=(len(scale), len(scale)))
        if matrix is None:
            return None
        root = np.maximum(np.sqrt(np.abs(np.diag(matrix))), FLOOR * scale)
        relative = matrix / np.outer(root, root)
        if np.max(np.abs(relative - relative.T)) > FLOOR:
            self.fault(".".join(path), "symmetric", "an asymmetric matrix")
            return None
        lowest = float(np.linalg.eigvalsh(0.5 * (relative + relative.T))[0])
        if lowest < -FLOOR:
            got = f"a matrix whose correlations have the eigenvalue {lowest:.3g}"
            self.fault(".".join(path), "a covariance (positive semidefinite)", got)
            return None
        return matrix


def _array(value: Any) -> Array | None:
    """Return nested lists of JSON numbers as an array; None when anything else is among them."""

    def plain(entry: Any) -> bool:
        if isinstance(entry, list):
            return all(plain(part) for part in entry)
        return isinstance(entry, int | float) and not isinstance(entry, bool)

    try:
        return np.array(value, dtype=float) if plain(value) else None
    except (ValueError, OverflowError):
        return None


def _notices(file: Reader) -> tuple[Notice, ...]:
    values = file.get("warnings") or []
    if not isinstance(values, list) or not all(
        isinstance(value, Mapping) and isinstance(value.get(key), str)
        for value in values
        for key in ("code", "text")
    ):
        file.fault("warnings", "a list of objects with code and text", values)
        return ()
    return from_json(values)


def _pose(file: Reader, name: str) -> tuple[RigidTransform | None, Array]:
    """Return a frame in the scan and the covariance of its displacement, zero when it is not stated."""
    key = f"scan_from_{name}"
    path, covariance = ("frames", "pose_covariance", key), None
    if name == "footplate":
        file.mapping("frames")
    if file.mapping("frames", "pose_covariance").get(key) is not None:
        covariance = file.covariance(*path, "matrix_si", scale=_POSE_SCALE)
        names = file.get(*path, "names")
        if names not in (None, list(DOF_NAMES)):
            file.fault(".".join((*path, "names")), ", ".join(DOF_NAMES), names)
    matrix = file.numbers("frames", key, shape=(4, 4), optional=name == "plate")
    faults = [] if matrix is None else transform_faults(matrix, f"frames.{key}", file.name)
    file.faults += [replace(fault, next_step=fault.next_step or MADE_BY) for fault in faults]
    transform = None if matrix is None or faults else RigidTransform(matrix, "scan", name)
    return transform, np.zeros((6, 6)) if covariance is None else covariance


def _mass_matrix(file: Reader) -> MassMatrix | None:
    """Return parameters and covariance, or None with faults noted."""
    block = "inertial_parameters"
    parameters = file.numbers(block, "values_si", shape=(10,))
    if parameters is None:
        return None
    impossible = inertia_faults(matrix_from_parameters(parameters), f"{block}.values_si", file.name)
    file.faults += [replace(fault, next_step=fault.next_step or MADE_BY) for fault in impossible]
    if impossible:
        return None
    mass, tensor = central_tensor(parameters)
    length = float(np.sqrt(np.trace(tensor) / mass))
    scale = mass * np.array([1.0, *[length] * 3, *[length**2] * 6])
    total = file.covariance(block, "covariance_si", scale=scale)
    names = file.mapping(block, "contributions_si")
    parts = {name: file.covariance(block, "contributions_si", name, scale=scale) for name in names}
    sound = {name: part for name, part in parts.items() if part is not None}
    if total is None or len(sound) < len(parts):
        return None
    if sound:
        root = np.maximum(np.sqrt(np.abs(np.diag(total))), FLOOR * scale)
        if np.max(np.abs(sum(sound.values()) - total) / np.outer(root, root)) > FLOOR:
            file.fault(f"{block}.covariance_si", "the sum of contributions_si", "another matrix")
    return MassMatrix(parameters, total, sound)


def _compare(file: Reader, record: MassRecord) -> None:
    """Compare what the file states with what follows; two blocks of matrices may be left out whole."""
    if record.scan_from_plate is None:
        for thing in ("mass_matrix_plate_axes", "frames.plate_from_footplate"):
            if file.get(*thing.split(".")) is not None:
                file.fault(thing, "null in a file without frames.scan_from_plate", "a matrix")
    for thing, (value, scale) in statements(record).items():
        path = thing.split(".")
        if path[0] in ("mass_matrix_plate_axes", "mass_matrix_reduced") and not file.mapping(path[0]):
            continue
        if scale is None:
            if (stated := file.get(*path)) != value:
                file.fault(thing, ", ".join(value) if isinstance(value, list) else f'"{value}"', stated)
            continue
        array = file.numbers(*path, shape=np.shape(value))
        if array is not None and np.max(np.abs(array - value) / scale) > SAME:
            file.fault(thing, "what inertial_parameters and frames give", array.tolist())
