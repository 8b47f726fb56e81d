"""Mapping files, TOML in the folder of a measurement or by ``--mapping FILE``: what readers of them share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from legacy.kinematics.errors import KinematicsError
from legacy.stapeskit.faults import Fault, raise_all
from legacy.stapeskit.json_toml import parse_toml
from legacy.stapeskit.option_names import suggestion


def mapping_of(path: Path, mapping: Path | None) -> Path | None:
    """Return the mapping of a file: the one given, or ``<path>.toml`` where it exists."""
    beside = path.with_name(path.name + ".toml")
    return beside if mapping is None and beside.is_file() else mapping


def _document(path: Path) -> dict[str, Any]:
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


def read_mapping_file(
    path: Path,
    keys: Mapping[str, Sequence[str]],
    signal_keys: Iterable[str],
    pairs: Sequence[tuple[str, ...]],
    needed: Sequence[str] = (),
) -> dict[str, Any]:
    """Read a mapping of texts, and of tables ``[[signal]]`` with texts, ``direction`` and ``n_avg``.

    Parameters
    ----------
    keys : mapping of str to sequence of str
        The keys of the file with the values that they may have; any text where there are none.
    signal_keys : iterable of str
        The keys of a signal that are texts.
    pairs : sequence of tuple of str
        The keys of a signal of which one group must be given.
    needed : sequence of str
        Keys of the file that must be given.

    Raises
    ------
    KinematicsError
        No TOML, no signal, an unknown key, or a value of the wrong kind; all faults together.
    """
    document = _document(path)
    signals = document.get("signal", [])
    faults = _unknown_keys(document, {*keys, "signal"}, path.name)
    for key, values in keys.items():
        value = document.get(key, values[0] if values else "")
        if not isinstance(value, str) or (values and value not in values):
            faults.append(Fault(key, _join_with_or(values) or "a text in quotes", value, path.name))
    absent = [key for key in needed if not document.get(key)]
    faults += [Fault(key, "the name of a variable", "none", path.name) for key in absent]
    if not isinstance(signals, list) or not signals or not all(isinstance(entry, dict) for entry in signals):
        got = "none" if signals == [] else "something else"
        faults.append(Fault("a mapping", "of one [[signal]] at least", got, path.name))
        signals = []
    for number, entry in enumerate(signals, 1):
        where = f"{path.name}, signal {number}"
        faults += _unknown_keys(entry, {*signal_keys, "direction", "n_avg"}, where)
        faults += [
            Fault(key, "a text in quotes", entry[key], where)
            for key in signal_keys
            if not isinstance(entry.get(key, ""), str)
        ]
        if not any(all(entry.get(key) for key in pair) for pair in pairs):
            wanted = f"given as {', or as '.join(' and '.join(pair) for pair in pairs)}"
            faults.append(Fault("the columns of a signal", wanted, ", ".join(entry) or "none", where))
    raise_all(KinematicsError, faults)
    return document


def _join_with_or(values: Sequence[str]) -> str:
    return " or ".join([", ".join(values[:-1]), values[-1]]) if len(values) > 1 else "".join(values)


def _unknown_keys(keys: Iterable[str], known: set[str], where: str) -> list[Fault]:
    """List keys that are not known, each with the nearest that is."""
    faults = []
    for key in keys:
        if key not in known:
            step = suggestion(key, sorted(known)) or "Remove it"
            faults.append(Fault("a key", f"one of {', '.join(sorted(known))}", key, where, step))
    return faults
