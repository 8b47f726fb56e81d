"""The places that the rows of one point could belong to: other motions, positions, lines and conventions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from legacy.kinematics.faults.proposals.clean_motion import REACH, CleanMotion, Lines
from legacy.stapeskit.arrays import Array


@dataclass(frozen=True)
class Rows:
    """The rows of a point of one body in one run, and the motions (run, body) that others measured."""

    home: CleanMotion
    point: str
    arms_m: Array
    motions: Mapping[tuple[int, int], CleanMotion]
    runs: Sequence[str]

    @property
    def name(self) -> str:
        """The point, in words."""
        return f"point {self.point} of body {self.home.body.body}"


@dataclass(frozen=True)
class Place:
    """Where rows could belong: another motion, another point's position, or another reading of the same.

    Attributes
    ----------
    arms_m : ndarray, (3,)
    source : ndarray, (n,), int
        From which line of that motion the rows at each line of their own are.
    partner : tuple of int
        Channels of the point that holds the place.
    conjugate : complex number or zero
        Sign of the conjugates that the rows are; zero when they are none. Those of velocities, i w times
        displacements, have the opposite sign.
    """

    at: CleanMotion
    arms_m: Array
    source: Lines
    partner: tuple[int, ...] = ()
    conjugate: int = 0


Placed = tuple[Place, Mapping[str, object]]


def two_lines(rows: Rows) -> Iterator[Placed]:
    """Yield the rows of two lines in place of each other."""
    first, second = rows.home.freq_hz
    place = Place(rows.home, rows.arms_m, rows.home.lines[::-1])
    yield place, {"rows": rows.name, "first": first, "second": second}


def conjugated(rows: Rows) -> Iterator[Placed]:
    """Yield the conjugate of the motion, with either sign."""
    for sign in (1, -1):
        yield Place(rows.home, rows.arms_m, rows.home.lines, conjugate=sign), {}


def shifted(rows: Rows) -> Iterator[Placed]:
    """Yield the motion at other lines."""
    home = rows.home
    for shift in range(-REACH, REACH + 1):
        if shift:
            words = {
                "rows": rows.name,
                "lines": f"{abs(shift)} line{'s' if abs(shift) > 1 else ''}",
                "way": "higher" if shift > 0 else "lower",
                "hertz": -shift * home.step_hz,
            }
            yield Place(home, rows.arms_m, home.lines + shift), words


def other_runs(rows: Rows) -> Iterator[Placed]:
    """Yield the motion of the same body in other runs."""
    home = rows.home
    for (run, number), other in rows.motions.items():
        if number == home.number and run != home.run:
            words = {"rows": rows.name, "run": rows.runs[home.run], "other": rows.runs[run]}
            yield Place(other, rows.arms_m, home.lines), words


def other_bodies(rows: Rows) -> Iterator[Placed]:
    """Yield the motion of other bodies at the position of the rows."""
    for other in _beside(rows):
        yield Place(other, rows.arms_m, rows.home.lines), {"rows": rows.name, "other": other.body.body}


def points_of_bodies(rows: Rows) -> Iterator[Placed]:
    """Yield the motion of other bodies at each of their points."""
    for other in _beside(rows):
        names = other.body.points
        for name in dict.fromkeys(names):
            partner = tuple(c for c, held in enumerate(names) if held == name)
            arms = other.body.positions_mm[partner[0]] * 1e-3
            words = {"rows": rows.name, "point": name, "other": other.body.body}
            yield Place(other, arms, rows.home.lines, partner), words


def _beside(rows: Rows) -> list[CleanMotion]:
    """Return the motions of the other bodies in the run of the rows."""
    home = rows.home
    return [at for (run, n), at in rows.motions.items() if n != home.number and run == home.run]
