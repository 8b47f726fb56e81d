"""The annular ligament as stiffness and damping about the footplate centre, and the stapes that hangs in it.

Signals are e^{+i w t}; all matrices are SI, about the footplate centre in footplate axes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stapeskit.arrays import Array, ComplexArray
from stapeskit.frames import cross_matrix, rotation_from_vector
from stapeskit.spatial import DOF_NAMES, dof_indices

# CURAC 2019, p. 98 ff., "Results": y, alpha, gamma. D with the exponents of D12 and D13 corrected from -5 to
# -7, which restores the paper's Table 2 (as printed it is neither stable nor passive).
PAPER_STIFFNESS = np.array([[1722.0, 0.414, -0.48], [0.414, 1.37e-3, -6.41e-5], [-0.48, -6.41e-5, 3.79e-3]])
PAPER_DAMPING = np.array(
    [[22.89e-3, 61.42e-7, -36.79e-7], [61.42e-7, 30.15e-9, -67.56e-13], [-36.79e-7, -67.56e-13, 56.46e-9]]
)
BASE_PEAK_M = 1.0e-7  # 0.6 mm/s at 1 kHz, as a plan of a measurement assumes
PISTON_DOF = ("y", "alpha", "gamma")
ALIKE_HZ = 2200.0
"""Where the laws of `damped_alike` dissipate as much as a viscous one."""


LAWS: dict[str, tuple[Callable[[Array, float], Any], float, Callable[[float], float]]] = {
    "viscous": (lambda omega, _: 1j * omega, 1.0, lambda _: 1.0),
    "hysteretic": (lambda omega, _: np.full(omega.shape, 1j), 0.0, lambda _: 0.0),
    "fractional": (lambda omega, power: (1j * omega) ** power, 0.5, lambda power: power),
    "relaxation": (lambda omega, time: 1j * omega / (1.0 + 1j * omega * time), 30e-6, lambda _: 1.0),
}
"""Damping laws: s(w, exponent) in K + s(w) D, the usual exponent, and the power of time in the unit of D."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Ligament:
    """What ties the stapes to the bone: K + s(w) D of some degrees of freedom; others move with the bone."""

    stiffness_si: Array = field(default_factory=PAPER_STIFFNESS.copy)
    damping_si: Array = field(default_factory=PAPER_DAMPING.copy)
    dof: tuple[str, ...] = PISTON_DOF  # in the order of DOF_NAMES
    law: str = "viscous"  # one of LAWS
    # power of a fractional law, or relaxation time in s; None: the usual one of the law
    exponent: float | None = None
    # relative change of K and D from the first to the last line, from the middle line on, and from one run
    # to the next
    drift: float = 0.0
    step: float = 0.0
    run_change: float = 0.0
    # fluid of the cochlea that the bone carries along and the piston displaces: its inertia works against
    # the deflection along y
    fluid_mass_kg: float = 0.0

    def __post_init__(self) -> None:
        count = len(self.dof)
        if self.stiffness_si.shape != (count, count) or self.damping_si.shape != (count, count):
            raise ValueError(f"K and D must be {count} x {count}, as the degrees of freedom are.")
        if self.law not in LAWS:
            raise ValueError(f"the law must be one of {', '.join(LAWS)}; got {self.law}.")

    def damping_factor(self, omega: Array) -> ComplexArray:
        """Return s(w) at angular frequencies (L,), rad/s."""
        factor, usual, _ = LAWS[self.law]
        return np.asarray(factor(omega, usual if self.exponent is None else self.exponent))

    def dynamic_stiffness(self, freq_hz: Array, run: int = 0) -> ComplexArray:
        """Return K + s(w) D - w^2 (fluid) of a run, (L, n, n), with its changes over time."""
        factor = self.damping_factor(2.0 * np.pi * freq_hz)
        dynamic = self.stiffness_si + factor[:, None, None] * self.damping_si
        course = 1.0 + self.drift * np.linspace(0.0, 1.0, len(freq_hz))
        course[len(freq_hz) // 2 :] += self.step
        dynamic = dynamic * (course * (1.0 + self.run_change * run))[:, None, None]
        if self.fluid_mass_kg:
            piston = self.dof.index("y")
            dynamic[:, piston, piston] -= (2.0 * np.pi * freq_hz) ** 2 * self.fluid_mass_kg
        return np.asarray(dynamic)

    def scaled(self, factors: ArrayLike) -> Ligament:
        """Return the ligament with rows and columns of K and D multiplied by factors (n,)."""
        both = np.outer(np.asarray(factors, dtype=float), np.asarray(factors, dtype=float))
        return replace(self, stiffness_si=self.stiffness_si * both, damping_si=self.damping_si * both)


def damped_alike(ligament: Ligament, law: str, exponent: float | None = None) -> Ligament:
    """Return the ligament with another law whose D is rescaled to damp as much at ALIKE_HZ."""
    power = LAWS[law][2](LAWS[law][1] if exponent is None else exponent)
    scale = (2.0 * np.pi * ALIKE_HZ) ** (1.0 - power)
    return replace(ligament, law=law, exponent=exponent, damping_si=ligament.damping_si * scale)


@dataclass(frozen=True, kw_only=True)
class Ring:
    """Springs and dashpots on an ellipse around the footplate; its plane may lie above the footplate."""

    half_axes_mm: tuple[float, float] = (1.4, 0.65)  # along x and z
    # centre of the ring from the footplate centre; its y is the height of the plane
    centre_mm: tuple[float, float, float] = (-0.1, 0.1, 0.05)
    tilt_deg: tuple[float, float] = (0.0, 0.0)  # of the plane about x and z
    radial: float = 7.7e5  # stiffness per length against displacement in each direction, N/m per m
    tangential: float = 2.7e5
    normal: float = 2.6e5
    loss_s: float = 1.4e-5  # damping over stiffness, with ``loss_ratios`` for radial, tangential and normal
    loss_ratios: tuple[float, float, float] = (1.1, 0.9, 1.0)
    # harmonics along the rim: of the stiffness over its mean, one each, and the second of the height, mm
    uneven: tuple[complex, ...] = ()
    warp_mm: complex = 0.0j
    pieces: int = 90

    def matrix(self, radial: float, tangential: float, normal: float) -> Array:
        """Return the (6, 6) matrix of the ring about the footplate centre for three constants per length."""
        angle = (np.arange(self.pieces) + 0.5) * 2.0 * np.pi / self.pieces
        a, b = np.asarray(self.half_axes_mm) * 1e-3
        turn = rotation_from_vector(np.radians([self.tilt_deg[0], 0.0, self.tilt_deg[1]]))
        height = 1e-3 * (self.warp_mm * np.exp(2j * angle)).real
        places = np.column_stack([a * np.cos(angle), height, b * np.sin(angle)])
        tangents = np.column_stack([-a * np.sin(angle), np.zeros(self.pieces), b * np.cos(angle)])
        length = np.linalg.norm(tangents, axis=1)
        orders = np.arange(1, len(self.uneven) + 1)
        share = length * (1.0 + (np.exp(1j * np.outer(angle, orders)) @ np.array(self.uneven)).real)
        up = np.array([0.0, 1.0, 0.0])
        total = np.zeros((6, 6))
        for place, along, size in zip(places, tangents / length[:, None], share, strict=True):
            axes = turn @ np.column_stack([np.cross(along, up), along, up])
            local = axes @ np.diag([radial, tangential, normal]) @ axes.T * (size * angle[0] * 2.0)
            arm = turn @ place + np.asarray(self.centre_mm) * 1e-3
            rows = np.hstack([np.eye(3), -cross_matrix(arm)])
            total += rows.T @ local @ rows
        return total


def ring_ligament(ring: Ring | None = None, **options: object) -> Ligament:
    """Return the ligament of a ring in all six degrees of freedom; options are fields of `Ligament`."""
    ring = ring or Ring()
    stiffness = np.array([ring.radial, ring.tangential, ring.normal])
    damping = ring.loss_s * stiffness * ring.loss_ratios
    made = Ligament(stiffness_si=ring.matrix(*stiffness), damping_si=ring.matrix(*damping), dof=DOF_NAMES)
    return replace(made, **options)  # type: ignore[arg-type]


def draw_ring(rng: np.random.Generator, height_mm: float = 0.1, tilt_sd_deg: float = 1.0) -> Ring:
    """Draw a ring as human ears may have it: K11 near the paper's, plane and centre off by a little."""
    level = 1700.0 / 6.6e-3 * rng.uniform(0.7, 1.4)
    radial, tangential = level * rng.uniform(2.0, 4.0), level * rng.uniform(0.8, 1.3)
    tilt = tilt_sd_deg * rng.standard_normal(2)
    return Ring(
        centre_mm=(float(-0.2 * rng.uniform()), height_mm, float(0.2 * rng.uniform(-1.0, 1.0))),
        tilt_deg=(float(tilt[0]), float(tilt[1])),
        radial=float(radial),
        tangential=float(tangential),
        normal=float(level),
        loss_s=float(rng.uniform(0.9e-5, 2.0e-5)),
    )


def draw_uneven_ring(rng: np.random.Generator) -> Ring:
    """Draw a ring as fits of K and D expect a ligament beforehand (fitting/calibrated.toml).

    Its plane lies 0.15 +- 0.15 mm above the footplate centre, tilted by 3 degrees (sd) and warped by 0.03 mm;
    its stiffness varies along the rim by 30 % in the first and in the second harmonic.
    """
    ring = draw_ring(rng, float(rng.normal(0.15, 0.15)), 3.0)
    phases = np.exp(2j * np.pi * rng.uniform(size=3))
    warp = complex(0.03 * rng.standard_normal() * phases[2])
    return replace(ring, uneven=tuple((0.3 * phases[:2]).tolist()), warp_mm=warp)


def stapes_motion(
    freq_hz: Array, base: ComplexArray, mass_si: Array, ligament: Ligament, run: int = 0
) -> ComplexArray:
    """Return the motion (L, 6), m and rad, of all that moves, (6, 6), when the base (L, 6) drives it.

    It obeys w^2 (M_rr q_r + M_rc q_c) = Z (q_r - b_r), the paper's Eq. 2, in the degrees of freedom r of the
    ligament; the others, c, move with the base, and their inertia loads the ligament.
    """
    r = dof_indices(ligament.dof)
    c = [place for place in range(6) if place not in r]
    square = (2.0 * np.pi * freq_hz)[:, None, None] ** 2
    dynamic = ligament.dynamic_stiffness(freq_hz, run)
    load = dynamic @ base[:, r, None] + square * (mass_si[np.ix_(r, c)] @ base[:, c, None])
    motion = base.astype(complex).copy()
    motion[:, r] = np.linalg.solve(dynamic - square * mass_si[np.ix_(r, r)], load)[..., 0]
    return motion


def base_motion(freq_hz: Array, excitation: str, others: float = 1.0) -> ComplexArray:
    """Return the motion of the bone at the footplate centre, (L, 6), m and rad: some rocking, too."""
    main = "xyz".index(excitation)
    amplitude = np.array([0.06, 0.06, 0.05, 50.0, 15.0, -35.0]) * BASE_PEAK_M * others
    amplitude[main] = BASE_PEAK_M
    delay = np.array([0.4, 0.0, -0.3, 0.6, 1.1, -0.5])
    ripple = 1.0 + 0.15 * np.sin(freq_hz[:, None] / 700.0 + np.arange(6.0))
    decay = (1000.0 / freq_hz[:, None]) ** 0.5
    phase = np.exp(1j * (delay - 2.0 * np.pi * freq_hz[:, None] * 3.0e-5))
    return np.asarray(amplitude * ripple * decay * phase)


def resonant_motion(rng: np.random.Generator, freq_hz: Array) -> ComplexArray:
    """Return a random motion (L, 6), m and rad, with three resonances in all degrees of freedom."""
    motion = np.zeros((len(freq_hz), 6), dtype=complex)
    for resonance, damping in ((1753.0, 0.12), (2783.0, 0.14), (3862.0, 0.16)):
        ratio = freq_hz / resonance
        shape = rng.normal(size=6) * np.array([25e-9, 100e-9, 25e-9, 35e-6, 15e-6, 35e-6])
        motion += np.outer(1.0 / (1.0 - ratio**2 + 2j * damping * ratio), shape)
    motion[:, 1] += 100e-9
    return motion
