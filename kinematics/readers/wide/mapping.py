"""Which column of a wide table is what: ``FILE.csv.toml``, or ``--mapping FILE``.

::

    frequency = "f"            # name of a column; with its unit in brackets or without
    frequency_unit = "kHz"     # left out: as in the header, else Hz
    amplitude = "peak"         # or "rms" (left out: --amplitude)
    convention = "+"           # e^{+iwt}; "-" for e^{-iwt}, which is conjugated

    [[signal]]                 # one for every beam; {point} in the names stands for the name of each point
    magnitude = "ch{point} M"  # with phase; or value_re and value_im
    phase = "ch{point} P"
    phase_unit = "rad"         # left out: as in the header, else degrees
    unit = "mm/s"              # left out: as in the header
    direction = "z"            # x, y, z, -x, -y, -z, or three numbers (left out: --beam)
    point = "3"                # where the names have no {point} (left out: the name of the file)
    coherence = "C{point}"     # optional: coherence, sd (unit of the value), n_avg (a number), run, body
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from kinematics.errors import KinematicsError
from kinematics.readers.mapping_file import mapping_document, unknown_keys
from kinematics.readers.wide.columns import Beam
from stapeskit.faults import Fault, raise_all

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
    document = mapping_document(path)
    signals = document.get("signal")
    if not isinstance(signals, list) or not signals or not all(isinstance(entry, dict) for entry in signals):
        raise KinematicsError.of("a mapping", "of one [[signal]] at least", "none", path.name)
    faults = unknown_keys(document, {*_FILE, "signal"}, path.name)
    for key, values in _FILE.items():
        value = document.get(key, values[0] if values else "")
        if not isinstance(value, str) or (values and value not in values):
            faults.append(Fault(key, " or ".join(values) or "the name of a column", value, path.name))
    for number, entry in enumerate(signals, 1):
        where = f"{path.name}, signal {number}"
        faults += unknown_keys(entry, {*_PARTS, *_TEXTS, "direction", "n_avg"}, where)
        faults += [
            Fault(key, "a text in quotes", entry[key], where)
            for key in (*_PARTS, *_TEXTS)
            if not isinstance(entry.get(key, ""), str)
        ]
        count = entry.get("n_avg", 1)
        if isinstance(count, bool) or not isinstance(count, int | float):
            faults.append(Fault("n_avg", "a number of averages", count, where))
        if not {"value_re", "value_im"} <= set(entry) and not {"magnitude", "phase"} <= set(entry):
            want = "given as magnitude and phase, or as value_re and value_im"
            faults.append(Fault("the columns of a signal", want, ", ".join(entry) or "none", where))
    raise_all(KinematicsError, faults)
    return dict(document)


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
    near = get_close_matches(name, list(names), 1)
    step = f"Did you mean {near[0]}?" if near else f"It has {', '.join(names[:12])}"
    return Fault(f"the column {name}", "in the table", "no such one", file, step)
