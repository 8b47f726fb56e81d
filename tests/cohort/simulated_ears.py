"""Ears with a planted law, as mass.json and kd.json hold them."""

import numpy as np

from pipeline.cohort.ears import Ear


def ear(number, rng, exponent=2.0, density=1900.0, side="left"):
    """Return an ear whose K and D follow its mass by a law, as mass.json and kd.json hold it."""
    size = float(np.exp(0.15 * rng.standard_normal()))
    follow = size**exponent * float(np.exp(0.1 * rng.standard_normal()))
    theta = np.array([3e-6, 1e-10, 3e-9, 2e-10, 1.2e-11, 8e-12, 1.0e-11, 1e-13, 2e-13, -3e-13]) * size
    relative = 0.01
    noise = (0.002 * theta)[:, None] * (0.002 * theta)
    dense = (relative * theta)[:, None] * (relative * theta)
    stiffness = follow * np.array([[1700.0, 0.4, -0.5], [0.4, 1.4e-3, -6e-5], [-0.5, -6e-5, 3.8e-3]])
    damping = follow * np.array([[0.023, 6e-6, -4e-6], [6e-6, 3e-8, -1e-9], [-4e-6, -1e-9, 5.6e-8]])
    damping = damping * float(np.exp(0.1 * rng.standard_normal()))
    names = [f"{letter}{i + 1}{j + 1}" for letter in "KD" for i in range(3) for j in range(i, 3)]
    entries = np.r_[stiffness[np.triu_indices(3)], damping[np.triu_indices(3)]]
    sizes = np.r_[
        [
            np.sqrt(m[i, i] * m[j, j])
            for m in (stiffness, damping)
            for i, j in zip(*np.triu_indices(3), strict=True)
        ]
    ]
    channel = 0.01 * sizes
    covariance = np.diag(channel**2) + relative**2 * np.outer(entries, entries)
    mass = {
        "schema": "stapeskit.mass/1",
        "density_kg_m3": density,
        "mass_known_by": "density",
        "mass_kg": float(theta[0]),
        "frames": {"side": side},
        "inertial_parameters": {
            "values_si": theta.tolist(),
            "contributions_si": {"noise": noise.tolist(), "density": dense.tolist()},
        },
        "mass_matrix": {"standard_deviation_si": [[0.01 * float(theta[0])]]},
        "found": {"height_mm": 3.4, "footplate_length_mm": 2.7 * size ** (1 / 3), "footplate_width_mm": 1.3},
        "segmentation": {"voxel_size_mm": [0.02, 0.02, 0.02]},
    }
    kd = {
        "schema": "stapeskit.kd/1",
        "dof": ["y", "alpha", "gamma"],
        "estimator": "ml",
        "model": {"damping_law": "viscous"},
        "parameters": names,
        "stiffness_si": stiffness.tolist(),
        "damping_si": damping.tolist(),
        "stiffness_sd_si": (0.02 * np.abs(stiffness)).tolist(),
        "damping_sd_si": (0.02 * np.abs(damping)).tolist(),
        "covariance_si": covariance.tolist(),
        "budget": {
            "channel_noise": dict(zip(names, channel.tolist(), strict=True)),
            "mass.density": dict(zip(names, (relative * np.abs(entries)).tolist(), strict=True)),
        },
        "modes": [],
        "principal_axes": {"stiffness_si": [1.0, 1.0, 1.0]},
        "provenance": {"inputs": {"motion": {"hash": f"xxh3_128:{number}"}}},
    }
    return Ear(f"ear {number}", f"ear{number}", side, mass, kd, {"subject": f"s{number}"})
