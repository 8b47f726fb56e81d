"""Read universal files (UFF, UNV): functions 58 and 58b with the geometry of 15 or 2411."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.options import SeriesOptions
from legacy.kinematics.readers.recording import QUANTITIES, Recording, Recordings, scaled
from legacy.kinematics.readers.uff.coherence import coherences, reference_of
from legacy.kinematics.readers.uff.cross_spectra import from_cross_spectra
from legacy.kinematics.readers.uff.datasets import Dataset, datasets, plain_content
from legacy.kinematics.readers.uff.functions import COHERENCE, KINDS, SPECTRUM, TIME, Function, read_function
from legacy.kinematics.readers.uff.geometry import Geometry, read_geometry
from legacy.kinematics.readers.uff.motion_functions import Motion, direction_label, point_name, usable_motions
from legacy.kinematics.readers.unit_labels import is_none
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, Place, collect_faults, raise_all
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice, unique

# Datasets of nodes, coordinate systems and units.
_GEOMETRY = (15, 18, 164, 2411, 2420)


def read(path: Path, series: SeriesOptions | None = None) -> Recordings:
    """Read a universal file.

    Parameters
    ----------
    series : SeriesOptions, optional
        How time responses are turned into frequency responses. With it, or where a file holds nothing but
        time responses, these are read; else they are left out.

    Raises
    ------
    KinematicsError
        The file is cut short or says what it cannot hold, a measured direction is a rotation, a unit is
        unknown, there is no function of motion, or one point and direction is there twice; all faults of the
        file together.

    Notes
    -----
    The quantity follows from the data characteristic of the ordinate (8 displacement, 11 velocity,
    12 acceleration), the unit by its label, without a label by the length unit of dataset 164; texts such as
    names of channels are not looked at. A reference with a node number names the run.
    """
    path = Path(path)
    faults: list[Fault] = []
    functions: list[Function] = []
    sets: list[Dataset] = []
    for dataset in datasets(plain_content(path.read_bytes()), path.name, faults):
        if dataset.number == 58:
            with collect_faults(faults):
                functions.append(read_function(dataset, path.name))
        elif dataset.number in _GEOMETRY:
            sets.append(dataset)
    if not functions and not faults:
        step = "Export the spectra or frequency responses as UFF 58"
        raise KinematicsError.of(
            "a universal file", "one with functions (dataset 58)", "none", path.name, step
        )
    geometry = Geometry()
    with collect_faults(faults):
        geometry = read_geometry(sets, path.name, {function.node for function in functions})
    own = series if series is not None and series.channels is None else None
    if any(response.kind == TIME for response in functions) and (
        own or all(response.kind == TIME for response in functions)
    ):
        from legacy.kinematics.readers.uff.time_responses import read_responses

        return read_responses(functions, geometry, path.name, own or SeriesOptions(), faults)
    responses, used = from_cross_spectra(functions, path.name, faults)
    functions = [response for response in functions if response.place not in used] + responses
    return _spectra(functions, geometry, path.name, faults)


def _spectra(functions: Sequence[Function], geometry: Geometry, file: str, faults: list[Fault]) -> Recordings:
    """Make recordings of the functions over frequency."""
    usable, others = usable_motions(functions, geometry, file, faults)
    known = coherences(functions)
    coherent: dict[int, tuple[Array | None, bool]] = {}
    for motion in usable:
        with collect_faults(faults):
            coherent[motion.function.place] = known.of(motion.function, file)
    raise_all(KinematicsError, faults)
    if not usable:
        raise KinematicsError(_no_motion_fault(functions, others, file))
    chosen, notices = _choose_functions(usable, others, geometry, file)
    runs = _runs(chosen)
    coherence_of = {motion.function.place: coherent[motion.function.place][0] for motion in chosen}
    recordings = [
        _recording(motion, geometry, runs, coherence_of[motion.function.place], file) for motion in chosen
    ]
    _check_once(recordings, chosen)
    recordings = _repeats(recordings, chosen)
    notices += geometry.notices
    computed = sum(coherent[motion.function.place][1] for motion in chosen)
    if computed:
        text = f"{file}: the coherence of {computed} responses was computed from auto spectra, as for H1."
        notices.append(Notice("coherence_computed", text))
    return Recordings(
        tuple(recordings), unique(notices), geometry.units, length_stated=geometry.length_factor is not None
    )


def _choose_functions(
    usable: list[Motion], others: Counter[str], geometry: Geometry, file: str
) -> tuple[list[Motion], list[Notice]]:
    """Choose the functions to use: responses rather than spectra, one quantity of each channel."""
    notices = []
    kinds = {motion.function.kind for motion in usable}
    chosen = [motion for motion in usable if motion.function.kind != SPECTRUM] or usable
    if len(chosen) < len(usable):
        text = f"{file} holds spectra and frequency responses: the responses are used."
        notices.append(Notice("function_chosen", text))
    elif kinds == {SPECTRUM}:
        text = (
            f"{file} holds spectra, no frequency responses: their phases are those of one motion only when "
            "every point was triggered by the excitation."
        )
        notices.append(Notice("spectra_phase", text))
    chosen, several = _one_quantity(chosen)
    if several:
        text = f"{file} holds {' and '.join(several)} of the same points: {several[0]} is used."
        notices.append(Notice("quantity_chosen", text))
    if others:
        listed = ", ".join(f"{count} {name}" for name, count in others.most_common())
        notices.append(Notice("functions_left_out", f"{file}: left out: {listed}."))
    if geometry.length_factor is None and any(is_none(m.function.ordinate.unit) for m in chosen):
        text = f"{file} names no unit of its values and has no dataset 164: they were taken as SI."
        notices.append(Notice("unit_assumed", text))
    return chosen, notices


def _no_motion_fault(functions: Sequence[Function], others: Mapping[str, int], file: str) -> Fault:
    """Return the fault of a file without motion over frequency, with what it holds instead."""
    listed = ", ".join(f"{count} {name}" for name, count in others.items() if count) or KINDS[COHERENCE]
    step = "Export complex spectra or frequency responses of velocity or displacement"
    if any(function.kind == TIME for function in functions):
        step = f"Export them, or say how its time responses are averaged, e.g. by {named('frf')} h1"
    expected = "functions of displacement, velocity or acceleration over frequency"
    return Fault("a universal file", f"one with {expected}", listed, file, step)


def _one_quantity(motions: list[Motion]) -> tuple[list[Motion], list[str]]:
    """Keep one quantity of every channel, velocity first: that is what a vibrometer measures."""
    by_channel: dict[tuple[object, ...], set[int]] = {}
    for motion in motions:
        by_channel.setdefault(_channel(motion.function), set()).add(motion.order)
    several = set[int]().union(*(orders for orders in by_channel.values() if len(orders) > 1))
    if not several:
        return motions, []
    rank = sorted(several, key=lambda order: (order != 1, order))
    best = {channel: next((o for o in rank if o in orders), -1) for channel, orders in by_channel.items()}
    chosen = [
        motion
        for motion in motions
        if len(by_channel[_channel(motion.function)]) == 1 or motion.order == best[_channel(motion.function)]
    ]
    return chosen, [QUANTITIES[order] for order in rank]


def _channel(function: Function) -> tuple[object, ...]:
    """Return the key that distinguishes measurements at a point."""
    return (
        function.node,
        function.entity if function.node == 0 else "",
        function.direction,
        *reference_of(function),
        function.load_case,
        function.version,
    )


def _runs(motions: Sequence[Motion]) -> dict[tuple[int, int, int], str]:
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
    return {
        (case, node, direction): f"case {case}" if case else direction_label(node, direction)
        for case, node, direction in keys
    }


def _run_key(function: Function, roving: bool = False) -> tuple[int, int, int]:
    return (function.load_case, 0, 0) if roving else (function.load_case, *reference_of(function))


def _recording(
    motion: Motion,
    geometry: Geometry,
    runs: Mapping[tuple[int, int, int], str],
    coherence: Array | None,
    file: str,
) -> Recording:
    function = motion.function
    order = np.argsort(function.x, kind="stable")
    run = runs.get(_run_key(function), runs.get(_run_key(function, True), ""))
    return Recording(
        point_name(function),
        function.x[order],
        scaled(function.y[order], motion.scale),
        motion.order,
        Place(file, "dataset", (function.place,)),
        run=run,
        position_mm=geometry.position_mm(function.node),
        direction=geometry.direction(function.node, function.direction),
        coherence=None if coherence is None else coherence[order],
        per=motion.per,
    )


def _repeats(recordings: Sequence[Recording], chosen: Sequence[Motion]) -> list[Recording]:
    """Use the version number as the repeat where a channel has several versions."""
    channels = Counter(
        (recording.point, recording.direction.tobytes(), recording.run) for recording in recordings
    )
    if max(channels.values()) == 1:
        return list(recordings)
    return [
        replace(recording, repeat=str(motion.function.version))
        for recording, motion in zip(recordings, chosen, strict=True)
    ]


def _check_once(recordings: Sequence[Recording], chosen: Sequence[Motion]) -> None:
    """Refuse two functions of one point, direction and run."""
    where_of: dict[tuple[object, ...], Place | str] = {}
    faults = []
    for recording, motion in zip(recordings, chosen, strict=True):
        key = (recording.point, motion.function.direction, recording.run, motion.function.version)
        if key in where_of:
            thing = f"the function of node {recording.point} in direction {motion.function.direction}"
            step = "Export one signal of one excitation, or give the runs different references"
            faults.append(Fault(thing, "there once", "two", f"{where_of[key]} and {recording.where}", step))
        where_of[key] = recording.where
    raise_all(KinematicsError, faults)
