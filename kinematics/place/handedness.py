"""Positions in other axes than the directions of the beams."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np

from kinematics.calibrated import calibrated
from kinematics.faults.search import Diagnosis
from kinematics.joint.estimate import State
from kinematics.measurement import MIRRORS, Measurement
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError

UNITS = {
    f"{unit} taken as mm": factor * np.eye(3)
    for unit, factor in {"metres": 1e3, "micrometres": 1e-3, "inches": 25.4}.items()
}
"""Changes of scale (3, 3) that mistakes make, by their words."""

_CURED_SHARE = calibrated("handedness.cured_share")
_LEAST_FREEDOM_OF_FIT = 20  # fewer say too little of a misfit


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
    """Refuse positions that agree with the beams only in other axes; diagnoses by body.

    Raises
    ------
    StapeskitError
        Other axes of all positions bring the misfit down to a tenth, and no single fault explains it.

    Notes
    -----
    Where positions and beams are both mirrored, v = v0 + omega x r keeps its form with -omega, and no
    residual shows it: there only fiducials off a plane, or points on the surfaces of the scan, tell.
    """
    loud = {k: found for k, found in diagnoses.items() if found.findings or found.causes}
    first = [found.first for found in loud.values()]
    freedom = sum(now.state.freedom for now in first)
    chance = float(np.sqrt(2.0 * freedom))
    before = sum(now.estimate.chi2 / now.noise.level for now in first) - freedom
    large = freedom >= _LEAST_FREEDOM_OF_FIT and before > chance / _CURED_SHARE
    if not large or all(map(_explained, loud.values())):
        return
    after: dict[str, float] = {}
    for words, change in axes_changes(half_turns=False).items():
        energy = 0.0
        for number, found in loud.items():
            to_file, now = placed.bodies[number].file_from_here, found.first
            geometry = now.packed.geometry
            moved = replace(geometry, positions_m=geometry.positions_m @ (to_file.T @ change @ to_file).T)
            energy += State(replace(now.packed, visible=np.eye(6)), moved).energy / now.noise.level
        after[words] = energy - freedom
    best = min(after, key=lambda words: after[words])
    if max(after[best], chance) <= _CURED_SHARE * before:
        sizes = [np.sqrt(1.0 + misfit / freedom) for misfit in (before, after[best])]
        got = (
            f"positions that agree only with {best} (residuals {sizes[0]:.2g} times the noise, "
            f"{sizes[1]:.2g} so)"
        )
        step = "Correct these columns of the positions, or those of the directions"
        expected = "in the same axes as the beam directions"
        raise StapeskitError.of("the positions of the points", expected, got, "", step)


def _explained(found: Diagnosis) -> bool:
    """Return whether one fault leaves nothing but noise."""
    single = len(found.findings) == 1 and not found.causes and found.findings[0].kind != "flexible"
    return single and found.last.clean()
