"""Names and units of the degrees of freedom, without any mathematics: options and help need only these."""

from __future__ import annotations

DOF_NAMES: tuple[str, ...] = ("x", "y", "z", "alpha", "beta", "gamma")
DOF_UNITS: dict[str, str] = dict.fromkeys(DOF_NAMES[:3], "m") | dict.fromkeys(DOF_NAMES[3:], "rad")
