"""The paper's beam experiment, simulated: a finite-element beam with a steel cube at either end as truth.

The base cube is shaken in y with a little rotation; 3D points on both cubes are seen with noise. The cubes
are rigid, the beam between them is Euler-Bernoulli with consistent mass and stiffness-proportional damping.

The paper leaves open the cubes' third dimension and density, where on the tip its coordinates refer to, the
damping, the points, the noise and the band. Assumed: 10 mm steel cubes of 7850 kg/m3 that stand on the beam,
centred over its ends, coordinates on the beam's mid-line below the tip cube's centre.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.random import Generator

from legacy.fitting.examples.beam import (
    STEEL_DENSITY,
    Beam,
    element_mass,
    element_stiffness,
    transport_to_tip,
)
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.kd_fit import KDFit
from legacy.fitting.model.point_layout import Layout
from legacy.fitting.options import KDOptions
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.records.motion import RigidMotion

BEAM_DOF: tuple[str, ...] = ("y", "alpha")
# Edge of the cube of the paper.
CUBE_MM = 10.0
MODELS: tuple[str, ...] = ("massless", "condensed")
# Beam elements: the third frequency is exact to 2e-5.
_ELEMENTS = 24
# Nine points on the top and the front of a cube that stands on the beam; x, y, z in mm from the mid-line.
CUBE_POINTS_MM = np.array(
    [
        [x, y, z]
        for x, y, z in (
            (-4, 10.4, -4),
            (4, 10.4, -4),
            (-4, 10.4, 4),
            (4, 10.4, 4),
            (0, 10.4, 0),
            (-4, 2, 5),
            (4, 2, 5),
            (-4, 8, 5),
            (4, 8, 5),
        )
    ],
    dtype=float,
)


@dataclass(frozen=True)
class Setup:
    """One way to run the experiment.

    Attributes
    ----------
    beam_has_mass : bool
        False: a massless beam, for which the two-DOF model is exact.
    loss : float
        Damping: D = loss / w1 K, a damping ratio of loss / 2 in the first mode.
    freq_hz : ndarray, (lines,)
    noise : float
        Of a channel's velocity, relative to the root mean square over its body's points and the band.
    rocking : float
        Rotation of the base times 10 mm over its translation.
    """

    beam: Beam = field(default_factory=Beam)
    beam_has_mass: bool = True
    loss: float = 0.01
    freq_hz: Array = field(default_factory=lambda: np.linspace(20.0, 1200.0, 400))
    noise: float = 0.01
    rocking: float = 0.05


def cube_mass(beam: Beam, shift_z_m: float = 0.0, density_kg_m3: float = STEEL_DENSITY) -> Array:
    """Return M (2, 2) in (y, alpha), SI, of a cube on the beam and the piece of beam below it.

    Parameters
    ----------
    shift_z_m : float
        Position of the centre of mass along the beam from the reference point, m.
    density_kg_m3 : float
        Of the cube.

    Notes
    -----
    M12 = -m z_c; J is about the beam's mid-line at the reference point.
    """
    side, height = CUBE_MM * 1e-3, beam.height_mm * 1e-3
    cube = density_kg_m3 * side**3
    piece = beam.density_kg_m3 * height * side * beam.width_mm * 1e-3
    above = (side + height) / 2.0
    inertia = cube * (side**2 / 6.0 + above**2) + piece * (side**2 + height**2) / 12.0
    mass = cube + piece
    return np.array([[mass, -mass * shift_z_m], [-mass * shift_z_m, inertia + mass * shift_z_m**2]])


def matrices(setup: Setup) -> tuple[Array, Array]:
    """Return stiffness and mass (2 nodes, 2 nodes) of the free beam in elements, base node first, SI."""
    length = setup.beam.length_mm * 1e-3 / _ELEMENTS
    bending = setup.beam.young_n_mm2 * setup.beam.second_moment_mm4 * 1e-6
    size = 2 * (_ELEMENTS + 1)
    stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
    share = setup.beam.mass_kg / _ELEMENTS if setup.beam_has_mass else 0.0
    for place in range(_ELEMENTS):
        block = slice(2 * place, 2 * place + 4)
        stiffness[block, block] += bending * element_stiffness(length)
        mass[block, block] += share * element_mass(length)
    return stiffness, mass


def first_frequencies(setup: Setup, shift_z_m: float = 0.0) -> Array:
    """Return the first two undamped frequencies (2,) of the clamped beam with the tip cube, Hz."""
    stiffness, mass = matrices(setup)
    tip = cube_mass(setup.beam, shift_z_m)
    if not setup.beam_has_mass:
        return _frequencies(setup.beam.stiffness_si(), tip)
    mass[-2:, -2:] += tip
    return _frequencies(stiffness[2:, 2:], mass[2:, 2:])[:2]


def _frequencies(stiffness: Array, mass: Array) -> Array:
    root = np.linalg.cholesky(mass)
    half = np.linalg.solve(root, stiffness)
    values = np.linalg.eigvalsh(np.linalg.solve(root, half.T))
    return np.asarray(np.sqrt(np.maximum(values, 0.0)) / (2.0 * np.pi))


def tip_motion(setup: Setup, base: ComplexArray, shift_z_m: float = 0.0) -> ComplexArray:
    """Return the motion of the tip (lines, 2) for a motion of the base node (lines, 2), m and rad."""
    stiffness, mass = matrices(setup)
    mass[-2:, -2:] += cube_mass(setup.beam, shift_z_m)
    omega = (2.0 * np.pi * setup.freq_hz)[:, None, None]
    complex_stiffness = (1.0 + 1j * omega * damping_time(setup)) * stiffness
    dynamic = complex_stiffness - omega**2 * mass
    right = -np.einsum("lij,lj->li", dynamic[:, 2:, :2], base)
    return np.asarray(np.linalg.solve(dynamic[:, 2:, 2:], right[..., None])[:, -2:, 0])


def damping_time(setup: Setup) -> float:
    """Return the time D / K of the stiffness-proportional damping, s."""
    return float(setup.loss / (2.0 * np.pi * first_frequencies(setup)[0]))


def measured(setup: Setup, rng: Generator | None, shift_z_m: float = 0.0) -> RigidMotion:
    """Return the motion of both cubes about the reference point at the tip, with the noise of points.

    Parameters
    ----------
    rng : Generator or None
        None: no noise is added; its covariance is stated.
    shift_z_m : float
        Where the tip's centre of mass truly is along the beam, m.

    Returns
    -------
    RigidMotion
        Bodies ``tip`` and ``base`` in (y, alpha); the base is transported to the tip.
    """
    omega = 2.0 * np.pi * setup.freq_hz
    base = np.empty((len(omega), 2), dtype=complex)
    base[:, 0] = 1e-3 / omega
    base[:, 1] = setup.rocking * 1e-3 / omega / (CUBE_MM * 1e-3) * np.exp(1j * setup.freq_hz / 400.0)
    motions = [tip_motion(setup, base, shift_z_m), base]
    carry = [np.eye(2), transport_to_tip(setup.beam.length_mm * 1e-3)]
    layout = Layout(CUBE_POINTS_MM)
    q, covariance = [], []
    for motion, transport in zip(motions, carry, strict=True):
        level = (
            setup.noise * layout.signal(BEAM_DOF, np.asarray(motion * omega[:, None], dtype=complex)) / omega
        )
        spread = layout.covariance(BEAM_DOF, level)
        if rng is not None:
            draw = rng.standard_normal((2, *motion.shape)) * np.sqrt(0.5)
            root = np.linalg.cholesky(spread)
            motion = motion + np.einsum("lij,lj->li", root, draw[0] + 1j * draw[1])
        q.append(motion @ transport.T)
        covariance.append(transport @ spread @ transport.T)
    none = np.full((1, 2, len(omega)), np.nan)
    return RigidMotion(
        ("1",),
        ("tip", "base"),
        BEAM_DOF,
        setup.freq_hz,
        np.array(q)[None],
        np.array(covariance, dtype=complex)[None],
        none,
        none,
    )


def fit_beam(
    motion: RigidMotion, beam: Beam, model: str, estimator: str = "ml", shift_z_m: float = 0.0
) -> KDFit:
    """Fit K and D at the tip.

    Parameters
    ----------
    motion : RigidMotion
        From ``measured``.
    model : str
        ``massless``: the cube alone, the paper's model; ``condensed``: with the beam's own mass M_tt and its
        coupling M_tb to the base.
    shift_z_m : float
        Where the centre of mass is believed to be along the beam, m.
    """
    mass, coupling = cube_mass(beam, shift_z_m), None
    if model == "condensed":
        own, coupling = beam.condensed_mass_si()
        mass = mass + own
    options = KDOptions(dof=BEAM_DOF, structure="tip", base="base", estimator=estimator)
    return fit_kd(motion, mass, options, base_mass=coupling)


@dataclass(frozen=True)
class Deviations:
    """How far repeated estimates lie from Table 1's theory.

    Attributes
    ----------
    mean_percent, scatter_percent : ndarray, (3,)
        Mean and standard deviation of (estimate - theory) / theory over the repetitions, for c1, c2, c3.
    absolute_percent : ndarray, (3,)
        Mean of Eq. 9.
    chi2_per_dof : float
        Mean.
    """

    model: str
    estimator: str
    mean_percent: Array
    scatter_percent: Array
    absolute_percent: Array
    chi2_per_dof: float


def deviations(
    setup: Setup, model: str, estimator: str, repetitions: int, shift_z_m: float = 0.0, seed: int = 1
) -> Deviations:
    """Repeat the experiment with new noise; ``shift_z_m`` is where the centre of mass is believed to be."""
    rng = np.random.default_rng(seed)
    theory = setup.beam.coefficients
    errors, ratios = [], []
    for _ in range(repetitions):
        fit = fit_beam(measured(setup, rng), setup.beam, model, estimator, shift_z_m)
        errors.append(100.0 * (coefficients(fit.stiffness) / theory - 1.0))
        ratios.append(fit.chi2 / fit.n_dof)
    values = np.array(errors)
    return Deviations(
        model,
        estimator,
        values.mean(axis=0),
        values.std(axis=0),
        np.abs(values).mean(axis=0),
        float(np.mean(ratios)),
    )


def coefficients(stiffness: Array) -> Array:
    """Return c1 (N/mm), c2 (N), c3 (N mm) of K (2, 2) in SI: the paper's Table 1."""
    return np.array([stiffness[0, 0] * 1e-3, stiffness[0, 1], stiffness[1, 1] * 1e3])
