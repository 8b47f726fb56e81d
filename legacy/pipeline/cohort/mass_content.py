"""The content of mass.json out of whatever holds it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from legacy.pipeline.errors import PipelineError
from legacy.stapeskit.json_toml import read_json


def mass_content(source: object) -> Mapping[str, Any]:
    """Return the content of mass.json.

    Parameters
    ----------
    source : MassResult, StudyResult, path or mapping
        A path leads to mass.json or to the folder that holds it.

    Raises
    ------
    PipelineError
        It is none of these, or there is no such file.
    """
    if isinstance(source, Mapping):
        return source
    if isinstance(source, str | os.PathLike):
        path = Path(source)
        path = path / "mass.json" if path.is_dir() else path
        try:
            return read_json(path)
        except (OSError, ValueError) as fault:
            step = "Run ct2mass on the scan first"
            raise PipelineError.of(str(path), "a mass.json", fault, "", step) from fault
    if hasattr(source, "measured_mass"):
        return dict(source.measured_mass().record.raw)
    mass = getattr(source, "mass", None)
    if isinstance(mass, Mapping):
        return mass
    raise PipelineError.of("the mass", "a result of ct2mass or scan2kd, a path or a mapping", source)
