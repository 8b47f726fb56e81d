"""A simulated 3D laser Doppler vibrometer looking at the stapes and the bone around it.

Signals are e^{+i w t}; a channel reads v . d with d the unit vector towards its laser head. The stapes
follows the paper's Eq. 2 for its own mass matrix, the paper's K and the corrected D in y, alpha and gamma;
in x, z and beta it moves with the base, and the inertia of that motion loads the ligament as it must.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.fitting.examples.paper import PAPER_DAMPING_CORRECTED, PAPER_STIFFNESS
from legacy.stapeskit.frames import RigidTransform, rotation_from_vector
from sample_volumes import bodies
from sample_volumes.phantom import BONE_HIGH

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LIGAMENT = (1, 3, 5)
CARRIED = (0, 2, 4)
BASE_PEAK_M = 1.0e-7


@dataclass(frozen=True)
class Vibrometry:
    """How an ear is measured.

    Attributes
    ----------
    lines : int
        Frequencies, evenly spaced over ``band_hz``.
    stapes_points, bone_points : int
    noise : float
        Typical standard deviation of a channel over its own root mean square; each channel has its own,
        between 0.6 and 1.6 times this.
    position_sd_mm, fiducial_sd_mm : float
        Error with which points and fiducials are known, per coordinate.
    beam_cone_deg : float
        Angle between each of the three lasers and the optical axis.
    excitations : tuple of str
        One run each: the dominant direction of the shaker.
    seed : int
    noise_free : bool
        Leave all errors away: the data obey the equation of motion to rounding.
    mirror : str
        Axis of the vibrometer's coordinates that points the wrong way (a left-handed scanner), or empty.
    """

    lines: int = 200
    band_hz: tuple[float, float] = (400.0, 5000.0)
    stapes_points: int = 10
    bone_points: int = 9
    noise: float = 0.01
    position_sd_mm: float = 0.01
    fiducial_sd_mm: float = 0.01
    beam_cone_deg: float = 20.0
    excitations: tuple[str, ...] = ("y",)
    seed: int = 1
    noise_free: bool = False
    mirror: str = ""


@dataclass(frozen=True)
class Recording:
    """What the vibrometer writes, in its own coordinates.

    Attributes
    ----------
    runs : tuple of str
    freq_hz : ndarray, (freq,)
    body, point : tuple of str, (channel,)
    position_mm : ndarray, (channel, 3)
        As reported, in error by ``position_sd_mm``.
    direction : ndarray, (channel, 3)
    velocity_m_s : ndarray, (run, channel, freq), complex
    sd_m_s : ndarray, (run, channel)
        Of the real (= imaginary) part.
    fiducials : tuple of (name, vibrometer mm (3,), plate frame mm (3,))
    """

    runs: tuple[str, ...]
    freq_hz: Array
    body: tuple[str, ...]
    point: tuple[str, ...]
    position_mm: Array
    direction: Array
    velocity_m_s: ComplexArray
    sd_m_s: Array
    fiducials: tuple[tuple[str, Array, Array], ...]


def base_motion(freq_hz: Array, excitation: str) -> ComplexArray:
    """Return the motion of the bone at the footplate centre, (freq, 6): rocking and some in-plane too."""
    main = {"x": 0, "y": 1, "z": 2}[excitation]
    amplitude = np.array([0.06, 0.06, 0.05, 50.0, 15.0, -35.0]) * BASE_PEAK_M
    amplitude[main] = BASE_PEAK_M
    delay = np.array([0.4, 0.0, -0.3, 0.6, 1.1, -0.5])
    ripple = 1.0 + 0.15 * np.sin(freq_hz[:, None] / 700.0 + np.arange(6.0))
    decay = (1000.0 / freq_hz[:, None]) ** 0.5
    phase = np.exp(1j * (delay - 2.0 * np.pi * freq_hz[:, None] * 3.0e-5))
    return np.asarray(amplitude * ripple * decay * phase)


def stapes_motion(
    freq_hz: Array, base: ComplexArray, mass: Array, stiffness: Array, damping: Array
) -> ComplexArray:
    """Return the motion of the stapes, (freq, 6), that obeys w^2 (M_rr q_r + M_rc q_c) = (K + i w D) dq."""
    motion = base.copy()
    r, c = list(LIGAMENT), list(CARRIED)
    for k, w in enumerate(2.0 * np.pi * freq_hz):
        ligament = stiffness + 1j * w * damping
        load = ligament @ base[k, r] + w**2 * mass[np.ix_(r, c)] @ base[k, c]
        motion[k, r] = np.linalg.solve(ligament - w**2 * mass[np.ix_(r, r)], load)
    return motion


def record(
    mass: Array,
    footplate_from_plate: RigidTransform,
    how: Vibrometry,
    fiducials: Sequence[tuple[str, Array]],
    stiffness: Array = PAPER_STIFFNESS,
    damping: Array = PAPER_DAMPING_CORRECTED,
    stapes: bodies.Surface | None = None,
) -> Recording:
    """Simulate a measurement.

    Parameters
    ----------
    mass : ndarray, (6, 6)
        About the footplate centre in footplate axes, SI.
    footplate_from_plate : RigidTransform
        True pose of the plate frame.
    how : Vibrometry
    fiducials : sequence of (str, ndarray)
        Names and true places in the plate frame, mm.
    stiffness, damping : ndarray, (3, 3)
        Of y, alpha, gamma, SI.
    """
    rng = np.random.default_rng([how.seed, 7])
    surface = bodies.stapes_in_footplate() if stapes is None else stapes
    freq_hz = np.linspace(*how.band_hz, how.lines)
    pose = vibrometer_pose(rng)
    beams = laser_directions(how.beam_cone_deg)
    targets = {
        "stapes": visible_points(surface, how.stapes_points, pose.inverse().vectors(beams)),
        "base": bone_points(surface, how.bone_points),
    }
    motions = []
    for excitation in how.excitations:
        base = base_motion(freq_hz, excitation)
        motions.append({"base": base, "stapes": stapes_motion(freq_hz, base, mass, stiffness, damping)})
    names, points, reported, directions = [], [], [], []
    velocities: list[list[ComplexArray]] = [[] for _ in how.excitations]
    wobble = 0.0 if how.noise_free else how.position_sd_mm
    for body, places in targets.items():
        for number, place in enumerate(places, start=1):
            seen = pose.points(place) + wobble * rng.standard_normal(3)
            for beam in beams:
                names.append(body)
                points.append(f"{number}")
                reported.append(seen)
                directions.append(beam)
                along = pose.inverse().vectors(beam)
                for run, motion in enumerate(motions):
                    q = motion[body]
                    velocity = q[:, :3] + np.cross(q[:, 3:], place * 1e-3)
                    velocities[run].append(2j * np.pi * freq_hz * (velocity @ along))
    clean = np.array(velocities)
    size = np.sqrt(np.mean(np.abs(clean) ** 2, axis=2))
    sd = how.noise * size * rng.uniform(0.6, 1.6, size.shape)
    noise = rng.standard_normal((*clean.shape, 2)) @ np.array([1.0, 1j])
    measured = clean if how.noise_free else clean + sd[:, :, None] * noise
    marks = _fiducials(pose @ footplate_from_plate, fiducials, how, rng)
    recording = Recording(
        tuple(how.excitations),
        freq_hz,
        tuple(names),
        tuple(points),
        np.array(reported),
        np.array(directions),
        measured,
        sd,
        marks,
    )
    return _mirror(recording, how.mirror)


def visible_points(surface: bodies.Surface, count: int, beams: Array) -> Array:
    """Return vertices that all lasers reach, spread over head, crura and footplate.

    Parameters
    ----------
    surface : Surface
        In the footplate frame.
    count : int
    beams : ndarray, (n, 3)
        Unit vectors towards the laser heads, in footplate axes.

    Returns
    -------
    ndarray, (count, 3)
        mm.
    """
    vertices, faces = surface.vertices_mm, surface.faces
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    at_vertex = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(at_vertex, faces[:, k], normal)
    at_vertex /= np.linalg.norm(at_vertex, axis=1)[:, None]
    facing = np.all(at_vertex @ beams.T > 0.2, axis=1)
    starts, open_to = vertices[facing] + 1e-6 * at_vertex[facing], vertices[facing]
    nearest = open_to[:, 1] - open_to[:, 1].min()
    chosen: list[int] = []
    while len(chosen) < count and nearest.max() > 0.0:
        best = int(np.argmax(nearest))
        if any(_shaded(starts[best], corners, beam) for beam in beams):
            nearest[best] = 0.0
            continue
        away = np.linalg.norm(open_to - open_to[best], axis=1)
        nearest = np.where(nearest > 0.0, away if not chosen else np.minimum(nearest, away), 0.0)
        chosen.append(best)
    return open_to[chosen]


def _shaded(start: Array, corners: Array, beam: Array) -> bool:
    """Tell whether triangles (m, 3, 3) hide a point (3,) from a laser in the direction ``beam``.

    Moeller and Trumbore 1997, J. Graphics Tools 2:21, doi:10.1080/10867651.1997.10487468.
    """
    first = corners[:, 1] - corners[:, 0]
    second = corners[:, 2] - corners[:, 0]
    across = np.cross(beam, second)
    scale = np.einsum("mk,mk->m", across, first)
    cut = np.flatnonzero(scale)
    away = start - corners[cut, 0]
    turned = np.cross(away, first[cut])
    u = np.einsum("mk,mk->m", away, across[cut]) / scale[cut]
    v = turned @ beam / scale[cut]
    distance = np.einsum("mk,mk->m", turned, second[cut]) / scale[cut]
    return bool(np.any((u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (distance > 0.0)))


def bone_points(surface: bodies.Surface, count: int) -> Array:
    """Return points on the lateral side of the bone around the oval window, (count, 3) mm."""
    near, far = bodies.footplate_outline(surface, 0.32), bodies.footplate_outline(surface, 0.48)
    turn = np.linspace(0, len(near), count, endpoint=False).astype(int)
    places = np.where((np.arange(count) % 2 == 0)[:, None], near[turn], far[turn])
    return np.insert(places, 1, BONE_HIGH, axis=1)


def vibrometer_pose(rng: np.random.Generator) -> RigidTransform:
    """Return vibrometer_from_footplate: the optical axis (z) looks down on the stapes, up to some degrees."""
    lay = rotation_from_vector([np.pi / 2.0, 0.0, 0.0])
    turn = rotation_from_vector([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    lean = rotation_from_vector(np.radians(rng.uniform(-8.0, 8.0, 3)))
    return RigidTransform.from_parts(
        lean @ turn @ lay, rng.uniform(-20.0, 20.0, 3), "vibrometer", "footplate"
    )


def laser_directions(cone_deg: float) -> Array:
    """Return the unit vectors towards three laser heads on a cone around z, (3, 3)."""
    turn = np.radians([90.0, 210.0, 330.0])
    cone = np.radians(cone_deg)
    return np.column_stack(
        [np.sin(cone) * np.cos(turn), np.sin(cone) * np.sin(turn), np.full(3, np.cos(cone))]
    )


def _fiducials(
    pose_of_plate: RigidTransform,
    places: Sequence[tuple[str, Array]],
    how: Vibrometry,
    rng: np.random.Generator,
) -> tuple[tuple[str, Array, Array], ...]:
    wobble = 0.0 if how.noise_free else how.fiducial_sd_mm
    rows = []
    for name, place in places:
        seen = pose_of_plate.points(place) + wobble * rng.standard_normal(3)
        rows.append((name, seen, place))
    return tuple(rows)


def _mirror(recording: Recording, axis: str) -> Recording:
    if not axis:
        return recording
    flip = np.ones(3)
    flip["xyz".index(axis)] = -1.0
    return Recording(
        recording.runs,
        recording.freq_hz,
        recording.body,
        recording.point,
        recording.position_mm * flip,
        recording.direction * flip,
        recording.velocity_m_s,
        recording.sd_m_s,
        tuple((name, seen * flip, place) for name, seen, place in recording.fiducials),
    )
