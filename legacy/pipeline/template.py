"""The study file to start from."""

from __future__ import annotations

from legacy.pipeline.study import TABLES
from legacy.stapeskit.option_docs import template

_TITLE = """\
One ear: its micro-CT scan, its vibrometer measurement, the fit of stiffness and damping.
Run it with:  scan2kd study.toml
Paths are relative to this file. Lists of three numbers are x, y, z.
Remove the # in front of a key to set it."""

TEMPLATE = template(_TITLE, TABLES)
