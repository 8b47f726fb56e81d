"""An ear to be scanned: its parameters, and its bodies placed in the scan."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from legacy.stapeskit.frames import RigidTransform
from sample_volumes import bodies
from sample_volumes.bodies import Solid


@dataclass(frozen=True)
class Ear:
    """One simulated ear and its scan.

    Attributes
    ----------
    voxel_mm : tuple of float
        x, y, z.
    gap_mm : float
        Ligament gap between footplate outline and peripheral bone.
    bridges : int
        Bony bridges across the gap, of radius ``bridge_radius_mm``.
    psf_voxels : float
        Sigma of the point spread in voxels.
    noise : float
        Standard deviation over the contrast between bone and air.
    noise_correlation_voxels : float
        Sigma of the Gaussian blur of the noise; 0: white.
    cupping : float
        Share of the contrast lost in the middle of the field of view.
    levels : tuple of float
        Grey values of air, plastic and bone, as uint16; air near 0 is clipped there.
    dtype : str
        Of the stored numbers: uint8, int16, uint16 or float32.
    density_kg_m3 : float
        True density of the stapes; 1382.4 gives the OpenEar stapes 3.2 mg.
    gradient : float
        Relative change of the density from halfway up the stapes to either end; grey values follow it.
    plate_distance_mm, plate_tilt_deg, plate_turn_deg
        Where the plate lies under the footplate and how it is turned against it.
    plate_gap_mm : float or None
        Distance of the plate's face from the nearest point of the stapes, in place of
        ``plate_distance_mm``; 0: they touch; negative: the stapes is sunk into the plate.
    plate_reach : float
        Scales the plate outward; above 1 it runs out of the field of view.
    tilt_deg : float
        How far the sample may lean in the scanner; the direction comes from ``pose_seed``.
    upright : str
        Scan axis that the lateral direction lies near.
    shape : tuple of int or None
        Voxels x, y, z; None takes the smallest box with ``margin_mm`` around everything.
    shift_mm : tuple of float
        Moves the sample in a volume of given shape (to leave the field of view on purpose).
    plate, bone : bool
        Leave the plate or the peripheral bone away.
    dust : int
        Loose bone fragments of about 0.1 mm.
    incus_gap_mm : float or None
        Distance of the incus from the head; negative: grown together; None: incus removed.
    bone_reach : float
        Scales the peripheral bone outward; above 1 it runs out of the field of view.
    mirror : str
        Scan axis along which the stored slices are in reverse order, or empty.
    pose_seed, noise_seed : int
    stapes : Path
        Any closed surface in mm.
    """

    voxel_mm: tuple[float, float, float] = (0.025, 0.025, 0.025)
    gap_mm: float = 0.2
    bridges: int = 0
    bridge_radius_mm: float = 0.05
    psf_voxels: float = 1.2
    noise: float = 0.04
    noise_correlation_voxels: float = 0.0
    cupping: float = 0.0
    levels: tuple[float, float, float] = (8000.0, 15000.0, 30000.0)
    dtype: str = "uint16"
    density_kg_m3: float = 1382.4
    gradient: float = 0.0
    plate_distance_mm: float = 0.8
    plate_gap_mm: float | None = None
    plate_reach: float = 1.0
    plate_tilt_deg: tuple[float, float] = (4.0, -3.0)
    plate_turn_deg: float = 12.0
    tilt_deg: float = 18.0
    upright: str = "z"
    shape: tuple[int, int, int] | None = None
    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    margin_mm: float = 0.25
    plate: bool = True
    bone: bool = True
    dust: int = 0
    incus_gap_mm: float | None = None
    bone_reach: float = 1.0
    mirror: str = ""
    pose_seed: int = 1
    noise_seed: int = 1
    stapes: Path = field(default=bodies.OPENEAR_STAPES)


@dataclass(frozen=True)
class Scene:
    """The bodies of an ear placed in the scan.

    Attributes
    ----------
    shape : tuple of int
        Voxels x, y, z.
    scan_from_footplate, footplate_from_plate : RigidTransform
    solids : tuple of (Solid, int)
        In scan coordinates, each with its material: 1 plastic, 2 bone.
    """

    ear: Ear
    shape: tuple[int, int, int]
    scan_from_footplate: RigidTransform
    footplate_from_plate: RigidTransform
    solids: tuple[tuple[Solid, int], ...]
