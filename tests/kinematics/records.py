"""A mass.json as ct2mass writes it, small and consistent, for the tests of its readers."""

from __future__ import annotations

import copy
import json

import numpy as np

from legacy.stapeskit.frames import RigidTransform, rotation_from_vector
from legacy.stapeskit.spatial import DOF_NAMES, PARAMETER_NAMES, matrix_from_parameters, parameter_basis

SCAN_FROM_FOOTPLATE = RigidTransform.from_parts(
    rotation_from_vector([0.4, -0.7, 1.1]), [3.0, -2.0, 5.0], "scan", "footplate"
)
SCAN_FROM_PLATE = RigidTransform.from_parts(
    rotation_from_vector([-0.2, 0.3, 0.9]), [-1.0, 4.0, -3.0], "scan", "plate"
)
PARAMETERS = np.array(
    [3.2e-6, 1.43e-10, 3.5e-9, 4.35e-10, 9.8e-12, 5.0e-12, 1.114e-11, -2.0e-13, -4.0e-13, 3.0e-14]
)


def pose_block(size_m, size_rad):
    return {
        "names": list(DOF_NAMES),
        "convention": "displacement of the frame in its own axes, m and rad",
        "matrix_si": np.diag([size_m**2] * 3 + [size_rad**2] * 3).tolist(),
    }


def mass_record():
    """Return the content of a mass.json."""
    com = SCAN_FROM_FOOTPLATE.points(PARAMETERS[1:4] / PARAMETERS[0] * 1e3)
    matrix = matrix_from_parameters(PARAMETERS)
    covariance = np.diag((0.01 * np.abs(PARAMETERS)) ** 2)
    places = [1, 3, 5]
    plate = SCAN_FROM_PLATE.inverse() @ SCAN_FROM_FOOTPLATE
    deviation = np.sqrt(sum(v * b**2 for v, b in zip(np.diag(covariance), parameter_basis(), strict=True)))
    arm = PARAMETERS[1:4] / PARAMETERS[0]
    central = matrix[3:, 3:] - PARAMETERS[0] * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    turn = np.kron(np.eye(2), plate.rotation)
    return copy.deepcopy(
        {
            "schema": "stapeskit.mass/1",
            "density_kg_m3": 1600.0,
            "volume_m3": float(PARAMETERS[0]) / 1600.0,
            "mass_kg": float(PARAMETERS[0]),
            "center_of_mass_in_scan_mm": com.tolist(),
            "inertia_about_center_of_mass_in_scan_axes_kg_m2": (
                SCAN_FROM_FOOTPLATE.rotation @ central @ SCAN_FROM_FOOTPLATE.rotation.T
            ).tolist(),
            "frames": {
                "scan_from_footplate": SCAN_FROM_FOOTPLATE.matrix.tolist(),
                "scan_from_plate": SCAN_FROM_PLATE.matrix.tolist(),
                "plate_from_footplate": plate.matrix.tolist(),
                "pose_covariance": {
                    "scan_from_footplate": pose_block(5e-6, 1e-3),
                    "scan_from_plate": pose_block(2e-6, 2e-4),
                },
            },
            "inertial_parameters": {
                "names": list(PARAMETER_NAMES),
                "about": "footplate_centre",
                "axes": "footplate",
                "values_si": PARAMETERS.tolist(),
                "covariance_si": covariance.tolist(),
                "contributions_si": {
                    "levels": (0.75 * covariance).tolist(),
                    "frame": (0.25 * covariance).tolist(),
                },
            },
            "mass_matrix": {
                "about": "footplate_centre",
                "axes": "footplate",
                "dof": list(DOF_NAMES),
                "matrix_si": matrix.tolist(),
                "standard_deviation_si": deviation.tolist(),
            },
            "mass_matrix_plate_axes": {
                "about": "footplate_centre",
                "axes": "plate",
                "dof": list(DOF_NAMES),
                "matrix_si": (turn @ matrix @ turn.T).tolist(),
                "standard_deviation_si": deviation.tolist(),
            },
            "mass_matrix_reduced": {
                "dof": ["y", "alpha", "gamma"],
                "matrix_si": matrix[np.ix_(places, places)].tolist(),
                "standard_deviation_si": deviation[np.ix_(places, places)].tolist(),
            },
            "found": {"added_masses": []},
            "warnings": [{"code": "anterior_not_given", "text": "No hint."}],
        }
    )


def write_record(folder, record=None):
    """Write a mass.json into a folder and return its path."""
    path = folder / "mass.json"
    path.write_text(json.dumps(mass_record() if record is None else record), encoding="utf-8")
    return path
