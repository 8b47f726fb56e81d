"""The paper recomputed: what follows from its printed matrices, next to what it prints.

CURAC 2019 (18th annual meeting of the German Society for Computer- and Robot-Assisted Surgery), p. 98 ff.
Run: python docs/examples/paper.py
"""

from __future__ import annotations

import numpy as np

from fitting.model import modes, passive, principal_axes
from stapeskit.arrays import Array

# Stapes experiment, y, alpha, gamma about the footplate centre, SI.
MASS = np.array(
    [
        [3.2e-6, -434.88e-12, 143.04e-12],
        [-434.88e-12, 9.77e-12, -29.7e-15],
        [143.04e-12, -29.7e-15, 11.14e-12],
    ]
)
STIFFNESS = np.array([[1722.0, 0.414, -0.48], [0.414, 1.37e-3, -6.41e-5], [-0.48, -6.41e-5, 3.79e-3]])
DAMPING_PRINTED = np.array(
    [
        [22.89e-3, 61.42e-5, -36.79e-5],
        [61.42e-5, 30.15e-9, -67.56e-13],
        [-36.79e-5, -67.56e-13, 56.46e-9],
    ]
)
# D12 and D13 with the exponent -7 in place of -5.
DAMPING = DAMPING_PRINTED * np.array([[1.0, 1e-2, 1e-2], [1e-2, 1.0, 1.0], [1e-2, 1.0, 1.0]])

# Table 2 and Fig. 6 as printed.
FREQUENCY_HZ = (1753.0, 2783.0, 3862.0)
DAMPING_RATIO = (0.12, 0.14, 0.18)
SHAPES = np.array([[33.5, 90.0, 4.6], [33.4, 9.2, 56.0], [164.0, 25.0, 32.0]])
PRINCIPAL_STIFFNESS = (1722.0, 1.26e-3, 3.65e-3)
ORIGIN_MM, ANGLE_DEG = (0.28, 0.24), 1.0


def centre_of_mass_mm() -> tuple[float, float]:
    """Return x and z of the centre of mass: M12 = -m z, M13 = m x."""
    return 1e3 * MASS[0, 2] / MASS[0, 0], -1e3 * MASS[0, 1] / MASS[0, 0]


def table_2() -> tuple[Array, Array, Array, Array]:
    """Return damped and undamped frequencies (Hz), damping ratios and |shape| of the corrected model.

    The shapes are entries of the state eigenvector of unit length, times 1e9 for y and 1e6 for rotations:
    what the paper labels nm and urad.
    """
    pairs = modes(MASS, STIFFNESS, DAMPING).pairs
    shapes = np.array([np.abs(mode.shape) * [1e9, 1e6, 1e6] for mode in pairs])
    return (
        np.array([mode.frequency_hz for mode in pairs]),
        np.array([mode.undamped_frequency_hz for mode in pairs]),
        np.array([mode.damping_ratio for mode in pairs]),
        shapes,
    )


def printed_damping() -> tuple[bool, float]:
    """Return whether the printed D is passive, and the largest real part of an eigenvalue with it, 1/s."""
    return passive(DAMPING_PRINTED), modes(MASS, STIFFNESS, DAMPING_PRINTED).max_real_1_s


def main() -> None:
    """Print every number of the paper next to the one that follows from its matrices."""
    x, z = centre_of_mass_mm()
    print(f"centre of mass: x {x:+.4f} mm, z {z:+.4f} mm")
    is_passive, growth = printed_damping()
    print(f"D as printed: passive {is_passive}, largest real part of an eigenvalue {growth:+.3g} 1/s")
    damped, undamped, ratios, shapes = table_2()
    print(f"D12, D13 with the exponent -7: passive {passive(DAMPING)}")
    print("mode  printed Hz  damped Hz  undamped Hz  printed zeta  zeta")
    for place, values in enumerate(zip(FREQUENCY_HZ, damped, undamped, DAMPING_RATIO, ratios, strict=True)):
        print("{:<4}  {:>10.0f}  {:>9.1f}  {:>11.1f}  {:>12.2f}  {:.3f}".format(place + 1, *values))
    for place, (printed, found) in enumerate(zip(SHAPES, shapes, strict=True), 1):
        print(f"shape of mode {place} (y, alpha, gamma): printed {printed}, found {np.round(found, 2)}")
    x0, z0, angle, *stiffness = principal_axes(STIFFNESS)
    print(f"origin of the principal axes: x {1e3 * x0:+.4f}, z {1e3 * z0:+.4f} mm (printed {ORIGIN_MM})")
    print(f"turned by {np.degrees(angle):.3f} degrees about y (printed {ANGLE_DEG:g})")
    print(f"K about them: {[float(f'{value:.5g}') for value in stiffness]} (printed {PRINCIPAL_STIFFNESS})")


if __name__ == "__main__":
    main()
