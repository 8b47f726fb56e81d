"""Read universal files (UFF, UNV): functions 58 and 58b with the geometry of 15 or 2411."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinematics.errors import KinematicsError, raise_all, sentence
from kinematics.notices import Notice, unique
from kinematics.readers.recording import QUANTITIES, Recording, Recordings, scaled, unknown_vector
from kinematics.readers.text import shown
from kinematics.readers.uff_coherence import Coherences, coherences, reference_of
from kinematics.readers.uff_function import (
    COHERENCE,
    FRF,
    KINDS,
    SPECTRUM,
    TIME,
    TRANSMISSIBILITY,
    Function,
    read_function,
)
from kinematics.readers.uff_geometry import Geometry, read_geometry
from kinematics.readers.uff_sets import datasets
from kinematics.readers.unit_labels import MOTIONS, is_none, motion_unit, plain

Array = NDArray[np.float64]
_ORDERS = {8: 0, 11: 1, 12: 2}
_SI = {13: "N", 9: "N", 15: "Pa", 8: "m", 11: "m/s", 12: "m/s2"}
_GEOMETRY = (15, 18, 164, 2411, 2420)
_FREQUENCY = 18
_AXES = "xyz"


@dataclass(frozen=True)
class _Motion:
    """A function that holds motion: derivative order, factor to SI, unit of the reference."""

    function: Function
    order: int
    scale: float
    per: str


def read(path: Path) -> Recordings:
    """Read a universal file.

    Parameters
    ----------
    path : Path

    Raises
    ------
    KinematicsError
        The file is cut short or says what it cannot hold, a measured direction is a rotation, a unit is
        unknown, there is no function of motion over frequency, or one point and direction is there twice.

    Notes
    -----
    The quantity is told by the data characteristic of the ordinate (8 displacement, 11 velocity,
    12 acceleration), the unit by its label, without a label by the length unit of dataset 164; texts such as
    names of channels are not looked at. A reference with a node of its own names the run.
    """
    path = Path(path)
    functions, sets = [], []
    for dataset in datasets(path.read_bytes(), path.name):
        if dataset.number == 58:
            functions.append(read_function(dataset, path.name))
        elif dataset.number in _GEOMETRY:
            sets.append(dataset)
    if not functions:
        step = "Export the spectra or frequency responses as UFF 58"
        raise KinematicsError(
            sentence("a universal file", "one with functions (dataset 58)", "none", path.name, step)
        )
    geometry = read_geometry(sets, path.name, {function.node for function in functions})
    chosen, notices = _chosen(functions, geometry, path.name)
    runs = _runs(chosen)
    known = coherences(functions)
    made = [_recording(motion, geometry, runs, known, path.name) for motion in chosen]
    _check_once(made, chosen)
    made = _repeats(made, chosen)
    notices += geometry.notices
    computed = sum(known.of(motion.function, path.name)[1] for motion in chosen)
    if computed:
        text = (
            f"{path.name}: the coherence of {computed} responses was computed from auto spectra, as for H1."
        )
        notices.append(Notice("coherence_computed", text))
    stated = geometry.length_factor is not None
    units = f"lengths by dataset 164, {geometry.length_factor:g} per metre" if stated else "lengths as metres"
    return Recordings(tuple(made), unique(notices), f"global axes of the file, {units}", length_stated=stated)


def _chosen(
    functions: Sequence[Function], geometry: Geometry, file: str
) -> tuple[list[_Motion], list[Notice]]:
    """Choose the functions to use: responses rather than spectra, one quantity of each channel."""
    usable, faults, left = [], [], Counter[str]()
    for function in functions:
        if function.kind not in (FRF, TRANSMISSIBILITY, SPECTRUM):
            left[function.kind_name] += function.kind != COHERENCE
        elif function.ordinate.kind not in _ORDERS and not _general_motion(function):
            left[f"{function.kind_name} of {function.ordinate.label or 'another quantity'}"] += 1
        elif function.abscissa.kind not in (0, 1, _FREQUENCY):
            left[f"{function.kind_name} over {function.abscissa.label or 'something else'}"] += 1
        elif function.real:
            left[f"{function.kind_name} of real numbers, without phase"] += 1
        else:
            faults += _direction_faults(function, file)
            motion = _motion(function, geometry, file, faults)
            if motion is not None:
                usable.append(motion)
    raise_all(KinematicsError, faults)
    if not usable:
        raise KinematicsError(_nothing(functions, left, file))
    notices = []
    kinds = {motion.function.kind for motion in usable}
    kept = [motion for motion in usable if motion.function.kind != SPECTRUM] or usable
    if len(kept) < len(usable):
        text = f"{file} holds spectra and frequency responses: the responses are used."
        notices.append(Notice("function_chosen", text))
    elif kinds == {SPECTRUM}:
        text = (
            f"{file} holds spectra, no frequency responses: their phases are those of one motion only when "
            "every point was triggered by the excitation."
        )
        notices.append(Notice("spectra_phase", text))
    kept, several = _one_quantity(kept)
    if several:
        text = f"{file} holds {' and '.join(several)} of the same points: {several[0]} is used."
        notices.append(Notice("quantity_chosen", text))
    left = Counter({name: count for name, count in left.items() if count})
    if left:
        listed = ", ".join(f"{count} {name}" for name, count in left.most_common())
        notices.append(Notice("functions_left_out", f"{file}: left out: {listed}."))
    if geometry.length_factor is None and any(is_none(m.function.ordinate.unit) for m in kept):
        text = f"{file} names no unit of its values and has no dataset 164: they were taken as SI."
        notices.append(Notice("unit_assumed", text))
    return kept, notices


def _general_motion(function: Function) -> bool:
    """Tell whether a function of unknown or general type is motion by its unit."""
    ordinate = function.ordinate
    if ordinate.kind not in (0, 1) or is_none(ordinate.unit):
        return False
    return motion_unit(ordinate.unit) is not None


def _nothing(functions: Sequence[Function], left: Mapping[str, int], file: str) -> str:
    """Say what is there instead of motion over frequency."""
    listed = ", ".join(f"{count} {name}" for name, count in left.items() if count) or KINDS[COHERENCE]
    step = "Export complex spectra or frequency responses of velocity or displacement"
    if all(function.kind == TIME for function in functions):
        step = "Export spectra or frequency responses, or the time series as a table with a column time_s"
    expected = "functions of displacement, velocity or acceleration over frequency"
    return sentence("a universal file", f"one with {expected}", listed, file, step)


def _direction_faults(function: Function, file: str) -> list[str]:
    where = f"{file}, dataset {function.place}"
    if abs(function.direction) in (4, 5, 6):
        step = "Vibrometers measure translations: leave this function out of the export"
        got = f"{function.direction}, a rotation"
        expected = "0 (scalar) or +-1, +-2, +-3 (translations)"
        return [sentence(f"the direction at node {function.node}", expected, got, where, step)]
    if abs(function.direction) > 6:
        expected = "0 (scalar) or +-1, +-2, +-3 (translations)"
        return [sentence(f"the direction at node {function.node}", expected, function.direction, where)]
    return []


def _motion(function: Function, geometry: Geometry, file: str, faults: list[str]) -> _Motion | None:
    """Find order, factor to SI and reference of a function of motion."""
    where = f"{file}, dataset {function.place}"
    ordinate, denominator = function.ordinate, function.denominator
    scale = 1.0 / (geometry.length_factor or 1.0)
    order, per = _ORDERS.get(ordinate.kind), ""
    if not is_none(ordinate.unit):
        unit = motion_unit(ordinate.unit)
        if unit is None:
            faults.append(
                sentence(
                    "the unit of the values",
                    f"one of {'; '.join(MOTIONS)} [per unit of a reference]",
                    shown(ordinate.unit),
                    where,
                    "Export the file in SI units",
                )
            )
            return None
        if order is not None and unit.order != order:
            got = f"{QUANTITIES[order]} (type {ordinate.kind}) in {ordinate.unit}"
            step = "Correct the unit in the measuring program, and export again"
            faults.append(sentence("quantity and unit", "those of one motion", got, where, step))
            return None
        order, scale, per = unit.order, unit.scale, unit.per
    if order is None:
        return None
    if function.kind == SPECTRUM:
        return _Motion(function, order, scale, per)
    if not is_none(denominator.unit):
        per = plain(denominator.unit)
    elif not per:
        per = _SI.get(denominator.kind, "unit of the reference")
    return _Motion(function, order, scale, per)


def _one_quantity(motions: list[_Motion]) -> tuple[list[_Motion], list[str]]:
    """Keep one quantity of every channel, velocity first: that is what a vibrometer measures."""
    by_channel: dict[tuple[object, ...], set[int]] = {}
    for motion in motions:
        by_channel.setdefault(_channel(motion.function), set()).add(motion.order)
    several = set[int]().union(*(orders for orders in by_channel.values() if len(orders) > 1))
    if not several:
        return motions, []
    rank = sorted(several, key=lambda order: (order != 1, order))
    best = {channel: next((o for o in rank if o in orders), -1) for channel, orders in by_channel.items()}
    kept = [
        motion
        for motion in motions
        if len(by_channel[_channel(motion.function)]) == 1 or motion.order == best[_channel(motion.function)]
    ]
    return kept, [QUANTITIES[order] for order in rank]


def _channel(function: Function) -> tuple[object, ...]:
    """Return what tells one measurement at a point from another."""
    return (
        function.node,
        function.entity if function.node == 0 else "",
        function.direction,
        *reference_of(function),
        function.load_case,
        function.version,
    )


def _runs(motions: Sequence[_Motion]) -> dict[tuple[int, int, int], str]:
    """Name the runs: by load case, else by node and direction of the reference, when there are several.

    Notes
    -----
    Some exports repeat the node of the response as the reference; that says nothing about the excitation.
    """
    functions = [motion.function for motion in motions]
    own = [f.reference_node == f.node for f in functions]
    nodes = {f.node for f in functions}
    roving = all(own) and len(nodes) > 1
    keys = {_run_key(f, roving) for f in functions}
    if len(keys) == 1:
        return {}
    return {key: _run_name(*key) for key in keys}


def _run_key(function: Function, roving: bool = False) -> tuple[int, int, int]:
    return (function.load_case, 0, 0) if roving else (function.load_case, *reference_of(function))


def _run_name(case: int, node: int, direction: int) -> str:
    if case:
        return f"case {case}"
    sign = "-" if direction < 0 else "+"
    axes = {1: "x", 2: "y", 3: "z", 4: "rx", 5: "ry", 6: "rz"}
    return f"{node}{sign}{axes[abs(direction)]}" if abs(direction) in axes else f"{node}"


def _recording(
    motion: _Motion,
    geometry: Geometry,
    runs: Mapping[tuple[int, int, int], str],
    known: Coherences,
    file: str,
) -> Recording:
    function = motion.function
    where = f"{file}, dataset {function.place}"
    direction = unknown_vector()
    if function.direction:
        axes = geometry.axes.get(function.node, np.eye(3))
        direction = axes[abs(function.direction) - 1] * np.sign(function.direction)
    order = np.argsort(function.x, kind="stable")
    freq = function.x[order]
    if np.any(np.diff(freq) <= 0.0) or np.any(freq < 0.0) or not np.all(np.isfinite(freq)):
        step = "Export it again"
        raise KinematicsError(
            sentence("the frequencies of a function", "different and not negative", "others", where, step)
        )
    name = str(function.node)
    if function.node == 0 and not is_none(function.entity):
        name = function.entity
    coherence, _ = known.of(function, file)
    position = geometry.positions_m.get(function.node)
    run = runs.get(_run_key(function), runs.get(_run_key(function, True), ""))
    return Recording(
        name,
        freq,
        scaled(function.y[order], motion.scale),
        motion.order,
        where,
        run=run,
        position_mm=unknown_vector() if position is None else position * 1e3,
        direction=direction,
        coherence=None if coherence is None else coherence[order],
        per=motion.per,
    )


def _repeats(made: Sequence[Recording], chosen: Sequence[_Motion]) -> list[Recording]:
    """Name repeats by the version number where one channel is there in several."""
    channels = Counter((one.point, one.direction.tobytes(), one.run) for one in made)
    if max(channels.values()) == 1:
        return list(made)
    return [
        replace(one, repeat=str(motion.function.version)) for one, motion in zip(made, chosen, strict=True)
    ]


def _check_once(made: Sequence[Recording], chosen: Sequence[_Motion]) -> None:
    """Refuse two functions of one point, direction and run."""
    seen: dict[tuple[object, ...], str] = {}
    faults = []
    for recording, motion in zip(made, chosen, strict=True):
        key = (recording.point, motion.function.direction, recording.run, motion.function.version)
        if key in seen:
            thing = f"the function of node {recording.point} in direction {motion.function.direction}"
            step = "Export one signal of one excitation, or give the runs different references"
            faults.append(sentence(thing, "there once", "two", f"{seen[key]} and {recording.where}", step))
        seen[key] = recording.where
    raise_all(KinematicsError, faults)
