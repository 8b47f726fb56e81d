"""Read and write ``mass.json``: ten inertial parameters with their covariance, and the frames of a scan.

What defines the body must be possible, and the rest must follow from it: the writer derives it by
`statements`, and the reader compares.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from stapeskit.arrays import Array
from stapeskit.documents import as_json, read_json
from stapeskit.faults import Fault, StapeskitError, collect_faults, raise_all
from stapeskit.frames import RigidTransform
from stapeskit.records.mass_matrix import MassMatrix
from stapeskit.records.mass_record import FLOOR, SAME, MassRecord, statements
from stapeskit.spatial import central_tensor
from stapeskit.warnings import from_json

SCHEMA = "stapeskit.mass/1"
MADE_BY = "Make the file with ct2mass"

_SAME_MASS = 1e-4  # relative difference of mass and volume times density, which people type
_POSE_SCALE = np.array([1e-3] * 3 + [1.0] * 3)
_POSE = "frames.pose_covariance.scan_from_"
_OPTIONAL = ("mass_matrix_plate_axes", "mass_matrix_reduced", f"{_POSE}footplate", f"{_POSE}plate")


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
        What does not follow from the record: ``uncertainty``, ``found``, ``{"frames": {"side": ...}}``. It
        cannot replace what follows.

    Raises
    ------
    StapeskitError
        The content is not one that `mass_record` accepts.
    """
    mass, plate = record.mass_matrix, record.scan_from_plate
    values = {
        "schema": SCHEMA,
        "density_kg_m3": record.density_kg_m3,
        "volume_m3": record.volume_m3,
        **{path: value for path, (value, _) in statements(record).items()},
        "inertial_parameters.values_si": mass.parameters,
        "inertial_parameters.covariance_si": mass.covariance,
        "inertial_parameters.contributions_si": mass.contributions,
        "frames.scan_from_footplate": record.scan_from_footplate.matrix,
        "frames.scan_from_plate": None if plate is None else plate.matrix,
        f"{_POSE}footplate.matrix_si": record.footplate_covariance,
        "warnings": [notice.as_json() for notice in record.notices],
        "provenance": provenance or {},
    }
    if plate is None:
        values |= dict.fromkeys(("frames.plate_from_footplate", "mass_matrix_plate_axes", f"{_POSE}plate"))
    else:
        covariance = record.plate_covariance
        values[f"{_POSE}plate.matrix_si"] = np.zeros((6, 6)) if covariance is None else covariance
    content: dict[str, Any] = {}
    for path, value in values.items():
        *parents, key = path.split(".")
        place = content
        for parent in parents:
            place = place.setdefault(parent, {})
        place[key] = value
    for key, value in (further or {}).items():
        own = content.get(key, value)
        content[key] = {**value, **own} if isinstance(value, Mapping) and isinstance(own, Mapping) else own
    content = as_json(content)
    mass_record(content)
    return content


def read_mass_json(path: Path) -> MassRecord:
    """Read and check a ``mass.json``.

    Raises
    ------
    StapeskitError
        The file is missing, is no JSON, has another schema, lacks a key, contradicts itself, or holds a
        matrix that no rigid body can have. Every fault found is listed.
    """
    path = Path(path)
    return replace(mass_record(read_json(path, "the mass file", MADE_BY), path.name), file=path)


@runtime_checkable
class HasMass(Protocol):
    """A result that holds a mass record, as that of ct2mass."""

    def mass_record(self) -> MassRecord:
        """Return mass, frames and surfaces."""


MassInput = str | os.PathLike[str] | MassRecord | HasMass
"""What gives a mass: the path of a mass.json, a record, or a result that holds one."""


def read_mass(source: MassInput) -> MassRecord:
    """Return the mass that a path, a record or a result gives.

    Raises
    ------
    StapeskitError
        The file is not what ct2mass writes; see `read_mass_json`.
    """
    if isinstance(source, MassRecord):
        return source
    return source.mass_record() if isinstance(source, HasMass) else read_mass_json(Path(source))


def mass_record(raw: Mapping[str, Any], name: str = "mass.json") -> MassRecord:
    """Check the content of a ``mass.json``, read from a file or just computed; ``name`` is for messages.

    Raises
    ------
    StapeskitError
        As in `read_mass_json`.
    """
    if raw.get("schema") != SCHEMA:
        raise StapeskitError.of("schema", f'"{SCHEMA}"', raw.get("schema"), name, MADE_BY)
    file = Reader(raw, name)
    record = _record(file)
    if record is None:
        raise StapeskitError(*file.faults)
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

    @contextmanager
    def collecting(self) -> Iterator[None]:
        """Collect the faults that types find in their parts, with file and next step."""
        found: list[Fault] = []
        with collect_faults(found):
            yield
        self.faults += [replace(one, where=self.name, next_step=one.next_step or MADE_BY) for one in found]

    def object(self, *path: str) -> Mapping[str, Any]:
        """Return the object at a path of keys; empty when it is missing, or no object, which is a fault."""
        value = self.get(*path) if path else self.raw
        if value is not None and not isinstance(value, Mapping):
            self.fault(".".join(path), "an object", value)
        return value if isinstance(value, Mapping) else {}

    def get(self, *path: str) -> Any:
        """Return the value at a path of keys; None where there is none."""
        return self.object(*path[:-1]).get(path[-1])

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

    def covariance(self, *path: str, scale: Array) -> Array | None:
        """Return a covariance that is symmetric and positive semidefinite, or None with a fault noted.

        ``scale`` is the natural size of each parameter; what is below its rounding is not judged.
        """
        matrix = self.numbers(*path, shape=(len(scale), len(scale)))
        if matrix is None:
            return None
        relative = matrix / _roots(matrix, scale)
        lowest = float(np.linalg.eigvalsh(0.5 * (relative + relative.T))[0])
        if np.max(np.abs(relative - relative.T)) > FLOOR or lowest < -FLOOR:
            got = f"a matrix that is asymmetric, or whose correlations have the eigenvalue {lowest:.3g}"
            self.fault(".".join(path), "a covariance (symmetric, positive semidefinite)", got)
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


def _roots(covariance: Array, scale: Array) -> Array:
    """Return the products of the standard deviations, each at least the rounding of its parameter."""
    root = np.maximum(np.sqrt(np.abs(np.diag(covariance))), FLOOR * scale)
    return np.outer(root, root)


def _record(file: Reader) -> MassRecord | None:
    """Return what defines the body, or None where that is at fault."""
    try:
        notices = from_json(file.get("warnings") or ())
    except (TypeError, KeyError):
        file.fault("warnings", "a list of objects with code and text", file.get("warnings"))
        notices = ()
    poses = [_pose(file, name) for name in ("footplate", "plate")]
    sizes = [file.numbers(key, optional=True) for key in ("density_kg_m3", "volume_m3")]
    bone_alone = not file.get("found", "added_masses")
    mass = _mass_matrix(file)
    (footplate, footplate_pose), (plate, plate_pose) = poses
    if mass is None or footplate is None:
        return None
    density, volume = (None if size is None else float(size) for size in sizes)
    whole = float(mass.parameters[0])
    product = whole if density is None or volume is None or not bone_alone else density * volume
    if abs(product / whole - 1.0) > _SAME_MASS or min(density or 1.0, volume or 1.0) < 0.0:
        got = f"{product:g} kg against {whole:g} kg"
        file.fault("density_kg_m3 times volume_m3", "the mass of inertial_parameters, both positive", got)
    known = (density, volume, notices, dict(file.raw))
    return MassRecord(mass, footplate, footplate_pose, plate, None if plate is None else plate_pose, *known)


def _pose(file: Reader, name: str) -> tuple[RigidTransform | None, Array]:
    """Return a frame in the scan and the covariance of its displacement, zero when it is not stated."""
    key, covariance = f"scan_from_{name}", None
    path = ("frames", "pose_covariance", key)
    if file.get(*path) is not None:
        covariance = file.covariance(*path, "matrix_si", scale=_POSE_SCALE)
    matrix = file.numbers("frames", key, shape=(4, 4), optional=name == "plate")
    with file.collecting():
        transform = None if matrix is None else RigidTransform(matrix, "scan", name)
        return transform, np.zeros((6, 6)) if covariance is None else covariance
    return None, np.zeros((6, 6))


def _mass_matrix(file: Reader) -> MassMatrix | None:
    """Return parameters and covariance, or None with faults noted."""
    block, key = "inertial_parameters", "contributions_si"
    parameters = file.numbers(block, "values_si", shape=(10,))
    if parameters is None:
        return None
    with file.collecting():
        mass, tensor = central_tensor(MassMatrix(parameters).parameters)
        length = float(np.sqrt(np.trace(tensor) / mass))
        scale = mass * np.array([1.0, *[length] * 3, *[length**2] * 6])
        total = file.covariance(block, "covariance_si", scale=scale)
        parts = {name: file.covariance(block, key, name, scale=scale) for name in file.object(block, key)}
        sound = {name: part for name, part in parts.items() if part is not None}
        if total is None or len(sound) < len(parts):
            return None
        if sound and np.max(np.abs(sum(sound.values()) - total) / _roots(total, scale)) > FLOOR:
            file.fault(f"{block}.covariance_si", "the sum of contributions_si", "another matrix")
        return MassMatrix(parameters, total, sound)
    return None


def _compare(file: Reader, record: MassRecord) -> None:
    """Compare what the file states with what follows; two blocks of matrices may be left out whole."""
    if record.scan_from_plate is None:
        for path in (("mass_matrix_plate_axes",), ("frames", "plate_from_footplate")):
            if file.get(*path) is not None:
                file.fault(".".join(path), "null in a file without frames.scan_from_plate", "a matrix")
    for thing, (value, scale) in statements(record).items():
        keys = thing.split(".")
        words_alone = thing.startswith(_POSE) and (keys[-1] == "convention" or file.get(*keys) is None)
        absent = any(thing.startswith(block) and not file.object(*block.split(".")) for block in _OPTIONAL)
        if words_alone or absent:
            continue
        if scale is None:
            if (stated := file.get(*keys)) != value:
                file.fault(thing, ", ".join(value) if isinstance(value, list) else f'"{value}"', stated)
            continue
        array = file.numbers(*keys, shape=np.shape(value))
        if array is not None and np.max(np.abs(array - value) / scale) > SAME:
            file.fault(thing, "what inertial_parameters and frames give", array.tolist())
