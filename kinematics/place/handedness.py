"""Positions that are not those of the data: other axes than stated, or one row further on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from kinematics.calibrated import calibrated
from kinematics.faults.search import Diagnosis
from kinematics.joint.estimate import State
from kinematics.measurement import MIRRORS, BodyChannels, Measurement
from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError, raise_all

UNITS = {
    f"{unit} taken as mm": factor * np.eye(3)
    for unit, factor in {"metres": 1e3, "micrometres": 1e-3, "inches": 25.4}.items()
}
"""Changes of scale (3, 3) that mistakes make, by their words."""

_CURED_SHARE = calibrated("handedness.cured_share")
_LEAST_FREEDOM_OF_FIT = 20  # fewer say too little of a misfit
_LEAST_SHIFTED = 3  # points in the wrong row: two are an exchange


def axes_changes(half_turns: bool = True) -> dict[str, Array]:
    """Return changes of coordinates (3, 3) that mistakes make, by their words.

    Half turns about an axis exchange RAS and LPS (z) and their likes; a rigid fit cannot see them.
    """
    changes = {f"the axis {axis} reversed": np.diag(signs) for axis, signs in MIRRORS.items()}
    for first, second in combinations(range(3), 2):
        order = [0, 1, 2]
        order[first], order[second] = second, first
        changes[f"the axes {'xyz'[first]} and {'xyz'[second]} exchanged"] = np.eye(3)[order]
    for axis, signs in MIRRORS.items() if half_turns else ():
        others = " and ".join(name for name in "xyz" if name != axis)
        also = " (RAS against LPS)" if axis == "z" else ""
        changes[f"the axes {others} reversed{also}"] = -np.diag(signs)
    return changes


def check_positions(placed: Measurement, diagnoses: Mapping[int, Diagnosis]) -> None:
    """Refuse positions that agree with the beams only in other axes, or one row further on.

    Parameters
    ----------
    placed : Measurement
    diagnoses : mapping of int to Diagnosis
        By body.

    Raises
    ------
    StapeskitError
        Other axes of all positions, or points of a body that each have the data of the next one, bring the
        misfit down to a tenth, and no single fault explains it.

    Notes
    -----
    Where positions and beams are both mirrored, v = v0 + omega x r keeps its form with -omega, and no
    residual shows it: there only fiducials off a plane, or points on the surfaces of the scan, tell.
    """
    loud = {k: found for k, found in diagnoses.items() if found.findings or found.causes}
    before = _sum([_Misfit.of(found) for found in loud.values()])
    if before.is_small() or all(map(_explained, loud.values())):
        return
    after: dict[str, _Misfit] = {}
    for words, change in axes_changes(half_turns=False).items():
        moved = []
        for number, found in loud.items():
            to_file = placed.bodies[number].file_from_here
            places = found.first.packed.geometry.positions_m @ (to_file.T @ change @ to_file).T
            moved.append(_Misfit.of(found, places))
        after[f"with {words}"] = _sum(moved)
    best = min(after, key=lambda words: after[words].energy)
    if after[best].cures(before):
        got = f"positions that agree only {best} {after[best].words(before)}"
        step = "Correct these columns of the positions, or those of the directions"
        expected = "in the same axes as the beam directions"
        raise StapeskitError.of("the positions of the points", expected, got, "", step)
    faults = [_shifted(placed.bodies[number], found) for number, found in loud.items()]
    raise_all(fault for fault in faults if fault is not None)


def _shifted(body: BodyChannels, found: Diagnosis) -> Fault | None:
    """Return the fault of points that each have the data of the next or the previous row, from one on.

    The point at the end, whose data may be those of no other, is left out.
    """
    points = found.first.layout.by_point(found.first.live)
    names, rows = list(points), list(points.values())
    before = _Misfit.of(found)
    if before.is_small() or _explained(found) or len({len(own) for own in rows}) != 1:
        return None
    given = found.first.packed.geometry.positions_m
    tried: dict[tuple[int, int], _Misfit] = {}
    for first in range(len(rows) - _LEAST_SHIFTED):
        for shift in (1, -1):
            places = given.copy()
            order = range(first, len(rows) - 1) if shift == 1 else range(first + 1, len(rows))
            for row in order:
                places[rows[row]] = given[rows[row + shift][0]]
            tried[first, shift] = _Misfit.of(found, places, rows[-1] if shift == 1 else rows[first])
    best = min(tried, key=lambda key: tried[key].energy / max(tried[key].freedom, 1), default=None)
    if best is None or not tried[best].cures(before):
        return None
    point, other = (names[best[0]], names[best[0] + 1])[:: best[1]]
    got = (
        f"data shifted by one row: point {point} has those of point {other}, and so on to the end "
        f"{tried[best].words(before)}"
    )
    step = "Bring names and rows together: a row is missing or was inserted, here or in points.csv"
    return Fault(f"the rows of body {body.body}", "those of the points that they name", got, "", step)


@dataclass(frozen=True)
class _Misfit:
    """Sum of squares over noise of a rigid motion, and its degrees of freedom."""

    energy: float
    freedom: int

    @classmethod
    def of(cls, found: Diagnosis, positions_m: Array | None = None, without: Sequence[int] = ()) -> _Misfit:
        """Fit a body as given, or at other positions (c, 3) and without some channels."""
        now = found.first
        if positions_m is None:
            return cls(now.estimate.chi2 / now.noise.level, now.state.freedom)
        w = now.packed.w.copy()
        w[:, list(without)] = 0.0
        y = now.packed.y * (w > 0.0)[:, :, None]
        geometry = replace(now.packed.geometry, positions_m=positions_m)
        state = State(replace(now.packed, y=y, w=w, visible=np.eye(6)), geometry)
        return cls(state.energy / now.noise.level, state.freedom)

    def is_small(self) -> bool:
        """Return whether there is no misfit, or too little to judge it by."""
        least = self.freedom + np.sqrt(2.0 * self.freedom) / _CURED_SHARE
        return bool(self.freedom < _LEAST_FREEDOM_OF_FIT or self.energy < least)

    def cures(self, before: _Misfit) -> bool:
        """Return whether this is a tenth of the misfit before."""
        left = max(self.energy - self.freedom, np.sqrt(2.0 * self.freedom))
        enough = self.freedom >= _LEAST_FREEDOM_OF_FIT
        return bool(enough and left <= _CURED_SHARE * (before.energy - before.freedom))

    def words(self, before: _Misfit) -> str:
        """Say how large residuals are."""
        sizes = [float(np.sqrt(one.energy / one.freedom)) for one in (before, self)]
        return f"(residuals {sizes[0]:.2g} times the noise, {sizes[1]:.2g} so)"


def _sum(misfits: Sequence[_Misfit]) -> _Misfit:
    return _Misfit(sum(one.energy for one in misfits), sum(one.freedom for one in misfits))


def _explained(found: Diagnosis) -> bool:
    """Return whether one fault leaves nothing but noise."""
    single = len(found.findings) == 1 and not found.causes and found.findings[0].kind != "flexible"
    return single and found.last.clean()
