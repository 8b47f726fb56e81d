"""From a micro-CT and a 3D laser Doppler vibrometer to mass, stiffness and damping of a stapes.

Four functions, one a step, with the options of the four commands by the same names. Each takes files, or the
result of the step before:

    import stapeskit as sk

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
    from ct_inertia.api import ct2mass
    from ct_inertia.results import MassResult
    from fitting.api import dof2kd
    from fitting.kd_fit import KDFit
    from fitting.results import KDResult
    from kinematics.api import points2dof
    from kinematics.results import MotionResult
    from pipeline.api import scan2kd
    from pipeline.cohort.api import Cohort, cohort
    from pipeline.results import StudyResult
    from stapeskit.faults import StapeskitError
    from stapeskit.frames import RigidTransform
    from stapeskit.records.mass_record import MassMatrix, MassRecord
    from stapeskit.records.motion import RigidMotion, SharedErrors
    from stapeskit.warnings import Notice

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
    "ct2mass": "ct_inertia.api",
    "MassResult": "ct_inertia.results",
    "dof2kd": "fitting.api",
    "KDFit": "fitting.kd_fit",
    "KDResult": "fitting.results",
    "points2dof": "kinematics.api",
    "MotionResult": "kinematics.results",
    "scan2kd": "pipeline.api",
    "cohort": "pipeline.cohort.api",
    "Cohort": "pipeline.cohort.api",
    "StudyResult": "pipeline.results",
    "StapeskitError": "stapeskit.faults",
    "RigidTransform": "stapeskit.frames",
    "MassMatrix": "stapeskit.records.mass_record",
    "MassRecord": "stapeskit.records.mass_record",
    "RigidMotion": "stapeskit.records.motion",
    "SharedErrors": "stapeskit.records.motion",
    "Notice": "stapeskit.warnings",
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
