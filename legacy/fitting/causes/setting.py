"""The fit to which a cause is added, and what a cause does to it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from legacy.fitting.ligament.equations import Equations
from legacy.fitting.ligament.joint_lines import JointLines
from legacy.stapeskit.arrays import Array

Applied = tuple[JointLines, Equations]


@dataclass(frozen=True)
class Setting:
    """The fit to which a cause is added.

    Attributes
    ----------
    lines : JointLines
        Without any cause.
    omega : ndarray, (lines,)
        rad/s.
    mass : ndarray, (6, 6)
        SI.
    """

    lines: JointLines
    omega: Array
    mass: Array


Apply = Callable[[float, JointLines, Equations], Applied]
