"""A paragraph on the methods with the numbers of a study, to start a text from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from legacy.fitting.estimators import estimator
from legacy.stapeskit import __version__
from legacy.stapeskit.page.numbers import plus_minus
from legacy.stapeskit.records.motion import RigidMotion


def methods(mass: Mapping[str, Any], kd: Mapping[str, Any], motion: RigidMotion) -> str:
    """Return the paragraph.

    Parameters
    ----------
    mass, kd : mapping
        Content of mass.json and kd.json.
    """
    voxel = (mass.get("segmentation") or {}).get("voxel_size_mm")
    scan = f"a micro-CT scan with voxels of {_sizes(voxel)} µm" if voxel else "a surface of the stapes"
    density = mass["provenance"]["parameters"].get("density_kg_m3")
    if mass.get("mass_known_by", "density") == "density" and density:
        value, sd = density if isinstance(density, list) else (density, None)
        known = f"a density of {plus_minus(value, sd)} kg/m³"
    else:
        known = f"its {str(mass.get('mass_known_by', 'density')).replace('_', ' ')}"
    model, low_high = kd["model"], kd["model"]["band_hz"]
    return (
        f"The mass matrix of the stapes was computed from {scan} and {known}, about the centre of the "
        f"footplate. Rigid motion of {' and '.join(motion.bodies)} was fitted to the readings of the laser "
        f"Doppler vibrometer at {model['lines']} frequencies. Stiffness and damping ({model['damping_law']}) "
        f"of the annular ligament for {', '.join(kd['dof'])} were estimated by "
        f"{estimator(kd['estimator']).phrase} between {low_high[0]:.4g} and "
        f"{low_high[1]:.4g} Hz. Standard deviations contain noise, registration, frames, point positions and "
        f"the mass matrix. Computed with stapeskit {__version__}."
    )


def _sizes(voxel_mm: Any) -> str:
    return " × ".join(f"{1e3 * size:.4g}" for size in voxel_mm)
