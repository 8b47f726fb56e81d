"""From time series to recordings: frequency responses by the excitation, channels by the channel table.

The inputs say which excitation it is: a table of steps or a column ``freq_hz`` means a stepped sine
(kinematics.signals.stepped_sine), a period means periodic excitation (kinematics.signals.frf_periodic), and
everything else is averaged over segments (kinematics.signals.frf).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.options import LOCAL, SeriesOptions
from legacy.kinematics.readers.input_options import is_file
from legacy.kinematics.readers.recording import Recording, Recordings
from legacy.kinematics.readers.series.channel_table import Channel, read_channels
from legacy.kinematics.readers.series.series_files import Series, read_series
from legacy.kinematics.signals.frf import Welch, segment_for, welch_frf
from legacy.kinematics.signals.frf_local import Local, local_frf
from legacy.kinematics.signals.frf_noise import Frf
from legacy.kinematics.signals.frf_periodic import Periodic, periodic_frf
from legacy.kinematics.signals.lock_in import SteppedSine
from legacy.kinematics.signals.sample_faults import sample_notices
from legacy.kinematics.signals.stepped_sine import Step, stepped_amplitudes, stepped_frf, steps_of
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, Place, collect_faults, raise_all
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice, unique

# Share of a step that may lie within another one: times are rounded.
_OVERLAP = 0.01


def read(path: Path, options: SeriesOptions | None = None) -> Recordings:
    """Read the time series of one file as frequency responses.

    Parameters
    ----------
    path : Path
        CSV, NPZ, WAV, MATLAB or HDF5; see kinematics.readers.series.series_files.
    options : SeriesOptions, optional
        Must be given: it names the channel table.

    Raises
    ------
    KinematicsError
        No channel table, a channel that is missing, no or several references, or what the file or the
        estimate says.
    """
    path = Path(path)
    if options is None or options.channels is None:
        step = "Write a table with channel, role, body, point, dir and unit; see points2dof --help"
        raise KinematicsError.of("time series", "read with {channels} FILE", "none", path.name, step)
    rows = [
        channel
        for channel in read_channels(options.channels)
        if not channel.file or is_file(channel.file, path.name)
    ]
    responses = [row for row in rows if row.role == "response"]
    if not responses:
        step = "Add a row, or leave the column file empty"
        raise KinematicsError.of(
            "the channel table", f"with a response of {path.name}", "none", options.channels.name, step
        )
    reference = _reference(rows, options)
    names = [response.name for response in responses] + ([] if reference is None else [reference.name])
    recordings = estimated(read_series(path, names), responses, reference, options)
    if not recordings.recordings:
        raise KinematicsError(empty_band(path.name))
    return recordings


def empty_band(file: str) -> Fault:
    """Return the fault of a ``--frf-band`` without a line in it."""
    step = f"Widen {named('frf_band')}, or record longer"
    return Fault("the band", "wide enough for at least one line", "none", file, step)


def estimated(
    series: Series, responses: Sequence[Channel], reference: Channel | None, options: SeriesOptions
) -> Recordings:
    """Estimate the frequency responses of channels; there may be none within the band.

    Parameters
    ----------
    reference : Channel or None
        None is possible with a stepped sine alone.

    Raises
    ------
    KinematicsError
        Channels of different lengths, no reference, or what the estimate says; of all groups of channels.
    """
    lead = () if reference is None else (reference.name,)
    notices = sample_notices(series.channels, lead, series.file)
    groups, group_notices = _groups(series, responses, reference)
    recordings: list[Recording] = []
    faults: list[Fault] = []
    how = ""
    for group in groups:
        with collect_faults(faults):
            frf, how = _estimate(group, series, options)
            recordings += _recordings(group, frf, reference, series, options)
            notices += list(frf.notices)
    raise_all(KinematicsError, dict.fromkeys(faults))
    return Recordings(
        tuple(recordings),
        unique([*notices, *group_notices]),
        how,
        series.file,
        amplitude_stated=True,
        length_stated=True,
        from_series=True,
    )


def _reference(rows: Sequence[Channel], options: SeriesOptions) -> Channel | None:
    table = "" if options.channels is None else options.channels.name
    references = [channel for channel in rows if channel.role == "reference"]
    if options.reference_channel:
        references = [
            channel for channel in rows if channel.name.lower() == options.reference_channel.lower()
        ]
        if not references:
            known = ", ".join(dict.fromkeys(channel.name for channel in rows))
            raise KinematicsError.of(
                "{reference_channel}", f"one of {known}", options.reference_channel, table
            )
    names = list(dict.fromkeys(channel.name for channel in references))
    if len(names) > 1:
        step = f"Choose one by {named('reference_channel')}, or ignore the others"
        raise KinematicsError.of("the reference", "one channel", ", ".join(names), table, step)
    return references[0] if references else None


@dataclass(frozen=True)
class _Group:
    """Channels recorded together: per record, reference and responses (channel, sample)."""

    channels: tuple[Channel, ...]
    points: tuple[str, ...]
    records: tuple[tuple[Array | None, Array], ...]
    where: str


def _groups(
    series: Series, responses: Sequence[Channel], reference: Channel | None
) -> tuple[list[_Group], list[Notice]]:
    """Return what was recorded together: channels with a point, and each row of channels without one."""
    ref = None if reference is None else series.channels[reference.name]
    scale = 1.0 if reference is None else reference.scale
    faults, groups, notices = [], [], []
    fixed = [channel for channel in responses if channel.point or len(series.channels[channel.name]) == 1]
    rows = [channel for channel in responses if channel not in fixed]
    lengths = {channel.name: len(series.channels[channel.name]) for channel in responses}
    for part in (fixed, rows):
        counts = {lengths[channel.name] for channel in part}
        if len(counts) > 1:
            got = ", ".join(f"{channel.name} {lengths[channel.name]}" for channel in part)
            faults.append(Fault("the channels", "of as many rows (records or points)", got, series.file))
        elif part and ref is not None and len(ref) not in (1, *counts):
            want = f"{counts.pop()} rows, as the responses have"
            faults.append(
                Fault(f"the reference {reference.name if reference else ''}", want, len(ref), series.file)
            )
    raise_all(KinematicsError, faults)

    def row(of: Sequence[Channel], k: int) -> tuple[Array | None, Array]:
        signals = [series.channels[channel.name][k] * channel.scale for channel in of]
        lead = None if ref is None else ref[k if len(ref) > 1 else 0] * scale
        sizes = {len(channel) for channel in (*signals, *([] if lead is None else [lead]))}
        if len(sizes) > 1:
            got = " and ".join(str(size) for size in sorted(sizes))
            step = "Resample channels that were sampled at another rate, or read them in a run of their own"
            raise KinematicsError.of("the channels", "of one number of samples", got, series.file, step)
        return lead, np.array(signals)

    if fixed:
        alive, dead_notices = _drop_silent_channels(series, fixed, 0)
        notices += dead_notices
        records = tuple(row(alive, k) for k in range(lengths[fixed[0].name])) if alive else ()
        if alive:
            points = tuple(channel.point or "1" for channel in alive)
            groups.append(_Group(tuple(alive), points, records, series.file))
    for k in range(lengths[rows[0].name] if rows else 0):
        alive, dead_notices = _drop_silent_channels(series, rows, k)
        notices += dead_notices
        if alive:
            place = f"{series.file}, row {k + 1}"
            groups.append(_Group(tuple(alive), (str(k + 1),) * len(alive), (row(alive, k),), place))
    if not groups:
        step = "Check that the channels were connected"
        raise KinematicsError.of("the responses", "with a signal", "one value in all", series.file, step)
    return groups, notices


def _drop_silent_channels(
    series: Series, channels: Sequence[Channel], k: int
) -> tuple[list[Channel], list[Notice]]:
    """Leave out channels without any signal in a row: missing points are rows of zeros or NaN."""
    alive: list[Channel] = []
    dead: list[Channel] = []
    for channel in channels:
        signal = series.channels[channel.name][k]
        good = bool(np.all(np.isfinite(signal)) and np.any(signal != signal[0]))
        (alive if good else dead).append(channel)
    if not dead:
        return alive, []
    names = ", ".join(channel.name for channel in dead)
    row = f", row {k + 1}" if len(series.channels[dead[0].name]) > 1 else ""
    text = f"{names} of {series.file}{row} holds one value throughout (a missing point) and is left out."
    return alive, [Notice("zero_rows", text)]


def _estimate(group: _Group, series: Series, options: SeriesOptions) -> tuple[Frf, str]:
    rate = series.sample_rate_hz
    if options.steps is not None or series.set_hz:
        steps = _steps(group, series, options)
        how = SteppedSine(settle=options.settle)
        if group.records[0][0] is None:
            return stepped_amplitudes(steps, rate, how, group.where), f"stepped sine, {len(steps)} steps"
        return stepped_frf(steps, rate, how, group.where), f"stepped sine, {len(steps)} steps"
    records = [(lead, signals) for lead, signals in group.records if lead is not None]
    if not records:
        step = "Give a channel the role reference, e.g. the generator or a microphone"
        raise KinematicsError.of("the channel table", "with a reference", "none", group.where, step)
    if options.period_s is not None:
        how_often = Periodic(options.period_s, options.skip_periods)
        return periodic_frf(records, rate, how_often, group.where), f"periodic, {options.period_s:g} s"
    shortest = min(len(lead) for lead, _ in records)
    segment = segment_for(shortest, max(3, -(-options.averages // len(records))), options.overlap)
    if options.resolution_hz is not None:
        segment = round(rate / options.resolution_hz)
    if segment < 8:
        step = f"Ask for fewer {named('averages')} or a coarser {named('resolution')}"
        got = f"{segment} samples of a record of {shortest}"
        raise KinematicsError.of("a segment", "at least 8 samples long", got, group.where, step)
    if options.frf == LOCAL:
        frf = local_frf(records, rate, Local(rate / segment), group.where)
        return frf, f"local polynomials, resolution {frf.freq_hz[1] - frf.freq_hz[0]:.4g} Hz"
    welch = Welch(segment, options.window, options.overlap, options.frf)
    frf = welch_frf(records, rate, welch, group.where)
    text = (
        f"{options.frf.upper()}, window {options.window}, resolution {rate / segment:.4g} Hz, "
        f"{frf.n_avg:.3g} effective averages"
    )
    return frf, text


def _steps(group: _Group, series: Series, options: SeriesOptions) -> list[Step]:
    steps: list[Step] = []
    faults: list[Fault] = []
    table = None if options.steps is None else read_steps(options.steps)
    for number, (lead, signals) in enumerate(group.records):
        first = np.zeros(signals.shape[1]) if lead is None else lead
        if table is None:
            column = series.set_hz[number if len(series.set_hz) > 1 else 0]
            if len(column) != signals.shape[1]:
                want = f"{signals.shape[1]} samples long"
                raise KinematicsError.of("freq_hz", want, len(column), series.file)
            steps += steps_of(column, first, signals, series.file)
            continue
        for row, (start, stop, freq) in enumerate(table, 1):
            a = (start - series.start_s) * series.sample_rate_hz
            b = (stop - series.start_s) * series.sample_rate_hz
            if not (a >= -0.5 and b < signals.shape[1] + 1.5):
                end = series.start_s + signals.shape[1] / series.sample_rate_hz
                want = f"within the record, {series.start_s:g} to {end:g} s"
                place = f"{options.steps.name}, step {row}" if options.steps is not None else ""
                faults.append(Fault("a step", want, f"{start:g} to {stop:g} s", place))
                continue
            steps.append(Step(freq, first[round(a) : round(b)], signals[:, round(a) : round(b)]))
    raise_all(KinematicsError, dict.fromkeys(faults))
    return steps


def read_steps(path: Path) -> list[tuple[float, float, float]]:
    """Read a table of steps: start_s, stop_s, freq_hz.

    Raises
    ------
    KinematicsError
        A column is missing or a cell is no finite number, a step ends before it starts or overlaps another
        one, or a frequency is not positive; all faults are listed.
    """
    from legacy.kinematics.tidy.points_csv import finite_faults, require
    from legacy.stapeskit.tables.csv_table import read_table

    columns = ("start_s", "stop_s", "freq_hz")

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        require(header, columns, file)
        return set(columns), set()

    table = read_table(Path(path), choose)
    faults = [*table.faults, *finite_faults(table, columns)]
    start, stop, freq = (table.numbers[name] for name in columns)
    for row in np.flatnonzero(stop <= start):
        got = f"{start[row]:g} to {stop[row]:g} s"
        faults.append(Fault("stop_s", "later than start_s", got, table.where(int(row))))
    for row in np.flatnonzero(freq <= 0.0):
        faults.append(Fault("freq_hz", "positive", f"{freq[row]:g}", table.where(int(row))))
    order = np.argsort(start, kind="stable")
    for before, after in pairwise(order.tolist()):
        shared = min(stop[before], stop[after]) - start[after]
        if shared > _OVERLAP * min(stop[before] - start[before], stop[after] - start[after]) > 0.0:
            later, earlier = max(before, after), min(before, after)
            got = f"{start[later]:g} to {stop[later]:g} s, within that of line {table.lines[earlier]}"
            step = "Give every stretch of the record once"
            faults.append(Fault("a step", "apart from the others", got, table.where(int(later)), step))
    raise_all(KinematicsError, faults)
    return [(float(a), float(b), float(f)) for a, b, f in zip(start, stop, freq, strict=True)]


def _recordings(
    group: _Group, frf: Frf, reference: Channel | None, series: Series, options: SeriesOptions
) -> list[Recording]:
    low, high = options.frf_band_hz or (0.0, np.inf)
    in_band = (frf.freq_hz >= low) & (frf.freq_hz <= high)
    if not np.any(in_band):
        return []
    return [
        Recording(
            point,
            frf.freq_hz[in_band],
            frf.value[k, in_band],
            channel.order,
            Place(series.file, detail=f"channel {channel.name}"),
            channel.run,
            channel.body,
            channel.position_mm,
            channel.direction,
            frf.sd[k, in_band],
            None if frf.coherence is None else frf.coherence[k, in_band],
            None if np.isnan(frf.n_avg) else frf.n_avg,
            per="" if reference is None else reference.unit,
            common_sd=frf.common_sd[in_band],
            line_spread=frf.line_spread,
        )
        for k, (channel, point) in enumerate(zip(group.channels, group.points, strict=True))
    ]
