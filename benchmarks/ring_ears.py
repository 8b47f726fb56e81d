"""Simulated ears for benchmarks/model_errors.py, written from physics; no code of fitting is used.

The ligament is a ring of springs and dashpots in a plane of its own: each piece resists radial, tangential
and normal displacement of the rim of the footplate. Vibrometer points are seen along three beams; motions
follow by least squares with the positions that the experimenter believes in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from legacy.stapeskit.records.mass_record import MassMatrix
from legacy.stapeskit.records.motion import RigidMotion, SharedErrors

# Pieces of the ring, drawn with other sums than those of the prior's population (72).
PIECES = 90
DOF = ("x", "y", "z", "alpha", "beta", "gamma")
PISTON = (1, 3, 5)


@dataclass(frozen=True)
class EarSettings:
    """What a case of the benchmark varies; lengths in mm, noise relative to the points' motion.

    ``head_mm`` is where the head lies along z. ``cause`` is an error of ERRORS with its size, or a law of
    LAWS; ``second_run`` measures twice. ``uneven`` is by how much the strength varies around the rim in its
    first and second harmonic; the rim is then warped by 0.03 mm, too.
    """

    height_mm: float = 0.1
    noise: float = 0.01
    tilt_sd_deg: float = 1.0
    lines: int = 120
    shared: bool = True
    cause: str = ""
    size: float = 0.0
    law: str = "viscous"
    head_mm: float = 0.12
    band_hz: tuple[float, float] = (400.0, 5000.0)
    uneven: float = 0.0

    @property
    def runs(self) -> int:
        """Number of runs."""
        return 2 if self.cause == "second_run" else 1


@dataclass(frozen=True)
class SimulatedEar:
    """What the experimenter has, and the truth: 6 x 6 K and D about the footplate centre, SI."""

    motion: RigidMotion
    mass: MassMatrix
    stiffness: np.ndarray
    damping: np.ndarray


def cross(v: np.ndarray) -> np.ndarray:
    """Return [v]x with [v]x u = v x u."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def rotation(turn: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of a rotation vector (Rodrigues)."""
    angle = np.linalg.norm(turn)
    if angle == 0.0:
        return np.eye(3)
    axis = cross(turn / angle)
    return np.eye(3) + np.sin(angle) * axis + (1.0 - np.cos(angle)) * axis @ axis


def rim(rng: Generator, uneven: float) -> tuple[np.ndarray, np.ndarray]:
    """Return strength and height (m) around the rim, (PIECES,)."""
    angle = (np.arange(PIECES) + 0.5) * 2.0 * np.pi / PIECES
    if not uneven:
        return np.ones(PIECES), np.zeros(PIECES)
    size, phase = rng.standard_normal(3), rng.uniform(0.0, 2.0 * np.pi, 3)
    waves = size[:, None] * np.cos(np.outer([1, 2, 2], angle) + phase[:, None])
    return np.maximum(1.0 + uneven * (waves[0] + waves[1]), 0.05), 0.03e-3 * waves[2]


def ring(
    radial: float,
    tangential: float,
    normal: float,
    tilt: np.ndarray,
    centre: np.ndarray,
    around: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Return the 6 x 6 matrix of an elliptic ring (1.4 x 0.65 mm) of springs per length, about the origin."""
    total = np.zeros((6, 6))
    turn = rotation(tilt)
    angles = (np.arange(PIECES) + 0.5) * 2.0 * np.pi / PIECES
    for angle, strength, height in zip(angles, *around, strict=True):
        place = np.array([1.4e-3 * np.cos(angle), height, 0.65e-3 * np.sin(angle)])
        along = np.array([-1.4e-3 * np.sin(angle), 0.0, 0.65e-3 * np.cos(angle)])
        length = np.linalg.norm(along) * 2.0 * np.pi / PIECES
        along = along / np.linalg.norm(along)
        up = np.array([0.0, 1.0, 0.0])
        axes = turn @ np.column_stack([np.cross(along, up), along, up])
        local = axes @ np.diag([radial, tangential, normal]) @ axes.T * length * strength
        rows = np.hstack([np.eye(3), -cross(turn @ place + centre)])
        total += rows.T @ local @ rows
    return total


def stapes_mass(rng: Generator, head_mm: float = 0.12) -> np.ndarray:
    """Return ten inertial parameters (m, m c, J about the origin) of a footplate, two crura and a head."""
    masses, places = [], []
    for x in np.linspace(-1.25, 1.25, 11):
        for z in np.linspace(-0.55, 0.55, 7):
            if (x / 1.3) ** 2 + (z / 0.6) ** 2 < 1.0:
                masses.append(0.021)
                places.append((x, 0.1, z))
    for side in (-1.0, 1.0):
        for t in np.linspace(0.0, 1.0, 12):
            masses.append(0.045)
            places.append((side * (1.0 - 0.75 * t**2), 0.2 + 2.4 * t, 0.08 * t))
    masses.append(0.75)
    places.append((0.1 + 0.05 * rng.standard_normal(), 3.0, head_mm + 0.05 * rng.standard_normal()))
    m = np.array(masses) * 1e-6 * rng.uniform(0.85, 1.15)
    p = np.array(places) * 1e-3
    inertia = np.einsum("i,ij,ij->", m, p, p) * np.eye(3) - np.einsum("i,ij,ik->jk", m, p, p)
    entries = [inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[1, 2], inertia[0, 2]]
    return np.array([m.sum(), *(m @ p), *entries])


def mass_matrix(parameters: np.ndarray) -> np.ndarray:
    """Return the 6 x 6 mass matrix of ten inertial parameters."""
    mass, moment = parameters[0], parameters[1:4]
    xx, yy, zz, xy, yz, xz = parameters[4:]
    full = np.zeros((6, 6))
    full[:3, :3] = mass * np.eye(3)
    full[:3, 3:], full[3:, :3] = -cross(moment), cross(moment)
    full[3:, 3:] = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
    return full


def observation_rows(points: np.ndarray, beams: np.ndarray) -> np.ndarray:
    """Return what every point and beam sees of the six degrees of freedom, (points * beams, 6)."""
    return np.vstack([np.hstack([beams, np.cross(point, beams)]) for point in points])


def ear(settings: EarSettings, rng: Generator) -> SimulatedEar:
    """Draw an ear, measure it with all errors, and return what the experimenter has."""
    freq = np.tile(np.linspace(*settings.band_hz, settings.lines), settings.runs)
    omega = 2.0 * np.pi * freq
    parameters = stapes_mass(rng, settings.head_mm)
    mass = mass_matrix(parameters)
    tilt = np.radians(settings.tilt_sd_deg) * np.array([rng.standard_normal(), 0.0, rng.standard_normal()])
    centre = np.array([-0.2 * rng.uniform(), settings.height_mm, 0.2 * rng.uniform(-1, 1)]) * 1e-3
    level = 1700.0 / 6.6e-3 * rng.uniform(0.7, 1.4)
    shape = np.array([rng.uniform(2.0, 4.0), rng.uniform(0.8, 1.3), 1.0])
    around = rim(rng, settings.uneven)
    stiffness = ring(*(level * shape), tilt, centre, around)
    loss = rng.uniform(0.9e-5, 2.0e-5)
    damping = loss * ring(*(level * shape * np.array([1.1, 0.9, 1.0])), tilt, centre, around)
    base = drive(freq, rng)
    lossy, unit = (LAWS | BRANCHES)[settings.law](omega)
    damping = damping * unit
    dynamic = stiffness + lossy[:, None, None] * damping
    size, time = settings.size, np.linspace(-0.5, 0.5, len(freq))[:, None, None]
    if settings.cause == "fluid":
        dynamic[:, 1, 1] -= omega**2 * 1e-6 * size
    if settings.cause == "drift":
        dynamic = dynamic * (1.0 + 0.01 * size * time)
    if settings.cause == "step":
        dynamic[round(rng.uniform(0.25, 0.75) * settings.lines) :] *= 1.0 + 0.01 * size
    if settings.cause == "second_run":
        dynamic[settings.lines :] *= 1.0 + 0.01 * size
    if settings.cause == "holder":
        ratio = freq / 2600.0
        seen_base = base * (1.0 + 0.001 * size / (1.0 - ratio**2 + 0.1j * ratio))[:, None]
    else:
        seen_base = base
    if settings.cause == "head_mass":
        mass = mass + mass_matrix(point_mass(1e-6 * size, np.array([0.1e-3, 3.3e-3, 0.1e-3])))
    force = (dynamic @ base[:, :, None])[:, :, 0]
    stapes = np.linalg.solve(dynamic - omega[:, None, None] ** 2 * mass, force[:, :, None])[:, :, 0]
    if settings.cause == "delay":
        stapes = stapes * np.exp(-1e-6j * size * omega)[:, None]
    if settings.cause == "phase":
        stapes = stapes * np.exp(-1j * np.radians(size))
    if settings.cause == "gain":
        stapes = stapes / (1.0 + 0.01 * size)
    if settings.cause.startswith("centre_"):
        parameters = shifted_parameters(parameters, -1e-3 * size * np.eye(3)["xyz".index(settings.cause[-1])])
    if settings.cause == "mirrored":
        parameters = parameters * np.array([1, 1, 1, -1, 1, 1, 1, 1, -1, -1])
    if settings.cause == "inertia":
        parameters = parameters.copy()
        parameters[4:] /= 1.0 + 0.01 * size
    return measured(settings, rng, freq, (stapes, seen_base), parameters, stiffness, damping)


def point_mass(mass: float, place: np.ndarray) -> np.ndarray:
    """Return the ten inertial parameters of a point."""
    tensor = mass * (place @ place * np.eye(3) - np.outer(place, place))
    entries = [tensor[0, 0], tensor[1, 1], tensor[2, 2], tensor[0, 1], tensor[1, 2], tensor[0, 2]]
    return np.array([mass, *(mass * place), *entries])


def shifted_parameters(parameters: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return the ten inertial parameters of the same body, displaced."""
    mass, centre = parameters[0], parameters[1:4] / parameters[0]
    shifted = parameters - point_mass(mass, centre) + point_mass(mass, centre + shift)
    shifted[0] = mass
    shifted[1:4] = mass * (centre + shift)
    return shifted


def relaxing(omega: np.ndarray, *times_us: float) -> np.ndarray:
    """Return the mean of i w / (1 + i w T) over relaxation times T."""
    return np.mean([1j * omega / (1.0 + 1e-6j * time * omega) for time in times_us], axis=0)


MIDDLE = 2.0 * np.pi * 2200.0
LAWS = {
    "viscous": lambda omega: (1j * omega, 1.0),
    "hysteretic": lambda omega: (np.full(len(omega), 1j), MIDDLE),
    "fractional": lambda omega: ((1j * omega) ** 0.5, MIDDLE**0.5),
    "relaxation": lambda omega: (relaxing(omega, 30.0), 1.0),
    "two_relaxations": lambda omega: (relaxing(omega, 20.0, 200.0), 1.0),
}
"""s(w), and what makes D damp alike at 2.2 kHz."""
BRANCHES = {
    f"two branches, {first:g} and {second:g} us": lambda omega, a=first, b=second: (
        relaxing(omega, a, b),
        1.0,
    )
    for first, second in ((10.0, 30.0), (10.0, 100.0), (30.0, 300.0))
}
"""Ligaments that relax with two times; the fit has a law whose times are in the ratio of 10."""
ERRORS = {
    "delay": 1.0,
    "phase": 0.5,
    "gain": 1.0,
    "fluid": 0.5,
    "head_mass": 5.0,
    "centre_z": 0.3,
    "mirrored": 1.0,
    "inertia": 25.0,
    "drift": 8.0,
    "second_run": 5.0,
    "step": 8.0,
    "holder": 2.0,
}
"""Sizes that 1 % of noise lets see: us, degrees, %, mg, mg, mm, 1 (whole), %, %, %, %, %."""


def drive(freq: np.ndarray, rng: Generator) -> np.ndarray:
    """Return a base motion along y with rocking and in-plane motion of a tenth, smooth in frequency."""
    motion = np.zeros((len(freq), 6), dtype=complex)
    phase = 2.0 * np.pi * rng.uniform(size=6)
    for place in range(6):
        share = 0.1 * rng.uniform(0.5, 1.5) * np.exp(1j * (phase[place] + rng.uniform(-2, 2) * freq / 5000.0))
        motion[:, place] = share * (1.0 if place < 3 else 200.0)
    motion[:, 1] = 1.0
    return motion * (1e-4 / freq)[:, None]


def measured(
    settings: EarSettings,
    rng: Generator,
    freq: np.ndarray,
    bodies: tuple[np.ndarray, np.ndarray],
    parameters: np.ndarray,
    stiffness: np.ndarray,
    damping: np.ndarray,
) -> SimulatedEar:
    """Measure both bodies with noise, wrong positions, wrong registration and a wrong mass."""
    beams = np.array([[0.05, 0.998, -0.03], [0.45, 0.86, 0.24], [-0.32, 0.85, 0.42]])
    beams /= np.linalg.norm(beams, axis=1)[:, None]
    on = settings.shared
    position_sd, turn_sd, shift_sd = 30e-6 * on, np.radians(0.3) * on, 30e-6 * on
    registration = np.concatenate([shift_sd * rng.standard_normal(3), turn_sd * rng.standard_normal(3)])
    q, covariance, slopes, names, spread = [], [], [], [], []
    for body, motion in enumerate(bodies):
        points = body_points(body, rng)
        believed = points + position_sd * rng.standard_normal(points.shape)
        signal = motion @ observation_rows(points, beams).T
        noise = settings.noise * np.sqrt(np.mean(np.abs(signal) ** 2, axis=1))[:, None]
        draws = rng.standard_normal((2, *signal.shape)) * np.sqrt(0.5)
        signal = signal + noise * (draws[0] + 1j * draws[1])
        rows = observation_rows(believed, beams)
        inverse = np.linalg.pinv(rows)
        estimate = signal @ inverse.T
        moved = frame_change(registration)
        q.append(estimate @ moved.T)
        own = moved @ inverse @ inverse.T @ moved.T
        covariance.append((noise**2)[:, :, None] * own[None])
        for place in range(points.size if on else 0):
            step = np.zeros(points.size)
            step[place] = 1e-7
            other = np.linalg.pinv(observation_rows(believed + step.reshape(points.shape), beams))
            change = signal @ ((other - inverse) / 1e-7).T @ moved.T
            slopes.append([change, 0 * change] if body == 0 else [0 * change, change])
            names.append(f"position.{body}_{place}")
            spread.append(position_sd)
    for place in range(6 if on else 0):
        step = np.zeros(6)
        step[place] = 1e-7
        change = (frame_change(step) - np.eye(6)) / 1e-7
        slopes.append([part @ change.T for part in q])
        names.append(f"registration.{DOF[place]}")
        spread.append(shift_sd if place < 3 else turn_sd)
    mass_sd = np.concatenate([[0.02 * parameters[0]], [2.0e-6 * 1e-5] * 3]) * on
    mass_error = np.zeros(10)
    mass_error += parameters * 0.02 * on * rng.standard_normal()
    mass_error[1:4] += mass_sd[1:4] * rng.standard_normal(3)
    contributions = {
        "density": 0.02**2 * np.outer(parameters, parameters) * on,
        "centre": np.diag([0.0, *mass_sd[1:4] ** 2, *[0.0] * 6]),
    }
    mass = MassMatrix("footplate_centre", "footplate", parameters + mass_error, contributions if on else {})
    shared = None
    if on:
        derivatives = by_run(np.array(slopes), settings.runs)
        shared = SharedErrors(tuple(names), np.diag(np.array(spread) ** 2), derivatives)
    runs, freq = settings.runs, freq[: settings.lines]
    none = np.full((runs, 2, settings.lines), np.nan)
    motion = RigidMotion(
        tuple("12"[:runs]), ("stapes", "base"), DOF, freq, by_run(np.array(q), runs, body=0),
        by_run(np.array(covariance) + 0j, runs, body=0), none, none, shared=shared,
    )  # fmt: skip
    return SimulatedEar(motion, mass, stiffness, damping)


def by_run(values: np.ndarray, runs: int, body: int = 1) -> np.ndarray:
    """Split the lines after the axis of bodies by run; runs come before that axis."""
    shape = values.shape
    split = values.reshape(*shape[: body + 1], runs, shape[body + 1] // runs, *shape[body + 2 :])
    return np.moveaxis(split, body + 1, body)


def frame_change(error: np.ndarray) -> np.ndarray:
    """Return the map of the motion when its frame is displaced by ``error`` (shift in m, turn in rad)."""
    turn = rotation(error[3:]).T
    change = np.zeros((6, 6))
    change[:3, :3] = change[3:, 3:] = turn
    change[:3, 3:] = -turn @ cross(error[:3])
    return change


def body_points(body: int, rng: Generator) -> np.ndarray:
    """Return the true positions (m) of the points on the stapes (0) or on the bone (1)."""
    if body == 0:
        x = np.array([1.1, -1.1, 0.4, 0.4, -0.4, -0.4, 0.8, -0.7, 0.1, 0.15])
        y = np.array([0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 1.4, 1.5, 2.9, 3.2])
        z = np.array([0.0, 0.0, 0.4, -0.4, 0.4, -0.4, 0.15, -0.15, 0.35, -0.1])
    else:
        angle = np.arange(9) * 2.0 * np.pi / 9.0
        x, z = 2.6 * np.cos(angle), 2.0 * np.sin(angle)
        y = 0.5 * np.cos(3.0 * angle)
    points = np.column_stack([x, y, z]) + 0.05 * rng.standard_normal((len(x), 3))
    return points * 1e-3
