"""The files that belong to a measurement and lie beside it: points.csv, fiducials.csv, mass.json."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from kinematics.options import NONE, MotionOptions
from stapeskit.faults import StapeskitError


@dataclass(frozen=True)
class Found:
    """Options and mass with what was found beside the measurement; ``taken`` holds what was, by role."""

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
    measured = {path.absolute() for path in options.file}
    given: dict[str, Any] = {
        "points": options.points,
        "fiducials": options.fiducials or options.frame,
        "mass": mass,
    }
    taken: dict[str, Path] = {}
    for role, name in {"points": "points.csv", "fiducials": "fiducials.csv", "mass": "mass.json"}.items():
        found = [folder / name] if (folder / name).is_file() else []
        if role == "mass" and not found:
            found = sorted(folder.glob(f"*_mass/{name}"))
        if given[role] is None and len(found) > 1:
            got = ", ".join(str(path.relative_to(folder)) for path in found)
            step = "Choose one with --mass FILE, or none with --mass none"
            raise StapeskitError.of("the mass.json beside the measurement", "a single one", got, "", step)
        if given[role] is None and found and found[0] not in measured:
            taken[role] = found[0]
    update: dict[str, Any] = {role: path for role, path in taken.items() if role != "mass"}
    chosen = None if mass in (None, NONE) else Path(mass)
    return Found(replace(options, **update), taken.get("mass", chosen), taken)
