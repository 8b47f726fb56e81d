"""Facts about vibrometer files that the files do not contain: bodies, runs, beams, units."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.options import SeriesOptions
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, raise_all
from legacy.stapeskit.frames import axis_vector

SERIES = "the options of time series"


@dataclass(frozen=True)
class Chosen:
    """Points of one rule: of a file (empty: of any) one name, a range of numbers, or all."""

    file: str = ""
    name: str = ""
    first: int = 0
    last: int = -1

    def holds(self, file: str, point: str) -> bool:
        """Return whether a point of a file is meant."""
        if self.file and not is_file(self.file, file):
            return False
        if self.name:
            named = not self.file and not self.name.isdigit() and is_file(self.name, file)
            return point == self.name or named
        if self.last >= self.first:
            return point.isdigit() and self.first <= int(point) <= self.last
        return True


def is_file(item: str, file: str) -> bool:
    """Return whether a file is named by its name, with or without the ending."""
    return item in (file, file.rsplit(".", 1)[0])


@dataclass(frozen=True)
class InputOptions:
    """Facts about the files that the options give; their values are as `LdvOptions` checks them.

    Attributes
    ----------
    body : tuple of str
        ``NAME=POINTS`` each: points are numbers, ranges 3-7, names, FILE or FILE:POINTS, comma separated.
    run : tuple of str
        ``NAME=FILE`` each: the excitation that a file belongs to.
    beam : str
        Direction towards the laser head, x, -y ... or three numbers, where a file does not say it.
    amplitude : str
        ``peak`` or ``rms``, where a file does not say it; empty: peak, with a warning.
    length_unit : str
        Of positions whose unit a file does not say; empty: m, with a warning.
    n_avg : float, optional
        Number of averages behind each coherence, where a file does not say it.
    mapping : Path, optional
        Which variable of a MATLAB or HDF5 file is what; see kinematics.readers.matlab.mapping.
    series : SeriesOptions, optional
        How files with time series are turned into spectra; with it, MATLAB and HDF5 files hold time series.

    Raises
    ------
    KinematicsError
        Points of a body that cannot be read; all faults together.
    """

    body: tuple[str, ...] = ()
    run: tuple[str, ...] = ()
    beam: str = ""
    amplitude: str = ""
    length_unit: str = ""
    n_avg: float | None = None
    mapping: Path | None = None
    series: SeriesOptions | None = None
    bodies: tuple[tuple[str, tuple[Chosen, ...]], ...] = field(init=False, default=())
    runs: tuple[tuple[str, str], ...] = field(init=False, default=())
    direction: Array | None = field(init=False, default=None, compare=False)

    def __post_init__(self) -> None:
        faults: list[Fault] = []
        bodies = [_body(text, faults) for text in self.body]
        raise_all(KinematicsError, faults)
        runs = [text.partition("=") for text in self.run]
        object.__setattr__(self, "bodies", tuple(rule for rule in bodies if rule is not None))
        object.__setattr__(self, "runs", tuple((name.strip(), file.strip()) for name, _, file in runs))
        object.__setattr__(self, "direction", _direction(self.beam) if self.beam else None)

    @property
    def stated_names(self) -> tuple[str, ...]:
        """Names of the options that were given."""
        by_option = {
            "{body}": self.body,
            "{run}": self.run,
            "{beam}": self.beam,
            "{amplitude}": self.amplitude,
            "{length_unit}": self.length_unit,
            "{n_avg}": self.n_avg,
            "{mapping}": self.mapping,
            "{channels}": self.series,
        }
        chosen = tuple(name for name, value in by_option.items() if value)
        if self.series is not None and self.series.channels is None:
            return tuple(SERIES if name == "{channels}" else name for name in chosen)
        return chosen


def _body(text: str, faults: list[Fault]) -> tuple[str, tuple[Chosen, ...]] | None:
    """Read ``NAME=POINTS``."""
    name, _, points = (part.strip() for part in text.partition("="))
    chosen: list[Chosen] = []
    file = ""
    for item in points.split(","):
        head, colon, rest = item.strip().rpartition(":")
        file, item = (head.strip(), rest.strip()) if colon else (file, item.strip())
        item_points = _points(file, item)
        if item_points is None:
            step = "Write it like {body} stapes=1-10,12 or {body} base=base.uff"
            faults.append(Fault("the points of {body}", "numbers, ranges or names", text, "", step))
            return None
        chosen.append(item_points)
    return name, tuple(chosen)


def _points(file: str, item: str) -> Chosen | None:
    if not item:
        return None
    span = re.fullmatch(r"(\d+)\s*-\s*(\d+)", item)
    if span is None:
        return Chosen(file, item)
    first, last = int(span[1]), int(span[2])
    return Chosen(file, "", first, last) if first <= last else None


def _direction(text: str) -> Array:
    """Read ``-z`` or ``0,0.34,0.94``."""
    axis = axis_vector(text.strip())
    if axis is not None:
        return axis
    numbers = np.array([float(part) for part in text.split(",")])
    return np.asarray(numbers / np.linalg.norm(numbers))


def check_used(options: InputOptions, files: Sequence[str]) -> list[Fault]:
    """List the files that rules name and nobody gave."""
    faults = []
    known = ", ".join(files)
    named = [(f"{{run}} {name}={file}", file) for name, file in options.runs]
    named += [
        (f"{{body}} {name}", item.file) for name, items in options.bodies for item in items if item.file
    ]
    for thing, file in named:
        if not any(is_file(file, other) for other in files):
            faults.append(Fault(f"the file of {thing}", f"one of {known}", file, "", "Correct its name"))
    return faults
