"""Check a ``mass.json``: types, shapes, signs, and contradictions between its parts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault
from legacy.stapeskit.frames import RigidTransform, transform_faults
from legacy.stapeskit.spatial import (
    DOF_NAMES,
    PARAMETER_NAMES,
    central_tensor,
    inertia_faults,
    matrix_from_parameters,
    parameter_basis,
    twist_transfer,
)

MADE_BY = "Make the file with ct2mass"
# Relative differences by which redundant entries of a file may round: all entries; mass against volume
# times density, which people type.
_SAME = 1e-6
_SAME_MASS = 1e-4
# Rounding of variances, of correlations and of eigenvalues.
_NEGATIVE = 1e-12
_FLOOR = 1e-5
_POSE_SCALE = np.array([1e-3] * 3 + [1.0] * 3)
_POSES = ("scan_from_footplate", "scan_from_plate")


@dataclass
class Checked:
    """What a ``mass.json`` says, read piece by piece while the faults are collected.

    Attributes
    ----------
    raw : mapping
        The whole file.
    file : str
        Its name, for messages.
    faults : list of str
        Finished sentences.
    parameters, covariance : ndarray, (10,) and (10, 10)
        SI; None when they cannot be used.
    contributions : dict of str to ndarray, (10, 10)
    transforms : dict of str to RigidTransform
        By the name in ``frames``; missing and null ones are left out.
    poses : dict of str to ndarray, (6, 6)
        Covariance of the frames, m and rad.
    """

    raw: Mapping[str, Any]
    file: str
    faults: list[Fault] = field(default_factory=list)
    parameters: Array | None = None
    covariance: Array | None = None
    contributions: dict[str, Array] = field(default_factory=dict)
    transforms: dict[str, RigidTransform] = field(default_factory=dict)
    poses: dict[str, Array] = field(default_factory=dict)

    def fault(self, thing: str, expected: str, got: object) -> None:
        """Add one fault to the list."""
        self.faults.append(Fault(thing, expected, got, self.file, MADE_BY))

    def get(self, path: str, optional: bool = False) -> Any:
        """Return the value at a dotted path; None, and a fault unless optional, when null or missing."""
        value: Any = self.raw
        for place, key in enumerate(keys := path.split(".")):
            if value is None or (isinstance(value, Mapping) and key not in value):
                value = None
                break
            if not isinstance(value, Mapping):
                self.fault(".".join(keys[:place]), "an object", short(value))
                return None
            value = value[key]
        if value is None and not optional:
            self.fault(path, "given", "none")
        return value

    def numbers(self, path: str, shape: tuple[int, ...], optional: bool = False) -> Array | None:
        """Return finite numbers of one shape, or None with a fault noted."""
        value = self.get(path, optional)
        return None if value is None else self.array(value, path, shape)

    def array(self, value: Any, name: str, shape: tuple[int, ...]) -> Array | None:
        """Return a JSON value as finite numbers of one shape, or None with a fault noted."""
        array = _array(value)
        wanted = f"finite numbers of shape {shape}" if shape else "a finite number"
        if array is None:
            self.fault(name, wanted, short(value))
        elif array.shape != shape:
            self.fault(name, wanted, f"shape {array.shape}" if array.shape else short(value))
        elif not np.all(np.isfinite(array)):
            self.fault(name, wanted, "NaN or infinity")
        else:
            return array
        return None

    def covariance_of(self, value: Any, name: str, scale: Array) -> Array | None:
        """Return a covariance that is symmetric and positive semidefinite, or None with a fault noted.

        ``scale`` is the natural size of each parameter; what is below its rounding is not judged.
        """
        matrix = self.array(value, name, (len(scale), len(scale)))
        if matrix is None:
            return None
        variances = np.diag(matrix)
        if np.any(variances < -_NEGATIVE * scale**2):
            self.fault(
                name, "a covariance (variances zero or positive)", f"a variance of {variances.min():g}"
            )
            return None
        root = np.maximum(np.sqrt(np.maximum(variances, 0.0)), _FLOOR * scale)
        relative = matrix / np.outer(root, root)
        if np.max(np.abs(relative - relative.T)) > _FLOOR:
            self.fault(name, "symmetric", "an asymmetric matrix")
            return None
        lowest = float(np.linalg.eigvalsh(0.5 * (relative + relative.T))[0])
        if lowest < -_FLOOR:
            got = f"a correlation matrix with the eigenvalue {lowest:.3g}"
            self.fault(name, "a covariance (positive semidefinite)", got)
            return None
        return matrix

    def word(self, path: str, wanted: str) -> None:
        """Check that a text is the one that it must be."""
        value = self.get(path)
        if value is not None and value != wanted:
            self.fault(path, f'"{wanted}"', f'"{value}"' if isinstance(value, str) else short(value))

    def listed(self, path: str, wanted: tuple[str, ...]) -> None:
        """Check that a list of names is the one that it must be."""
        value = self.get(path)
        if value is not None and value != list(wanted):
            self.fault(path, ", ".join(wanted), short(value))


def short(value: Any) -> str:
    """Return a JSON value for a message, not more than a line of it."""
    text = f'"{value}"' if isinstance(value, str) else str(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _array(value: Any) -> Array | None:
    """Return nested lists of JSON numbers as an array; None when anything else is among them."""

    def plain(entry: Any) -> bool:
        if isinstance(entry, list):
            return all(plain(part) for part in entry)
        return isinstance(entry, int | float) and not isinstance(entry, bool)

    if not plain(value):
        return None
    try:
        return np.array(value, dtype=float)
    except (ValueError, OverflowError):
        return None


def check(raw: Mapping[str, Any], file: str) -> Checked:
    """Read and check everything of a ``mass.json`` that is used.

    Parameters
    ----------
    raw : mapping
        The JSON object.
    file : str
        Its name, for messages.

    Returns
    -------
    Checked
        Complete when its ``faults`` are empty.
    """
    checked = Checked(raw, file)
    for block in ("inertial_parameters", "mass_matrix"):
        checked.word(f"{block}.about", "footplate_centre")
        checked.word(f"{block}.axes", "footplate")
    checked.listed("inertial_parameters.names", PARAMETER_NAMES)
    checked.listed("mass_matrix.dof", DOF_NAMES)
    checked.parameters = checked.numbers("inertial_parameters.values_si", (10,))
    matrix = checked.numbers("mass_matrix.matrix_si", (6, 6))
    impossible = [] if matrix is None else inertia_faults(matrix, "mass_matrix.matrix_si", file)
    if checked.parameters is not None:
        own = matrix_from_parameters(checked.parameters)
        faults = inertia_faults(own, "inertial_parameters.values_si", file)
        same = matrix is not None and _differ(matrix, own) <= _SAME
        impossible = impossible if same or not faults else [*impossible, *faults]
        if matrix is not None and not same:
            checked.fault("mass_matrix", "the matrix of inertial_parameters", "another one")
        if faults:
            checked.parameters = None
    checked.faults += impossible
    _frames(checked)
    _notices(checked)
    mass, centre, tensor = _body(checked)
    if checked.parameters is not None:
        _uncertainty(checked, checked.parameters)
        _same_body(checked, checked.parameters, mass, centre, tensor)
    checked.faults = list(dict.fromkeys(checked.faults))
    return checked


def _differ(stated: Array, computed: Array) -> float:
    """Return the largest difference of two inertia matrices in units of sqrt(Mii Mjj)."""
    root = np.sqrt(np.abs(np.diag(computed)))
    root = np.where(root > 0.0, root, 1.0)
    return float(np.max(np.abs(stated - computed) / np.outer(root, root)))


def _frames(checked: Checked) -> None:
    """Read the frames and their covariances; check that they fit together."""
    for name in (*_POSES, "plate_from_footplate"):
        to, source = name.split("_from_")
        matrix = checked.numbers(f"frames.{name}", (4, 4), optional=name != "scan_from_footplate")
        if matrix is None:
            continue
        faults = transform_faults(matrix, f"frames.{name}", checked.file)
        checked.faults += faults
        if not faults:
            checked.transforms[name] = RigidTransform(matrix, to, source)
    plate_poses = {name for name in ("scan_from_plate", "plate_from_footplate") if _is_given(checked, name)}
    if len(plate_poses) == 1:
        present = plate_poses.pop()
        other = "plate_from_footplate" if present == "scan_from_plate" else "scan_from_plate"
        checked.fault(f"frames.{other}", f"given together with {present}", "none")
    if len(checked.transforms) == 3:
        wanted = (
            checked.transforms["scan_from_plate"].inverse() @ checked.transforms["scan_from_footplate"]
        ).matrix
        off = np.abs(checked.transforms["plate_from_footplate"].matrix - wanted)
        lengths = [
            float(np.linalg.norm(transform.translation_mm)) for transform in checked.transforms.values()
        ]
        if np.max(off[:, :3]) > _SAME or np.max(off[:, 3]) > _SAME * max([1.0, *lengths]):
            got = f"one that is {np.max(off[:, 3]):.3g} mm and {np.max(off[:, :3]):.3g} rad off"
            checked.fault(
                "frames.plate_from_footplate", "inverse(scan_from_plate) @ scan_from_footplate", got
            )
    for name in _POSES:
        path = f"frames.pose_covariance.{name}"
        if checked.get(path, optional=True) is None:
            continue
        if checked.get(f"{path}.names", optional=True) is not None:
            checked.listed(f"{path}.names", DOF_NAMES)
        value = checked.get(f"{path}.matrix_si")
        matrix = None if value is None else checked.covariance_of(value, f"{path}.matrix_si", _POSE_SCALE)
        if matrix is not None:
            checked.poses[name] = matrix


def _is_given(checked: Checked, name: str) -> bool:
    frames = checked.raw.get("frames")
    return isinstance(frames, Mapping) and frames.get(name) is not None


def _notices(checked: Checked) -> None:
    warnings = checked.raw.get("warnings", [])
    good = isinstance(warnings, list) and all(
        isinstance(warning, Mapping)
        and isinstance(warning.get("code"), str)
        and isinstance(warning.get("text"), str)
        for warning in warnings
    )
    if not good:
        checked.fault("warnings", "a list of objects with code and text", short(warnings))
    if not isinstance(checked.raw.get("found") or {}, Mapping):
        checked.fault("found", "an object", short(checked.raw["found"]))


def _body(checked: Checked) -> tuple[Array | None, Array | None, Array | None]:
    """Return mass (kg), centre of mass (3,), mm, and central tensor (3, 3), kg m2; check density x volume."""
    mass = checked.numbers("mass_kg", ())
    if mass is not None and not mass > 0.0:
        checked.fault("mass_kg", "positive", f"{mass:g}")
        mass = None
    centre = checked.numbers("center_of_mass_in_scan_mm", (3,))
    tensor = checked.numbers("inertia_about_center_of_mass_in_scan_axes_kg_m2", (3, 3), optional=True)
    density = checked.numbers("density_kg_m3", (), optional=True)
    volume = checked.numbers("volume_m3", (), optional=True)
    for name, value in (("density_kg_m3", density), ("volume_m3", volume)):
        if value is not None and not value > 0.0:
            checked.fault(name, "positive", f"{value:g}")
    landmarks = checked.raw.get("found")
    added = isinstance(landmarks, Mapping) and bool(landmarks.get("added_masses"))
    if mass is not None and density is not None and volume is not None and not added:
        product = float(density * volume)
        if abs(product / float(mass) - 1.0) > _SAME_MASS:
            got = f"{product:g} kg against {mass:g} kg"
            checked.fault("density_kg_m3 times volume_m3", "mass_kg", got)
    return mass, centre, tensor


def _uncertainty(checked: Checked, parameters: Array) -> None:
    """Read the covariance of the parameters and its parts, and compare the stated standard deviations."""
    mass, tensor = central_tensor(parameters)
    length = float(np.sqrt(np.trace(tensor) / mass))
    scale = mass * np.array([1.0, *[length] * 3, *[length**2] * 6])
    value = checked.get("inertial_parameters.covariance_si")
    if value is not None:
        checked.covariance = checked.covariance_of(value, "inertial_parameters.covariance_si", scale)
    parts = checked.get("inertial_parameters.contributions_si", optional=True) or {}
    if not isinstance(parts, Mapping):
        checked.fault("inertial_parameters.contributions_si", "an object", short(parts))
        parts = {}
    for name, part in parts.items():
        matrix = checked.covariance_of(part, f"inertial_parameters.contributions_si.{name}", scale)
        if matrix is not None:
            checked.contributions[name] = matrix
    covariance = checked.covariance
    if covariance is None:
        return
    if parts and len(checked.contributions) == len(parts):
        root = np.maximum(np.sqrt(np.maximum(np.diag(covariance), 0.0)), _FLOOR * scale)
        total = sum(checked.contributions.values(), np.zeros((10, 10)))
        if np.max(np.abs(total - covariance) / np.outer(root, root)) > _FLOOR:
            checked.fault(
                "inertial_parameters.covariance_si", "the sum of contributions_si", "another matrix"
            )
    basis = parameter_basis()
    wanted = np.sqrt(np.maximum(np.einsum("aij,ab,bij->ij", basis, covariance, basis), 0.0))
    root = np.sqrt(np.diag(matrix_from_parameters(parameters)))
    for block, size in (("mass_matrix", 6), ("mass_matrix_plate_axes", 6), ("mass_matrix_reduced", 0)):
        dof = checked.raw.get(block)
        if not isinstance(dof, Mapping) or dof.get("standard_deviation_si") is None:
            continue
        places = list(range(6)) if size else _places(dof.get("dof"))
        path = f"{block}.standard_deviation_si"
        sd = checked.numbers(path, (len(places), len(places)))
        if sd is not None and np.any(sd < 0.0):
            checked.fault(path, "zero or positive", f"{np.min(sd):g}")
        elif sd is not None and block != "mass_matrix_plate_axes":
            off = np.abs(sd - wanted[np.ix_(places, places)]) / np.outer(root[places], root[places])
            if np.max(off, initial=0.0) > _FLOOR:
                checked.fault(path, "that of inertial_parameters.covariance_si", "another one")


def _places(names: Any) -> list[int]:
    """Return the positions of a list of degrees of freedom; empty when it is none."""
    good = isinstance(names, list) and all(name in DOF_NAMES for name in names)
    return [DOF_NAMES.index(name) for name in names] if good else []


def _same_body(
    checked: Checked, parameters: Array, mass: Array | None, centre: Array | None, tensor: Array | None
) -> None:
    """Compare every other statement about the body with its inertial parameters."""
    if mass is not None and abs(float(mass) / parameters[0] - 1.0) > _SAME:
        checked.fault("mass_kg", f"{parameters[0]:g} as in inertial_parameters", f"{mass:g}")
    own = matrix_from_parameters(parameters)
    frame = checked.transforms.get("scan_from_footplate")
    if frame is not None:
        com_mm = frame.points(parameters[1:4] / parameters[0] * 1e3)
        size = max(100.0, float(np.max(np.abs(com_mm))))
        if centre is not None and np.max(np.abs(com_mm - centre)) > _SAME * size:
            where = "where inertial_parameters and frames put it"
            checked.fault("center_of_mass_in_scan_mm", where, short(centre.tolist()))
        turned = frame.rotation @ central_tensor(parameters)[1] @ frame.rotation.T
        if tensor is not None and np.max(np.abs(tensor - turned)) > _SAME * np.trace(turned):
            name = "inertia_about_center_of_mass_in_scan_axes_kg_m2"
            checked.fault(name, "the tensor of inertial_parameters, turned by frames", "another one")
    reduced = checked.get("mass_matrix_reduced", optional=True)
    if reduced is not None:
        names = checked.get("mass_matrix_reduced.dof")
        places = _places(names)
        if not places:
            checked.fault("mass_matrix_reduced.dof", f"names out of {', '.join(DOF_NAMES)}", short(names))
        else:
            stated = checked.numbers("mass_matrix_reduced.matrix_si", (len(places), len(places)))
            root = np.sqrt(np.diag(own))[places]
            part = own[np.ix_(places, places)]
            if stated is not None and np.max(np.abs(stated - part) / np.outer(root, root)) > _SAME:
                checked.fault("mass_matrix_reduced", "the same entries as mass_matrix", "others")
    if checked.get("mass_matrix_plate_axes", optional=True) is None:
        return
    checked.word("mass_matrix_plate_axes.about", "footplate_centre")
    checked.word("mass_matrix_plate_axes.axes", "plate")
    checked.listed("mass_matrix_plate_axes.dof", DOF_NAMES)
    stated = checked.numbers("mass_matrix_plate_axes.matrix_si", (6, 6))
    plate = checked.transforms.get("plate_from_footplate")
    if plate is None and not _is_given(checked, "plate_from_footplate"):
        checked.fault("mass_matrix_plate_axes", "null in a file without plate_from_footplate", "a matrix")
    elif plate is not None and stated is not None:
        back = np.linalg.inv(twist_transfer(plate.rotation, np.zeros(3)))
        if _differ(stated, back.T @ own @ back) > _SAME:
            checked.fault(
                "mass_matrix_plate_axes", "mass_matrix turned into the plate axes", "another matrix"
            )
