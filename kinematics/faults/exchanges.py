"""Exchanged names: two points, two beams of a point, or two lasers that were taken for each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from kinematics.joint.expected import Layout
from kinematics.joint.tangents import Geometry


@dataclass(frozen=True)
class Exchange:
    """Channels that changed places: what is exchanged, (first, second), and the true geometry."""

    what: str
    first: tuple[int, ...]
    second: tuple[int, ...]
    geometry: Geometry

    @property
    def channels(self) -> tuple[int, ...]:
        """All of them."""
        return self.first + self.second


def exchanges(
    geometry: Geometry, layout: Layout, live: Sequence[int], suspects: Sequence[int]
) -> list[Exchange]:
    """List the exchanges in which a suspected channel takes part, and that change anything.

    Two points change places when they have equally many channels: their positions alone (names in points.csv)
    or with their beams (names of rows). Two lasers change with all their channels, two beams at one point.
    """
    points = layout.by_point(live)
    names = {layout.points[channel] for channel in suspects} & set(points)
    pairs: list[tuple[str, Sequence[int], Sequence[int]]] = []
    for one, other in combinations(points, 2):
        if one in names or other in names:
            pairs += [(what, points[one], points[other]) for what in ("points", "rows")]
    for name in names:
        pairs += [("beams", [first], [second]) for first, second in combinations(points[name], 2)]
    pairs += [("lasers", *pair) for pair in combinations(layout.by_laser(live).values(), 2)]
    found: dict[bytes, Exchange] = {}
    for what, first, second in pairs:
        if len(first) == len(second):
            changed = _exchanged(what, geometry, list(first), list(second))
            key = _key(changed)
            found.setdefault(
                key, Exchange("points" if what == "rows" else what, (*first,), (*second,), changed)
            )
    found.pop(_key(geometry), None)
    return list(found.values())


def _exchanged(what: str, geometry: Geometry, one: list[int], other: list[int]) -> Geometry:
    positions, directions = geometry.positions_m.copy(), geometry.directions.copy()
    if what in ("points", "rows"):
        positions[one], positions[other] = geometry.positions_m[other[0]], geometry.positions_m[one[0]]
    if what != "points":
        directions[one], directions[other] = geometry.directions[other], geometry.directions[one]
    return replace(geometry, positions_m=positions, directions=directions)


def _key(geometry: Geometry) -> bytes:
    """Return a key that is equal for geometries equal within 1 nm and 1 urad."""
    whole = np.hstack([geometry.positions_m * 1e9, geometry.directions * 1e6])
    return bytes((np.round(whole) + 0.0).tobytes())
