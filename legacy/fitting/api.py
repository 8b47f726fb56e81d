"""`stapeskit.dof2kd`: the command dof2kd as a function."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from legacy.fitting.errors import FittingError
from legacy.stapeskit.faults import translate_option_names
from legacy.stapeskit.option_names import as_keyword
from legacy.stapeskit.records.mass_record import MassMatrix, MassRecord
from legacy.stapeskit.records.measured_mass import HasMass, MassInput, MeasuredMass, measured_mass
from legacy.stapeskit.records.motion import RigidMotion

if TYPE_CHECKING:
    from legacy.fitting.results import KDResult


class HasMotion(Protocol):
    """A result that holds a motion, as that of points2dof."""

    @property
    def motion(self) -> RigidMotion:
        """The motion of the bodies."""


@translate_option_names(as_keyword)
def dof2kd(
    motion: str | os.PathLike[str] | RigidMotion | HasMotion,
    *,
    mass: MassInput | MassMatrix | ArrayLike,
    force: bool = False,
    **options: Any,
) -> KDResult:
    """Estimate stiffness and damping from motion and mass.

    Parameters
    ----------
    mass : path or result of ct2mass, MassMatrix, or ndarray, (n, n)
        An array is in the order of ``dof``, SI, about the footplate centre in footplate axes.
    force : bool
        Use a mass that is not the one whose frames the motion was computed with, with a warning.
    **options
        The options of the command dof2kd by their names: ``dof``, ``estimator``, ``damping``, ``band``,
        ``exclude``, ``monte_carlo`` ...

    Raises
    ------
    StapeskitError
        An option is unknown (the nearest is named), or options or files are at fault; all of it together.

    Examples
    --------
    >>> fit = dof2kd(motion, mass=mass, band=(400, 5000))  # doctest: +SKIP
    """
    from legacy.fitting.calibrated import calibrated
    from legacy.fitting.file_chain import check_chain
    from legacy.fitting.model.mass_file import read_mass
    from legacy.fitting.options import KDOptions
    from legacy.fitting.recorded_fit import kd_of
    from legacy.stapeskit.provenance import record
    from legacy.stapeskit.records.motion_files import read_motion

    chosen = KDOptions.of(**options)
    if chosen.dof_reordered and _is_plain(mass):
        step = "Order rows and columns of the matrix so, too"
        wanted = "in the order x,y,z,alpha,beta,gamma where a plain mass matrix counts by it"
        raise FittingError.of("{dof}", wanted, "another order", "", step)
    files: dict[str, Any] = {}
    if isinstance(mass, str | os.PathLike):
        files["mass"] = Path(mass)
        matrix, known = read_mass(Path(mass), chosen.dof)
    elif isinstance(mass, HasMass | MassRecord | MeasuredMass):
        measured = measured_mass(mass)
        matrix, known = measured.record.mass_matrix, measured.record
        files["mass"] = measured.provenance_input
    elif isinstance(mass, MassMatrix):
        matrix, known = mass, None
    else:
        try:
            matrix, known = np.asarray(mass, dtype=float), None
        except (TypeError, ValueError) as fault:
            expected = "a file, a result of ct2mass or a matrix in SI"
            raise FittingError.of("the mass", expected, type(mass).__name__) from fault
    if isinstance(motion, str | os.PathLike):
        files["motion"] = Path(motion)
        moved = read_motion(Path(motion))
    else:
        moved = motion if isinstance(motion, RigidMotion) else motion.motion
    motion_name = files["motion"].name if "motion" in files else "the motion"
    mass_file = files.get("mass")
    chain = check_chain(moved, motion_name, known, mass_file if isinstance(mass_file, Path) else None, force)
    provenance = record(files, chosen.parameters(), calibrated.version(), ["legacy.stapeskit.dof2kd"])
    read = tuple(path.absolute() for path in files.values() if isinstance(path, Path))
    return kd_of(moved, matrix, chosen, known, provenance, read, chain)


def _is_plain(mass: Any) -> bool:
    """Return whether a mass is a matrix in the order of the degrees of freedom, in memory or in a table."""
    if isinstance(mass, str | os.PathLike):
        return Path(mass).suffix.lower() != ".json"
    return not isinstance(mass, HasMass | MassRecord | MeasuredMass)
