"""The paper's beam experiment recomputed: a clamped beam with a steel cube, in y and alpha at its tip.

The beam lies along +z from the base to the tip; a rotation alpha about x moves a point by u_y = -alpha z. The
paper leaves open the third dimension of the cube, its density and the reference point; taken here are a 10 mm
cube of 7850 kg/m3 that stands on the tip, and the mid-line of the beam. Run: python docs/examples/beam.py
"""

from __future__ import annotations

import numpy as np

import stapeskit as sk
from stapeskit.arrays import Array, ComplexArray
from stapeskit.records.motion_file import RigidMotion

YOUNG_PA, HEIGHT_M, WIDTH_M, LENGTH_M = 210e9, 0.81e-3, 10e-3, 48e-3
STEEL_KG_M3, CUBE_M = 7850.0, 10e-3
BENDING = YOUNG_PA * WIDTH_M * HEIGHT_M**3 / 12.0  # E I, N m2
BEAM_KG = STEEL_KG_M3 * HEIGHT_M * WIDTH_M * LENGTH_M
PRINTED_PERCENT = (3.17, 1.28, 0.38)  # deviations of the paper's estimates of c1, c2, c3 (Table 1)
TO_TIP = np.array([[1.0, -LENGTH_M], [0.0, 1.0]])  # motion of the base, carried to the tip (paper, Eq. 7)
FREQ_HZ = np.linspace(20.0, 1200.0, 400)
LOSS_HZ = 85.0  # frequency at which the damping ratio is half the loss factor
LOSS = 0.01


def element_stiffness(length: float) -> Array:
    """Return the stiffness (4, 4) of an element with E I = 1 in (y1, alpha1, y2, alpha2)."""
    one, two, three = length, length**2, length**3
    return (
        np.array(
            [
                [12.0, -6.0 * one, -12.0, -6.0 * one],
                [-6.0 * one, 4.0 * two, 6.0 * one, 2.0 * two],
                [-12.0, 6.0 * one, 12.0, 6.0 * one],
                [-6.0 * one, 2.0 * two, 6.0 * one, 4.0 * two],
            ]
        )
        / three
    )


def element_mass(length: float) -> Array:
    """Return the consistent mass (4, 4) of an element of 1 kg (Przemieniecki 1968, section 11.5)."""
    one, two = length, length**2
    return (
        np.array(
            [
                [156.0, -22.0 * one, 54.0, 13.0 * one],
                [-22.0 * one, 4.0 * two, -13.0 * one, -3.0 * two],
                [54.0, 13.0 * one, 156.0, 22.0 * one],
                [13.0 * one, -3.0 * two, 22.0 * one, 4.0 * two],
            ]
        )
        / 420.0
    )


def tip_stiffness() -> Array:
    """Return K (2, 2) at the tip, N/m, N, N m (paper, Eq. 6)."""
    return BENDING * np.array([[12.0 / LENGTH_M**3, 6.0 / LENGTH_M**2], [6.0 / LENGTH_M**2, 4.0 / LENGTH_M]])


def cube_mass(shift_m: float = 0.0) -> Array:
    """Return M (2, 2) of the cube and its piece of beam, its centre shifted along the beam; SI."""
    cube = STEEL_KG_M3 * CUBE_M**3
    piece = STEEL_KG_M3 * HEIGHT_M * CUBE_M * WIDTH_M
    above = (CUBE_M + HEIGHT_M) / 2.0
    inertia = cube * (CUBE_M**2 / 6.0 + above**2) + piece * (CUBE_M**2 + HEIGHT_M**2) / 12.0
    mass = cube + piece
    return np.array([[mass, -mass * shift_m], [-mass * shift_m, inertia + mass * shift_m**2]])


def condensed_mass() -> tuple[Array, Array]:
    """Return the beam's own mass at the tip and its coupling to the base carried there, M_tt and M_tb."""
    element = BEAM_KG * element_mass(LENGTH_M)
    return element[2:, 2:], element[2:, :2] @ np.linalg.inv(TO_TIP)


def assembled(has_mass: bool = True, elements: int = 24) -> tuple[Array, Array]:
    """Return stiffness and mass of the free beam in finite elements, base first."""
    length, size = LENGTH_M / elements, 2 * (elements + 1)
    stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
    for place in range(elements):
        block = slice(2 * place, 2 * place + 4)
        stiffness[block, block] += BENDING * element_stiffness(length)
        mass[block, block] += has_mass * BEAM_KG / elements * element_mass(length)
    return stiffness, mass


def frequencies_hz(stiffness: Array, mass: Array) -> Array:
    """Return the first two undamped frequencies."""
    values = np.linalg.eigvals(np.linalg.solve(mass, stiffness)).real
    return np.sqrt(np.sort(values)[:2]) / (2.0 * np.pi)


def clamped_frequencies_hz() -> Array:
    """Return the first two frequencies of the clamped beam with its own mass and the cube."""
    stiffness, mass = assembled()
    mass[-2:, -2:] += cube_mass()
    return frequencies_hz(stiffness[2:, 2:], mass[2:, 2:])


def measured(has_mass: bool, noise: float, seed: int = 1) -> RigidMotion:
    """Simulate both cubes in (y, alpha), the base carried to the tip, with relative noise."""
    stiffness, mass = assembled(has_mass)
    mass[-2:, -2:] += cube_mass()
    omega = 2.0 * np.pi * FREQ_HZ
    base = np.stack([1e-3 / omega, 5e-3 / omega * np.exp(1j * FREQ_HZ / 400.0)], axis=1)
    factor = (1.0 + 1j * omega * LOSS / (2.0 * np.pi * LOSS_HZ))[:, None, None]
    dynamic = factor * stiffness - (omega**2)[:, None, None] * mass
    load = -np.einsum("lij,lj->li", dynamic[:, 2:, :2], base)
    tip = np.linalg.solve(dynamic[:, 2:, 2:], load[..., None])[:, -2:, 0]
    q: ComplexArray = np.stack([tip, base @ TO_TIP.T])[None]
    sd = noise * np.sqrt(np.mean(np.abs(q * omega[:, None]) ** 2, axis=2, keepdims=True)) / omega[:, None]
    rng = np.random.default_rng(seed)
    q = q + sd * (rng.standard_normal(q.shape) + 1j * rng.standard_normal(q.shape))
    covariance = 2.0 * sd[..., None] ** 2 * np.eye(2) + 0j
    none = np.full(q.shape[:3], np.nan)
    return RigidMotion(("1",), ("tip", "base"), ("y", "alpha"), FREQ_HZ, q, covariance, none, none)


def deviations_percent(motion: RigidMotion, shift_m: float = 0.0, estimator: str = "ml") -> Array:
    """Fit K and D with the cube alone as mass, and return the deviations of c1, c2, c3 (paper, Eq. 9)."""
    fit = sk.dof2kd(
        motion,
        mass=cube_mass(shift_m),
        dof=("y", "alpha"),
        structure="tip",
        base="base",
        estimator=estimator,
        unknowns=("none",) if estimator == "ml" else (),
    )
    return 100.0 * (fit.stiffness / tip_stiffness() - 1.0)[np.triu_indices(2)]


def deviations_with_beam_mass(motion: RigidMotion) -> Array:
    """Solve w^2 (M_tt q_s + M_tb q_b) = (K + i w D) dq by least squares, in units of the cube's mass."""
    tip, base = motion.q[0]
    omega = 2.0 * np.pi * FREQ_HZ
    own, coupling = condensed_mass()
    root = np.sqrt(np.diag(cube_mass()))
    wanted = omega[:, None] ** 2 * (tip @ (cube_mass() + own).T + base @ coupling.T) / root
    deflection = (tip - base) * root
    rows = np.zeros((len(omega), 2, 6), dtype=complex)
    for place, (row, column) in enumerate(((0, 0), (0, 1), (1, 1))):
        unit = np.zeros((2, 2))
        unit[row, column] = unit[column, row] = 1.0
        rows[:, :, place] = deflection @ unit
        rows[:, :, 3 + place] = 1j * omega[:, None] * (deflection @ unit)
    matrix, right = rows.reshape(-1, 6), wanted.ravel()
    size = np.linalg.norm(matrix, axis=0)
    stacked = np.concatenate([(matrix / size).real, (matrix / size).imag])
    found = np.linalg.lstsq(stacked, np.concatenate([right.real, right.imag]))[0] / size
    stiffness = found[[0, 1, 1, 2]].reshape(2, 2) * np.outer(root, root)
    return 100.0 * (stiffness / tip_stiffness() - 1.0)[np.triu_indices(2)]


def main() -> None:
    """Print the numbers of the beam experiment."""
    c = tip_stiffness()[np.triu_indices(2)] * [1e-3, 1.0, 1e3]
    print(f"c1 {c[0]:.4f} N/mm, c2 {c[1]:.3f} N, c3 {c[2]:.1f} N mm")
    share = 100.0 * BEAM_KG / cube_mass()[0, 0]
    print(f"free beam {1e3 * BEAM_KG:.2f} g, {share:.0f} % of the cube and its piece")
    massless, whole = frequencies_hz(tip_stiffness(), cube_mass()), clamped_frequencies_hz()
    condensed = frequencies_hz(tip_stiffness(), cube_mass() + condensed_mass()[0])
    print(f"f1, f2: massless {massless.round(1)} Hz, with the mass of the beam {whole.round(1)} Hz")
    print(f"        change {np.round(100.0 * (whole / massless - 1.0), 2)} %")
    print(f"        condensed mass M_tt {condensed.round(1)} Hz")
    shifted = frequencies_hz(tip_stiffness(), cube_mass(1e-4))
    print(f"centre of mass 100 um along the beam: {np.round(100.0 * (shifted / massless - 1.0), 2)} %")
    print("deviations of c1, c2, c3 in % (printed in the paper: 3.17, 1.28, 0.38)")
    light, heavy = measured(False, 0.002), measured(True, 0.002)
    print(f"  massless beam, ml:                       {deviations_percent(light).round(2)}")
    print(f"  massless beam, pinv:                     {deviations_percent(light, 0.0, 'pinv').round(2)}")
    print(f"  massless, centre 100 um off, ml:         {deviations_percent(light, 1e-4).round(2)}")
    print(f"  massless, centre 100 um off, pinv:       {deviations_percent(light, 1e-4, 'pinv').round(2)}")
    print(f"  beam with mass, cube alone, ml:          {deviations_percent(heavy).round(2)}")
    print(f"  beam with mass, M_tt and M_tb:           {deviations_with_beam_mass(heavy).round(2)}")


if __name__ == "__main__":
    main()
