"""The files that belong to a measurement and lie beside it: points.csv, fiducials.csv, mass.json."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from kinematics.options import NONE, MotionOptions
from stapeskit.faults import StapeskitError

POINTS, FIDUCIALS, MASS = "points.csv", "fiducials.csv", "mass.json"
MASS_FOLDERS = "*_mass"


@dataclass(frozen=True)
class Found:
    """The options with what was found beside the measurement.

    Attributes
    ----------
    options : MotionOptions
    mass : Path or None
    taken : dict of str to Path
        By role: the files that were not given but found.
    """

    options: MotionOptions
    mass: Path | None
    taken: dict[str, Path]


def with_companions(options: MotionOptions, mass: Path | str | None = None) -> Found:
    """Add the files beside the first vibrometer file that were not given; ``none`` turns one off.

    Parameters
    ----------
    mass : Path or str, optional
        As given; ``none`` turns it off, as does a mass in memory.

    Raises
    ------
    StapeskitError
        Several folders hold a mass.json, and none was chosen.

    Notes
    -----
    Fiducials are not looked for where a frame is given. A file that is itself given as measurement is none.
    """
    folder = options.file[0].absolute().parent
    given = {path.absolute() for path in options.file}
    taken: dict[str, Path] = {}
    for role, name in (("points", POINTS), ("fiducials", FIDUCIALS)):
        path = folder / name
        wanted = getattr(options, role) is None and not (role == "fiducials" and options.frame)
        if wanted and path.is_file() and path not in given:
            taken[role] = path
    found = None if mass in (None, NONE) else Path(mass)
    if mass is None:
        found = _mass_beside(folder)
        taken |= {} if found is None else {"mass": found}
    update: dict[str, Any] = {role: path for role, path in taken.items() if role != "mass"}
    return Found(replace(options, **update), found, taken)


def _mass_beside(folder: Path) -> Path | None:
    own = folder / MASS
    if own.is_file():
        return own
    found = sorted(folder.glob(f"{MASS_FOLDERS}/{MASS}"))
    if len(found) > 1:
        got = ", ".join(str(path.relative_to(folder)) for path in found)
        step = "Choose one with --mass FILE, or none with --mass none"
        raise StapeskitError.of("the mass.json beside the measurement", "a single one", got, "", step)
    return found[0] if found else None
