"""Read universal files (UFF, UNV) by pyuff: functions 58, 58b with the geometry of 15, 2411, 18, 2420, 164.

The quantity follows from the data characteristic of the ordinate, the unit from its label, without a label
from dataset 164. Texts such as names of channels are localised and are not read.

Source: universal file format of SDRC, as kept by the University of Cincinnati.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from kinematics.readers.facts import FileFacts
from kinematics.readers.gather import Row, joined_place, recording_of
from kinematics.readers.recording import Channel, Recording, unknown_vector
from kinematics.readers.text import CUT, shown
from kinematics.readers.uff_geometry import Geometry, read_geometry
from kinematics.readers.units import MotionUnit, is_none, motion_unit, plain
from stapeskit.faults import Fault, Place, StapeskitError, list_some, raise_all
from stapeskit.warnings import Notice

Function = Mapping[str, Any]
"""A dataset 58 as pyuff gives it, with its ``place`` in the file."""

FRF, TRANSMISSIBILITY, COHERENCE, SPECTRUM = 4, 5, 6, 12
KINDS = {
    0: "function of unknown type", 1: "time response", 2: "auto spectrum", 3: "cross spectrum",
    FRF: "frequency response function", TRANSMISSIBILITY: "transmissibility", COHERENCE: "coherence",
    9: "power spectral density", 10: "energy spectral density", SPECTRUM: "spectrum",
    26: "multiple coherence",
}  # fmt: skip
"""Function types of dataset 58."""

ORDERS = {8: 0, 11: 1, 12: 2}
"""Data characteristics of the ordinate: displacement, velocity, acceleration."""

REFERENCES = {13: "N", 9: "N", 15: "Pa", 8: "m", 11: "m/s", 12: "m/s2"}
"""Units of the denominator by its data characteristic."""

AXES = ("", "+x", "+y", "+z", "+rx", "+ry", "+rz", "-rz", "-ry", "-rx", "-z", "-y", "-x")
"""Directions by their codes, the negative ones counted from the end."""

_FREQUENCY = (0, 1, 18)  # data characteristics of the abscissa: unknown, general, frequency
_BINARY = re.compile(rb"^ {4}58b", re.MULTILINE | re.IGNORECASE)
_PADDED_RULE = re.compile(rb"^ {4}-1[ \t]+(\r?)$", re.MULTILINE)
_FORTRAN_EXPONENT = re.compile(rb"(\d)[Dd]([+-]\d\d)")
_IN_TEXT = re.compile(r"(?:^|[\s_])[+-]?[xyz]\b", re.IGNORECASE)


def read(path: Path, facts: FileFacts) -> Recording:  # noqa: ARG001
    """Read a universal file.

    Raises
    ------
    StapeskitError
        The file is cut short, a function holds fewer values than its header says, a measured direction is a
        rotation, or there is no function of motion; as `recording_of`. All faults together, one a kind.
    """
    path = Path(path)
    sets, faults = _read_sets(path)
    functions = [one for one in sets if one.get("type") == 58]
    geometry = read_geometry(sets, path.name, {int(one["rsp_node"]) for one in functions}, faults)
    others = Counter(text for one in functions if (text := _unusable(one)))
    usable = [one for one in functions if one["func_type"] != COHERENCE and not _unusable(one)]
    listed = ", ".join(f"{count} {name}" for name, count in others.most_common())
    if not usable and not faults:
        want = "one with functions 58 of displacement, velocity or acceleration over frequency"
        step = "Export complex spectra or frequency responses of velocity or displacement as UFF 58"
        raise StapeskitError.of("a universal file", want, listed or "none", path.name, step)
    runs, repeats = _runs(usable), len({one["ver_num"] for one in usable}) > 1
    coherences = {
        key: np.real(one["data"])
        for one in functions
        if one["func_type"] == COHERENCE
        for key in (_response(one), _response(one)[:3])
    }
    rows = [
        _row(one, geometry, run, repeats, coherences, path.name)
        for one, run in zip(usable, runs, strict=True)
    ]
    raise_all([*faults, *_row_faults(usable, rows)])
    stated = geometry.length_factor is not None
    lengths = f"by dataset 164, {geometry.length_factor:g} per metre" if stated else "as metres"
    return recording_of(
        path.name,
        rows,
        twice=_step_for_directions(usable),
        notices=(*_notices(usable, listed, stated, path.name), *geometry.notices),
        statement=f"global axes of the file, lengths {lengths}",
        amplitude_stated=False,
        length_stated=stated,
    )


def _read_sets(path: Path) -> tuple[list[dict[str, Any]], list[Fault]]:
    """Return the datasets of a file with their places from 1, and what is wrong with them.

    Where pyuff fails, rules padded with blanks to 80 columns and Fortran's exponents D are rewritten.
    """
    content = path.read_bytes()
    sets, faults = _datasets(path, content, path.name)
    if (sets and not faults) or _BINARY.search(content) is not None:
        return sets, faults
    plain_text = _PADDED_RULE.sub(rb"    -1\1", _FORTRAN_EXPONENT.sub(rb"\1E\2", content))
    with TemporaryDirectory() as folder:
        copy = Path(folder) / "plain.uff"
        copy.write_bytes(plain_text)
        return _datasets(copy, plain_text, path.name)


def _datasets(path: Path, content: bytes, name: str) -> tuple[list[dict[str, Any]], list[Fault]]:
    """Return the datasets that pyuff reads, and what is wrong with the others."""
    import pyuff

    faults: list[Fault] = []
    whole = content.rstrip(b" \t\r\n\0\x1a")
    if not whole.endswith(b" -1"):
        got = shown(whole.rsplit(b"\n", 1)[-1][-40:].decode("latin-1")) or "nothing"
        faults.append(Fault("the last line of a universal file", "-1", got, name, CUT))
    file = pyuff.UFF(str(path))
    sets: list[dict[str, Any]] = []
    damaged: list[int] = []
    for place in range(1, file.get_n_sets() + 1):
        try:
            one = {**file.read_sets(place - 1), "place": place}
        except Exception:  # pyuff raises plain exceptions of many kinds
            damaged.append(place)
            continue
        if one.get("type") == 58:
            x, y = np.atleast_1d(one.get("x", [])), np.atleast_1d(one.get("data", []))
            if not len(y) or len(y) != one["num_pts"] or len(x) != len(y):
                got, where = f"{len(y)} of {one['num_pts']}", Place(name, "dataset", (place,))
                want = "as many as its header says"
                faults.append(Fault("the values of a function", want, got, where, CUT))
                continue
        sets.append(one)
    if damaged:
        where = Place(name, "dataset", tuple(damaged))
        faults.append(Fault("a dataset", "as the format describes it", "another layout", where, CUT))
    return sets, faults


def _unusable(one: Function) -> str:
    """Return the kind of a function that is neither motion over frequency nor coherence; else empty."""
    kind = KINDS.get(one["func_type"], f"function of type {one['func_type']}")
    named = motion_unit(_label(one, "ordinate")) is not None
    ordinate = one["ordinate_spec_data_type"]
    reasons = {
        "": one["func_type"] not in (FRF, TRANSMISSIBILITY, SPECTRUM),
        " of another quantity": ordinate not in ORDERS and (ordinate not in (0, 1) or not named),
        " over something else": one["abscissa_spec_data_type"] not in _FREQUENCY,
        " of real numbers, without phase": not np.iscomplexobj(one["data"]),
    }
    if one["func_type"] == COHERENCE or not any(reasons.values()):
        return ""
    return kind + next(text for text, true in reasons.items() if true)


def _label(one: Function, axis: str) -> str:
    """Return the unit of an axis; empty where none is stated."""
    label = str(one.get(f"{axis}_axis_units_lab", ""))
    return "" if is_none(label) else label


def _row(
    one: Function,
    geometry: Geometry,
    run: str,
    repeats: bool,
    coherences: Mapping[tuple[int, ...], Any],
    file: str,
) -> Row:
    """Return a function as a row, with its coherence where the file holds it."""
    label, per, response = _label(one, "ordinate"), _label(one, "orddenom"), one["func_type"] != SPECTRUM
    order = ORDERS.get(one["ordinate_spec_data_type"], 1)
    unit = motion_unit(label) if label else MotionUnit(order, 1.0 / (geometry.length_factor or 1.0))
    if unit is not None and response and (per or not unit.per):
        known = REFERENCES.get(one["orddenom_spec_data_type"], "unit of the reference")
        unit = replace(unit, per=plain(per) if per else known)
    node, name = int(one["rsp_node"]), str(one.get("rsp_ent_name", "")).strip()
    channel = Channel(
        name if node == 0 and not is_none(name) else str(node),
        run=run,
        repeat=str(one["ver_num"]) if repeats else "",
        position_m=geometry.positions_m.get(node, unknown_vector()),
        direction=geometry.direction(node, int(one["rsp_dir"])),
        where=Place(file, "dataset", (one["place"],)),
    )
    coherence, key = None, _response(one)
    match = coherences.get(key, coherences.get(key[:3]))  # of the same reference, else of another
    if match is not None and response:
        if len(match) != len(one["data"]):
            want, got = "of as many lines as its response", len(match)
            raise StapeskitError.of("the coherence", want, got, channel.where, "Export both again")
        coherence = np.array(match, dtype=float)
    return Row(channel, one["x"].astype(float), one["data"], coherence=coherence, unit=unit or label)


def _response(one: Function) -> tuple[int, ...]:
    """Return the key that a coherence shares with its response."""
    return (one["rsp_node"], abs(one["rsp_dir"]), one["load_case_id"], one["ref_node"], one["ref_dir"])


def _row_faults(functions: Sequence[Function], rows: Sequence[Row]) -> list[Fault]:
    """Refuse rotations, and units that contradict the quantity; one sentence a kind."""
    turned = [row.channel for one, row in zip(functions, rows, strict=True) if abs(one["rsp_dir"]) > 3]
    wrong = [
        row.channel
        for one, row in zip(functions, rows, strict=True)
        if isinstance(row.unit, MotionUnit)
        and ORDERS.get(one["ordinate_spec_data_type"], row.unit.order) != row.unit.order
    ]
    faults = []
    if turned:
        want, got = "0 (scalar) or +-1, +-2, +-3", "a rotation or another number"
        step = "Vibrometers measure translations: leave rotations out of the export"
        faults.append(Fault("the direction of a function", want, got, joined_place(turned), step))
    if wrong:
        want, step = "those of one motion", "Correct the unit in the measuring program"
        faults.append(Fault("quantity and unit", want, "different ones", joined_place(wrong), step))
    return faults


def _runs(functions: Sequence[Function]) -> list[str]:
    """Return the run of each function: its load case, else its reference, where there are several.

    Some exports repeat the node of the response as the reference; that says nothing about the excitation.
    """
    excitations = []
    for one in functions:
        case = int(one["load_case_id"])
        spectrum = case or one["func_type"] == SPECTRUM
        excitations.append((case, 0, 0) if spectrum else (0, int(one["ref_node"]), int(one["ref_dir"])))
    nodes = [one["rsp_node"] for one in functions]
    roving = len(set(nodes)) > 1 and nodes == [node for _, node, _ in excitations]
    spectra = [one["func_type"] == SPECTRUM for one in functions]
    responses = {excitation for excitation, own in zip(excitations, spectra, strict=True) if not own}
    if len(responses or set(excitations)) <= 1 or roving:
        return [""] * len(functions)
    return [
        f"case {case}" if case else f"{node}{AXES[direction] if abs(direction) <= 6 else ''}"
        for case, node, direction in excitations
    ]


def _step_for_directions(functions: Sequence[Function]) -> str:
    """Return the next step for a node and direction that occurs twice."""
    labels = (str(one.get(key, "")).strip() for one in functions for key in ("id1", "id2"))
    in_text = sorted({label for label in labels if _IN_TEXT.search(label)})
    if len(in_text) < 2:
        return "Export one signal of one excitation, or give the runs different references"
    return (
        f"Their directions are in the text alone ({list_some(in_text)}): export them with directions of the "
        "degrees of freedom (record 6), or as a wide table"
    )


def _notices(functions: Sequence[Function], left_out: str, stated: bool, file: str) -> list[Notice]:
    """Report what was left out, spectra, and values without a unit."""
    notices = [Notice("file_read", f"{file}: left out: {left_out}.")] if left_out else []
    if all(one["func_type"] == SPECTRUM for one in functions):
        text = (
            f"{file} holds spectra, no frequency responses: their phases are those of one motion only when "
            "every point was triggered by the excitation."
        )
        notices.append(Notice("spectra_phase", text))
    if not stated and not all(_label(one, "ordinate") for one in functions):
        text = f"{file} names no unit of its values and has no dataset 164: they were taken as SI."
        notices.append(Notice("length_unit_assumed", text))
    return notices
