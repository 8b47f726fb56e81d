"""Names and coordinates that were exchanged: the places at which they could be, as faults without a size."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from legacy.kinematics.faults.catalogue import Fault
from legacy.kinematics.faults.packed_readings import Packed
from legacy.stapeskit.arrays import Array

# Directions that differ by less are written alike: rounding of six digits in a file.
_SAME_BEAM = 1e-6
# The most suspected points, those that may be exchanged with them (at 24 points 1100 exchanges of two or
# three are looked at in 40 ms), and those of which two beams, or coordinates, are exchanged.
_MOST_SUSPECTED, _PARTNERS, _BY_THEMSELVES = 6, 24, 4
# A fault, and what the sentence says of it.
Exchange = tuple[Fault, Mapping[str, object]]


@dataclass(frozen=True)
class Layout:
    """What exchanges are made of: channels by point and laser, and positions as in the user's file.

    ``suspects`` are the names of points, the most suspected first.
    """

    data: Packed
    points: dict[str, list[int]]
    lasers: list[list[int]]
    reported_mm: Array
    file_from_here: Array
    suspects: Sequence[str]

    def sets(self, number: int) -> Iterator[tuple[str, ...]]:
        """Yield sets of points of which all but one are among the most suspected.

        One of exchanged points may look sound: the fit is mostly wrong at the others.
        """
        most = self.suspects[:_MOST_SUSPECTED]
        for some in combinations(self.suspects[:_PARTNERS], number):
            if some[-2] in most:
                yield some

    def swap(self, owner: str, first: list[int], second: list[int], places: int) -> Fault:
        """Exchange the directions of two lists of channels, one by one."""
        beams = self.data.assumed.directions
        apart = beams[second] - beams[first]
        return Fault("label_swap", owner, [*first, *second], 0.0, np.vstack([apart, -apart]), places)

    def rename(
        self, wrong: Sequence[str], right: Sequence[str], places: int, words: Mapping[str, object]
    ) -> Iterator[Exchange]:
        """Give the rows of some points the positions of others, and their beams where these differ."""
        arms, beams = self.data.assumed.arms_m, self.data.assumed.directions
        pairs = [(self.points[one], self.points[two]) for one, two in zip(wrong, right, strict=True)]
        channels = [channel for own, _ in pairs for channel in own]
        apart = [arms[other[0]] - arms[own[0]] for own, other in pairs]
        shift = np.repeat(apart, [len(own) for own, _ in pairs], axis=0)
        yield Fault("label_swap", "points", channels, shift, places=places), {**words, "beams": ""}
        alike = [np.argmax(beams[own] @ beams[other].T, axis=1) for own, other in pairs]
        if all(sorted(k) == list(range(len(other))) for k, (_, other) in zip(alike, pairs, strict=True)):
            taken = [other[c] for k, (_, other) in zip(alike, pairs, strict=True) for c in k]
            turn = beams[taken] - beams[channels]
            if np.max(np.abs(turn)) > _SAME_BEAM:
                fault = Fault("label_swap", "points", channels, shift, turn, places)
                yield fault, {**words, "beams": " with their beams"}


def two_points(layout: Layout) -> Iterator[Exchange]:
    """Exchange the positions of two points, and their beams where these differ."""
    number = len(layout.points)
    for pair in layout.sets(2):
        yield from layout.rename(pair, pair[::-1], number * (number - 1) // 2, {"points": " and ".join(pair)})


def three_points(layout: Layout) -> Iterator[Exchange]:
    """Exchange the positions of three points in a cycle, and their beams where these differ."""
    number = len(layout.points)
    for three in layout.sets(3):
        for right in (three, three[::-1]):
            wrong = (*right[1:], right[0])
            rows = ", ".join(f"{a} are those of {b}" for a, b in zip(wrong, right, strict=True))
            yield from layout.rename(wrong, right, number * (number - 1) * (number - 2) // 3, {"rows": rows})


def two_beams(layout: Layout) -> Iterator[Exchange]:
    """Exchange the directions of two beams of one point."""
    for name in layout.suspects[:_BY_THEMSELVES]:
        for one, two in combinations(layout.points[name], 2):
            yield layout.swap("beams", [one], [two], len(layout.data.live)), {"point": name}


def two_lasers(layout: Layout) -> Iterator[Exchange]:
    """Exchange the directions of two lasers at all points that both see."""
    points = layout.data.points
    for one, two in combinations(layout.lasers, 2):
        same = {points[c]: c for c in two}
        first = [c for c in one if points[c] in same]
        if len(first) > 2:
            yield layout.swap("lasers", first, [same[points[c]] for c in first], 3), {}


def coordinates_of_a_point(layout: Layout) -> Iterator[Exchange]:
    """Exchange two coordinates of one point, as in the user's file."""
    for name in layout.suspects[:_BY_THEMSELVES]:
        for words, shift, right in _coordinates(layout, layout.points[name]):
            value = ", ".join(f"{axis}_mm {v:.4g}" for axis, v in zip("xyz", right[0], strict=True))
            fault = Fault("coordinates", "point", layout.points[name], shift, places=3 * len(layout.points))
            yield fault, {**words, "point": name, "right": value}


def coordinates_of_all(layout: Layout) -> Iterator[Exchange]:
    """Exchange two coordinates of all points, as in the user's file."""
    every = [c for own in layout.points.values() for c in own]
    for words, shift, _right in _coordinates(layout, every):
        yield Fault("coordinates", "body", every, shift, places=3), words


def _coordinates(layout: Layout, own: list[int]) -> Iterator[tuple[Mapping[str, object], Array, Array]]:
    """Yield two axes, and the shifts (n, 3), m, and coordinates, mm, with these exchanged."""
    reported = layout.reported_mm[own]
    for one, two in combinations(range(3), 2):
        right = reported.copy()
        right[:, [one, two]] = reported[:, [two, one]]
        axes = f"{'xyz'[one]}_mm and {'xyz'[two]}_mm"
        yield {"axes": axes}, (right - reported) @ layout.file_from_here * 1e-3, right
