"""Mapping files, TOML beside a measurement or by ``--mapping FILE``: what readers of them share."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from kinematics.errors import KinematicsError
from stapeskit.faults import Fault
from stapeskit.json_toml import parse_toml


def mapping_document(path: Path) -> dict[str, Any]:
    """Read the TOML of a mapping file.

    Raises
    ------
    KinematicsError
        The file does not exist or is no TOML.
    """
    if not path.is_file():
        raise KinematicsError.of("{mapping}", "an existing TOML file", path, "", "Check its name")
    try:
        return parse_toml(path.read_bytes().decode("utf-8-sig"))
    except ValueError as fault:
        raise KinematicsError.of("a mapping", "a TOML file", str(fault), path.name) from fault


def unknown_keys(keys: Iterable[str], known: set[str], where: str) -> list[Fault]:
    """List keys that are not known, each with the nearest that is."""
    faults = []
    for key in keys:
        if key not in known:
            near = get_close_matches(key, sorted(known), 1)
            step = f"Did you mean {near[0]}?" if near else "Remove it"
            faults.append(Fault("a key", f"one of {', '.join(sorted(known))}", key, where, step))
    return faults
