"""Time responses in a universal file: records of responses and of their reference, as time series."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.options import SeriesOptions
from legacy.kinematics.readers.recording import Recording, Recordings, unknown_vector
from legacy.kinematics.readers.series.channel_table import Channel
from legacy.kinematics.readers.series.frequency_responses import empty_band, estimated
from legacy.kinematics.readers.series.series_files import Series, check_finite, sampling_rate
from legacy.kinematics.readers.uff.functions import TIME, Function
from legacy.kinematics.readers.uff.geometry import Geometry
from legacy.kinematics.readers.uff.motion_functions import (
    REFERENCES,
    direction_faults,
    direction_label,
    is_motion,
    motion_of,
    point_name,
)
from legacy.kinematics.readers.unit_labels import is_none, plain
from legacy.stapeskit.faults import Fault, collect_faults, list_some, raise_all
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice, unique

# Specific data type of the abscissa (dataset 58, record 8).
_TIME = 17
_SECONDS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6}
_SI = ("m", "m/s", "m/s2")
# Channels that a message lists.
_MOST_NAMED = 12


@dataclass(frozen=True)
class _Signal:
    """The records of one node and direction in one run, in order, with their quantity."""

    channel: Channel
    records: tuple[Function, ...]


def read_responses(
    functions: Sequence[Function],
    geometry: Geometry,
    file: str,
    options: SeriesOptions,
    faults: list[Fault],
) -> Recordings:
    """Estimate frequency responses from the time responses of a file.

    Parameters
    ----------
    faults : list of str
        Faults of the file that are known already; they are reported with those found here.

    Raises
    ------
    KinematicsError
        No reference or several that could be it, an unknown unit, records of different lengths or rates,
        or what the estimate says; all faults together.

    Notes
    -----
    The reference is the one that is named, else the node and direction that the responses name as their
    reference, else the only signal that is no motion. Load cases are runs. Signals of one load case were
    recorded together; several records of them are paired in the order of their version numbers. A reference
    that was recorded again for each group of responses belongs to the responses behind it, or before it
    where the file begins with responses.
    """
    times = [function for function in functions if function.kind == TIME and not _is_unusable(function)]
    other_count = len(functions) - len(times)
    recordings: list[Recording] = []
    notices: list[Notice] = []
    how = ""
    name: str | None = None
    with collect_faults(faults):
        name = _reference(times, file, options)
    for case in dict.fromkeys(time.load_case for time in times):
        runs = len({time.load_case for time in times}) > 1
        own = [time for time in times if time.load_case == case]
        signals = _signals(own, geometry, file, name or "", f"case {case}" if runs else "", faults)
        if name is None:
            continue
        for part in _parts(signals, name, file, faults):
            with collect_faults(faults):
                records = _part(part, name, file, options)
                recordings += records.recordings
                notices += records.notices
                how = records.frame_units
    raise_all(KinematicsError, dict.fromkeys(faults))
    if not recordings:
        raise KinematicsError(empty_band(file))
    if other_count:
        text = f"{file}: left out: {other_count} functions that are no time responses."
        notices.append(Notice("functions_left_out", text))
    notices += geometry.notices
    units = f"{geometry.units}; {how}" + (f", reference {name}" if name else "")
    stated = geometry.length_factor is not None
    return Recordings(
        tuple(recordings), unique(notices), units, file, True, length_stated=stated, from_series=True
    )


def _is_unusable(function: Function) -> bool:
    """Return whether a time response is over something else than time, or complex."""
    return function.abscissa.kind not in (0, 1, _TIME) or not function.real


def _label(function: Function) -> str:
    name = direction_label(function.node, function.direction)
    return name if function.node or is_none(function.entity) else function.entity


def _reference(times: Sequence[Function], file: str, options: SeriesOptions) -> str:
    """Return the name of the signal that all responses refer to; empty when a stepped sine needs none."""
    labels = list(dict.fromkeys(_label(function) for function in times))
    shown = list_some(labels, _MOST_NAMED)
    if options.reference_channel:
        wanted = options.reference_channel.strip().lower()
        fitting = [
            _label(function)
            for function in times
            if wanted in (name.lower() for name in (_label(function), *function.names))
        ]
        fitting += (
            [_label(function) for function in times if wanted == str(function.node)] if not fitting else []
        )
        matches = list(dict.fromkeys(fitting))
        if len(matches) != 1:
            got = options.reference_channel + (f", which is {' and '.join(matches)}" if matches else "")
            raise KinematicsError.of("{reference_channel}", f"one of {shown}", got, file)
        return matches[0]
    stated = {
        direction_label(function.reference_node, function.reference_direction)
        for function in times
        if function.reference_node
        and (function.reference_node, function.reference_direction) != (function.node, function.direction)
    }
    matches = [name for name in labels if name in stated]
    if len(matches) != 1:
        matches = list(dict.fromkeys(_label(function) for function in times if not is_motion(function)))
    if len(matches) == 1 or (not matches and options.steps is not None):
        return matches[0] if matches else ""
    step = f"Name it by {named('reference_channel')}, as node and direction"
    got = " and ".join(matches[:_MOST_NAMED]) if matches else f"none among {shown}"
    raise KinematicsError.of("the reference of the time responses", "one signal", got, file, step)


def _signals(
    times: Sequence[Function], geometry: Geometry, file: str, name: str, run: str, faults: list[Fault]
) -> list[_Signal]:
    """Sort the records of one load case by signal."""
    by_label: dict[str, list[Function]] = {}
    for function in times:
        by_label.setdefault(_label(function), []).append(function)
    signals = []
    for label, records in by_label.items():
        if label != name and not is_motion(records[0]):
            continue
        errors: list[Fault] = []
        channels = [_channel(record, geometry, file, label == name, run, errors) for record in records]
        if not errors and len({(channel.scale, channel.unit) for channel in channels}) > 1:
            got = ", ".join(dict.fromkeys(channel.unit for channel in channels))
            errors.append(Fault(f"the records of {label}", "in one unit", got, file, "Export it again"))
        faults += errors
        if not errors:
            ordered = sorted(records, key=lambda function: (function.version, function.place))
            signals.append(_Signal(channels[0], tuple(ordered)))
    return signals


def _channel(
    function: Function, geometry: Geometry, file: str, leads: bool, run: str, faults: list[Fault]
) -> Channel:
    """Describe one record as a row of a table of channels."""
    where = f"{file}, dataset {function.place}"
    scale, order, unit = 1.0, -1, plain(function.ordinate.unit)
    if is_motion(function):
        motion = motion_of(function, geometry, file, faults)
        if motion is not None:
            scale, order, unit = motion.scale, motion.order, _SI[motion.order]
            unit += f"/{motion.per}" if motion.per else ""
    elif is_none(function.ordinate.unit):
        unit = REFERENCES.get(function.ordinate.kind, "unit of the reference")
    if not leads:
        faults += direction_faults(function, file)
    return Channel(
        _label(function),
        "reference" if leads else "response",
        "",
        point_name(function),
        run,
        "",
        unknown_vector() if leads else geometry.direction(function.node, function.direction),
        geometry.position_mm(function.node),
        scale,
        order,
        unit,
        where,
    )


def _parts(signals: Sequence[_Signal], name: str, file: str, faults: list[Fault]) -> list[list[_Signal]]:
    """Return what was recorded together: responses and their reference, with as many records each."""
    responses = [signal for signal in signals if signal.channel.name != name]
    lead = next((signal for signal in signals if signal.channel.name == name), None)
    if not responses:
        if not faults:
            step = "Export the records of the points too"
            faults.append(
                Fault("time responses", "of one motion in addition to the reference", "none", file, step)
            )
        return []
    counts = {len(response.records) for response in responses}
    if lead is None or counts == {len(lead.records)}:
        return [[*responses, *([] if lead is None else [lead])]]
    if counts == {1}:
        return _assign_responses(responses, lead, file, faults)
    known = ", ".join(
        f"{signal.channel.name} {len(signal.records)}" for signal in [lead, *responses][:_MOST_NAMED]
    )
    step = "Export every record of the reference once"
    faults.append(Fault("the time responses", "of as many records as their reference", known, file, step))
    return []


def _assign_responses(
    responses: Sequence[_Signal], lead: _Signal, file: str, faults: list[Fault]
) -> list[list[_Signal]]:
    """Assign to each record of the reference the responses that follow, or precede, it in the file."""
    by_place: Mapping[int, _Signal] = {response.records[0].place: response for response in responses}
    leads = sorted(lead.records, key=lambda record: record.place)
    behind = leads[0].place < min(by_place)
    parts = []
    for k, record in enumerate(leads):
        if behind:
            low, high = record.place, leads[k + 1].place if k + 1 < len(leads) else np.inf
        else:
            low, high = leads[k - 1].place if k else 0, record.place
        inner = [signal for place, signal in by_place.items() if low < place < high]
        if inner:
            parts.append([*inner, replace(lead, records=(record,))])
    if len(parts) == len(leads) and sum(len(part) - 1 for part in parts) == len(responses):
        return parts
    got = f"{len(leads)} of {lead.channel.name} for {len(responses)} responses, not in turn"
    step = "Export the reference with each group of responses, or once"
    faults.append(Fault("the records of the reference", "one for each group of responses", got, file, step))
    return []


def _part(signals: Sequence[_Signal], name: str, file: str, options: SeriesOptions) -> Recordings:
    """Estimate the responses of signals recorded together."""
    rates: dict[float, str] = {}
    faults: list[Fault] = []
    for signal in signals:
        for response in signal.records:
            with collect_faults(faults):
                rates.setdefault(_rate(response, file), f"dataset {response.place}")
    raise_all(KinematicsError, faults)
    if max(rates) > min(rates) * (1.0 + 1e-6):
        got = " and ".join(f"{rate:g} Hz ({place})" for rate, place in list(rates.items())[:4])
        raise KinematicsError.of("the sampling rate", "one in all records", got, file)
    first = signals[0].records[0]
    samples = {signal.channel.name: tuple(record.y.real for record in signal.records) for signal in signals}
    check_finite(samples, file)
    series = Series(file, max(rates), float(first.x[0] * _SECONDS[_time_unit(first)]), samples)
    lead = next((signal.channel for signal in signals if signal.channel.name == name), None)
    if lead is None and options.steps is None:
        step = f"Name the reference by {named('reference_channel')}"
        raise KinematicsError.of("the time signals", "with their reference", "none", file, step)
    return estimated(
        series, [signal.channel for signal in signals if signal.channel.name != name], lead, options
    )


def _time_unit(function: Function) -> str:
    label = plain(function.abscissa.unit).lower()
    return "s" if is_none(label) else label


def _rate(function: Function, file: str) -> float:
    where = f"{file}, dataset {function.place}"
    unit = _time_unit(function)
    if unit not in _SECONDS:
        want = f"one of {', '.join(_SECONDS)}"
        raise KinematicsError.of("the unit of time", want, function.abscissa.unit, where, "Export it again")
    return sampling_rate(function.x * _SECONDS[unit], where)
