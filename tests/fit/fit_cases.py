"""Simulated motion for the tests of fitting: the paper's stapes, and ears with a ring of springs as ligament.

The ears come from the simulator of the project and plain least squares: no engine of fitting is in them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace

import numpy as np

from fitting.dof2kd import fit_of
from fitting.mass import Inertia, inertia_of
from fitting.options import KDOptions
from fitting.planned_motion import BASE_POINTS_MM, STAPES_POINTS_MM, Layout, frame_maps
from fitting.result import KDFit
from fitting.unknowns import HEAD_M, point
from simulate.ligament import (
    PAPER_DAMPING,
    PAPER_STIFFNESS,
    Ligament,
    draw_ring,
    ring_ligament,
    stapes_motion,
)
from stapeskit.records.mass_matrix import MassMatrix
from stapeskit.records.motion_file import RigidMotion, SharedErrors
from stapeskit.spatial import DOF_NAMES, matrix_from_parameters

K, D = PAPER_STIFFNESS, PAPER_DAMPING
M = np.array(
    [
        [3.2e-6, -434.88e-12, 143.04e-12],
        [-434.88e-12, 9.77e-12, -29.7e-15],
        [143.04e-12, -29.7e-15, 11.14e-12],
    ]
)
DOF = ("y", "alpha", "gamma")
TRUTH = np.concatenate([K[np.triu_indices(3)], D[np.triu_indices(3)]])
STAPES, BASE = (Layout(np.array(points), np.eye(3)) for points in (STAPES_POINTS_MM, BASE_POINTS_MM))
ROWS = [1, 3, 5]


def exact_motion(lines=200, band=(400.0, 5000.0), in_plane=0.0, mass=None, ligament=None, directions="y"):
    """Motion of base and stapes without noise, (runs, 2, lines, 6), and its frequencies."""
    freq = np.linspace(*band, lines)
    runs = []
    for direction in directions:
        base = np.zeros((lines, 6), dtype=complex)
        for place in range(6):
            share = 0.05 if place in ROWS else in_plane
            base[:, place] = share * np.exp(1j * (1.0 + place) * freq / 5000.0) * (1e3 if place > 2 else 1.0)
        base[:, DOF_NAMES.index(direction)] = 1.0
        base *= (6e-4 / (2.0 * np.pi * freq))[:, None]
        own = ligament or Ligament()
        runs.append([stapes_motion(freq, base, full_mass() if mass is None else mass, own), base])
    return freq, np.array(runs)


def full_mass():
    """A 6 x 6 mass matrix with the paper's block of y, alpha and gamma."""
    return matrix_from_parameters(six_parameters())


@cache
def six_parameters():
    """Ten inertial parameters: the paper's mass and centre, 1.3 mm above the footplate."""
    mass, centre = 3.2e-6, np.array([0.0447e-3, 1.3e-3, 0.1359e-3])
    central = np.array([[4.2, -0.1, 0.05], [-0.1, 2.1, 0.08], [0.05, 0.08, 5.0]]) * 1e-12
    tensor = central + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return np.array([mass, *(mass * centre), *tensor[[0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]]])


def record(freq, q, covariance, dof=DOF_NAMES, shared=None, notices=()):
    """A motion record of runs, stapes and base."""
    none = np.zeros(q.shape[:3])
    runs = tuple(str(run + 1) for run in range(len(q)))
    return RigidMotion(
        runs, ("stapes", "base"), dof, freq, q, covariance, none, none, shared=shared, notices=notices
    )


def paper_motion(noise=0.02, seed=0, lines=200, law="viscous", band=(400.0, 5000.0), stiffness=K, damping=D):
    """The paper's stapes in y, alpha and gamma; exact where seed is None, its covariance stated."""
    scale = {"viscous": 1.0, "hysteretic": 2.0 * np.pi * 2700.0, "fractional": (2.0 * np.pi * 2700.0) ** 0.3}[
        law
    ]
    exponent = 0.7 if law == "fractional" else None
    freq = np.linspace(*band, lines)
    base = np.zeros((lines, 3), dtype=complex)
    base[:, 0] = 1.0
    base[:, 1:] = 50.0 * np.exp(1j * np.outer(freq, [2.0, 4.0]) / 5000.0)
    base *= (6e-4 / (2.0 * np.pi * freq))[:, None]
    ligament = Ligament(stiffness_si=stiffness, damping_si=damping * scale, law=law, exponent=exponent)
    z = ligament.dynamic_stiffness(freq)
    omega = 2.0 * np.pi * freq
    force = (z @ base[..., None])[..., 0]
    stapes = np.linalg.solve(z - (omega**2)[:, None, None] * M, force[..., None])[..., 0]
    q = np.stack([stapes, base])[None]
    covariance = np.empty((1, 2, lines, 3, 3), dtype=complex)
    rng = None if seed is None else np.random.default_rng(seed)
    for body, layout in enumerate((STAPES, BASE)):
        rows = layout.rows[:, ROWS]
        level = noise * np.sqrt(np.mean(np.abs(q[0, body] @ rows.T) ** 2, axis=1))
        own = np.linalg.inv(rows.T @ rows)
        covariance[0, body] = (level**2)[:, None, None] * own
        if rng is not None:
            draws = rng.standard_normal((2, lines, 3)) * np.sqrt(0.5)
            q[0, body] += level[:, None] * ((draws[0] + 1j * draws[1]) @ np.linalg.cholesky(own).T)
    return record(freq, q, covariance, DOF), damping * scale


@dataclass(frozen=True)
class RingEar:
    """What an experimenter has, and the truth about the footplate centre (12,)."""

    motion: RigidMotion
    mass: MassMatrix
    truth: np.ndarray


def ring_ear(
    seed, height_mm=0.1, noise=0.01, lines=120, band=(400.0, 5000.0), shared=True, cause="", size=0.0
):
    """Draw an ear with a ring as ligament, measured with wrong positions, registration, mass and noise.

    ``cause`` is an error that is not known: delay (us), gain (%), fluid, head_mass (mg), drift, step (%).
    """
    rng = np.random.default_rng(seed)
    parameters = six_parameters() * rng.uniform(0.85, 1.15)
    ligament = ring_ligament(draw_ring(rng, height_mm))
    if cause in ("drift", "step"):
        ligament = replace(ligament, **{cause: 0.01 * size})
    mass = matrix_from_parameters(parameters)
    moving = mass + (matrix_from_parameters(point(HEAD_M, 1e-6 * size)) if cause == "head_mass" else 0.0)
    freq, q = exact_motion(lines, band, 0.1, moving, ligament)
    omega = 2.0 * np.pi * freq
    if cause == "fluid":  # a mass on the piston deflection: solved again with it on the left
        z = ligament.dynamic_stiffness(freq)
        z[:, 1, 1] -= omega**2 * 1e-6 * size
        force = (z @ q[0, 1][..., None])[..., 0]
        q[0, 0] = np.linalg.solve(z - (omega**2)[:, None, None] * mass, force[..., None])[..., 0]
    if cause == "delay":
        q[0, 0] = q[0, 0] * np.exp(-1e-6j * size * omega)[:, None]
    if cause == "gain":
        q[0, 0] = q[0, 0] / (1.0 + 0.01 * size)
    names, sds, maps = [], [], []
    on = float(shared)
    for axis, change in zip(DOF_NAMES, frame_maps(), strict=True):
        names.append(f"registration.{axis}")
        sds.append(on * (30e-6 if axis in "xyz" else np.radians(0.3)))
        maps.append(np.stack([change, change]))
    for body, layout in enumerate((STAPES, BASE)):
        for number, change in enumerate(layout.position_maps()):
            both = np.zeros((2, 6, 6))
            both[body] = change
            names.append(f"position.{body}_{number}")
            sds.append(on * 30e-6)
            maps.append(both)
    maps, drawn = np.array(maps), np.array(sds) * rng.standard_normal(len(sds))
    covariance = np.empty((1, 2, lines, 6, 6), dtype=complex)
    for body, layout in enumerate((STAPES, BASE)):
        level = noise * np.sqrt(np.mean(np.abs(q[0, body] @ layout.rows.T) ** 2, axis=1))
        inverse = layout.inverse
        covariance[0, body] = (level**2)[:, None, None] * (inverse @ inverse.T)
        turn = np.eye(6) + np.tensordot(drawn, maps[:, body], 1)
        draws = rng.standard_normal((2, lines, inverse.shape[1])) * np.sqrt(0.5)
        q[0, body] = q[0, body] @ turn.T + level[:, None] * ((draws[0] + 1j * draws[1]) @ inverse.T)
    known = None
    if shared:
        slopes = np.einsum("kbij,rblj->krbli", maps, q)
        known = SharedErrors(tuple(names), np.diag(np.square(sds)), slopes)
    stated = parameters * (1.0 + 0.02 * on * rng.standard_normal())
    density = {"density": 0.02**2 * np.outer(stated, stated)} if shared else {}
    block = np.ix_(ROWS, ROWS)
    truth = [part[block][np.triu_indices(3)] for part in (ligament.stiffness_si, ligament.damping_si)]
    return RingEar(
        record(freq, q, covariance, shared=known),
        MassMatrix(stated, contributions=density),
        np.concatenate(truth),
    )


def fit(motion, mass, confirmed=(), **options) -> KDFit:
    """Fit as every command does."""
    chosen = KDOptions.of(**options)
    inertia = mass if isinstance(mass, Inertia) else inertia_of(mass, chosen.dof, "tensor")
    return fit_of(motion, inertia, chosen, {}, confirmed=confirmed)


def with_outline(result, points_mm):
    """The same fit with a footplate of an outline (n, 2), x and z in mm."""
    found = {"footplate_outline_in_footplate_mm": np.asarray(points_mm).tolist()}
    record = SimpleNamespace(raw={"found": found})
    return replace(result, inertia=replace(result.inertia, record=record))


def drawn(motion, rng):
    """A planned motion with its shared errors and noise of readings drawn."""
    shared = motion.shared
    errors = np.sqrt(np.diag(shared.covariance)) * rng.standard_normal(len(shared.names))
    growth = (2j * np.pi * motion.freq_hz)[None] ** shared.powers[:, None]
    turn = np.eye(6) + np.einsum("k,kl,kbij->blij", errors, growth, shared.maps)
    noise = rng.standard_normal((2, *motion.q.shape)) * np.sqrt(0.5)
    noise = np.linalg.cholesky(motion.covariance) @ (noise[0] + 1j * noise[1])[..., None]
    return replace(motion, q=(turn @ motion.q[..., None] + noise)[..., 0])


def deviation(result, truth=TRUTH):
    """Errors of K and D in their standard deviations."""
    return (result.values - truth) / np.sqrt(np.diag(result.covariance))


def codes(result):
    """Codes of the warnings."""
    return {notice.code for notice in result.notices}


def agrees(share, expected, count, correlated=1.0):
    """Whether a share agrees with a probability within three binomial standard deviations.

    ``correlated``: how many times fewer independent cases there are.
    """
    return abs(share - expected) < 3.0 * np.sqrt(expected * (1.0 - expected) * correlated / count)
