"""From a micro-CT and a 3D laser Doppler vibrometer to mass, stiffness and damping of a stapes.

Four functions, one a step, with the options of the four commands by the same names. Each takes files, or the
result of the step before:

    import legacy.stapeskit as sk

    mass = sk.ct2mass("scan.tif", density=(1900, 60), anterior=(-0.9, 0.1, 0))
    motion = sk.points2dof("ldv.csv", points="points.csv", fiducials="fiducials.csv", mass=mass)
    fit = sk.dof2kd(motion, mass=mass)
    fit.stiffness, fit.damping

A result is printed in one screen; it has ``warnings``, ``to_frame()``, ``plot()`` and ``write(folder)``.
Everything here is loaded on first use.
"""

from __future__ import annotations

TYPE_CHECKING = False  # typing itself would cost more than this package
if TYPE_CHECKING:
    from legacy.ct_inertia.api import ct2mass
    from legacy.ct_inertia.results import MassResult
    from legacy.fitting.api import dof2kd
    from legacy.fitting.kd_fit import KDFit
    from legacy.fitting.results import KDResult
    from legacy.kinematics.api import points2dof
    from legacy.kinematics.results import MotionResult
    from legacy.pipeline.api import scan2kd
    from legacy.pipeline.cohort.api import Cohort, cohort
    from legacy.pipeline.results import StudyResult
    from legacy.stapeskit.faults import StapeskitError
    from legacy.stapeskit.frames import RigidTransform
    from legacy.stapeskit.records.mass_record import MassMatrix, MassRecord
    from legacy.stapeskit.records.motion import RigidMotion, SharedErrors
    from legacy.stapeskit.warnings import Notice

__version__ = "0.2.0"

__all__ = [
    "Cohort",
    "KDFit",
    "KDResult",
    "MassMatrix",
    "MassRecord",
    "MassResult",
    "MotionResult",
    "Notice",
    "RigidMotion",
    "RigidTransform",
    "SharedErrors",
    "StapeskitError",
    "StudyResult",
    "__version__",
    "cohort",
    "ct2mass",
    "dof2kd",
    "points2dof",
    "scan2kd",
]

# Where each name is: the rooms are above this package and are imported when a name is asked for.
_PLACES = {
    "ct2mass": "legacy.ct_inertia.api",
    "MassResult": "legacy.ct_inertia.results",
    "dof2kd": "legacy.fitting.api",
    "KDFit": "legacy.fitting.kd_fit",
    "KDResult": "legacy.fitting.results",
    "points2dof": "legacy.kinematics.api",
    "MotionResult": "legacy.kinematics.results",
    "scan2kd": "legacy.pipeline.api",
    "cohort": "legacy.pipeline.cohort.api",
    "Cohort": "legacy.pipeline.cohort.api",
    "StudyResult": "legacy.pipeline.results",
    "StapeskitError": "legacy.stapeskit.faults",
    "RigidTransform": "legacy.stapeskit.frames",
    "MassMatrix": "legacy.stapeskit.records.mass_record",
    "MassRecord": "legacy.stapeskit.records.mass_record",
    "RigidMotion": "legacy.stapeskit.records.motion",
    "SharedErrors": "legacy.stapeskit.records.motion",
    "Notice": "legacy.stapeskit.warnings",
}


def __getattr__(name: str) -> object:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    value = getattr(import_module(_PLACES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
