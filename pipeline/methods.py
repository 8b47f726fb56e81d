"""A paragraph on the methods with the numbers of a study, to start a text from."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stapeskit import __version__
from stapeskit.faults import list_some

if TYPE_CHECKING:
    from pipeline.run import StudyResult

_ESTIMATORS = {
    "ml": "maximum likelihood with errors in all variables",
    "pinv": "least squares (pseudo-inverse)",
    "constrained": "constrained least squares",
}


def methods(result: StudyResult) -> str:
    """Return the paragraph; the sources of uncertainty are those that the budget of this fit holds."""
    mass, fit, motion = result.mass, result.fit, result.moved.motion
    voxel = (mass.get("segmentation") or {}).get("voxel_size_mm")
    sizes = " × ".join(f"{1e3 * size:.4g}" for size in voxel) if voxel else ""
    scan = f"a micro-CT scan with voxels of {sizes} µm" if voxel else "a surface of the stapes"
    known = str(mass.get("mass_known_by", "density")).replace("_", " ")
    data = fit.found.data
    low, high = float(data.freq_hz.min()), float(data.freq_hz.max())
    sources = list_some((name.replace("_", " ").replace("mass.", "mass: ") for name in fit.budget), 20)
    return (
        f"The mass matrix of the stapes was computed from {scan} and its {known}, about the centre of the "
        f"footplate. Rigid motion of {' and '.join(motion.bodies)} was fitted to the readings of the laser "
        f"Doppler vibrometer. Stiffness and damping ({fit.law.name}) of the annular ligament for "
        f"{', '.join(fit.dof)} were estimated by {_ESTIMATORS[fit.options.estimator]} at {data.count} lines "
        f"between {low:.4g} and {high:.4g} Hz. Standard deviations contain: {sources}. Computed with "
        f"stapeskit {__version__}."
    )
