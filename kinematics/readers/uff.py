"""Read universal files (UFF, UNV) by pyuff: functions 58, 58b with the geometry of 15, 2411, 18, 2420, 164.

The quantity follows from the data characteristic of the ordinate, the unit from its label, without a label
from dataset 164. Texts such as names of channels are localised and are not read.

Source: universal file format of SDRC, as kept by the University of Cincinnati.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from kinematics.readers.facts import FileFacts
from kinematics.readers.recording import (
    Channel,
    Recording,
    Row,
    best_quantity,
    recording_of,
    scaled,
    unknown_vector,
)
from kinematics.readers.text import CUT, shown
from kinematics.readers.uff_geometry import Geometry, read_geometry
from kinematics.readers.units import MotionUnit, is_none, motion_unit, plain, unit_fault
from stapeskit.faults import Fault, Place, StapeskitError, list_some, raise_all
from stapeskit.warnings import Notice

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

_FREQUENCY = (0, 1, 18)  # data characteristics of the abscissa: unknown, general, frequency
_BINARY = re.compile(rb"^ {4}58b", re.MULTILINE | re.IGNORECASE)
_PADDED_RULE = re.compile(rb"^ {4}-1[ \t]+(\r?)$", re.MULTILINE)
_FORTRAN_EXPONENT = re.compile(rb"(\d)[Dd]([+-]\d\d)")
_IN_TEXT = re.compile(r"(?:^|[\s_])[+-]?[xyz]\b", re.IGNORECASE)
_ROTATION = Fault(
    "the direction of a function",
    "0 (scalar) or +-1, +-2, +-3",
    "a rotation or another number",
    next_step="Vibrometers measure translations: leave rotations out of the export",
)
_CONTRADICTION = Fault(
    "quantity and unit",
    "those of one motion",
    "different ones",
    next_step="Correct the unit in the measuring program",
)


@dataclass(frozen=True)
class Function:
    """A function of motion over frequency: ``data`` are the fields of its dataset, ``scale`` leads to SI."""

    place: int
    data: Mapping[str, Any]
    order: int
    scale: float
    per: str

    @property
    def node(self) -> int:
        """Node of the response."""
        return int(self.data["rsp_node"])

    @property
    def point(self) -> str:
        """Name of the point: the number of its node, or the name of the entity where that is 0."""
        name = str(self.data.get("rsp_ent_name", "")).strip()
        return name if self.node == 0 and not is_none(name) else str(self.node)

    @property
    def excitation(self) -> tuple[int, int, int]:
        """Load case, else node and direction of the reference; zeros where they mean nothing."""
        case = int(self.data["load_case_id"])
        if case or self.data["func_type"] == SPECTRUM:
            return case, 0, 0
        return 0, int(self.data["ref_node"]), int(self.data["ref_dir"])

    @property
    def channel(self) -> tuple[object, ...]:
        """What tells measurements at a point apart."""
        return self.point, self.data["rsp_dir"], self.excitation, self.data["ver_num"]


def read(path: Path, facts: FileFacts) -> Recording:  # noqa: ARG001
    """Read a universal file.

    Raises
    ------
    StapeskitError
        The file is cut short, a function holds fewer values than its header says, a measured direction is a
        rotation, a unit is unknown, there is no function of motion, or one point and direction is there
        twice; all faults of the file together, one a kind.
    """
    path = Path(path)
    sets, faults = _read_sets(path)
    functions = [(place, one) for place, one in sets if one.get("type") == 58]
    geometry = read_geometry(sets, path.name, {int(one["rsp_node"]) for _, one in functions}, faults)
    motions, others = _motions(functions, geometry, path.name, faults)
    raise_all(faults)
    listed = ", ".join(f"{count} {name}" for name, count in others.most_common())
    if not motions:
        want = "one with functions 58 of displacement, velocity or acceleration over frequency"
        step = "Export complex spectra or frequency responses of velocity or displacement as UFF 58"
        raise StapeskitError.of("a universal file", want, listed or "none", path.name, step)
    keep, notices = best_quantity([(one.channel, one.order, one.per) for one in motions], path.name)
    chosen = [one for one, kept in zip(motions, keep, strict=True) if kept]
    if listed:
        notices.append(Notice("content_ignored", f"{path.name}: left out: {listed}."))
    if any(one.data["func_type"] == SPECTRUM for one in chosen):
        text = (
            f"{path.name} holds spectra, no frequency responses: their phases are those of one motion only "
            "when every point was triggered by the excitation."
        )
        notices.append(Notice("spectra_phase", text))
    stated = geometry.length_factor is not None
    if not stated and any(is_none(str(one.data.get("ordinate_axis_units_lab", ""))) for one in chosen):
        text = f"{path.name} names no unit of its values and has no dataset 164: they were taken as SI."
        notices.append(Notice("length_unit_assumed", text))
    raise_all(_repeated(chosen, path.name))
    runs, repeats = _runs(chosen), len({one.data["ver_num"] for one in chosen}) > 1
    coherence = {
        key: one
        for _, one in functions
        if one["func_type"] == COHERENCE
        for key in (_response(one), _response(one)[:3])
    }
    lengths = (
        f"lengths by dataset 164, {geometry.length_factor:g} per metre" if stated else "lengths as metres"
    )
    return recording_of(
        path.name,
        [
            _row(one, geometry, run, repeats, coherence, path.name)
            for one, run in zip(chosen, runs, strict=True)
        ],
        notices=(*notices, *geometry.notices),
        statement=f"global axes of the file, {lengths}",
        length_stated=stated,
    )


def _read_sets(path: Path) -> tuple[list[tuple[int, dict[str, Any]]], list[Fault]]:
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


def _datasets(path: Path, content: bytes, name: str) -> tuple[list[tuple[int, dict[str, Any]]], list[Fault]]:
    """Return the datasets that pyuff reads, and what is wrong with the others."""
    import pyuff

    faults: list[Fault] = []
    whole = content.rstrip(b" \t\r\n\0\x1a")
    if not whole.endswith(b" -1"):
        got = shown(whole.rsplit(b"\n", 1)[-1][-40:].decode("latin-1")) or "nothing"
        faults.append(Fault("the last line of a universal file", "-1", got, name, CUT))
    file = pyuff.UFF(str(path))
    sets: list[tuple[int, dict[str, Any]]] = []
    damaged: list[int] = []
    for place in range(1, file.get_n_sets() + 1):
        try:
            one = file.read_sets(place - 1)
        except Exception:  # pyuff raises plain exceptions of many kinds
            damaged.append(place)
            continue
        if one.get("type") == 58:
            faults += _function_faults(one, place, name)
        sets.append((place, one))
    if damaged:
        where = Place(name, "dataset", tuple(damaged))
        faults.append(Fault("a dataset", "as the format describes it", "another layout", where, CUT))
    return sets, faults


def _function_faults(one: dict[str, Any], place: int, file: str) -> list[Fault]:
    """List what keeps the numbers of a function from being used; descending frequencies are turned round."""
    where = Place(file, "dataset", (place,))
    x, y = np.atleast_1d(one.get("x", [])), np.atleast_1d(one.get("data", []))
    if not len(y) or len(y) != one["num_pts"] or len(x) != len(y):
        want = "as many as its header says"
        return [Fault("the values of a function", want, f"{len(y)} of {one['num_pts']}", where, CUT)]
    if one["func_type"] == 1:
        return []
    order = np.argsort(x, kind="stable")
    one["x"], one["data"] = x[order].astype(float), y[order]
    if not np.all(np.isfinite(x)) or one["x"][0] < 0.0 or np.any(np.diff(one["x"]) <= 0.0):
        want = "different, finite and not negative"
        got = f"{len(np.unique(x))} different ones of {len(x)}, from {np.min(x):g} to {np.max(x):g}"
        return [Fault("the frequencies of a function", want, got, where, "Export it again")]
    return []


def _motions(
    functions: Sequence[tuple[int, Mapping[str, Any]]], geometry: Geometry, file: str, faults: list[Fault]
) -> tuple[list[Function], Counter[str]]:
    """Return the functions of motion over frequency, and count the others by what they are."""
    usable, others = [], Counter[str]()
    problems: dict[Fault, list[int]] = {}
    for place, one in functions:
        kind = KINDS.get(one["func_type"], f"function of type {one['func_type']}")
        ordinate, label = one["ordinate_spec_data_type"], str(one.get("ordinate_axis_units_lab", ""))
        unit = None if is_none(label) else motion_unit(label)
        if one["func_type"] == COHERENCE:
            continue
        reasons = {
            "": one["func_type"] not in (FRF, TRANSMISSIBILITY, SPECTRUM),
            " of another quantity": ordinate not in ORDERS and (ordinate not in (0, 1) or unit is None),
            " over something else": one["abscissa_spec_data_type"] not in _FREQUENCY,
            " of real numbers, without phase": not np.iscomplexobj(one["data"]),
        }
        if any(reasons.values()):
            others[kind + next(text for text, true in reasons.items() if true)] += 1
        elif abs(one["rsp_dir"]) > 3:
            problems.setdefault(_ROTATION, []).append(place)
        elif unit is None and not is_none(label):
            step = "Export the file in SI units, on a linear scale"
            problems.setdefault(unit_fault(shown(label), (), "", step), []).append(place)
        elif unit is not None and ORDERS.get(ordinate, unit.order) != unit.order:
            problems.setdefault(_CONTRADICTION, []).append(place)
        else:
            usable.append(_function(place, one, geometry))
    faults += [
        replace(fault, where=Place(file, "dataset", tuple(places))) for fault, places in problems.items()
    ]
    return usable, others


def _function(place: int, one: Mapping[str, Any], geometry: Geometry) -> Function:
    """Find order, factor to SI and reference of a function of motion."""
    label = str(one.get("ordinate_axis_units_lab", ""))
    unit = None if is_none(label) else motion_unit(label)
    if unit is None:
        order = ORDERS.get(one["ordinate_spec_data_type"], 1)
        unit = MotionUnit(order, 1.0 / (geometry.length_factor or 1.0))
    denominator = str(one.get("orddenom_axis_units_lab", ""))
    per = unit.per
    if one["func_type"] != SPECTRUM and not is_none(denominator):
        per = plain(denominator)
    elif one["func_type"] != SPECTRUM and not per:
        per = REFERENCES.get(one["orddenom_spec_data_type"], "unit of the reference")
    return Function(place, one, unit.order, unit.scale, per)


def _repeated(chosen: Sequence[Function], file: str) -> list[Fault]:
    """Refuse functions of one point, direction, run and version; one sentence for all of them."""
    groups: dict[tuple[object, ...], list[Function]] = {}
    for one in chosen:
        groups.setdefault(one.channel, []).append(one)
    twice = [group for group in groups.values() if len(group) > 1]
    if not twice:
        return []
    step = "Export one signal of one excitation, or give the runs different references"
    labels = (
        str(one.data.get(key, "")).strip() for group in twice for one in group for key in ("id1", "id2")
    )
    in_text = sorted({label for label in labels if _IN_TEXT.search(label)})
    if len(in_text) > 1:
        step = (
            f"Their directions are in the text alone ({list_some(in_text)}): export them with directions "
            "of the degrees of freedom (record 6), or as a wide table"
        )
    listed = list_some((f"{group[0].point} ({group[0].data['rsp_dir']:+d})" for group in twice), 6)
    where = Place(file, "dataset", tuple(one.place for group in twice for one in group))
    got = f"up to {max(map(len, twice))} of them"
    return [Fault(f"the function of nodes and directions {listed}", "there once", got, where, step)]


def _response(one: Mapping[str, Any]) -> tuple[int, ...]:
    """Return what a coherence has in common with its response."""
    return (one["rsp_node"], abs(one["rsp_dir"]), one["load_case_id"], one["ref_node"], one["ref_dir"])


def _runs(chosen: Sequence[Function]) -> list[str]:
    """Return the run of each function: its load case, else its reference, where there are several.

    Some exports repeat the node of the response as the reference; that says nothing about the excitation.
    """
    roving = all(one.excitation[1] == one.node for one in chosen) and len({one.node for one in chosen}) > 1
    if len({one.excitation for one in chosen}) == 1 or roving:
        return [""] * len(chosen)
    axes = ("", "+x", "+y", "+z", "+rx", "+ry", "+rz", "-rz", "-ry", "-rx", "-z", "-y", "-x")
    names = []
    for case, node, direction in (one.excitation for one in chosen):
        beam = axes[direction] if abs(direction) <= 6 else ""
        names.append(f"case {case}" if case else f"{node}{beam}")
    return names


def _row(
    one: Function,
    geometry: Geometry,
    run: str,
    repeats: bool,
    coherences: Mapping[tuple[int, ...], Mapping[str, Any]],
    file: str,
) -> Row:
    """Return a function as a row, with its coherence where the file holds it."""
    data = one.data
    channel = Channel(
        one.point,
        run=run,
        repeat=str(data["ver_num"]) if repeats else "",
        order=one.order,
        per=one.per,
        position_m=geometry.positions_m.get(one.node, unknown_vector()),
        direction=geometry.direction(one.node, int(data["rsp_dir"])),
        where=Place(file, "dataset", (one.place,)),
    )
    coherence, key = None, _response(data)
    match = coherences.get(key, coherences.get(key[:3]))  # of the same reference, else of another
    if match is not None and data["func_type"] != SPECTRUM:
        stated = np.real(match["data"])
        same = len(match["x"]) == len(data["x"]) and np.allclose(match["x"], data["x"])
        if not same or np.any(stated < -1e-6) or np.any(stated > 1.0 + 1e-4):
            want = "within 0 and 1, at the frequencies of its response"
            step = "Export both again, or leave it out"
            raise StapeskitError.of("the coherence", want, "others", channel.where, step)
        coherence = np.clip(stated, 0.0, 1.0)
    return Row(channel, data["x"], scaled(data["data"], one.scale), coherence=coherence)
