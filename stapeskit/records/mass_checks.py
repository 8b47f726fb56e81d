"""Check a ``mass.json``: what defines the body must be possible; the rest must follow from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from stapeskit.arrays import Array
from stapeskit.faults import Fault
from stapeskit.frames import RigidTransform, transform_faults
from stapeskit.records.mass_matrix import MassMatrix
from stapeskit.records.mass_record import FLOOR, SAME, MassRecord, Stated
from stapeskit.spatial import DOF_NAMES, central_tensor, inertia_faults, matrix_from_parameters
from stapeskit.warnings import from_json

MADE_BY = "Make the file with ct2mass"
REDUCED = ("y", "alpha", "gamma")
"""Degrees of freedom of the stapes in the paper: those of the reduced matrix."""

_SAME_MASS = 1e-4  # relative difference of mass and volume times density, which people type
_POSE_SCALE = np.array([1e-3] * 3 + [1.0] * 3)


@dataclass
class MassReader:
    """Reads a ``mass.json`` piece by piece while the faults are collected."""

    raw: Mapping[str, Any]
    file: str
    faults: list[Fault] = field(default_factory=list)

    def fault(self, thing: str, expected: str, got: object) -> None:
        """Add one fault, its value cut to what a line of a message holds."""
        text = str(got)
        shown = text if len(text) <= 60 else text[:57] + "..."
        self.faults.append(Fault(thing, expected, shown, self.file, MADE_BY))

    def add(self, faults: Sequence[Fault]) -> None:
        """Add faults that were found elsewhere, with what to do where they do not name it."""
        self.faults += [replace(fault, next_step=fault.next_step or MADE_BY) for fault in faults]

    def get(self, path: str, optional: bool = False) -> Any:
        """Return the value at a dotted path; None, and a fault unless optional, when null or missing."""
        value: Any = self.raw
        for key in path.split("."):
            value = value.get(key) if isinstance(value, Mapping) else None
        if value is None and not optional:
            self.fault(path, "given", "none")
        return value

    def numbers(
        self, path: str, shape: tuple[int, ...] = (), optional: bool = False, value: Any = None
    ) -> Array | None:
        """Return finite numbers of one shape, or None with a fault noted; ``value`` is that of the path."""
        value = self.get(path, optional) if value is None else value
        if value is None:
            return None
        array = _array(value)
        if array is None or array.shape != shape or not np.all(np.isfinite(array)):
            self.fault(path, f"finite numbers of shape {shape}" if shape else "a finite number", value)
            return None
        return array

    def positive(self, path: str, optional: bool = False) -> float | None:
        """Return a positive number, or None with a fault noted."""
        value = self.numbers(path, (), optional)
        if value is not None and not value > 0.0:
            self.fault(path, "positive", f"{value:g}")
            return None
        return None if value is None else float(value)

    def mapping(self, path: str) -> Mapping[str, Any]:
        """Return an optional object; empty when it is missing, or no object, which is a fault."""
        value = self.get(path, optional=True)
        if value is not None and not isinstance(value, Mapping):
            self.fault(path, "an object", value)
        return value if isinstance(value, Mapping) else {}

    def covariance(self, path: str, scale: Array, value: Any = None) -> Array | None:
        """Return a covariance that is symmetric and positive semidefinite, or None with a fault noted.

        ``scale`` is the natural size of each parameter; what is below its rounding is not judged.
        """
        matrix = self.numbers(path, (len(scale), len(scale)), value=value)
        if matrix is None:
            return None
        root = np.maximum(np.sqrt(np.abs(np.diag(matrix))), FLOOR * scale)
        relative = matrix / np.outer(root, root)
        if np.max(np.abs(relative - relative.T)) > FLOOR:
            self.fault(path, "symmetric", "an asymmetric matrix")
            return None
        lowest = float(np.linalg.eigvalsh(0.5 * (relative + relative.T))[0])
        if lowest < -FLOOR:
            got = f"a matrix whose correlations have the eigenvalue {lowest:.3g}"
            self.fault(path, "a covariance (positive semidefinite)", got)
            return None
        return matrix

    def record(self) -> MassRecord | None:
        """Return the record of what defines the body, or None with faults noted."""
        self.mapping("frames")
        footplate, footplate_pose = self.pose("footplate")
        plate, plate_pose = self.pose("plate")
        notices = self.get("warnings", optional=True) or []
        if not _are_notices(notices):
            self.fault("warnings", "a list of objects with code and text", notices)
            notices = []
        mass = self.mass_matrix()
        density, volume = (self.positive(name, optional=True) for name in ("density_kg_m3", "volume_m3"))
        added = self.mapping("found").get("added_masses")
        if mass is not None and density is not None and volume is not None and not added:
            product, whole = density * volume, float(mass.parameters[0])
            if abs(product / whole - 1.0) > _SAME_MASS:
                got = f"{product:g} kg against {whole:g} kg"
                self.fault("density_kg_m3 times volume_m3", "the mass of inertial_parameters", got)
        if mass is None or footplate is None:
            return None
        return MassRecord(
            mass,
            footplate,
            footplate_pose,
            plate,
            None if plate is None else plate_pose,
            density,
            volume,
            from_json(notices),
            dict(self.raw),
        )

    def pose(self, name: str) -> tuple[RigidTransform | None, Array]:
        """Return a frame in the scan and the covariance of its displacement, zero when it is not stated."""
        path = f"frames.scan_from_{name}"
        matrix = self.numbers(path, (4, 4), optional=name == "plate")
        faults = [] if matrix is None else transform_faults(matrix, path, self.file)
        self.add(faults)
        covariance = None
        poses = self.mapping("frames.pose_covariance")
        if poses.get(f"scan_from_{name}") is not None:
            path = f"frames.pose_covariance.scan_from_{name}"
            covariance = self.covariance(f"{path}.matrix_si", _POSE_SCALE)
            if self.get(f"{path}.names", optional=True) not in (None, list(DOF_NAMES)):
                self.fault(f"{path}.names", ", ".join(DOF_NAMES), self.get(f"{path}.names"))
        good = matrix is not None and not faults
        transform = RigidTransform(matrix, "scan", name) if good and matrix is not None else None
        return transform, np.zeros((6, 6)) if covariance is None else covariance

    def mass_matrix(self) -> MassMatrix | None:
        """Return parameters and covariance, or None with faults noted."""
        parameters = self.numbers("inertial_parameters.values_si", (10,))
        if parameters is None:
            return None
        where = "inertial_parameters.values_si"
        impossible = inertia_faults(matrix_from_parameters(parameters), where, self.file)
        self.add(impossible)
        if impossible:
            return None
        mass, tensor = central_tensor(parameters)
        length = float(np.sqrt(np.trace(tensor) / mass))
        scale = mass * np.array([1.0, *[length] * 3, *[length**2] * 6])
        total = self.covariance("inertial_parameters.covariance_si", scale)
        path = "inertial_parameters.contributions_si"
        stated = self.mapping(path)
        parts = {name: self.covariance(f"{path}.{name}", scale, part) for name, part in stated.items()}
        sound = {name: part for name, part in parts.items() if part is not None}
        if total is None or len(sound) < len(parts):
            return None
        if sound:
            root = np.maximum(np.sqrt(np.abs(np.diag(total))), FLOOR * scale)
            difference = np.abs(sum(sound.values()) - total) / np.outer(root, root)
            if np.max(difference) > FLOOR:
                got = "another matrix"
                self.fault("inertial_parameters.covariance_si", "the sum of contributions_si", got)
        return MassMatrix(parameters, total, sound)

    def reduced_dof(self) -> Sequence[str]:
        """Return the degrees of freedom of the reduced matrix."""
        names = self.mapping("mass_matrix_reduced").get("dof")
        return (
            names if names and isinstance(names, list) and set(map(str, names)) <= set(DOF_NAMES) else REDUCED
        )

    def compare(self, statements: Mapping[str, Stated]) -> None:
        """Compare what the file states with what follows."""
        for block in ("mass_matrix_plate_axes", "frames.plate_from_footplate"):
            given = self.get(block, optional=True) is not None
            if given and "frames.plate_from_footplate" not in statements:
                self.fault(block, "null in a file without frames.scan_from_plate", "a matrix")
        for path, wanted in statements.items():
            block = path.partition(".")[0]
            if block in ("mass_matrix_plate_axes", "mass_matrix_reduced") and not self.mapping(block):
                continue
            if wanted.scale is None:
                stated = self.get(path, optional=not wanted.needed)
                if stated is not None and stated != wanted.value:
                    expected = (
                        ", ".join(wanted.value) if isinstance(wanted.value, list) else f'"{wanted.value}"'
                    )
                    self.fault(path, expected, stated)
                continue
            array = self.numbers(path, np.shape(wanted.value), optional=not wanted.needed)
            if array is not None and np.max(np.abs(array - wanted.value) / wanted.scale) > SAME:
                self.fault(path, "what inertial_parameters and frames give", array.tolist())


def _are_notices(values: Any) -> bool:
    return isinstance(values, list) and all(
        isinstance(value, Mapping) and isinstance(value.get(key), str)
        for value in values
        for key in ("code", "text")
    )


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
