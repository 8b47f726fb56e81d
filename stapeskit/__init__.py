"""From a micro-CT and a 3D laser Doppler vibrometer to mass, stiffness and damping of a stapes.

Functions, one a step, with the options of the commands by the same names. Each takes files, or the result
of the step before:

    import stapeskit as sk

    mass = sk.ct2mass("scan.tif", density=(1900, 60), anterior=(-0.9, 0.1, 0))
    motion = sk.points2dof("ldv.csv", points="points.csv", fiducials="fiducials.csv", mass=mass)
    fit = sk.dof2kd(motion, mass=mass)
    fit.stiffness, fit.damping

A result is printed in one screen; it has ``warnings``, ``to_frame()``, ``plot()`` and ``write(folder)``.
Everything here is loaded on first use.
"""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path

TYPE_CHECKING = False  # typing itself would cost more than this package
if TYPE_CHECKING:
    from ct_inertia.api import ct2mass
    from fitting.dof2kd import dof2kd
    from kinematics.api import points2dof, read_vibrometer
    from pipeline.cohort.cohort import cohort
    from pipeline.run import scan2kd
    from stapeskit.faults import StapeskitError
    from stapeskit.frames import RigidTransform
    from stapeskit.warnings import Notice

__version__ = "0.3.0"

# Where each name is: the rooms are above this package and are imported when a name is asked for.
_PLACES = {
    "ct2mass": "ct_inertia.api",
    "points2dof": "kinematics.api",
    "dof2kd": "fitting.dof2kd",
    "scan2kd": "pipeline.run",
    "read_vibrometer": "kinematics.api",
    "cohort": "pipeline.cohort.cohort",
    "StapeskitError": "stapeskit.faults",
    "RigidTransform": "stapeskit.frames",
    "Notice": "stapeskit.warnings",
}

__all__ = ["Notice", "RigidTransform", "StapeskitError", "cohort", "ct2mass", "dof2kd", "points2dof",
           "read_vibrometer", "scan2kd"]  # fmt: skip

_FOLDER = str(Path(__file__).resolve().parents[1])
_ROOMS = frozenset({"ct_inertia", "kinematics", "fitting", "pipeline", "simulate"})


class _RoomFinder:
    """Find the packages beside this one before files of the same names in a user's folder."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> ModuleSpec | None:  # noqa: ARG004
        return PathFinder.find_spec(name, [_FOLDER]) if name in _ROOMS else None


if _RoomFinder not in sys.meta_path:
    sys.meta_path.insert(0, _RoomFinder)


def _check_rooms() -> None:
    """Raise ImportError where a module of a user was imported under the name of a room before."""
    for room in _ROOMS & sys.modules.keys():
        source = getattr(sys.modules[room], "__file__", None) or ""
        if not source.startswith(_FOLDER):
            raise ImportError(
                f"Module {room} must be the one of stapeskit; got {source}. "
                "Rename that file, or import stapeskit before it."
            )


def __getattr__(name: str) -> object:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    _check_rooms()
    value = getattr(import_module(_PLACES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
