"""Read and write ``mass.json``: ten inertial parameters with their covariance, and the frames of a scan.

What defines the body must be possible, and the rest must follow from it: the writer derives it by
`statements`, and the reader compares.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
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
    """Return the content of ``mass.json``, of a record whose ``raw`` is not used.

    ``further`` is what does not follow from the record: ``uncertainty``, ``found``, ``{"frames": {"side":
    ...}}``. It cannot replace what follows.

    Raises
    ------
    StapeskitError
        The content is not one that `mass_record` accepts.
    """
    mass, plate, covariance = record.mass_matrix, record.scan_from_plate, record.plate_covariance
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
        "warnings": [notice.as_json() for notice in record.notices],
        "provenance": provenance or {},
    }
    poses = {"footplate": record.footplate_covariance}
    if plate is None:
        values |= dict.fromkeys(("frames.plate_from_footplate", "mass_matrix_plate_axes", f"{_POSE}plate"))
    else:
        poses["plate"] = np.zeros((6, 6)) if covariance is None else covariance
    for name, matrix in poses.items():
        values[f"{_POSE}{name}.matrix_si"] = matrix
        words = f"displacement of the {name} frame in its own axes, m and rad"
        values[f"{_POSE}{name}.convention"] = words
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
    """Return the mass that a path, a record or a result gives; of a file see `read_mass_json`."""
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
    file = _Reader(raw, name)
    record = file.record()
    if record is None:
        raise StapeskitError(*file.faults)
    file.compare(record)
    raise_all(file.faults)
    return record


@dataclass(frozen=True)
class _Reader:
    """Reads values out of a ``mass.json`` by dotted keys while the faults are collected."""

    raw: Mapping[str, Any]
    name: str
    faults: list[Fault] = field(default_factory=list)

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
        self.faults.extend(replace(one, where=self.name, next_step=one.next_step or MADE_BY) for one in found)

    def get(self, path: str) -> Any:
        """Return the value at a path of keys; None where there is none."""
        value: Any = self.raw
        for key in path.split("."):
            value = value.get(key) if isinstance(value, Mapping) else None
        return value

    def numbers(self, path: str, shape: tuple[int, ...] = (), optional: bool = False) -> Array | None:
        """Return finite numbers of one shape, or None: with a fault noted unless they are optional."""
        value = self.get(path)
        return None if optional and value is None else self.array(path, value, shape)

    def array(self, path: str, value: Any, shape: tuple[int, ...]) -> Array | None:
        """Return a value as finite numbers of one shape, or None with a fault noted."""
        array = _array(value)
        if array is not None and array.shape == shape and np.all(np.isfinite(array)):
            return array
        self.fault(path, f"finite numbers of shape {shape}" if shape else "a finite number", value)
        return None

    def covariance(self, path: str, value: Any, scale: Array) -> Array | None:
        """Return a covariance that is symmetric and positive semidefinite, or None with a fault noted.

        ``scale`` is the natural size of each parameter; what is below its rounding is not judged.
        """
        matrix = self.array(path, value, (len(scale), len(scale)))
        if matrix is None:
            return None
        relative = matrix / _roots(matrix, scale)
        lowest = float(np.linalg.eigvalsh(0.5 * (relative + relative.T))[0])
        if np.max(np.abs(relative - relative.T)) > FLOOR or lowest < -FLOOR:
            got = f"a matrix that is asymmetric, or whose correlations have the eigenvalue {lowest:.3g}"
            self.fault(path, "a covariance (symmetric, positive semidefinite)", got)
            return None
        return matrix

    def record(self) -> MassRecord | None:
        """Return what defines the body, or None where that is at fault."""
        try:
            notices = from_json(self.get("warnings") or ())
        except (TypeError, KeyError):
            self.fault("warnings", "a list of objects with code and text", self.get("warnings"))
            notices = ()
        (footplate, footplate_pose), (plate, plate_pose) = self.pose("footplate"), self.pose("plate")
        sizes = [self.numbers(key, optional=True) for key in ("density_kg_m3", "volume_m3")]
        mass = self.mass_matrix()
        if mass is None or footplate is None:
            return None
        density, volume = (None if size is None else float(size) for size in sizes)
        whole = float(mass.parameters[0])
        bone_alone = not self.get("found.added_masses")
        product = whole if density is None or volume is None or not bone_alone else density * volume
        if abs(product / whole - 1.0) > _SAME_MASS or min(density or 1.0, volume or 1.0) < 0.0:
            got = f"{product:g} kg against {whole:g} kg"
            self.fault("density_kg_m3 times volume_m3", "the mass of inertial_parameters, both positive", got)
        known = (density, volume, notices, dict(self.raw))
        plate_covariance = None if plate is None else plate_pose
        return MassRecord(mass, footplate, footplate_pose, plate, plate_covariance, *known)

    def pose(self, name: str) -> tuple[RigidTransform | None, Array]:
        """Return a frame in the scan and the covariance of its displacement, zero when it is not stated."""
        covariance, path = None, f"{_POSE}{name}.matrix_si"
        if self.get(f"{_POSE}{name}") is not None:
            covariance = self.covariance(path, self.get(path), _POSE_SCALE)
        matrix = self.numbers(f"frames.scan_from_{name}", (4, 4), optional=name == "plate")
        with self.collecting():
            transform = None if matrix is None else RigidTransform(matrix, "scan", name)
            return transform, np.zeros((6, 6)) if covariance is None else covariance
        return None, np.zeros((6, 6))

    def mass_matrix(self) -> MassMatrix | None:
        """Return parameters and covariance, or None with faults noted."""
        parameters = self.numbers("inertial_parameters.values_si", (10,))
        if parameters is None:
            return None
        with self.collecting():
            mass, tensor = central_tensor(MassMatrix(parameters).parameters)
            length = float(np.sqrt(np.trace(tensor) / mass))
            scale = mass * np.array([1.0, *[length] * 3, *[length**2] * 6])
            whole, path = "inertial_parameters.covariance_si", "inertial_parameters.contributions_si"
            total, given = self.covariance(whole, self.get(whole), scale), self.get(path) or {}
            if not isinstance(given, Mapping):
                self.fault(path, "an object", given)
                return None
            parts = {name: self.covariance(f"{path}.{name}", part, scale) for name, part in given.items()}
            sound = {name: part for name, part in parts.items() if part is not None}
            if total is None or len(sound) < len(parts):
                return None
            if sound and np.max(np.abs(sum(sound.values()) - total) / _roots(total, scale)) > FLOOR:
                self.fault(whole, "the sum of contributions_si", "another matrix")
            return MassMatrix(parameters, total, sound)
        return None

    def compare(self, record: MassRecord) -> None:
        """Compare what the file states with what follows; some blocks may be left out whole."""
        if record.scan_from_plate is None:
            for path in ("mass_matrix_plate_axes", "frames.plate_from_footplate"):
                if self.get(path) is not None:
                    self.fault(path, "null in a file without frames.scan_from_plate", "a matrix")
        for path, (value, scale) in statements(record).items():
            block, stated = path.rpartition(".")[0], self.get(path)
            if block in _OPTIONAL and self.get(block) in (None, {}):
                continue
            if scale is None:
                if stated != value and (stated is not None or not path.startswith(_POSE)):
                    self.fault(path, ", ".join(value) if isinstance(value, list) else f'"{value}"', stated)
                continue
            array = self.array(path, stated, np.shape(value))
            if array is not None and np.max(np.abs(array - value) / scale) > SAME:
                self.fault(path, "what inertial_parameters and frames give", array.tolist())


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
