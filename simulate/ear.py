"""An ear: its stapes, what surrounds it, and what it hangs in; and the same placed in a scan."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field

import numpy as np

from simulate.ligament import Ligament
from simulate.mass import MassProperties, point_mass, uniform_mass
from simulate.solids import Solid, box, ellipsoid, outward, ring, rod
from simulate.stapes import Stapes, stapes_solid
from stapeskit.arrays import Array
from stapeskit.frames import RigidTransform, rotation_from_vector
from stapeskit.spatial import matrix_from_parameters

WINDOW_TOP_MM = 0.45  # of the bone around the window, from the footplate centre
_BONE_LOW_MM = -0.15  # of the same bone
_MARGIN_MM = 0.25  # of air around everything
_PLATE_LOW, _PLATE_HIGH = np.array([-2.2, -0.5, -1.5]), np.array([2.2, 0.0, 1.5])
_PINS = ((-1.95, 1.3, 0.7), (1.95, -1.3, 0.45))
_PLATE_DISTANCE_MM = 0.8  # of the face from the footplate centre; chosen for the sample ear
_PLATE_TILT = rotation_from_vector(np.radians([4.0, 0.0, -3.0]))
_PLATE_TURN = rotation_from_vector(np.radians([0.0, 12.0, 0.0]))
FIDUCIALS_MM = {
    "corner_a": (-2.1, 0.0, -1.4),
    "corner_b": (2.1, 0.0, -1.4),
    "corner_c": (2.1, 0.0, 1.4),
    "corner_d": (-2.1, 0.0, 1.4),
    "pin_e": (_PINS[0][0], _PINS[0][2], _PINS[0][1]),
    "pin_f": (_PINS[1][0], _PINS[1][2], _PINS[1][1]),
}
"""Marks on the plate in the frame it is built in, mm; its corners and pins name its sides."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Ear:
    """One ear."""

    stapes: Stapes = field(default_factory=Stapes)
    density_kg_m3: float = 1382.4  # the true one; this gives the OpenEar stapes the paper's 3.2 mg
    ligament: Ligament = field(default_factory=Ligament)
    # point masses on the stapes that the scan does not show
    loose_masses: tuple[tuple[float, float, float, float], ...] = ()
    gap_mm: float = 0.2  # between the outline of the footplate and the bone around it
    bridges: int = 0  # bony bridges across the gap, of radius ``bridge_radius_mm``
    bridge_radius_mm: float = 0.05
    bone: bool = True  # bone around the window
    plate: bool = True  # the plastic plate below
    # distance of the plate from the nearest point of the stapes, negative: sunk into the plate; None: usual
    plate_gap_mm: float | None = None
    # distance of the incus from the head; negative: grown together; None: incus removed
    incus_gap_mm: float | None = None
    # thickness of soft tissue on the stapes; fluid on the footplate up to this height. Their grey value is
    # that of Scan.soft
    coat_mm: float = 0.0
    fluid_depth_mm: float = 0.0

    @property
    def side(self) -> str:
        """``left``, or ``right`` for a mirrored stapes."""
        return "right" if self.stapes.mirrored else "left"

    @property
    def solid(self) -> Solid:
        """The stapes in its footplate frame, mm."""
        return stapes_solid(self.stapes)

    def mass(self) -> MassProperties:
        """Return the exact mass properties of the bone in footplate axes."""
        return uniform_mass(self.solid.moments(), self.density_kg_m3)

    def moving_mass_si(self) -> Array:
        """Return the mass matrix (6, 6) of all that moves: bone and loose masses."""
        matrix = self.mass().matrix()
        for x, y, z, mass_kg in self.loose_masses:
            matrix = matrix + matrix_from_parameters(point_mass(mass_kg, (x, y, z)))
        return matrix

    def footplate_from_plate(self) -> RigidTransform:
        """Return the pose of the plate's face as it is built; +y looks towards the stapes."""
        shift = _PLATE_TILT @ [0.0, -self.face_distance_mm(), 0.0]
        return RigidTransform.from_parts(_PLATE_TILT @ _PLATE_TURN, shift, "footplate", "plate")

    def face_distance_mm(self) -> float:
        """Return the distance of the plate's face from the footplate centre."""
        if self.plate_gap_mm is None:
            return _PLATE_DISTANCE_MM
        return self.plate_gap_mm - float((self.solid.vertices_mm @ _PLATE_TILT[:, 1]).min())

    def solids(self) -> list[tuple[Solid, str]]:
        """Return all bodies in footplate coordinates, each with its material; the stapes comes first."""
        made = [(self.solid, "bone")]
        if self.bone:
            made += [(solid, "bone") for solid in _bone_around(self)]
        if self.plate:
            made += [(solid.moved(self.footplate_from_plate()), "plastic") for solid in _plate()]
        if self.incus_gap_mm is not None:
            made += [(solid, "bone") for solid in _incus(self.solid, self.incus_gap_mm)]
        if self.coat_mm:
            made.append((_grown(self.solid, self.coat_mm), "soft"))
        if self.fluid_depth_mm:
            low, high = self.solid.vertices_mm.min(axis=0) - 0.3, self.solid.vertices_mm.max(axis=0) + 0.3
            made.append((box(low, [high[0], self.fluid_depth_mm, high[2]]), "soft"))
        return made


@functools.lru_cache(maxsize=128)
def footplate_outline(solid: Solid, gap_mm: float, least_mm: float = 0.01) -> Array:
    """Return the outline of the footplate in the oval window, widened by a gap, at its waist too.

    It is (192, 2), x and z, mm, at equal angles around the footplate centre; not to be changed.
    """
    angles = np.linspace(0.0, 2.0 * np.pi, 192, endpoint=False)
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    rim = _silhouette(solid)
    along = rim @ directions.T
    beside = rim[:, :1] * directions[:, 1] - rim[:, 1:] * directions[:, 0]
    around = max(gap_mm, least_mm)
    half = np.sqrt(np.maximum(around**2 - beside**2, 0.0))
    reach = np.where(np.abs(beside) < around, along + half, -np.inf).max(axis=0)
    return np.asarray(directions * (reach - (around - gap_mm))[:, None])


def _silhouette(solid: Solid, sectors: int = 20000) -> Array:
    """Return the outermost points (n, 2) of a stapes in the window, seen along y, densely by angle."""
    corners = solid.vertices_mm[solid.faces]
    corners = corners[corners[:, :, 1].min(axis=1) < WINDOW_TOP_MM]
    longest = np.ptp(corners, axis=1).max()
    steps = np.linspace(0.0, 1.0, 2 + int(longest / 0.003))[:, None, None, None]
    points = (corners + steps * (np.roll(corners, -1, axis=1) - corners)).reshape(-1, 3)
    flat = points[points[:, 1] < WINDOW_TOP_MM][:, [0, 2]]
    radius = np.hypot(flat[:, 0], flat[:, 1])
    sector = np.floor((np.arctan2(flat[:, 1], flat[:, 0]) / (2.0 * np.pi) + 0.5) * sectors).astype(int)
    order = np.lexsort((-radius, sector))
    _, first = np.unique(sector[order], return_index=True)
    return np.asarray(flat[order[first]])


def _bone_around(ear: Ear) -> list[Solid]:
    """Return the bone around the oval window, its feet on the plate, and the bridges."""
    inner = footplate_outline(ear.solid, ear.gap_mm)
    angle = np.arctan2(inner[:, 1], inner[:, 0])
    reach = 1.0 / (np.abs(np.cos(angle) / 2.0) ** 4 + np.abs(np.sin(angle) / 1.4) ** 4) ** 0.25
    lumps = 1.0 + 0.03 * np.sin(3.0 * angle + 0.5) + 0.02 * np.sin(7.0 * angle)
    outer = np.column_stack([np.cos(angle), np.sin(angle)]) * (reach * lumps)[:, None]
    parts = [ring(inner, outer, _BONE_LOW_MM, WINDOW_TOP_MM)]
    deep = -ear.face_distance_mm() - 0.1
    feet = ((-1.6, 0.88), (1.56, 0.9), (-1.55, -0.9), (1.6, -0.86))
    parts += [box([x - 0.18, deep, z - 0.18], [x + 0.18, 0.0, z + 0.18]) for x, z in feet]
    rim = footplate_outline(ear.solid, 0.0)
    for number in range(ear.bridges):
        place = int((0.12 + number / ear.bridges) * len(rim)) % len(rim)
        (x0, z0), (x1, z1) = rim[place] * 0.93, inner[place] * 1.05
        parts.append(rod([x0, 0.12, z0], [x1, 0.12, z1], ear.bridge_radius_mm))
    return parts


def _plate() -> list[Solid]:
    """Return the slab and its two pins of other heights, in the frame it is built in."""
    pins = [box([x - 0.12, -0.1, z - 0.12], [x + 0.12, height, z + 0.12]) for x, z, height in _PINS]
    return [box(_PLATE_LOW, _PLATE_HIGH), *pins]


def _incus(solid: Solid, gap_mm: float, thick: float = 0.22) -> list[Solid]:
    """Return the lenticular process and the end of the long process of the incus, above the head."""
    top = solid.vertices_mm[int(np.argmax(solid.vertices_mm[:, 1]))]
    centre = top + np.array([0.0, gap_mm + thick, 0.0])
    shaft = rod(centre, centre + np.array([0.25, 0.75, -0.2]), 0.26)
    return [ellipsoid(centre, [0.42, thick, 0.34]), shaft]


def vertex_normals(solid: Solid) -> Array:
    """Return area-weighted unit normals (n, 3) at the vertices."""
    corners = solid.vertices_mm[solid.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    at_vertex = np.zeros_like(solid.vertices_mm)
    for k in range(3):
        np.add.at(at_vertex, solid.faces[:, k], normal)
    return np.asarray(at_vertex / np.linalg.norm(at_vertex, axis=1)[:, None])


def _grown(solid: Solid, thickness_mm: float) -> Solid:
    return outward(solid.vertices_mm + thickness_mm * vertex_normals(solid), solid.faces)


@dataclass(frozen=True, kw_only=True, eq=False)
class Placed:
    """The bodies of an ear placed in a scan."""

    ear: Ear
    shape: tuple[int, int, int]  # voxels x, y, z
    voxel_mm: Array  # (3,)
    # the plate frame is that of the contract: x towards the larger positive component along scan x
    scan_from_footplate: RigidTransform
    scan_from_plate: RigidTransform
    plate_turn: Array  # (3,): What coordinates in the frame that the plate is built in are multiplied with
    solids: tuple[tuple[Solid, str], ...]  # in scan coordinates, each with its material

    def fiducials_mm(self) -> dict[str, Array]:
        """Return the true places of the marks in the plate frame of the contract, mm."""
        return {name: self.plate_turn * place for name, place in FIDUCIALS_MM.items()}


def place(
    ear: Ear,
    voxel_mm: Array,
    rotation: Array,
    rng: np.random.Generator,
    shape: tuple[int, int, int] | None = None,
) -> Placed:
    """Place an ear in the middle of a scan, turned by scan_from_footplate (3, 3), off by part of a voxel.

    Without a shape, voxels x, y, z, the volume is the smallest box that holds everything with a margin.
    """
    turned = RigidTransform.from_parts(rotation, np.zeros(3), "scan", "footplate")
    solids = ear.solids()
    points = np.concatenate([turned.points(solid.vertices_mm) for solid, _ in solids])
    low, high = points.min(axis=0), points.max(axis=0)
    count = (
        np.ceil((high - low + 2.0 * _MARGIN_MM) / voxel_mm).astype(int) if shape is None else np.array(shape)
    )
    centre = 0.5 * (count - 1) * voxel_mm
    offset = centre - 0.5 * (low + high) + rng.uniform(-0.5, 0.5, 3) * voxel_mm
    pose = RigidTransform.from_parts(rotation, offset, "scan", "footplate")
    plate = pose @ ear.footplate_from_plate()
    leading = next((part for part in plate.rotation[:, 0] if abs(part) > 1e-6), 1.0)
    turn = np.ones(3) if leading > 0.0 else np.array([-1.0, 1.0, -1.0])
    plate = plate @ RigidTransform.from_parts(np.diag(turn), np.zeros(3), "plate", "plate")
    placed = tuple((solid.moved(pose), material) for solid, material in solids)
    nx, ny, nz = (int(n) for n in count)
    return Placed(
        ear=ear,
        shape=(nx, ny, nz),
        voxel_mm=voxel_mm,
        scan_from_footplate=pose,
        scan_from_plate=plate,
        plate_turn=turn,
        solids=placed,
    )
