"""The calibrated numbers of this room: ``calibrated("ligament.height_mm")``; see ``calibrated.toml``."""

from __future__ import annotations

from pathlib import Path

from legacy.stapeskit.calibrated import CalibratedNumbers

calibrated = CalibratedNumbers(Path(__file__).with_suffix(".toml"))
