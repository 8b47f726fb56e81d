"""What the columns of a wide table are: ``FILE.csv.toml``, ``--mapping FILE`` (docs/vibrometer_files.md)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.mapping_file import read_mapping_file
from legacy.kinematics.readers.wide.columns import Beam
from legacy.stapeskit.faults import Fault, raise_all
from legacy.stapeskit.option_names import suggestion

_PARTS = {
    "value_re": "re",
    "value_im": "im",
    "magnitude": "amp",
    "phase": "phase",
    "coherence": "coherence",
    "sd": "sd",
}
_TEXTS = ("unit", "phase_unit", "point", "body", "run")
_FILE = {
    "frequency": (),
    "frequency_unit": ("Hz", "kHz", "MHz"),
    "amplitude": ("peak", "rms"),
    "convention": ("+", "-"),
}


def read_mapping(path: Path) -> dict[str, Any]:
    """Read a mapping: its texts, and ``signal`` as a list of tables.

    Raises
    ------
    KinematicsError
        No TOML, an unknown key, or a value of the wrong kind; all faults together.
    """
    pairs = (("magnitude", "phase"), ("value_re", "value_im"))
    document = read_mapping_file(path, _FILE, (*_PARTS, *_TEXTS), pairs)
    counts = [(number, entry.get("n_avg", 1)) for number, entry in enumerate(document["signal"], 1)]
    faults = [
        Fault("n_avg", "a number of averages", count, f"{path.name}, signal {number}")
        for number, count in counts
        if isinstance(count, bool) or not isinstance(count, int | float)
    ]
    raise_all(KinematicsError, faults)
    return document


def mapped_beams(signals: Sequence[Mapping[str, Any]], names: Sequence[str], file: str) -> list[Beam]:
    """Return the beams that a mapping names.

    Raises
    ------
    KinematicsError
        A column is not in the table (the nearest is named), or is there twice.
    """
    beams: list[Beam] = []
    faults: list[Fault] = []
    for entry in signals:
        wanted = {part: entry[key] for key, part in _PARTS.items() if entry.get(key)}
        first = next(iter(wanted.values()))
        labels = _labels(first, names) if "{point}" in first else [str(entry.get("point", ""))]
        if not labels:
            faults.append(_missing(first, names, file))
        for label in labels:
            columns = {}
            for part, pattern in wanted.items():
                name = plain_name(pattern.replace("{point}", label))
                places = [place for place, other in enumerate(names) if other == name]
                if len(places) == 1:
                    columns[part] = places[0]
                elif places:
                    got = f"{len(places)} times"
                    faults.append(Fault(f"the column {name}", "in the table once", got, file))
                else:
                    faults.append(_missing(name, names, file))
            texts = {key: entry[key] for key in ("unit", "phase_unit", "body", "run") if key in entry}
            beams.append(Beam(columns, label, entry.get("direction", ""), n_avg=entry.get("n_avg"), **texts))
    raise_all(KinematicsError, list(dict.fromkeys(faults)))
    return beams


def plain_name(name: str) -> str:
    """Return the name of a column without the unit in brackets behind it."""
    return re.sub(r"\s*[\[(][^\])]*[\])]\s*$", "", name).strip()


def _labels(pattern: str, names: Sequence[str]) -> list[str]:
    """Return the names of points: the texts in place of ``{point}`` in the names that fit the pattern."""
    before, _, after = plain_name(pattern).partition("{point}")
    matches = (re.fullmatch(f"{re.escape(before)}(.+?){re.escape(after)}", name) for name in names)
    return list(dict.fromkeys(match[1].strip() for match in matches if match))


def _missing(name: str, names: Sequence[str], file: str) -> Fault:
    step = suggestion(name, names) or f"It has {', '.join(names[:12])}"
    return Fault(f"the column {name}", "in the table", "no such one", file, step)
