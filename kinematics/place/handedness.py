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
from stapeskit.warnings import Notice

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
    if half_turns:
        for axis, signs in MIRRORS.items():
            others = " and ".join(name for name in "xyz" if name != axis)
            also = " (RAS against LPS)" if axis == "z" else ""
            changes[f"the axes {others} reversed{also}"] = -np.diag(signs)
    return changes


def units_changes() -> dict[str, Array]:
    """Return changes of scale (3, 3) by their words."""
    factors = {"metres taken as mm": 1e3, "micrometres taken as mm": 1e-3, "inches taken as mm": 25.4}
    return {words: factor * np.eye(3) for words, factor in factors.items()}


def check_axes(diagnoses: Mapping[int, Diagnosis], footplate_from_source: RigidTransform) -> list[Notice]:
    """Refuse positions that agree with the beams only when an axis is reversed or two are exchanged.

    Parameters
    ----------
    diagnoses : mapping of int to Diagnosis
        By body.
    footplate_from_source : RigidTransform
        Whose source axes are those of the files.

    Returns
    -------
    list of Notice
        ``mirrored_axes`` where one fault explains the readings as well.

    Raises
    ------
    StapeskitError
        Other axes of all positions bring the misfit down to a tenth, and nothing else does.

    Notes
    -----
    Where positions and beams are both mirrored, v = v0 + omega x r keeps its form with -omega, and no
    residual shows it: there only fiducials off a plane, or points on the surfaces of the scan, tell.
    """
    loud = {number: found for number, found in diagnoses.items() if found.findings or found.causes}
    freedom = sum(found.first.state.freedom for found in loud.values())
    before = sum(found.first.estimate.chi2 / found.first.noise.level for found in loud.values())
    if freedom < _LEAST_FREEDOM or before < _LEAST_MISFIT * freedom:
        return []
    turn = footplate_from_source.rotation
    after = {
        words: sum(_energy(found, turn @ change @ turn.T) for found in loud.values())
        for words, change in axes_changes(half_turns=False).items()
    }
    best = min(after, key=lambda words: after[words])
    least = float(np.sqrt(2.0 * freedom))
    if max(after[best] - freedom, least) > _CURED_SHARE * (before - freedom):
        return []
    if after[best] > _LEAST_MISFIT * freedom:
        return []
    single = all(
        len(found.findings) == 1 and not found.causes and found.findings[0].kind != "flexible"
        for found in loud.values()
    )
    if single and all(found.last.clean() for found in loud.values()):
        text = f"positions with {best} would explain the readings as well as the fault that was found."
        return [Notice("mirrored_axes", text)]
    sizes = [float(np.sqrt(value / freedom)) for value in (before, after[best])]
    got = (
        f"positions that agree only with {best} (residuals {sizes[0]:.2g} times the noise, {sizes[1]:.2g} so)"
    )
    step = "Correct these columns of the positions, or those of the directions"
    expected = "in the same axes as the beam directions"
    raise StapeskitError.of("the positions of the points", expected, got, "", step)


def _energy(found: Diagnosis, change: Array) -> float:
    """Return the sum of squares over noise with other axes of all positions."""
    packed = replace(found.first.packed, visible=np.eye(6))
    moved = replace(packed.geometry, positions_m=packed.geometry.positions_m @ change.T)
    return State(packed, moved).energy / found.first.noise.level
