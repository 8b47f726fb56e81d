"""Prior distribution of the in-plane coupling of a ligament, from a population of uneven rings.

    python benchmarks/ligament_prior.py [RINGS]

Y = Z_rc Z_cc^-1 (rows y, alpha, gamma; columns x, z, beta; mm, mm and 1/mm) is calculated for elliptic rings
of springs of random size, place, tilt (3 degrees), stiffness ratios, and unevenness: the stiffness varies
around the rim (30 % in the first and in the second harmonic) and the rim is no plane (0.03 mm). Heights are
those about the mean height. The printed standard deviations are the ones of fitting/calibrated.toml,
[ligament.*_sd].
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.random import Generator

# Pieces of the ring: with ten times as many, Y changes by less than 6e-6, and its sd is 0.02.
PIECES = 72
TILT_DEG, UNEVEN, WARP_MM = 3.0, 0.3, 0.03


def coupling(rng: Generator) -> np.ndarray:
    """Return Y (3, 3) of one ring, mm."""
    angle = 2.0 * np.pi * (np.arange(PIECES) + 0.5) / PIECES
    half_x, half_z = 1.4 * rng.uniform(0.9, 1.1), 0.65 * rng.uniform(0.9, 1.1)
    rim = np.column_stack([half_x * np.cos(angle), np.zeros(PIECES), half_z * np.sin(angle)])
    tangent = np.column_stack([-half_x * np.sin(angle), np.zeros(PIECES), half_z * np.cos(angle)])
    length = np.linalg.norm(tangent, axis=1)
    tangent /= length[:, None]
    normal = np.tile([0.0, 1.0, 0.0], (PIECES, 1))
    radial = np.cross(tangent, normal)
    strength = np.ones(PIECES)
    for order in (1, 2):
        strength += UNEVEN * rng.standard_normal() * np.cos(order * angle + rng.uniform(0.0, 2.0 * np.pi))
        if order == 2:
            rim[:, 1] += WARP_MM * rng.standard_normal() * np.cos(2.0 * angle + rng.uniform(0.0, 2.0 * np.pi))
    strength = np.maximum(strength, 0.05) * length
    share = np.exp(rng.uniform(np.log([0.5, 0.3]), np.log([4.0, 1.5])))
    turns = np.radians(TILT_DEG) * rng.standard_normal(2)
    lean = np.array([[1.0, -turns[1], 0.0], [turns[1], 1.0, -turns[0]], [0.0, turns[0], 1.0]])
    rim = rim @ lean.T + np.array([-0.2 * rng.uniform(), 0.0, 0.2 * rng.uniform(-1.0, 1.0)])
    stiffness = np.zeros((6, 6))
    for axis, factor in ((radial, share[0]), (tangent, share[1]), (normal, 1.0)):
        along = axis @ lean.T
        rows = np.hstack([along, np.cross(rim, along)])
        stiffness += (rows * (factor * strength)[:, None]).T @ rows
    piston, plane = [1, 3, 5], [0, 2, 4]
    return stiffness[np.ix_(piston, plane)] @ np.linalg.inv(stiffness[np.ix_(plane, plane)])


def main() -> None:
    """Print standard deviations and the correlations above 0.3."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("rings", type=int, nargs="?", default=2000)
    rng = np.random.default_rng(0)
    couplings = np.array([coupling(rng) for _ in range(parser.parse_args().rings)])
    names = [f"Y[{row}, {column}]" for row in ("y", "alpha", "gamma") for column in ("x", "z", "beta")]
    flat = couplings.reshape(len(couplings), 9)
    for name, mean, sd in zip(names, flat.mean(axis=0), flat.std(axis=0), strict=True):
        print(f"{name:16s} mean {mean:+.4f} sd {sd:.4f}")
    heights = np.column_stack([couplings[:, 1, 1], -couplings[:, 2, 0]])
    print(f"heights: sd of the mean {heights.mean(axis=1).std():.4f}, of the difference "
          f"{(heights[:, 0] - heights[:, 1]).std():.4f} mm")  # fmt: skip
    correlation = np.corrcoef(flat.T)
    for row, column in np.argwhere(np.triu(np.abs(correlation), 1) > 0.3):
        print(f"correlation {names[row]} {names[column]}: {correlation[row, column]:+.2f}")


if __name__ == "__main__":
    main()
