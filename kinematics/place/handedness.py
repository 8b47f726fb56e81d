"""Other axes than stated: reversed, exchanged, turned by half a turn; and positions against beams."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np

from kinematics.calibrated import calibrated
from kinematics.faults.search import Diagnosis
from kinematics.joint.estimate import State
from kinematics.measurement import MIRRORS
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.frames import RigidTransform

UNITS = {
    f"{unit} taken as mm": factor * np.eye(3)
    for unit, factor in {"metres": 1e3, "micrometres": 1e-3, "inches": 25.4}.items()
}
"""Changes of scale (3, 3) that mistakes make, by their words."""

_CURED_SHARE = calibrated("handedness.cured_share")
_LEAST_MISFIT = calibrated("handedness.least_misfit")
_LEAST_FREEDOM = 20


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


def check_axes(diagnoses: Mapping[int, Diagnosis], footplate_from_source: RigidTransform) -> None:
    """Refuse positions that agree with the beams only when an axis is reversed or two are exchanged.

    Parameters
    ----------
    diagnoses : mapping of int to Diagnosis
        By body.
    footplate_from_source : RigidTransform
        Whose source axes are those of the files.

    Raises
    ------
    StapeskitError
        Other axes of all positions bring the misfit down to a tenth, and no single fault explains it.

    Notes
    -----
    Where positions and beams are both mirrored, v = v0 + omega x r keeps its form with -omega, and no
    residual shows it: there only fiducials off a plane, or points on the surfaces of the scan, tell.
    """
    loud = [found for found in diagnoses.values() if found.findings or found.causes]
    freedom = sum(found.first.state.freedom for found in loud)
    before = sum(found.first.estimate.chi2 / found.first.noise.level for found in loud)
    if freedom < _LEAST_FREEDOM or before < _LEAST_MISFIT * freedom or all(map(_explained, loud)):
        return
    turn = footplate_from_source.rotation
    after = {
        words: sum(_energy(found, turn @ change @ turn.T) for found in loud)
        for words, change in axes_changes(half_turns=False).items()
    }
    best = min(after, key=lambda words: after[words])
    least = float(np.sqrt(2.0 * freedom))
    if max(after[best] - freedom, least) > _CURED_SHARE * (before - freedom):
        return
    if after[best] > _LEAST_MISFIT * freedom:
        return
    sizes = [float(np.sqrt(value / freedom)) for value in (before, after[best])]
    got = (
        f"positions that agree only with {best} (residuals {sizes[0]:.2g} times the noise, {sizes[1]:.2g} so)"
    )
    step = "Correct these columns of the positions, or those of the directions"
    expected = "in the same axes as the beam directions"
    raise StapeskitError.of("the positions of the points", expected, got, "", step)


def _explained(found: Diagnosis) -> bool:
    """Return whether one fault leaves nothing but noise."""
    single = len(found.findings) == 1 and not found.causes and found.findings[0].kind != "flexible"
    return single and found.last.clean()


def _energy(found: Diagnosis, change: Array) -> float:
    """Return the sum of squares over noise with other axes of all positions."""
    packed = replace(found.first.packed, visible=np.eye(6))
    moved = replace(packed.geometry, positions_m=packed.geometry.positions_m @ change.T)
    return State(packed, moved).energy / found.first.noise.level
