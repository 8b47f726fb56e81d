"""Units by suffix: ``re_mm_s`` is a velocity in mm/s, ``amp_rms_m`` a displacement in m, rms."""

from __future__ import annotations

import re
from dataclasses import dataclass

_COLUMN = re.compile(r"^(re|im|amp|sd)_(rms_)?(m|mm|um|nm)(_s2|_s)?$")
_PREFIX = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9}
_ORDER = {None: 0, "_s": 1, "_s2": 2}
_NAMES = ("displacement", "velocity", "acceleration")
SUFFIXES = "m, mm, um, nm (displacement), m_s, mm_s, ... (velocity), m_s2, ... (acceleration), rms_m_s, ..."

# No measurement reaches these: numbers beyond come from damaged files, and their squares still are numbers.
LARGEST = 1e100  # of any unit: its square, 1e200, is below the largest double
HIGHEST_HZ = 1e12  # a hundred times the bandwidth of the fastest vibrometers, 8 GHz
LOWEST_HZ = 1e-12  # a period of 30 000 years
FARTHEST_MM = 1e9  # 1000 km: nothing under a laser
NEAREST_MM = 1e-12  # a hundred thousandth of the radius of an atom: no sd of a place


@dataclass(frozen=True)
class Unit:
    """What a column holds."""

    part: str  # re, im, amp or sd
    order: int  # time derivatives: 0 displacement, 1 velocity, 2 acceleration
    scale: float  # to SI peak amplitude
    rms: bool

    @property
    def quantity(self) -> str:
        """``displacement``, ``velocity`` or ``acceleration``."""
        return _NAMES[self.order]


def unit_of(column: str) -> Unit | None:
    """Read the unit from a column's name; None when it carries no known one."""
    match = _COLUMN.match(column)
    if match is None:
        return None
    part, rms, prefix, rate = match.groups()
    scale = _PREFIX[prefix] * (2.0**0.5 if rms else 1.0)
    return Unit(part, _ORDER[rate], scale, bool(rms))
