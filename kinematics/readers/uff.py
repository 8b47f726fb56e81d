"""Read universal files (UFF, UNV) by pyuff: functions 58, 58b with the geometry of 15, 2411, 18, 2420, 164.

The quantity follows from the data characteristic of the ordinate, the unit from its label, without a label
from dataset 164. Texts such as names of channels are localised and are not read.

Source: universal file format of SDRC, as kept by the University of Cincinnati.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from kinematics.readers.facts import FileFacts
from kinematics.readers.recording import (
    QUANTITY_OF_ORDER,
    Channel,
    Recording,
    Row,
    recording_of,
    scaled,
    unknown_vector,
)
from kinematics.readers.text import CUT, shown
from kinematics.readers.uff_geometry import Geometry, read_geometry
from kinematics.readers.units import is_none, motion_unit, plain, unit_fault
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


@dataclass(frozen=True)
class Function:
    """A function of motion over frequency, in SI: ``data`` are the fields of its dataset."""

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
    def reference(self) -> tuple[int, int]:
        """Node and direction of the reference, zeros where they mean nothing."""
        if self.data["func_type"] == SPECTRUM or self.data["load_case_id"]:
            return 0, 0
        return int(self.data["ref_node"]), int(self.data["ref_dir"])

    @property
    def channel(self) -> tuple[object, ...]:
        """What tells measurements at a point apart."""
        return (
            self.point,
            self.data["rsp_dir"],
            self.reference,
            self.data["load_case_id"],
            self.data["ver_num"],
        )


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
    if not functions and not faults:
        want, step = "one with functions (dataset 58)", "Export the spectra or frequency responses as UFF 58"
        raise StapeskitError.of("a universal file", want, "none", path.name, step)
    used = {int(one["rsp_node"]) for _, one in functions}
    geometry = read_geometry(sets, path.name, used, faults)
    motions, others = _motions(functions, geometry, path.name, faults)
    raise_all(faults)
    if not motions:
        listed = ", ".join(f"{count} {name}" for name, count in others.items()) or KINDS[COHERENCE]
        want = "one with functions of displacement, velocity or acceleration over frequency"
        step = "Export complex spectra or frequency responses of velocity or displacement"
        raise StapeskitError.of("a universal file", want, listed, path.name, step)
    chosen, notices = _choose(motions, others, geometry, path.name)
    raise_all(_repeated(chosen, path.name))
    coherence = _coherences(functions)
    runs, versions = _runs(chosen), len({one.data["ver_num"] for one in chosen}) > 1
    rows = [_row(one, geometry, runs, versions, coherence, path.name) for one in chosen]
    stated = geometry.length_factor is not None
    lengths = (
        f"lengths by dataset 164, {geometry.length_factor:g} per metre" if stated else "lengths as metres"
    )
    return recording_of(
        path.name,
        rows,
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
    rotations, units, contradictions = list[int](), dict[str, list[int]](), list[int]()
    for place, one in functions:
        kind = KINDS.get(one["func_type"], f"function of type {one['func_type']}")
        ordinate, label = one["ordinate_spec_data_type"], str(one.get("ordinate_axis_units_lab", ""))
        unit = None if is_none(label) else motion_unit(label)
        if one["func_type"] not in (FRF, TRANSMISSIBILITY, SPECTRUM):
            others[kind] += one["func_type"] != COHERENCE
        elif ordinate not in ORDERS and (ordinate not in (0, 1) or unit is None):
            others[f"{kind} of {str(one.get('ordinate_axis_lab', '')).strip() or 'another quantity'}"] += 1
        elif one["abscissa_spec_data_type"] not in _FREQUENCY:
            others[f"{kind} over {str(one.get('abscissa_axis_lab', '')).strip() or 'something else'}"] += 1
        elif not np.iscomplexobj(one["data"]):
            others[f"{kind} of real numbers, without phase"] += 1
        elif abs(one["rsp_dir"]) > 3:
            rotations.append(place)
        elif unit is None and not is_none(label):
            units.setdefault(label, []).append(place)
        elif unit is not None and ORDERS.get(ordinate, unit.order) != unit.order:
            contradictions.append(place)
        else:
            usable.append(_function(place, one, geometry))
    if rotations:
        want, step = (
            "0 (scalar) or +-1, +-2, +-3",
            "Vibrometers measure translations: leave rotations out of the export",
        )
        where = Place(file, "dataset", tuple(rotations))
        faults.append(Fault("the direction of a function", want, "a rotation or another number", where, step))
    for label, places in units.items():
        step = "Export the file in SI units, on a linear scale"
        faults.append(unit_fault(shown(label), (), Place(file, "dataset", tuple(places)), step))
    if contradictions:
        where, step = (
            Place(file, "dataset", tuple(contradictions)),
            "Correct the unit in the measuring program",
        )
        faults.append(Fault("quantity and unit", "those of one motion", "different ones", where, step))
    return usable, Counter({name: count for name, count in others.items() if count})


def _function(place: int, one: Mapping[str, Any], geometry: Geometry) -> Function:
    """Find order, factor to SI and reference of a function of motion."""
    label = str(one.get("ordinate_axis_units_lab", ""))
    order, scale, per = (
        ORDERS.get(one["ordinate_spec_data_type"], 1),
        1.0 / (geometry.length_factor or 1.0),
        "",
    )
    unit = None if is_none(label) else motion_unit(label)
    if unit is not None:
        order, scale, per = unit.order, unit.scale, unit.per
    if one["func_type"] == SPECTRUM:
        return Function(place, one, order, scale, per)
    denominator = str(one.get("orddenom_axis_units_lab", ""))
    if not is_none(denominator):
        per = plain(denominator)
    elif not per:
        per = REFERENCES.get(one["orddenom_spec_data_type"], "unit of the reference")
    return Function(place, one, order, scale, per)


def _choose(
    motions: list[Function], others: Counter[str], geometry: Geometry, file: str
) -> tuple[list[Function], list[Notice]]:
    """Choose responses rather than spectra, and one quantity of each channel, velocity first."""
    notices = []
    chosen = [one for one in motions if one.data["func_type"] != SPECTRUM] or motions
    if len(chosen) < len(motions):
        text = f"{file} holds spectra and frequency responses: the responses are used."
        notices.append(Notice("quantity_chosen", text))
    elif chosen[0].data["func_type"] == SPECTRUM:
        text = (
            f"{file} holds spectra, no frequency responses: their phases are those of one motion only when "
            "every point was triggered by the excitation."
        )
        notices.append(Notice("spectra_phase", text))
    rank = {1: 0, 0: 1, 2: 2}
    best: dict[tuple[object, ...], int] = {}
    for one in chosen:
        best[one.channel] = min(best.get(one.channel, one.order), one.order, key=rank.__getitem__)
    dropped = {one.order for one in chosen if one.order != best[one.channel]}
    chosen = [one for one in chosen if one.order == best[one.channel]]
    if dropped:
        left = " and ".join(QUANTITY_OF_ORDER[order] for order in sorted(dropped))
        used = " and ".join(QUANTITY_OF_ORDER[order] for order in sorted({one.order for one in chosen}))
        notices.append(
            Notice("quantity_chosen", f"{file} holds {used} and {left} of the same points: {used} is used.")
        )
    if others:
        listed = ", ".join(f"{count} {name}" for name, count in others.most_common())
        notices.append(Notice("content_ignored", f"{file}: left out: {listed}."))
    silent = any(is_none(str(one.data.get("ordinate_axis_units_lab", ""))) for one in chosen)
    if geometry.length_factor is None and silent:
        text = f"{file} names no unit of its values and has no dataset 164: they were taken as SI."
        notices.append(Notice("length_unit_assumed", text))
    return chosen, notices


def _repeated(chosen: Sequence[Function], file: str) -> list[Fault]:
    """Refuse functions of one point, direction, run and version; one sentence for all of them."""
    groups: dict[tuple[object, ...], list[Function]] = {}
    for one in chosen:
        groups.setdefault(one.channel, []).append(one)
    twice = [group for group in groups.values() if len(group) > 1]
    if not twice:
        return []
    step = "Export one signal of one excitation, or give the runs different references"
    texts = [
        str(one.data.get(name, "")).strip() for group in twice for one in group for name in ("id1", "id2")
    ]
    in_text = sorted({text for text in texts if _IN_TEXT.search(text)})
    if len(in_text) > 1:
        step = (
            f"Their directions stand in the text alone ({list_some(in_text)}): export them with directions "
            "of the degrees of freedom (record 6), or as a wide table"
        )
    listed = list_some((f"{group[0].point} ({group[0].data['rsp_dir']:+d})" for group in twice), 6)
    where = Place(file, "dataset", tuple(one.place for group in twice for one in group))
    got = f"up to {max(map(len, twice))} of them"
    return [Fault(f"the function of nodes and directions {listed}", "there once", got, where, step)]


def _coherences(
    functions: Sequence[tuple[int, Mapping[str, Any]]],
) -> dict[tuple[object, ...], Mapping[str, Any]]:
    """Return coherence functions by point, direction and load case, with and without their reference."""
    found: dict[tuple[object, ...], Mapping[str, Any]] = {}
    for _, one in functions:
        if one["func_type"] == COHERENCE:
            key = (one["rsp_node"], abs(one["rsp_dir"]), one["load_case_id"])
            found[(*key, one["ref_node"], one["ref_dir"])] = one
            found.setdefault(key, one)
    return found


def _runs(chosen: Sequence[Function]) -> dict[int, str]:
    """Return the run of each function: its load case, else its reference, where there are several.

    Some exports repeat the node of the response as the reference; that says nothing about the excitation.
    """
    roving = all(one.reference[0] == one.node for one in chosen) and len({one.node for one in chosen}) > 1
    keys = {one.place: (one.data["load_case_id"], *((0, 0) if roving else one.reference)) for one in chosen}
    if len(set(keys.values())) == 1:
        return {}
    axes = {1: "x", 2: "y", 3: "z", 4: "rx", 5: "ry", 6: "rz"}
    names = {}
    for place, (case, node, direction) in keys.items():
        beam = f"{'-' if direction < 0 else '+'}{axes[abs(direction)]}" if abs(direction) in axes else ""
        names[place] = f"case {case}" if case else f"{node}{beam}"
    return names


def _row(
    one: Function,
    geometry: Geometry,
    runs: Mapping[int, str],
    versions: bool,
    coherences: Mapping[tuple[object, ...], Mapping[str, Any]],
    file: str,
) -> Row:
    data = one.data
    channel = Channel(
        one.point,
        run=runs.get(one.place, ""),
        repeat=str(data["ver_num"]) if versions else "",
        order=one.order,
        per=one.per,
        position_m=geometry.positions_m.get(one.node, unknown_vector()),
        direction=geometry.direction(one.node, int(data["rsp_dir"])),
        where=Place(file, "dataset", (one.place,)),
    )
    key = (data["rsp_node"], abs(data["rsp_dir"]), data["load_case_id"])
    match = coherences.get((*key, data["ref_node"], data["ref_dir"]), coherences.get(key))
    coherence = None
    if match is not None and data["func_type"] != SPECTRUM:
        same = len(match["x"]) == len(data["x"]) and np.allclose(match["x"], data["x"])
        stated = np.real(match["data"])
        if not same or np.any(stated < -1e-6) or np.any(stated > 1.0 + 1e-4):
            want, step = (
                "within 0 and 1, at the frequencies of its response",
                "Export both again, or leave it out",
            )
            raise StapeskitError.of("the coherence", want, "others", channel.where, step)
        coherence = np.clip(stated, 0.0, 1.0)
    return Row(channel, data["x"], scaled(data["data"], one.scale), coherence=coherence)
