"""Mass, centre of mass and inertia of the stapes in scan axes, and from there the mass matrix."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ct_inertia.bodies import Moments
from ct_inertia.options import PLAUSIBLE_DENSITY_KG_M3
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.frames import RigidTransform
from stapeskit.records.mass_matrix import MassMatrix, parameter_transfer
from stapeskit.report.quantities import MASS

_POWERS_OF_LENGTH = np.array([3.0, 4.0, 4.0, 4.0, 5.0, 5.0, 5.0, 5.0, 5.0, 5.0])


def check_density(thing: str, density_kg_m3: float, got: str, step: str) -> None:
    """Refuse a density that no bone has.

    Raises
    ------
    StapeskitError
        It lies outside 500 to 4000 kg/m3.
    """
    low, high = PLAUSIBLE_DENSITY_KG_M3
    if not low <= density_kg_m3 <= high:
        raise StapeskitError.of(thing, f"between {low:g} and {high:g} kg/m3", got, "", step)


@dataclass(frozen=True)
class PointMass:
    """A bead, a drop of glue, a tendon stump.

    Attributes
    ----------
    position_mm : ndarray, (3,)
        Scan coordinates.
    mass_kg, sd_kg : float
        Its mass, and the standard deviation of that (0 when none was given).
    """

    position_mm: Array
    mass_kg: float
    sd_kg: float = 0.0

    def parameters(self, about_mm: Array) -> Array:
        """Return its ten inertial parameters about a point (3,) in scan mm, scan axes, SI."""
        x, y, z = (self.position_mm - about_mm) * 1e-3
        tensor = [y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -y * z, -x * z]
        return self.mass_kg * np.array([1.0, x, y, z, *tensor])


def point_masses(rows: Iterable[Sequence[float]]) -> tuple[PointMass, ...]:
    """Return the point masses of rows x, y, z (mm), mass and its standard deviation (mg)."""
    return tuple(PointMass(np.array(row[:3]), MASS.si(row[3]), MASS.si(row[4])) for row in rows)


@dataclass(frozen=True)
class MassProperties:
    """A body's inertia about its centre of mass in scan axes.

    Attributes
    ----------
    density_kg_m3 : float
        Of the bone; the mean one when it varies.
    volume_m3 : float
        Of the bone.
    com_mm : ndarray, (3,)
        Centre of mass of bone and added masses, scan coordinates.
    parameters : ndarray, (10,)
        Inertial parameters about that point in scan axes, SI.
    contributions : mapping of str to ndarray, (10, 10)
        Their covariance by independent source, SI.
    length_powers : ndarray, (10,)
        Powers of length in the bone's parameters about a point of the body: what a wrong voxel size does to
        them.
    added : ndarray, (10,)
        The part of ``parameters`` that added masses make: a wrong voxel size moves them, but their masses
        stay.
    """

    density_kg_m3: float
    volume_m3: float
    com_mm: Array
    parameters: Array
    contributions: Mapping[str, Array] = field(default_factory=dict)
    length_powers: Array = field(default_factory=lambda: _POWERS_OF_LENGTH)
    added: Array = field(default_factory=lambda: np.zeros(10))

    @property
    def mass_kg(self) -> float:
        """Mass of bone and added masses, kg."""
        return float(self.parameters[0])

    def with_added(self, added: Sequence[PointMass]) -> MassProperties:
        """Add point masses; the properties are about the common centre of mass afterwards."""
        if not added:
            return self
        every = [mass.parameters(self.com_mm) for mass in added]
        points = np.sum(every, axis=0)
        contributions = dict(self.contributions)
        steps = [of * (mass.sd_kg / mass.mass_kg) for mass, of in zip(added, every, strict=True)]
        if np.any(steps):
            contributions["added_mass"] = np.transpose(steps) @ np.array(steps)
        parameters = self.parameters + points
        shift_m = parameters[1:4] / parameters[0]
        linear = parameter_transfer(np.eye(3), shift_m)
        return replace(
            self,
            com_mm=self.com_mm + shift_m * 1e3,
            parameters=linear @ parameters,
            contributions={name: linear @ part @ linear.T for name, part in contributions.items()},
            added=linear @ (self.added + points),
        )

    def mass_matrix(
        self,
        scan_from_footplate: RigidTransform,
        frame_covariance: Array,
        voxel_size_sd: float | None = None,
    ) -> MassMatrix:
        """Return the mass matrix about the footplate centre in footplate axes.

        ``frame_covariance`` (6, 6) is that of the footplate frame's displacement in its own axes, m and rad;
        ``voxel_size_sd`` the relative standard deviation of the voxel size.

        Notes
        -----
        The errors of the moments are taken as independent of those of the frame: both come from the same grey
        values, but from other voxels (the whole boundary here, the footplate's medial face there).
        """
        shift_m = (scan_from_footplate.translation_mm - self.com_mm) * 1e-3
        linear = parameter_transfer(scan_from_footplate.rotation.T, shift_m)
        parameters = linear @ self.parameters
        contributions = {name: linear @ part @ linear.T for name, part in self.contributions.items()}
        if voxel_size_sd is not None:
            added = linear @ self.added
            powers = (parameters - added) * self.length_powers + added * (_POWERS_OF_LENGTH - 3.0)
            step = powers * voxel_size_sd
            contributions["voxel_size"] = np.outer(step, step)
        return MassMatrix(parameters, contributions=contributions).with_frame_error(frame_covariance)


def from_density(moments: Moments, density_kg_m3: float, sd_kg_m3: float | None) -> MassProperties:
    """Return the mass properties of a body of uniform density.

    Without ``sd_kg_m3`` the density is taken as exact and adds nothing to the budget.
    """
    volume, parts = moments.volume_parameters(moments.centroid_mm)
    parameters = volume * density_kg_m3
    contributions = {name: density_kg_m3**2 * part for name, part in parts.items()}
    if sd_kg_m3 is not None:
        step = parameters * (sd_kg_m3 / density_kg_m3)
        contributions["density"] = np.outer(step, step)
    centre = moments.centroid_mm.copy()
    return MassProperties(density_kg_m3, moments.volume_m3, centre, parameters, contributions)


def from_mass(moments: Moments, mass_kg: float, sd_kg: float | None) -> MassProperties:
    """Return the mass properties of a body of uniform density and known mass.

    ``mass_kg`` is of the bone alone, from a balance; without ``sd_kg`` it is taken as exact.

    Raises
    ------
    StapeskitError
        Mass and volume give a density outside 500 to 4000 kg/m3.
    """
    density = mass_kg / moments.volume_m3
    got = f"{MASS.text(mass_kg)} in {moments.volume_mm3:.4g} mm3, that is {density:.4g} kg/m3"
    check_density("the density by --mass-mg", density, got, "Check the mass (mg) and the voxel size")
    volume, parts = moments.volume_parameters(moments.centroid_mm)
    parameters = volume * density
    linear = density * np.eye(10)
    linear[:, 0] -= parameters / moments.volume_m3  # at a given mass the density falls where the volume grows
    contributions = {name: linear @ part @ linear.T for name, part in parts.items()}
    if sd_kg is not None:
        step = parameters * (sd_kg / mass_kg)
        contributions["mass"] = np.outer(step, step)
    powers = _POWERS_OF_LENGTH - 3.0
    centre = moments.centroid_mm.copy()
    return MassProperties(density, moments.volume_m3, centre, parameters, contributions, powers)
