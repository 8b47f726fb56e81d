"""Names and units of the degrees of freedom, apart from all mathematics: options and help need nothing more."""

from __future__ import annotations

DOF_NAMES: tuple[str, ...] = ("x", "y", "z", "alpha", "beta", "gamma")
DOF_UNITS: dict[str, str] = dict.fromkeys(DOF_NAMES[:3], "m") | dict.fromkeys(DOF_NAMES[3:], "rad")
