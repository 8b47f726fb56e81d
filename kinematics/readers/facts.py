"""Facts about vibrometer files that the files do not contain: bodies, runs, beams, units, time series."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, StapeskitError, raise_all
from stapeskit.frames import axis_vector


@dataclass(frozen=True)
class FileFacts:
    """What the user states where files are silent: options of the command, by their names.

    Attributes
    ----------
    body : tuple of str
        ``NAME=POINTS`` each: points are numbers, ranges 3-7, names, FILE or FILE:POINTS, comma separated.
    run : tuple of str
        ``NAME=FILE`` each: the excitation that a file belongs to.
    beam : str
        Direction towards the laser head, x, -y ... or three numbers.
    amplitude : str
        ``peak`` or ``rms``; empty: peak, with a warning.
    length_unit : str
        Of positions; empty: m, with a warning.
    n_avg : float, optional
        Number of averages behind each value.
    mapping : Path, optional
        Which variable or column is what; see `kinematics.readers.mapping`.
    channels : Path, optional
        With it, files hold time series: table with the beam, point and unit of each channel.
    reference_channel, averages, period_s, steps, settle, frf_band_hz
        How responses are estimated from time series: the reference among several channels; segments of random
        excitation; period of a periodic one; table of the steps of a stepped sine, and the share left out at
        the start of each; frequencies to keep.
    """

    body: tuple[str, ...] = ()
    run: tuple[str, ...] = ()
    beam: str = ""
    amplitude: str | None = ""
    length_unit: str | None = ""
    n_avg: float | None = None
    mapping: Path | None = None
    channels: Path | None = None
    reference_channel: str = ""
    averages: int = 30
    period_s: float | None = None
    steps: Path | None = None
    settle: float = 0.2
    frf_band_hz: tuple[float, float] | None = None

    @cached_property
    def direction(self) -> Array | None:
        """Unit vector (3,) of ``beam``; None without one. As `direction_of`."""
        return direction_of(self.beam) if self.beam else None

    @cached_property
    def bodies(self) -> tuple[tuple[str, tuple[Chosen, ...]], ...]:
        """The rules of ``body``: a name and the points that it has; refused where one cannot be read."""
        return tuple(_rule(text) for text in self.body)

    @cached_property
    def runs(self) -> tuple[tuple[str, str], ...]:
        """Names and files of ``run``; refused where one is no NAME=FILE."""
        rules = [tuple(part.strip() for part in text.partition("=")[::2]) for text in self.run]
        raise_all(Fault("--run", "NAME=FILE", "=".join(rule)) for rule in rules if not all(rule))
        return tuple((name, file) for name, file in rules)


@dataclass(frozen=True)
class Chosen:
    """Points of one rule: of a file (empty: of any) those in ``span``, those of a name, or all (empty)."""

    file: str
    name: str = ""
    span: range | None = None

    def holds(self, file: str, point: str) -> bool:
        """Return whether a point of a file is meant; a name without a file may be that of a file."""
        if self.file and not is_file(self.file, file):
            return False
        if self.span is not None:
            return point.isdigit() and int(point) in self.span
        as_file = not self.file and not self.name.isdigit() and is_file(self.name, file)
        return point == self.name or as_file


def is_file(item: str, file: str) -> bool:
    """Return whether a file is named by its name, with or without the ending."""
    return item in (file, file.rsplit(".", 1)[0])


def direction_of(text: str, where: Place | str = "", thing: str = "--beam") -> Array:
    """Read ``-z`` or ``0,0.34,0.94`` as a unit vector (3,).

    Raises
    ------
    StapeskitError
        Neither a name of an axis nor three numbers that are not all zero.
    """
    axis = axis_vector(text.strip())
    if axis is not None:
        return axis
    try:
        numbers = np.array([float(part) for part in text.split(",")])
        length = float(np.linalg.norm(numbers))
    except ValueError:
        numbers, length = np.zeros(0), 0.0
    if numbers.shape != (3,) or not 0.0 < length < np.inf:
        raise StapeskitError.of(thing, "x, -y ... or three numbers X,Y,Z", text, where)
    return np.asarray(numbers / length)


def _rule(text: str) -> tuple[str, tuple[Chosen, ...]]:
    """Read ``NAME=POINTS``."""
    name, _, points = (part.strip() for part in text.partition("="))
    chosen: list[Chosen] = []
    file = ""
    for item in points.split(","):
        head, colon, rest = item.strip().rpartition(":")
        file, item = (head.strip(), rest.strip()) if colon else (file, item.strip())
        span = re.fullmatch(r"(\d{1,9})\s*-\s*(\d{1,9})", item)
        numbers = range(int(span[1]), int(span[2]) + 1) if span else None
        if not item or not name or (numbers is not None and not numbers):
            step = "Write it like --body stapes=1-10,12 or --body base=base.uff"
            raise StapeskitError.of("--body", "NAME= and numbers, ranges or names", text, "", step)
        chosen.append(Chosen(file, "" if span else item, numbers))
    return name, tuple(chosen)


def unknown_files(facts: FileFacts, files: Sequence[str]) -> list[Fault]:
    """List the files that rules name and nobody gave."""
    stated = [(f"--run {name}={file}", file) for name, file in facts.runs]
    stated += [(f"--body {name}", item.file) for name, items in facts.bodies for item in items if item.file]
    return [
        Fault(f"the file of {thing}", f"one of {', '.join(files)}", file, "", "Correct its name")
        for thing, file in stated
        if not any(is_file(file, other) for other in files)
    ]
