"""A micro-CT phantom of a stapes in its oval window on a plastic plate, with the exact truth beside it.

The grey values are simulated: exact partial volumes, a Gaussian point spread, noise. What they show
is a real stapes (ATTRIBUTION.md). Any voxel size and any volume up to 2048^3 are written slab by slab.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.frames.plate_frame import positive_sense
from legacy.ct_inertia.mass.mass_properties import footplate_mass_matrix, from_density
from legacy.stapeskit.frames import RigidTransform, rotation_from_vector
from sample_volumes import bodies
from sample_volumes.bodies import Solid
from sample_volumes.density import graded_mass
from sample_volumes.ear import Ear, Scene
from sample_volumes.rendering import Renderer, render, write_scan
from sample_volumes.scanner import stored_levels

__all__ = ["Ear", "Renderer", "Scene", "render", "scene", "truth", "write_scan"]

Array = NDArray[np.float64]

PLATE_LOW = np.array([-2.2, -0.5, -1.5])
PLATE_HIGH = np.array([2.2, 0.0, 1.5])
PINS = ((-1.95, 1.3, 0.7), (1.95, -1.3, 0.45))
BONE_LOW, BONE_HIGH = -0.15, bodies.WINDOW_TOP_MM
_PIN_HALF = 0.12
FIDUCIALS_MM = (
    ("corner_a", -2.1, 0.0, -1.4),
    ("corner_b", 2.1, 0.0, -1.4),
    ("corner_c", 2.1, 0.0, 1.4),
    ("corner_d", -2.1, 0.0, 1.4),
    ("pin_e", PINS[0][0], PINS[0][2], PINS[0][1]),
    ("pin_f", PINS[1][0], PINS[1][2], PINS[1][1]),
)


def scene(ear: Ear) -> Scene:
    """Build the bodies of an ear and place them in the scan."""
    rng = np.random.default_rng(ear.pose_seed)
    ear = _with_plate_distance(ear)
    footplate_from_plate = bodies.plate_pose(ear.plate_distance_mm, ear.plate_tilt_deg, ear.plate_turn_deg)
    solids = _solids(ear, footplate_from_plate)
    rotation = _upright(ear.upright) @ _random_tilt(rng, ear.tilt_deg)
    turned = RigidTransform.from_parts(rotation, np.zeros(3), "scan", "footplate")
    within = replace(ear, bone_reach=min(ear.bone_reach, 1.0), plate_reach=min(ear.plate_reach, 1.0))
    seen = solids if within == ear else _solids(within, footplate_from_plate)
    points = np.concatenate([turned.points(solid.vertices) for solid, _ in seen])
    low, high = points.min(axis=0), points.max(axis=0)
    spacing = np.asarray(ear.voxel_mm)
    if ear.shape is None:
        count = np.ceil((high - low + 2.0 * ear.margin_mm) / spacing).astype(int)
    else:
        count = np.asarray(ear.shape)
    centre = 0.5 * (count - 1) * spacing + np.asarray(ear.shift_mm)
    offset = centre - 0.5 * (low + high) + rng.uniform(-0.5, 0.5, 3) * spacing
    pose = RigidTransform.from_parts(rotation, offset, "scan", "footplate")
    placed = tuple((bodies.moved(solid, pose), material) for solid, material in solids)
    nx, ny, nz = (int(n) for n in count)
    return Scene(ear, (nx, ny, nz), pose, footplate_from_plate, placed)


def _with_plate_distance(ear: Ear) -> Ear:
    """Return the ear with its plate ``plate_gap_mm`` below the nearest point of the stapes, where asked."""
    if ear.plate_gap_mm is None:
        return ear
    face = bodies.plate_pose(0.0, ear.plate_tilt_deg, ear.plate_turn_deg).rotation[:, 1]
    height = bodies.stapes_in_footplate(ear.stapes).vertices_mm @ face
    pose = bodies.plate_pose(1.0, ear.plate_tilt_deg, ear.plate_turn_deg)
    below = -float(face @ pose.translation_mm)
    distance = (ear.plate_gap_mm - float(height.min())) / below
    return replace(ear, plate_distance_mm=distance, plate_gap_mm=None)


def _upright(axis: str) -> Array:
    """Return a rotation that turns the lateral direction (y) onto a scan axis."""
    turns = {"x": [0.0, 0.0, -90.0], "y": [0.0, 0.0, 0.0], "z": [90.0, 0.0, 0.0]}
    return rotation_from_vector(np.radians(turns[axis]))


def _random_tilt(rng: np.random.Generator, most_deg: float) -> Array:
    lean = rng.normal(size=3) * np.array([1.0, 0.0, 1.0])
    lean *= np.radians(most_deg) * rng.uniform(0.4, 1.0) / np.linalg.norm(lean)
    turn = rotation_from_vector([0.0, np.radians(rng.uniform(-most_deg, most_deg)), 0.0])
    return rotation_from_vector(lean) @ turn


def _solids(ear: Ear, footplate_from_plate: RigidTransform) -> list[tuple[Solid, int]]:
    """Return the bodies in footplate coordinates with their material; the stapes comes first."""
    stapes = bodies.stapes_in_footplate(ear.stapes)
    solids = [(Solid(stapes.vertices_mm, np.asarray(stapes.faces)), 2)]
    if ear.bone:
        solids += [(solid, 2) for solid in _peripheral_bone(ear, stapes)]
    if ear.plate:
        wide = np.array([ear.plate_reach, 1.0, ear.plate_reach])
        slab = [bodies.box(PLATE_LOW * wide, PLATE_HIGH * wide)]
        slab += [
            bodies.box(
                np.array([x - _PIN_HALF, -0.1, z - _PIN_HALF]),
                np.array([x + _PIN_HALF, height, z + _PIN_HALF]),
            )
            for x, z, height in PINS
        ]
        solids += [(bodies.moved(part, footplate_from_plate), 1) for part in slab]
    if ear.incus_gap_mm is not None:
        solids += [(solid, 2) for solid in _incus(stapes, ear.incus_gap_mm)]
    rng = np.random.default_rng(ear.pose_seed + 1000)
    for _ in range(ear.dust):
        place = np.array([rng.uniform(-1.5, 1.5), rng.uniform(1.0, 2.5), rng.choice([-1.2, 1.2])])
        size = rng.uniform(0.03, 0.08, 3)
        solids.append((bodies.box(place - size, place + size), 2))
    return solids


def _peripheral_bone(ear: Ear, stapes: bodies.Surface) -> list[Solid]:
    """Return the bone around the oval window, its feet on the plate, and the bridges."""
    inner = bodies.footplate_outline(stapes, ear.gap_mm)
    angle = np.arctan2(inner[:, 1], inner[:, 0])
    reach = 1.0 / (np.abs(np.cos(angle) / 2.0) ** 4 + np.abs(np.sin(angle) / 1.4) ** 4) ** 0.25
    lumps = 1.0 + 0.03 * np.sin(3.0 * angle + 0.5) + 0.02 * np.sin(7.0 * angle)
    outer = np.column_stack([np.cos(angle), np.sin(angle)]) * (reach * lumps * ear.bone_reach)[:, None]
    parts = [bodies.ring(inner, outer, BONE_LOW, BONE_HIGH)]
    feet = ((-1.6, 0.88), (1.56, 0.9), (-1.55, -0.9), (1.6, -0.86))
    deep = -ear.plate_distance_mm - 0.1
    parts += [
        bodies.box(np.array([x - 0.18, deep, z - 0.18]), np.array([x + 0.18, 0.0, z + 0.18])) for x, z in feet
    ]
    rim = bodies.footplate_outline(stapes, 0.0)
    for number in range(ear.bridges):
        place = int((0.12 + number / max(ear.bridges, 1)) * len(rim)) % len(rim)
        start, end = rim[place] * 0.93, inner[place] * 1.05
        parts.append(
            bodies.rod(
                np.array([start[0], 0.12, start[1]]), np.array([end[0], 0.12, end[1]]), ear.bridge_radius_mm
            )
        )
    return parts


def _incus(stapes: bodies.Surface, gap_mm: float) -> list[Solid]:
    """Return the lenticular process and the end of the long process of the incus, above the head."""
    top = stapes.vertices_mm[int(np.argmax(stapes.vertices_mm[:, 1]))]
    thick = 0.22
    centre = top + np.array([0.0, gap_mm + thick, 0.0])
    return [
        bodies.ellipsoid(centre, np.array([0.42, thick, 0.34])),
        bodies.rod(centre, centre + np.array([0.25, 0.75, -0.2]), 0.26),
    ]


def truth(placed: Scene) -> dict[str, Any]:
    """Return the exact mass properties and frames of a scene, in the keys of mass.json where they exist."""
    ear = placed.ear
    moments = bodies.stapes_in_footplate(ear.stapes).moments()
    body = (
        graded_mass(bodies.stapes_in_footplate(ear.stapes), ear.density_kg_m3, ear.gradient)
        if ear.gradient
        else from_density(moments, ear.density_kg_m3, None)
    )
    matrix = footplate_mass_matrix(body, RigidTransform.identity("scan", "footplate"), np.zeros((6, 6)))
    scan_from_plate = placed.scan_from_footplate @ placed.footplate_from_plate
    edge = scan_from_plate.rotation[:, 0]
    built = np.ones(3) if positive_sense(edge) @ edge > 0.0 else np.array([-1.0, 1.0, -1.0])
    scan_from_plate = scan_from_plate @ RigidTransform.from_parts(
        np.diag(built), np.zeros(3), "plate", "plate"
    )
    return {
        "density_kg_m3": ear.density_kg_m3,
        "volume_m3": moments.volume_mm3 * 1e-9,
        "mass_kg": body.mass_kg,
        "center_of_mass_in_scan_mm": placed.scan_from_footplate.points(body.com_mm).tolist(),
        "centroid_in_scan_mm": placed.scan_from_footplate.points(moments.centroid_mm).tolist(),
        "scan_from_footplate": placed.scan_from_footplate.matrix.tolist(),
        "scan_from_plate": scan_from_plate.matrix.tolist(),
        "plate_from_footplate": (scan_from_plate.inverse() @ placed.scan_from_footplate).matrix.tolist(),
        "mass_matrix_si": matrix.matrix.tolist(),
        "inertial_parameters_si": matrix.parameters.tolist(),
        "fiducials_in_plate_mm": {name: (built * place).tolist() for name, *place in FIDUCIALS_MM},
        "voxel_mm": list(ear.voxel_mm),
        "gap_mm": ear.gap_mm,
        "levels": stored_levels(ear.levels, ear.dtype),
        "gradient": ear.gradient,
        "stapes_voxels_noise_free": moments.volume_mm3 / float(np.prod(ear.voxel_mm)),
    }
