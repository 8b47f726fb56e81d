"""Mass, centre of mass and inertia of the stapes in scan axes, and from there the mass matrix."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.options import PLAUSIBLE_DENSITY
from legacy.ct_inertia.surface.moments import Moments
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import RigidTransform
from legacy.stapeskit.page.quantities import MILLIGRAM
from legacy.stapeskit.records.mass_record import (
    FRAME_SOURCE,
    MassMatrix,
    frame_derivative,
    parameter_transfer,
)
from legacy.stapeskit.spatial import central_tensor

_POWERS_OF_LENGTH = np.array([3.0, 4.0, 4.0, 4.0, 5.0, 5.0, 5.0, 5.0, 5.0, 5.0])


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

    def __post_init__(self) -> None:
        object.__setattr__(self, "position_mm", np.asarray(self.position_mm, dtype=float))
        if not (np.isfinite(self.mass_kg) and self.mass_kg > 0.0):
            raise CtInertiaError.of(
                "{add_mass}",
                "a positive mass in mg",
                MILLIGRAM.text(self.mass_kg),
                next_step="Give X,Y,Z,MG with MG above 0",
            )

    def parameters(self, about_mm: Array, length_scale: float = 1.0) -> Array:
        """Return its ten inertial parameters about a point (3,) in scan mm, scan axes, SI."""
        arm = (self.position_mm - about_mm) * (1e-3 * length_scale)
        tensor = self.mass_kg * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        return np.concatenate([[self.mass_kg], self.mass_kg * arm, _pack(tensor)])


def point_masses(rows: Iterable[Sequence[float]]) -> tuple[PointMass, ...]:
    """Return the point masses of rows x, y, z (mm), mass and its standard deviation (mg)."""
    return tuple(PointMass(np.array(row[:3]), *map(MILLIGRAM.si, row[3:5])) for row in rows)


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
        The part of ``parameters`` that added masses make; a wrong voxel size moves them, but their masses
        stay.
    length_scale : float
        True length of 1 mm in scan coordinates, mm: applied to all but ``com_mm``.
    """

    density_kg_m3: float
    volume_m3: float
    com_mm: Array
    parameters: Array
    contributions: Mapping[str, Array] = field(default_factory=dict)
    length_powers: Array = field(default_factory=lambda: _POWERS_OF_LENGTH)
    added: Array = field(default_factory=lambda: np.zeros(10))
    length_scale: float = 1.0

    @property
    def mass_kg(self) -> float:
        """Mass of bone and added masses, kg."""
        return float(self.parameters[0])

    @property
    def inertia_about_com(self) -> Array:
        """Inertia tensor about the centre of mass in scan axes, (3, 3), kg m2."""
        return central_tensor(self.parameters)[1]


def from_density(moments: Moments, density_kg_m3: float, sd_kg_m3: float | None) -> MassProperties:
    """Compute the mass properties of a body of uniform density.

    Parameters
    ----------
    moments : Moments
        mm powers, scan axes.
    density_kg_m3 : float
    sd_kg_m3 : float or None
        None: the density is taken as exact and adds nothing to the budget.

    Raises
    ------
    CtInertiaError
        The density lies outside 500 to 4000 kg/m3, where no bone is (a wrong unit).
    """
    if not PLAUSIBLE_DENSITY[0] <= density_kg_m3 <= PLAUSIBLE_DENSITY[1]:
        raise CtInertiaError.of(
            "{density}",
            "between 500 and 4000 kg/m3",
            f"{density_kg_m3:g}",
            next_step="Bone has 1400 to 2200 kg/m3; 1 g/cm3 is 1000 kg/m3",
        )
    linear = density_kg_m3 * _by_moments(moments)
    parameters = unit_parameters(moments) * density_kg_m3
    contributions = {name: linear @ part @ linear.T for name, part in moments.contributions.items()}
    if sd_kg_m3 is not None:
        step = parameters * (sd_kg_m3 / density_kg_m3)
        contributions["density"] = np.outer(step, step)
    return MassProperties(
        density_kg_m3, moments.volume_mm3 * 1e-9, moments.centroid_mm.copy(), parameters, contributions
    )


def from_mass(moments: Moments, mass_kg: float, sd_kg: float | None) -> MassProperties:
    """Compute the mass properties of a body of uniform density and known mass.

    Parameters
    ----------
    moments : Moments
        mm powers, scan axes.
    mass_kg : float
        Of the bone alone, from a balance.
    sd_kg : float or None
        None: the mass is taken as exact.

    Raises
    ------
    CtInertiaError
        Mass and volume give a density outside 500 to 4000 kg/m3.
    """
    density = mass_kg / (moments.volume_mm3 * 1e-9)
    if not PLAUSIBLE_DENSITY[0] <= density <= PLAUSIBLE_DENSITY[1]:
        raise CtInertiaError.of(
            "{mass_mg}",
            f"a mass that gives the volume of {moments.volume_mm3:.4g} mm3 the density of a bone "
            "(500 to 4000 kg/m3)",
            f"{MILLIGRAM.text(mass_kg)}, that is {density:.4g} kg/m3",
            next_step="Check the mass (mg) and the voxel size",
        )
    parameters = unit_parameters(moments) * density
    linear = density * _by_moments(moments)
    linear[:, 0] -= parameters / moments.volume_mm3
    contributions = {name: linear @ part @ linear.T for name, part in moments.contributions.items()}
    if sd_kg is not None:
        step = parameters * (sd_kg / mass_kg)
        contributions["mass"] = np.outer(step, step)
    return MassProperties(
        density,
        moments.volume_mm3 * 1e-9,
        moments.centroid_mm.copy(),
        parameters,
        contributions,
        _POWERS_OF_LENGTH - 3.0,
    )


def scaled(body: MassProperties, factor: float) -> MassProperties:
    """Return the properties of bone whose voxels are larger by a factor; ``com_mm`` remains in scan mm."""
    powers = factor**body.length_powers
    mass = factor ** float(body.length_powers[0])
    return replace(
        body,
        density_kg_m3=body.density_kg_m3 * mass / factor**3,
        volume_m3=body.volume_m3 * factor**3,
        parameters=body.parameters * powers,
        contributions={name: part * np.outer(powers, powers) for name, part in body.contributions.items()},
        length_scale=factor,
    )


def with_added(body: MassProperties, added: Sequence[PointMass]) -> MassProperties:
    """Add point masses to a body; the properties are about the common centre of mass afterwards."""
    if not added:
        return body
    scale = body.length_scale
    every = [mass.parameters(body.com_mm, scale) for mass in added]
    points = np.sum(every, axis=0)
    parameters = body.parameters + points
    contributions = dict(body.contributions)
    steps = [of * (mass.sd_kg / mass.mass_kg) for mass, of in zip(added, every, strict=True)]
    if any(np.any(step) for step in steps):
        contributions["added_mass"] = sum((np.outer(step, step) for step in steps), np.zeros((10, 10)))
    shift_m = parameters[1:4] / parameters[0]
    linear = parameter_transfer(np.eye(3), shift_m)
    return MassProperties(
        body.density_kg_m3,
        body.volume_m3,
        body.com_mm + shift_m * 1e3 / scale,
        linear @ parameters,
        {name: linear @ part @ linear.T for name, part in contributions.items()},
        body.length_powers,
        linear @ (body.added + points),
        scale,
    )


def footplate_mass_matrix(
    body: MassProperties,
    scan_from_footplate: RigidTransform,
    frame_covariance: Array,
    voxel_size_sd: float | None = None,
) -> MassMatrix:
    """Return the mass matrix about the footplate centre in footplate axes.

    Parameters
    ----------
    body : MassProperties
    scan_from_footplate : RigidTransform
    frame_covariance : ndarray, (6, 6)
        Of the footplate frame's displacement in its own axes, m and rad.
    voxel_size_sd : float, optional
        Relative standard deviation of the voxel size, e.g. 0.002.

    Notes
    -----
    The errors of the moments are taken as independent of those of the frame: both come from the same
    grey values, but from other voxels (the whole boundary here, the footplate's medial face there).
    """
    rotation = scan_from_footplate.rotation.T
    shift_m = (scan_from_footplate.translation_mm - body.com_mm) * (1e-3 * body.length_scale)
    linear = parameter_transfer(rotation, shift_m)
    parameters = linear @ body.parameters
    contributions = {name: linear @ part @ linear.T for name, part in body.contributions.items()}
    if voxel_size_sd is not None:
        added = linear @ body.added
        powers = (parameters - added) * body.length_powers + added * (_POWERS_OF_LENGTH - 3.0)
        step = powers * voxel_size_sd
        contributions["voxel_size"] = np.outer(step, step)
    by_frame = frame_derivative(parameters)
    contributions[FRAME_SOURCE] = by_frame @ frame_covariance @ by_frame.T
    return MassMatrix("footplate_centre", "footplate", parameters, contributions)


def plate_axes_mass_matrix(
    matrix: MassMatrix,
    plate_from_footplate: RigidTransform,
    footplate_covariance: Array,
    plate_covariance: Array,
) -> MassMatrix:
    """Return the mass matrix about the footplate centre in plate axes.

    Here the footplate frame lends its origin and the plate frame its axes, and so do their errors.

    Parameters
    ----------
    matrix : MassMatrix
        About the footplate centre in footplate axes.
    plate_from_footplate : RigidTransform
    footplate_covariance, plate_covariance : ndarray, (6, 6)
        Of each frame's displacement in its own axes, m and rad.
    """
    rotation = plate_from_footplate.rotation
    moved = matrix.moved(rotation, np.zeros(3), "footplate_centre", "plate")
    pose = np.zeros((6, 6))
    pose[:3, :3] = rotation @ footplate_covariance[:3, :3] @ rotation.T
    pose[3:, 3:] = plate_covariance[3:, 3:]
    by_frame = frame_derivative(moved.parameters)
    contributions = dict(moved.contributions)
    contributions[FRAME_SOURCE] = by_frame @ pose @ by_frame.T
    return MassMatrix(moved.about, moved.axes, moved.parameters, contributions)


def _pack(tensor: Array) -> Array:
    """Return the six numbers of a symmetric tensor in the order xx, yy, zz, xy, yz, xz."""
    return np.array([tensor[0, 0], tensor[1, 1], tensor[2, 2], tensor[0, 1], tensor[1, 2], tensor[0, 2]])


def unit_parameters(moments: Moments) -> Array:
    """Return the inertial parameters about the centroid per unit density (kg/m3), SI."""
    tensor = moments.inertia_mm5 * 1e-15
    return np.concatenate([[moments.volume_mm3 * 1e-9], np.zeros(3), _pack(tensor)])


def _by_moments(moments: Moments) -> Array:
    """Return d(parameters about the found centroid)/d(V, c, S in mm powers) per unit density, (10, 10)."""
    linear = np.zeros((10, 10))
    linear[0, 0] = 1e-9
    linear[1:4, 1:4] = np.eye(3) * moments.volume_mm3 * 1e-12
    s = 1e-15
    linear[4, [5, 6]] = s
    linear[5, [4, 6]] = s
    linear[6, [4, 5]] = s
    linear[7, 7] = linear[8, 8] = linear[9, 9] = -s
    return linear
