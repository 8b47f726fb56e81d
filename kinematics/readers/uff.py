"""Read universal files (UFF, UNV) by pyuff: functions 58, 58b with the geometry of 15, 2411, 18, 2420, 164.

The quantity follows from the data characteristic of the ordinate, the unit from its label, without a label
from dataset 164. Texts such as names of channels are localised and are not read.

Source: universal file format of SDRC, as kept by the University of Cincinnati.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from kinematics.readers.in_si import ONE_EXCITATION
from kinematics.readers.recording import Recording, Row, unknown_vector
from kinematics.readers.stated_by_user import FileFacts
from kinematics.readers.text import CUT, shown
from kinematics.readers.uff_geometry import Dataset, nodes_of
from kinematics.readers.units import HERTZ, MotionUnit, is_none, motion_unit, plain
from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, StapeskitError, collect_faults, list_some
from stapeskit.tables import decoded
from stapeskit.warnings import Notice

FRF, TRANSMISSIBILITY, COHERENCE, SPECTRUM = 4, 5, 6, 12
KINDS = {
    1: "time response", 2: "auto spectrum", 3: "cross spectrum", FRF: "frequency response function",
    TRANSMISSIBILITY: "transmissibility", 9: "power spectral density", SPECTRUM: "spectrum",
}  # fmt: skip
"""Function types of dataset 58, for messages."""

ORDERS = {8: 0, 11: 1, 12: 2}
"""Data characteristics of the ordinate: displacement, velocity, acceleration."""

REFERENCES = {13: "N", 9: "N", 15: "Pa", 8: "m", 11: "m/s", 12: "m/s2"}
"""Units of the denominator by its data characteristic."""

_FREQUENCY = (0, 1, 18)  # data characteristics of the abscissa: unknown, general, frequency
_BINARY = re.compile(rb"^ {4}58b[^\n]*\n(?:[^\n]*\n){11}", re.MULTILINE | re.IGNORECASE)
_PADDED_RULE = re.compile(rb"^ {4}-1[ \t]+$", re.MULTILINE)
_FORTRAN_EXPONENT = re.compile(rb"(\d)[Dd]([+-]\d\d)")
_TEXT_AXIS = re.compile(r"(?<![A-Za-z0-9+-])([+-]?)([XYZ])(?![A-Za-z0-9])")
_OWN_FILES = (
    f"{ONE_EXCITATION}; the direction of every function stands in its record 6 (one that stands in its text "
    "alone is not read)"
)


def read(path: Path, facts: FileFacts) -> Recording:  # noqa: ARG001
    """Read a universal file.

    Raises
    ------
    StapeskitError
        There is no function of motion. What else is wrong is with the recording: a file that is cut short, a
        function with fewer values than its header says, functions of several excitations, nodes in coordinate
        systems that are not described as right-handed and cartesian.
    """
    path, notices = Path(path), list[Notice]()
    sets, faults = _datasets(path)
    functions = [one for one in sets if one["type"] == 58 and one["func_type"] != COHERENCE]
    reasons = [_unusable(one) for one in functions]
    usable = [one for one, reason in zip(functions, reasons, strict=True) if not reason]
    left_out = Counter(filter(None, reasons)).most_common()
    listed = ", ".join(f"{count} {name}" for name, count in left_out)
    if not usable and not faults:
        want = "one with functions 58 of displacement, velocity or acceleration over frequency"
        step = "Export complex spectra or frequency responses of velocity or displacement as UFF 58"
        raise StapeskitError.of("a universal file", want, listed or "none", path.name, step)
    factors = _factors(sets, path.name, faults)
    length = factors["m"] if factors else 1.0
    nodes = nodes_of(sets, {int(one["rsp_node"]) for one in usable}, path.name, faults, notices)
    coherences = [one for one in sets if one.get("func_type") == COHERENCE]
    rows: list[Row] = []
    for one in usable:
        with collect_faults(faults):
            place, axes = nodes.get(int(one["rsp_node"]), (unknown_vector(), np.eye(3)))
            rows.append(_row(one, place / length, axes, factors, coherences, path.name))
    notices += _notices(usable, listed, factors, path.name)
    faults += [*_excitation_faults(usable, path.name), *_direction_faults(usable, path.name, notices)]
    lengths = f"by dataset 164, {length:g} per metre" if factors else "as metres"
    return Recording(
        path.name,
        tuple(rows),
        tuple(notices),
        f"global axes of the file, lengths {lengths}",
        length_stated=bool(factors),
        faults=tuple(faults),
    )


def _datasets(path: Path) -> tuple[list[Dataset], list[Fault]]:
    """Return the datasets that pyuff reads, with their places from 1, and what is wrong with the others.

    Latin-1, rules padded with blanks to 80 columns and Fortran's exponents D are rewritten for pyuff.
    """
    import pyuff

    sets, faults, content = list[Dataset](), list[Fault](), path.read_bytes()
    if _BINARY.search(content) is None:
        content = _FORTRAN_EXPONENT.sub(rb"\1E\2", decoded(content).encode())
        content = _PADDED_RULE.sub(b"    -1", content)
    content = _BINARY.sub(lambda head: decoded(head[0]).encode(), content)
    end = content.rstrip(b" \t\r\n\0\x1a")
    if not end.endswith(b" -1"):
        got = shown(end.rsplit(b"\n", 1)[-1][-40:].decode("latin-1")) or "nothing"
        faults.append(Fault("the last line of a universal file", "-1", got, path.name, CUT))
    with TemporaryDirectory() as folder:
        copy = Path(folder) / "plain.uff"
        copy.write_bytes(content)
        file = pyuff.UFF(str(copy))
        for place in range(1, file.get_n_sets() + 1):
            got, whole = "another layout", False
            with suppress(Exception):  # pyuff raises plain exceptions of many kinds
                one = {**file.read_sets(place - 1), "place": place}
                x, y = (np.atleast_1d(one.get(axis, [])) for axis in ("x", "data"))
                got = f"{len(y)} of {one.get('num_pts')} values"
                whole = one["type"] != 58 or (len(y) > 0 and len(x) == len(y) == one["num_pts"])
            if whole:
                sets.append(one)
            else:
                where = Place(path.name, "dataset", (place,))
                faults.append(Fault("a dataset", "whole, as its header says", got, where, CUT))
    return sets, faults


def _unusable(one: Dataset) -> str:
    """Return the kind of a function that is no motion over frequency along a beam; else empty."""
    kind = KINDS.get(one["func_type"], f"function of type {one['func_type']}")
    unit, order = motion_unit(_label(one, "ordinate")), ORDERS.get(one["ordinate_spec_data_type"])
    unnamed = one["ordinate_spec_data_type"] in (0, 1) and unit is not None
    reasons = {
        "": one["func_type"] not in (FRF, TRANSMISSIBILITY, SPECTRUM),
        " of another quantity": order is None and not unnamed,
        " whose unit is that of another quantity": unit is not None and order not in (None, unit.order),
        " of a rotation": abs(one["rsp_dir"]) > 3,
        " over something else": one["abscissa_spec_data_type"] not in _FREQUENCY
        or (_label(one, "abscissa") or "Hz").lower() not in HERTZ,
        " of real numbers, without phase": not np.iscomplexobj(one["data"]),
    }
    return next((f"{kind}{text}" for text, true in reasons.items() if true), "")


def _label(one: Dataset, axis: str) -> str:
    """Return the unit of an axis; empty where none is stated."""
    label = str(one.get(f"{axis}_axis_units_lab", "")).strip()
    return "" if is_none(label) else label


def _factors(sets: Sequence[Dataset], file: str, faults: list[Fault]) -> dict[str, float]:
    """Return by unit the factor from SI to the numbers of the file by dataset 164; empty without one."""
    stated = [one for one in sets if one["type"] == 164]
    lengths = list(dict.fromkeys(float(one["length"]) for one in stated))
    if len(lengths) > 1 or not all(0.0 < length < np.inf for length in lengths):
        thing, got = "the length factor of dataset 164", list_some(f"{length:g}" for length in lengths)
        faults.append(Fault(thing, "positive, and one for the file", got, file, "Export it again in SI"))
    elif stated:
        length, force = lengths[0], float(stated[0]["force"]) or 1.0
        return {**dict.fromkeys(("m", "m/s", "m/s2"), length), "N": force, "Pa": force / length**2}
    return {}


def _coherence(one: Dataset, others: Sequence[Dataset], where: Place) -> Array | None:
    """Return the coherence (L,) of a response, None without one; of several that of its reference.

    Some exports write the node of the response as that of the reference. Several, or one at other lines, are
    refused.
    """
    names = ("rsp_node", "rsp_dir", "load_case_id", "ref_node", "ref_dir")
    key = [abs(one[name]) for name in names]
    keys = [[abs(other[name]) for name in names] for other in others]
    own = [other for other, its in zip(others, keys, strict=True) if its[:3] == key[:3]]
    found = [other for other, its in zip(others, keys, strict=True) if its == key] or own
    lines = [other["x"] for other in found]
    if len(found) > 1 or not all(len(x) == len(one["x"]) and np.allclose(x, one["x"], 1e-5) for x in lines):
        got = list_some(f"{len(x)} lines from {x[0]:g} Hz" for x in lines)
        want = f"one, at the {len(one['x'])} lines of its response"
        raise StapeskitError.of("the coherence", want, got, where, "Export both again")
    return np.real(found[0]["data"]).astype(float) if found else None


def _row(
    one: Dataset,
    position_m: Array,
    axes: Array,
    factors: Mapping[str, float],
    coherences: Sequence[Dataset],
    file: str,
) -> Row:
    """Return a function along one of the axes of its node as a row; SI is the number over the factor."""
    label, response = _label(one, "ordinate"), one["func_type"] != SPECTRUM
    unit = motion_unit(label)
    if not label:
        order = ORDERS.get(one["ordinate_spec_data_type"], 1)
        unit = MotionUnit(order, 1.0 / factors.get("m", 1.0))
    if unit is not None and response and (per := _label(one, "orddenom")):
        unit = replace(unit, per=plain(per))
    elif unit is not None and response and not unit.per:
        per = REFERENCES.get(one["orddenom_spec_data_type"], "unit of the reference")
        unit = replace(unit, per=per, scale=unit.scale * factors.get(per, 1.0))
    node, code, name = int(one["rsp_node"]), int(one["rsp_dir"]), str(one.get("rsp_ent_name", "")).strip()
    where = Place(file, "dataset", (one["place"],))
    return Row(
        name if node == 0 and not is_none(name) else str(node),
        one["x"].astype(float),
        one["data"],
        unit or label,
        position_m=position_m,
        direction=axes[abs(code) - 1] * np.sign(code) if code else unknown_vector(),
        coherence=_coherence(one, coherences, where) if response else None,
        freq_unit=_label(one, "abscissa") or "Hz",
        where=where,
    )


def _excitation_faults(functions: Sequence[Dataset], file: str) -> list[Fault]:
    """Refuse several load cases, or responses to several references: their values are of no one motion.

    Some exports repeat the node of the response as the reference; that says nothing about the excitation.
    """
    responses = [one for one in functions if one["func_type"] != SPECTRUM]
    nodes = {(int(one["rsp_node"]), int(one["ref_node"])) for one in responses}
    roving = len(nodes) > 1 and all(node == reference for node, reference in nodes)
    excitations = {f"load case {one['load_case_id']:.0f}" for one in responses or functions}
    if responses and not roving and excitations == {"load case 0"}:
        excitations = {f"node {one['ref_node']:.0f}, direction {one['ref_dir']:.0f}" for one in responses}
    got = list_some(sorted(excitations), 6)
    several = len(excitations) > 1
    return [Fault("the functions", "of one excitation", got, file, _OWN_FILES)] if several else []


def _direction_faults(functions: Sequence[Dataset], file: str, notices: list[Notice]) -> list[Fault]:
    """Refuse functions of one direction in record 6 and several in their texts; note other differences.

    Some programs number channels and write +z for all of them.
    """
    texts, named = set[str](), list[tuple[Dataset, str]]()
    for one in functions:
        match = _TEXT_AXIS.search(f"{one.get('id1', '')} {one.get('id2', '')}")
        if match and (code := int(one["rsp_dir"])):
            texts.add(match[0])
            alike = "XYZ".index(match[2]) + 1 == abs(code) and match[1] in ("", "+" if code > 0 else "-")
            named += [] if alike else [(one, match[0])]
    if not named:
        return []
    got = list_some(f"{text} where record 6 has {one['rsp_dir']:+.0f}" for one, text in named)
    if len({one["rsp_dir"] for one in functions}) == 1 and len(texts) > 1:
        where = Place(file, "dataset", tuple(one["place"] for one, _ in named))
        want = "those of record 6 (1, 2, 3 for x, y, z)"
        return [Fault("the directions in the texts", want, got, where, _OWN_FILES)]
    notices.append(
        Notice("axes_assumed", f"texts of {file} name other directions: {got}. Record 6 was taken.")
    )
    return []


def _notices(
    functions: Sequence[Dataset], left_out: str, factors: Mapping[str, float], file: str
) -> list[Notice]:
    """Report what was left out, spectra, and units of values that are not stated or stated in two ways."""
    notices = [Notice("file_read", f"{file}: left out: {left_out}.")] if left_out else []
    if functions and all(one["func_type"] == SPECTRUM for one in functions):
        text = (
            f"{file} holds spectra, no frequency responses: their phases are those of one motion only when "
            "every point was triggered by the excitation."
        )
        notices.append(Notice("file_read", text))
    labels = {_label(one, "ordinate") for one in functions}
    if not factors and "" in labels:
        text = f"{file} names no unit of its values and has no dataset 164: they were taken as SI."
        notices.append(Notice("length_unit_assumed", text))
    for label in sorted(labels) if factors else ():
        unit = motion_unit(label)
        ratio = 1.0 if unit is None else 1.0 / (factors["m"] * unit.scale)
        if not np.isclose(ratio, 1.0, rtol=1e-6):
            text = (
                f"{file} has values in {label} by the label of their axis, which was taken; by the length "
                f"factor {factors['m']:g} of its dataset 164 they would be {ratio:g} times as large."
            )
            notices.append(Notice("file_read", text))
    return notices
